"""The runs that a study plans, compared with those that exist."""

import json
import os
import subprocess
from collections.abc import Iterable, Sequence
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedSeq

from pipelines.specs.document import choices
from pipelines.specs.identity import combined, modules
from pipelines.specs.safe_names import folded
from pipelines.specs.search import Search
from pipelines.specs.study import IMPORTS, RunSpec, Study, changes
from pipelines.tracking.tracker import Card, Recorded, StudyCard
from pipelines.workspace.errors import InputError
from pipelines.workspace.provenance import Host
from reports.data.escaping import code, markdown, prose

LISTED = 25  # arms that a description names: MLflow keeps 8,000 characters of one
RESULTS = (":(top,exclude)dvc.lock", ":(top,exclude,glob)results/**")  # of the pipeline, as git's pathspecs
PATIENCE = 10.0  # seconds for git to answer
KIND = "algo.kind"  # which is what the param `method` says


class Item(NamedTuple):
    """A planned run with what a log needs to know of it."""

    card: Card
    spec: RunSpec
    study: str

    @property
    def name(self) -> str:
        """The name for people."""
        return f"{self.study} / {self.card.arm} s{self.card.seed}"

    @property
    def key(self) -> str:
        """Names the training: spec id and fingerprint."""
        return self.card.key


def items(study: Study, commit: str = "", where: Host | None = None) -> list[Item]:
    """The runs of a study under the code here, in its order. commit, where: of what is about to start them."""
    runs = study.runs()
    varying = what_varies([run.spec for run in runs])
    planned = []
    for run in runs:
        spec, flat = run.spec, flat_settings(run.spec)
        algorithm, task = spec.algo.kind, spec.env.kind
        params = {"method": algorithm} | {name: str(flat[name]) for name in varying if name in flat and name != KIND}
        params |= {"seed": str(spec.seed)}
        code = modules(algorithm, task, spec.imports)
        names = (run.arm, spec.seed, spec.id, combined(code.values()), algorithm, task, commit)
        env = spec.env.model_dump(mode="json")
        card = Card(*names, params, host=where or Host(), modules=code, env=env)
        planned.append(Item(card, spec, study.name))
    return planned


def chosen(study: Study, arms: Sequence[str] = (), seeds: Sequence[int] = ()) -> list[Item]:
    """The planned runs of these arms and seeds, of all where none are named; for commands with `--arm` and `--seed`.

    Raises:
        InputError: there is no such arm.
    """
    faults = [f"--arm: '{arm}' is not allowed; {choices(arm, study.arms)}" for arm in arms if arm not in study.arms]
    if faults:
        raise InputError(*faults)
    plan = items(study)
    return [i for i in plan if (not arms or i.card.arm in arms) and (not seeds or i.card.seed in seeds)]


def given_twice(studies: Sequence[Study | Search]) -> list[str]:
    """Studies or searches of one name, which would have one experiment and one table."""
    named: dict[str, list[Study | Search]] = {}
    for study in studies:
        named.setdefault(folded(study.name), []).append(study)
    twice = [same for same in named.values() if len(same) > 1]
    return [
        f"{same[0].name}: given {len(same)} times{_files(same)}; {_kind(same)} that go together need names of their own"
        for same in twice
    ]


def _kind(studies: Sequence[Study | Search]) -> str:
    return "studies" if isinstance(studies[0], Study) else "searches"


def _files(studies: Sequence[Study | Search]) -> str:
    files = dict.fromkeys(study.file for study in studies)
    return f" ({', '.join(files)})" if len(files) > 1 else ""


def flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one with dotted names."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            flat |= flatten(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


def flat_settings(spec: RunSpec) -> dict[str, Any]:
    """The settings of a run by dotted name; what it imports follows from them."""
    return flatten(spec.model_dump(mode="json", exclude={IMPORTS}))


def what_varies(specs: Iterable[RunSpec]) -> list[str]:
    """The dotted names whose value is not the same in all specs that have them."""
    flats = [flat_settings(spec) for spec in specs]
    names = {name: None for flat in flats for name in flat}
    return [name for name in names if len({json.dumps(flat[name]) for flat in flats if name in flat}) > 1]


def study_card(study: Study) -> StudyCard:
    """The study as its experiment shows it."""
    runs = study.runs()
    arms = list(dict.fromkeys(run.arm for run in runs))
    seeds = sorted({run.spec.seed for run in runs})
    steps = sorted({run.spec.trainer.steps for run in runs})
    budget = ", ".join(f"{count:,}" for count in steps)
    note = (
        f"{prose(study.question)}\n\n"
        f"Profile `{study.profile}`: {len(arms)} arms × {len(seeds)} seeds, {budget} environment steps each.\n\n"
        + "\n".join([*(f"- **{markdown(arm)}**: {_differs(study, arm)}" for arm in arms[:LISTED]), *more(arms)])
    )
    return StudyCard(study.name, study.profile, note, _varying([run.spec for run in runs]), arms)


def _varying(specs: Sequence[RunSpec]) -> dict[str, list[str]]:
    """The settings that vary between runs, as far as the runs of each method have it."""
    names = [name for name in what_varies(specs) if name != KIND]
    flats = {spec.algo.kind: flat_settings(spec) for spec in specs}
    return {method: [name for name in names if name in flat] for method, flat in flats.items()}


def more(arms: Sequence[str]) -> list[str]:
    """The line of a description that stands for the arms that are not listed, if any."""
    return [f"\n{len(arms) - LISTED:,} more arms are not listed here."] if len(arms) > LISTED else []


def _differs(study: Study, arm: str) -> str:
    """The changes of an arm in the base, as code."""
    found = changes(study.base, study.arms[arm])
    return ", ".join(code(f"{name}={value}") for name, value in found.items()) or "the base"


def finished(recorded: Iterable[Recorded]) -> set[tuple[str, str]]:
    """(arm, key) of the runs that need nothing more."""
    return {(run.arm, run.key) for run in recorded if run.status == "finished"}


def resolved_yaml(item: Item, study: StudyCard) -> str:
    """The full configuration of a run, defaults written out."""
    head = {"study": study.study, "profile": study.profile, "arm": item.card.arm}
    names = {"spec_id": item.card.spec_id, "fingerprint": item.card.fingerprint, "commit": item.card.commit}
    out = StringIO()
    YAML().dump(head | names | _lists_on_a_line(item.spec.model_dump(mode="json")), out)
    return out.getvalue()


def _lists_on_a_line(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {name: _lists_on_a_line(value) for name, value in tree.items()}
    if not isinstance(tree, list):
        return tree
    line = CommentedSeq(tree)
    line.fa.set_flow_style()
    return line


class Commit(NamedTuple):
    """The code's commit, with `-dirty` where files differ from it; `unknown` where it cannot be read, and why."""

    name: str
    why: str = ""


def commit(where: Path = Path(__file__).parent) -> str:
    """The name that `read_commit` finds."""
    return read_commit(where).name


def read_commit(where: Path = Path(__file__).parent) -> Commit:
    """The commit of the code.

    Results are not looked at: `dvc repro` writes its lock and the report's tables after every stage.

    Args:
        where: a folder of the repository.
    """
    try:
        name = _git(where, "rev-parse", "HEAD")
        changed = _git(where, "status", "--porcelain", "--untracked-files=no", "--", ":/", *RESULTS)
    except FileNotFoundError:
        return Commit("unknown", "git is not installed")
    except subprocess.TimeoutExpired as error:
        return Commit("unknown", f"git did not answer within {error.timeout:.0f} s in {where}")
    except subprocess.CalledProcessError as error:
        return Commit("unknown", _said(error.stderr, where))
    except OSError as error:
        return Commit("unknown", f"git cannot be run: {error.strerror}")
    return Commit(f"{name}-dirty" if changed else name)


def _said(words: str, where: Path) -> str:
    """The message of git, and the remedy, on one line."""
    lines = [line.strip() for line in words.splitlines() if line.strip()]
    remedy = [line for line in lines if line.startswith("git config ")]
    text = f"git in {where}: {lines[0].removeprefix('fatal: ')}" if lines else f"git failed in {where}"
    return text + (f"; {remedy[0]} lets you read it" if remedy else "")


def _git(where: Path, *words: str) -> str:
    elsewhere = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE")  # set inside git's own hooks, for another repository
    environment = {name: value for name, value in os.environ.items() if name not in elsewhere} | {"LC_ALL": "C"}
    done = subprocess.run(
        ["git", *words], cwd=where, env=environment, capture_output=True, encoding="utf-8", errors="replace",
        timeout=PATIENCE, check=True,
    )  # fmt: skip
    return done.stdout.strip()
