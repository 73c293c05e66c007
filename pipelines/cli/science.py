"""Verbs that describe the code: Theorem 1, the methods, the fingerprint; and the report from what was exported.

DVC's stages begin with `rhmc profile` or `rhmc fingerprint`: these say which stage it is.
"""

import inspect
import json
import os
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from pipelines.cli.common import Profile, folder_option, profile_faults, say, table, tell
from pipelines.specs.limits import EPISODES, SEED
from pipelines.specs.safe_names import PROFILES, fault_of_study, simple, study_name
from pipelines.workspace.errors import InputError, visible_lines
from pipelines.workspace.exit_codes import Exit
from pipelines.workspace.files import fault_of, regular

if TYPE_CHECKING:
    from pydantic import BaseModel

    from rhmc.types import Spec

Entry = TypeVar("Entry")
PIPELINE, STAGE = Path("dvc.yaml"), "DVC_STAGE"  # DVC names the stage to its commands in this variable
REPORTED = {"whole": Exit.DONE, "undrawn": Exit.UNFINISHED, "refused": Exit.BAD}


def theorem(
    instances: Annotated[
        int, typer.Option(min=1, max=EPISODES, help="Random instances per size and density.")
    ] = 20_000,
    seed: Annotated[int, typer.Option(min=0, max=SEED)] = 0,
    alpha: Annotated[float, typer.Option(min=0, max=1, help="The penalty of Eq. 6.")] = 0.1,
    out: Annotated[Path | None, typer.Option(help="Also write theorem.parquet in this folder.")] = None,
) -> None:
    """Put Theorem 1 to the test: Algorithm 1 against the optimum, and the smallest instances where it fails."""
    from pipelines.export.theorem import export_theorem
    from rhmc.hierarchy.theorem import shortfall_table, summary

    with folder_option(out):
        found = shortfall_table(instances, seed, alpha=alpha)
        print(summary(found, alpha))
        if out is not None:
            tell(f"wrote {export_theorem(found, seed, out)}")


def _methods(incomplete: str) -> list[str]:
    from rhmc.algorithms import ALGORITHMS

    return [kind for kind in ALGORITHMS if kind.startswith(incomplete)]


def _tasks(incomplete: str) -> list[str]:
    from rhmc.envs import ENVS

    return [kind for kind in ENVS if kind.startswith(incomplete)]


def methods(
    kind: Annotated[
        str | None, typer.Argument(autocompletion=_methods, help="Show the settings of this method instead.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Also write methods.json in this folder.")] = None,
) -> None:
    """Say what every method is (Table 1), with the parameters of the networks that it builds; or one's settings."""
    from pipelines.export.methods import describe, export_methods
    from pipelines.specs.plugins import discover
    from rhmc.algorithms import ALGORITHMS

    discover()
    if kind is not None:
        if out is not None:
            raise InputError("--out: belongs to the table of all methods; leave the method out")
        method = _entry(ALGORITHMS, kind, "method")
        say(f"{method.about.name}: {method.about.source}; {method.about.family}, {method.about.coordination}")
        from pipelines.specs.include import tuned
        from rhmc.envs import ENVS

        _settings(method.config, {f"tuned, {task}": tuned("algo", task, kind) for task in ENVS})
        return
    with folder_option(out):
        found = describe()
        rows = [
            [m["name"], m["source"], m["family"], m["training"], m["execution"], ", ".join(m["actions"])]
            + [f"{size['acting']:,} of {size['all']:,}" for size in m["parameters"]]
            for m in found
        ]
        counted = [f"{size['task']['kind']}, {size['encoder']}" for size in found[0]["parameters"]]
        table(["method", "source", "family", "training", "execution", "actions", *counted], rows, numbers=counted)
        if out is not None:
            tell(f"wrote {export_methods(out)}")


def tasks(
    kind: Annotated[str | None, typer.Argument(autocompletion=_tasks, help="Show the settings of this task.")] = None,
) -> None:
    """Say which tasks there are, with the sizes of their defaults; or one's settings."""
    from pipelines.specs.plugins import discover
    from rhmc.envs import ENVS

    discover()
    if kind is not None:
        config = _entry(ENVS, kind, "task").config
        say(f"{kind}: {_summary(config)}")
        from pipelines.specs.include import tuned

        _settings(config, {"tuned": tuned("env", kind)})
        return
    sizes = {name: task.physics.spec(task.config()) for name, task in ENVS.items()}
    rows = [
        [name, _summary(ENVS[name].config), *map(str, (s.agents, s.targets, s.episode)), _actions(s)]
        for name, s in sizes.items()
    ]
    table(["task", "what", "agents", "targets", "steps", "actions"], rows, numbers=["agents", "targets", "steps"])


def _entry(entries: Mapping[str, Entry], kind: str, what: str) -> Entry:
    from pipelines.specs.document import choices, show

    if kind not in entries:
        raise InputError(f"{show(kind)} is no {what}; {choices(kind, entries)}")
    return entries[kind]


def _settings(config: "type[BaseModel]", tuned: Mapping[str, Mapping[str, object]]) -> None:
    """Every setting, with what `preset: tuned` has instead of its default; a column for each task that has any."""
    from pipelines.specs.document import show
    from pipelines.specs.fields import described
    from pipelines.tracking.plan import flatten

    found = {name: flatten(dict(values)) for name, values in tuned.items() if values}
    rows = []
    for one in described(config):
        values = [str(show(each[one.name])).strip("'") if one.name in each else "" for each in found.values()]
        others = ["" if value == one.default else value for value in values]
        rows.append([one.name, one.allowed, one.default, *others, one.meaning])
    table(["setting", "allowed", "default", *found, "meaning"], rows)


def _summary(config: "type[BaseModel]") -> str:
    """First line of the page of a task."""
    return (inspect.getdoc(sys.modules[config.__module__]) or "").partition("\n")[0].rstrip(".")


def _actions(spec: "Spec") -> str:
    return f"{spec.actions} numbers in [-1, 1]" if spec.continuous else f"one of {spec.actions}"


def fingerprint(file: Annotated[Path | None, typer.Argument(help="Write it there, if it differs.")] = None) -> None:
    """Name the code that decides results: the same after editing a comment, another after editing behaviour."""
    from pipelines.specs.identity import fingerprint as of_code

    _tell_stage()
    text = of_code() + "\n"
    if file is None:
        print(text, end="")
        return
    try:
        if not file.exists() or regular(file).read_bytes() != text.encode():
            file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{file}: cannot be written ({error.strerror})") from error


def profile(
    file: Annotated[Path, typer.Argument(help="Where it stands, as `profile: quick`.")] = Path("params.yaml"),
) -> None:
    """Print the profile that the pipeline runs on, or say why there is none: its name goes into paths and commands."""
    from pipelines.specs.document import choices, read, show

    _tell_stage()
    root, faults = read(file)
    written = root.children.get("profile") if root else None
    if faults:
        raise InputError(*map(str, faults))
    if written is None:
        raise InputError(f"{file}: profile: missing; {choices('', PROFILES)}")
    if written.value not in PROFILES:
        raise InputError(f"{written.place}: profile: {show(written.value)} is not allowed; {choices('', PROFILES)}")
    say(str(written.value))


def _tell_stage() -> None:
    """Say on stderr which stage of the pipeline this process belongs to, if it does to one."""
    from pipelines.specs.document import read

    if not (name := os.environ.get(STAGE)) or not PIPELINE.is_file():
        return
    root, _ = read(PIPELINE)
    stages = list(root.children["stages"].children) if root and "stages" in root.children else []
    if name in stages:
        tell(f"stage {stages.index(name) + 1} of {len(stages)}: {name}")


def verdicts(
    profile: Profile = "quick",
    out: Annotated[Path | None, typer.Option(help="Folder of the report; results/<profile> if not given.")] = None,
) -> None:
    """Count the verdicts of a report, and print the address of its page."""
    if faults := profile_faults(profile):
        raise InputError(*faults)
    folder = out or Path("results") / profile
    claims = folder / "claims.json"
    if fault := fault_of(claims):
        raise InputError(f"{claims}: {fault}; `rhmc report` writes it")
    try:
        found = Counter(str(claim["verdict"]) for claim in json.loads(claims.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{claims}: not the claims of a report; `rhmc report` writes them") from error
    counts = ", ".join(f"{count} {verdict}" for verdict, count in found.items())
    say(f"Verdicts:  {sum(found.values())} claims: {counts or 'none'}")
    say(f"Report:    {(folder / 'index.html').absolute().as_uri()}")


def drawings(
    out: Annotated[Path, typer.Option(help="Folder; made if it is not there.")] = Path("results/quick/runs"),
) -> None:
    """Write what Figures 1 to 5 and 8 show: RHMC's networks as they run, and states of both tasks."""
    from pipelines.export.drawings import export_drawings

    with folder_option(out):
        for file in export_drawings(out):
            tell(f"wrote {file}")


def report(
    profile: Profile = "quick",
    study: Annotated[Path | None, typer.Option(metavar="FILE", help="Report on this study or search alone.")] = None,
    variant: Annotated[str | None, typer.Option(help="Variant of that study.")] = None,
    runs: Annotated[Path | None, typer.Option(help="Exported tables; results/<profile>/runs if not given.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder; results/<profile>, with study/<name> after it for one study, if not given."),
    ] = None,
) -> None:
    """Build figures, tables, claims and their page from the exported tables; or curves and comparison of one study."""
    if faults := profile_faults(profile):
        raise InputError(*faults)
    if study is not None and (fault := fault_of(study)):
        raise InputError(f"--study: {study}: {fault}; a study such as studies/ablation.yaml")
    if variant is not None and study is None:
        raise InputError("--variant: belongs to a study; give --study as well")
    if study is not None and (fault := fault_of_study(study_name(study))):
        raise InputError(f"--study: {study}: {fault}")
    if variant is not None and not simple(variant):
        raise InputError(f"--variant: {variant!r} is not allowed; letters, digits, '-' and '_' only")
    from reports.pages.build import write_report

    name = study_name(study, variant or "") if study else None
    raise typer.Exit(REPORTED[write_report(runs, out, profile, name, visible_lines)])
