"""The command `rhmc`. Everything heavy is imported by the verb that needs it, so that help answers at once.

Exit codes: 0 done, 1 some run failed, 2 bad input (nothing was started), 130 interrupted.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.errors import InputError

if TYPE_CHECKING:
    from pipelines.study import Study

DONE, BAD = 0, 2
WIDTH = 140  # columns of a table that is not shown on a terminal
HOST = "127.0.0.1"

SET_HELP = (
    "Change the study: KEY=VALUE, KEY a dotted path of its file, VALUE read as YAML (seeds=1, steps=1e5, "
    "base.algo.lr=1e-3, arms.full.env.agents=6). env., algo. and trainer. stand for base.env., base.algo. and "
    "base.trainer., and trainer.steps for steps. Merged as an arm is into the base. It goes before what a profile "
    "changes; an arm keeps what it states itself. Can be given several times."
)
File = Annotated[Path, typer.Argument(metavar="FILE", help="A study, such as studies/ablation.yaml.")]
Profile = Annotated[str, typer.Option(help="The budget: quick or paper.")]
Sets = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help=SET_HELP)]

app = typer.Typer(
    help="Reproduce a multi-agent coordination paper: run studies, score yardsticks, build the report.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
study_app = typer.Typer(help="Check, run and follow studies.", no_args_is_help=True)
yardsticks_app = typer.Typer(help="Score scripted policies and bounds.", no_args_is_help=True)
app.add_typer(study_app, name="study")
app.add_typer(yardsticks_app, name="yardsticks")


def main() -> None:
    """Entry point: what a user can mend is one message on stderr and exit code 2."""
    try:
        app(prog_name="rhmc")
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(BAD)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # the reader of our output has gone, as in `rhmc study list | head -1`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(DONE)


# Studies


@study_app.command("check")
def check(file: File, profile: Profile = "quick", overrides: Sets = None) -> None:
    """Say what a study would run, or everything that is wrong with it. Starts nothing."""
    from pipelines.study import changes

    study = _study(file, profile, overrides)
    rows = []
    for arm, setting in study.arms.items():
        differs = ", ".join(f"{key}={value}" for key, value in changes(study.base, setting).items()) or "the base"
        rows.append([arm, differs, str(study.seeds), f"{study.steps:,}", str(setting.trainer.num_envs)])
    _say(f"{study.name} ({study.profile}): {study.question}")
    _table(["arm", "differs in", "seeds", "steps", "copies"], rows, numbers=("seeds", "steps", "copies"))
    runs = len(study.arms) * study.seeds
    _say(f"{runs} runs, {runs * study.steps:,} environment steps in all, {study.resources.concurrent} runs at a time")


@study_app.command("run")
def run(file: File, profile: Profile = "quick", overrides: Sets = None) -> None:
    """Run what a study still lacks. Finished runs are skipped, interrupted ones continue."""
    study = _study(file, profile, overrides)
    from pipelines.run import run_study
    from pipelines.store import work_folder

    raise typer.Exit(run_study(study, work_folder()))


@study_app.command("status")
def status(file: File, profile: Profile = "quick", overrides: Sets = None) -> None:
    """Say how many runs are finished, under way, missing or stale (made by other code). Exit code 1 if any is left."""
    study = _study(file, profile, overrides)
    from pipelines.run import show_status
    from pipelines.store import work_folder

    raise typer.Exit(show_status(study, work_folder()))


@study_app.command("list")
def list_(folder: Annotated[Path, typer.Option(help="Where the studies are.")] = Path("studies")) -> None:
    """List the studies of a folder with their questions."""
    from pipelines.document import read

    files = sorted(folder.glob("*.yaml"))
    if not files:
        raise InputError(f"{folder}: no studies (*.yaml) here")
    rows = []
    for file in files:
        root, faults = read(file)
        question = root.children.get("question") if root else None
        rows.append([str(file), str(question.value) if question else str(faults[0]) if faults else "no question"])
    _table(["study", "question"], rows)


@app.command("export")
def export(
    file: File,
    profile: Profile = "quick",
    out: Annotated[Path | None, typer.Option(help="Folder; reports/<profile>/runs if not given.")] = None,
    overrides: Sets = None,
) -> None:
    """Write a study's results as one tidy table and a table of its runs."""
    study = _study(file, profile, overrides)
    from pipelines.export import export_study

    raise typer.Exit(export_study(study, out or _runs_folder(profile)))


def _study(file: Path, profile: str, overrides: Sequence[str] | None) -> "Study":
    from pipelines.study import Study

    return Study.load(file, profile, overrides or [])


def _runs_folder(profile: str) -> Path:
    return Path("reports") / profile / "runs"


# Yardsticks

Episodes = Annotated[int, typer.Option(min=2, help="Episodes of the bank.")]
Policies = Annotated[str | None, typer.Option(help="Names with commas between; all but the planner if not given.")]
Seed = Annotated[int, typer.Option(min=0, help="Names the bank of episodes.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on stdout instead of a table.")]
Out = Annotated[Path | None, typer.Option(help="Also write yardsticks.parquet there, beside the runs' tables.")]
OutProfile = Annotated[str, typer.Option("--profile", help="The profile that --out is for.")]


@yardsticks_app.command("coverage")
def coverage(
    preset: Annotated[str, typer.Option(help="flat, executor or coordinator.")] = "flat",
    agents: Annotated[int, typer.Option(help="Sensors.")] = 4,
    targets: Annotated[int, typer.Option(help="Targets.")] = 5,
    episodes: Episodes = 1000,
    policies: Policies = None,
    seed: Seed = 0,
    as_json: Json = False,
    out: Out = None,
    profile: OutProfile = "quick",
) -> None:
    """Coverage: the share of targets in view, its standard error and the mean reward, in percent."""
    bank = {"episodes": episodes, "seed": seed}
    _yardsticks(
        "coverage", {"preset": preset, "agents": agents, "targets": targets}, policies, bank, as_json, out, profile
    )


@yardsticks_app.command("navigation")
def navigation(
    agents: Annotated[int, typer.Option(help="Agents, and as many landmarks.")] = 3,
    reward: Annotated[str, typer.Option(help="paper, mpe2 or mpe1.")] = "paper",
    order: Annotated[str, typer.Option(help="Order of integration: mpe2 or mpe1.")] = "mpe2",
    episodes: Episodes = 1000,
    policies: Policies = None,
    seed: Seed = 0,
    as_json: Json = False,
    out: Out = None,
    profile: OutProfile = "quick",
) -> None:
    """Navigation: the return and its standard error, landmarks covered at the end, collisions."""
    bank = {"episodes": episodes, "seed": seed}
    _yardsticks(
        "navigation", {"agents": agents, "reward": reward, "order": order}, policies, bank, as_json, out, profile
    )


def _yardsticks(
    kind: str,
    fields: dict[str, Any],
    policies: str | None,
    bank: dict[str, int],
    as_json: bool,
    out: Path | None,
    profile: str,
) -> None:
    import torch

    from pipelines.document import choices
    from pipelines.study import PROFILES
    from rhmc.yardsticks import names, yardsticks

    env = _env(kind, fields)
    chosen = None if policies is None else [name.strip() for name in policies.split(",")]
    faults = [
        f"--policies: '{n}' is not allowed; {choices(n, names(kind))}" for n in chosen or [] if n not in names(kind)
    ]
    if profile not in PROFILES:
        faults.append(f"--profile: '{profile}' is not allowed; {choices(profile, PROFILES)}")
    if out is not None and out.exists() and not out.is_dir():
        faults.append(f"--out: {out} is not a folder")
    if faults:
        raise InputError("\n".join(faults))
    torch.set_num_threads(1)
    scores = yardsticks(env, chosen, **bank)
    if out is not None:
        _export(env, scores, bank, profile, out)
    if as_json:
        print(json.dumps(scores))
        return
    columns = list(dict.fromkeys(key for score in scores.values() for key in score))
    rows = [[name, *(f"{score[key]:.2f}" if key in score else "" for key in columns)] for name, score in scores.items()]
    _table(["policy", *columns], rows, numbers=columns)


def _export(env: Any, scores: Any, bank: dict[str, int], profile: str, out: Path) -> None:
    from pipelines.store import StoreError
    from pipelines.yardsticks import export_yardsticks

    try:
        written = export_yardsticks(env, scores, **bank, profile=profile, out=out)
    except StoreError as error:
        raise InputError(str(error)) from error
    print(f"wrote {written}", file=sys.stderr)


def _env(kind: str, fields: dict[str, Any]) -> Any:
    """The task that options describe, their faults named as options."""
    from pipelines.document import Node, Place, validate
    from rhmc.envs import ENVS

    def node(value: Any, name: str) -> Node:
        return Node(value, Place(f"--{name}"), Place(f"--{name}"), "")

    cfg, faults = validate(ENVS[kind][0], node({name: node(value, name) for name, value in fields.items()}, kind))
    if cfg is None:
        raise InputError("\n".join(str(fault) for fault in faults))
    return cfg


# The rest


@app.command("theorem")
def theorem(
    instances: Annotated[int, typer.Option(min=1, help="Random instances per size and density.")] = 20_000,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    alpha: Annotated[float, typer.Option(min=0, max=1, help="The penalty of Eq. 6.")] = 0.1,
    out: Annotated[Path | None, typer.Option(help="Also write theorem.parquet in this folder.")] = None,
) -> None:
    """Put Theorem 1 to the test: Algorithm 1 against the optimum, and the smallest instances where it fails."""
    from pipelines.store import StoreError
    from pipelines.theorem import export_theorem
    from rhmc.theorem import shortfall_table, summary

    if out is not None and out.exists() and not out.is_dir():
        raise InputError(f"--out: {out} is not a folder")
    table = shortfall_table(instances, seed, alpha=alpha)
    print(summary(table, alpha))
    try:
        if out is not None:
            print(f"wrote {export_theorem(table, seed, out)}", file=sys.stderr)
    except StoreError as error:
        raise InputError(str(error)) from error


@app.command("methods")
def methods(
    out: Annotated[Path | None, typer.Option(help="Also write methods.json in this folder.")] = None,
) -> None:
    """Say what every method is (Table 1), with the parameters of the networks that it builds."""
    from pipelines.methods import describe, export_methods
    from pipelines.store import StoreError

    found = describe()
    rows = [
        [m["name"], m["source"], m["family"], m["training"], m["execution"], ", ".join(m["actions"])]
        + [f"{size['acting']:,} of {size['all']:,}" for size in m["parameters"]]
        for m in found
    ]
    counted = [f"{size['task']['kind']}, {size['encoder']}" for size in found[0]["parameters"]]
    _table(["method", "source", "family", "training", "execution", "actions", *counted], rows, numbers=counted)
    try:
        if out is not None:
            print(f"wrote {export_methods(out)}", file=sys.stderr)
    except StoreError as error:
        raise InputError(str(error)) from error


@app.command("drawings")
def drawings(
    out: Annotated[Path, typer.Option(help="Folder; made if it is not there.")] = Path("reports/quick/runs"),
) -> None:
    """Write what Figures 1 to 5 and 8 show: RHMC's networks as they run, and states of both tasks."""
    from pipelines.drawings import export_drawings
    from pipelines.store import StoreError

    try:
        for file in export_drawings(out):
            print(f"wrote {file}", file=sys.stderr)
    except StoreError as error:
        raise InputError(str(error)) from error


@app.command("fingerprint")
def fingerprint(file: Annotated[Path | None, typer.Argument(help="Write it there, if it differs.")] = None) -> None:
    """Name the code that decides results: the same after editing a comment, another after editing behaviour."""
    from pipelines.fingerprint import fingerprint as of_code

    text = of_code() + "\n"
    if file is None:
        print(text, end="")
        return
    try:
        if not file.exists() or file.read_text() != text:
            file.write_text(text)
    except OSError as error:
        raise InputError(f"{file}: cannot be written ({error.strerror})") from error


@app.command("report")
def report(
    profile: Profile = "quick",
    study: Annotated[Path | None, typer.Option(metavar="FILE", help="Report on this study alone.")] = None,
    variant: Annotated[str | None, typer.Option(help="Of that study.")] = None,
    runs: Annotated[Path | None, typer.Option(help="Exported tables; reports/<profile>/runs if not given.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder; reports/<profile>[/study/<name>] if not given.")] = None,
) -> None:
    """Build figures, tables, claims and their page from the exported tables; or curves and comparison of one study."""
    if study is not None and not study.is_file():
        raise InputError(f"--study: {study} is not a file; a study such as studies/ablation.yaml")
    if variant is not None and study is None:
        raise InputError("--variant: belongs to a study; give --study as well")
    from reports.build import main as build

    arguments = ["--profile", profile]
    arguments += ["--study", f"{study.stem}@{variant}" if variant else study.stem] if study else []
    arguments += ["--runs", str(runs)] if runs else []
    arguments += ["--out", str(out)] if out else []
    raise typer.Exit(build(arguments))


@app.command("ui")
def ui(port: Annotated[int, typer.Option(min=1, max=65535, help="Where to listen on this machine.")] = 5000) -> None:
    """Show the logged runs in the browser: MLflow on this machine only, until Ctrl-C."""
    from pipelines.store import Home, StoreError, work_folder

    uri = os.environ.get("MLFLOW_TRACKING_URI")
    if uri and uri.startswith(("http://", "https://")):
        print(f"{uri.rstrip('/')}/#/experiments?workflowType=machine_learning")
        return
    home = Home(work_folder())
    if not uri and not home.database.exists():
        raise InputError(f"{home.database}: nothing is logged yet; `rhmc study run FILE` does it")
    from pipelines.mlflow_tracker import charts
    from pipelines.mlflow_tracker import check as check_store

    try:
        check_store(uri or f"sqlite:///{home.database}")
        curves = charts(uri or f"sqlite:///{home.database}", f"http://{HOST}:{port}")
    except StoreError as error:
        raise InputError(str(error)) from error
    _free(port)
    _serve(uri or f"sqlite:///{home.database}", home.artifacts, port, curves)


def _free(port: int) -> None:
    import socket

    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise InputError(f"--port: {port} cannot be used ({error.strerror}); choose another") from error


def _serve(uri: str, artifacts: Path, port: int, curves: Iterable[tuple[str, str]]) -> None:
    command = [
        sys.executable,
        "-m",
        "mlflow",
        "server",
        "--backend-store-uri",
        uri,
        "--host",
        HOST,
        "--port",
        str(port),
    ]
    command += ["--workers", "1", "--artifacts-destination", str(artifacts)]
    quiet = {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "true"}
    _say(f"http://{HOST}:{port}/#/experiments?workflowType=machine_learning  (Ctrl-C ends it)")
    for name, address in curves:
        _say(f"  curves of {name}, to be grouped by the tag `variant`: {address}")
    server = subprocess.Popen(command, env=os.environ | quiet)
    try:
        code = server.wait()
    except KeyboardInterrupt:  # the server got it as well
        server.wait()
        return
    raise typer.Exit(1 if code else DONE)


# Printing


def _say(text: str) -> None:
    print(text, flush=True)


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[str] = ()) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE)
    for column in columns:
        table.add_column(column, justify="right" if column in numbers else "left", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    Console(width=None if sys.stdout.isatty() else WIDTH).print(table)


if __name__ == "__main__":
    main()
