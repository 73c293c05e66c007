"""Scores of the yardsticks as tables of the form that runs are exported in."""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from pipelines.export.tables import read_parquet, write_parquet
from pipelines.specs.identity import fingerprint
from pipelines.tracking.plan import commit
from pipelines.workspace.process_pool import side_by_side
from pipelines.workspace.provenance import host
from reports.data.schema import MADE, METRICS, RUNS
from rhmc.envs import EnvConfig
from rhmc.envs.coverage import Config as Coverage
from rhmc.envs.navigation import Config as Navigation
from rhmc.yardsticks import offered
from rhmc.yardsticks.scores import SLOW, names, play_yardsticks

STUDY = "yardsticks"
QUESTION = "What do policies without learning, and bounds, reach?"

# What the report uses: the studies' tasks, and coverage with other numbers, one changed at a time.
TASKS: tuple[EnvConfig, ...] = (
    Coverage(agents=4, targets=5),
    *(Coverage(agents=n, targets=5) for n in (2, 3, 5, 6)),
    *(Coverage(agents=4, targets=m) for m in (3, 4, 6, 7)),
    Coverage(preset="coordinator", agents=4, targets=5),
    Navigation(agents=3, reward="paper"),
    Navigation(agents=3, reward="mpe1"),
)
SEED = 0  # of every yardstick's episodes

Scores = Mapping[str, Mapping[str, float]]
Row = dict[str, Any]


class Episodes(NamedTuple):
    """Of a evaluation."""

    most: int
    slow: int  # of `SLOW` policies


# Those of quick are a check that all of it works: their intervals are about twice as wide.
EPISODES = {"quick": Episodes(300, 60), "paper": Episodes(1000, 300)}


class Evaluation(NamedTuple):
    """Policies that play the same episodes of a task."""

    env: EnvConfig
    policies: tuple[str, ...]
    episodes: int
    seed: int = SEED


class Scored(NamedTuple):
    """Yardsticks in their episodes and the scores, as `rhmc.yardsticks.scores.play_yardsticks` gives it."""

    evaluation: Evaluation
    scores: Scores


def evaluations(profile: str) -> list[Evaluation]:
    """The evaluations that a profile's report uses, the slowest first, so that none of them begins late."""
    found = []
    for env in TASKS:
        slow = tuple(name for name in names(env.kind) if name in SLOW)
        most = tuple(name for name in names(env.kind) if name not in SLOW)
        counts = EPISODES[profile]
        found += [Evaluation(env, slow, counts.slow)] if slow else []
        found += [Evaluation(env, most, counts.most)]
    return sorted(found, key=_quickness)


def _quickness(evaluation: Evaluation) -> tuple[bool, bool, int]:
    """As measured: episodes of the coordinator preset take ten times as long, and then it is the planner."""
    env = evaluation.env
    size = env.agents * getattr(env, "targets", env.agents)
    return getattr(env, "preset", "") != "coordinator", not set(evaluation.policies) & set(SLOW), -size


def evaluate_all(wanted: Sequence[Evaluation], jobs: int) -> Iterator[Scored]:
    """Play evaluations, `jobs` at a time, each in a process of its own; what comes out does not depend on it.

    Raises:
        StoreError: one of the processes was killed.
    """
    for evaluation, scores in zip(wanted, side_by_side(_play, wanted, jobs), strict=True):
        yield Scored(evaluation, scores)


def _play(evaluation: Evaluation) -> Scores:
    return play_yardsticks(*evaluation)


class Tables(NamedTuple):
    """The rows of the files."""

    values: list[Row]
    runs: list[Row]
    made: list[Row]


def present(out: Path) -> Tables:
    """The tables that a folder has already.

    Raises:
        InputError: there is another file under one of the names.
    """
    forms = zip(_files(out), (METRICS, RUNS, MADE), strict=True)
    return Tables(*(read_parquet(file, schema, STUDY) for file, schema in forms))


def export_yardsticks(found: Iterable[Scored], profile: str, out: Path) -> Path:
    """Write `yardsticks.parquet`, `.runs.parquet` and `.made.parquet` in a folder, or bring them up to date.

    Rows of other tasks and other policies stay if the present code made them. A bound without a return (the reward is
    local) is left out: no figure could place it.

    Args:
        found: evaluations with their scores, in any order.
        profile: of the report that they are for.
        out: the folder.

    Returns:
        The file with the values.

    Raises:
        InputError: there is another file under one of the names.
        StoreError: the folder cannot be written to.
    """
    before, code, here = present(out), fingerprint(), _here()
    placed = [
        (evaluation, name, score) for evaluation, scores in found for name, score in scores.items() if "return" in score
    ]
    runs = [_run(evaluation, name, code, profile) for evaluation, name, _ in placed]
    values = [row for run, (_, _, score) in zip(runs, placed, strict=True) for row in _values(run, score)]
    made = [run | here for run in runs]
    new = {_place(run) for run in runs}
    kept = [r for r in before.runs if (r["fingerprint"], r["profile"]) == (code, profile) and _place(r) not in new]
    ids = {run["run"] for run in kept}
    values += [row for row in before.values if row["run"] in ids]
    made += [row for row in before.made if row["run"] in ids]
    values_file, runs_file, made_file = _files(out)
    write_parquet(values_file, METRICS, _rows(METRICS, values))
    write_parquet(runs_file, RUNS, _rows(RUNS, runs + kept))
    write_parquet(made_file, MADE, _rows(MADE, made))
    return values_file


def _files(out: Path) -> tuple[Path, ...]:
    return tuple(out / f"{STUDY}{kind}.parquet" for kind in ("", ".runs", ".made"))


def _here() -> Row:
    """The machine and code that make the scores; the time of a single policy is not taken."""
    return {"commit": commit(), "seconds": 0.0, "adopted": ""} | host()._asdict()


def _run(evaluation: Evaluation, name: str, code: str, profile: str) -> Row:
    env = evaluation.env.model_dump(mode="json")
    config = {"env": env, "episodes": evaluation.episodes, "seed": evaluation.seed, "policy": name}
    text = json.dumps(config, sort_keys=True, separators=(",", ":"))
    return {
        "study": STUDY,
        "arm": name,
        "seed": 0,
        "run": hashlib.sha256(text.encode()).hexdigest()[:12],
        "status": "finished",
        "algorithm": "yardstick",
        "task": evaluation.env.kind,
        "profile": profile,
        "config": text,
        "fingerprint": code,
        "question": QUESTION,
    }


def _values(run: Row, score: Mapping[str, float]) -> Iterable[Row]:
    place = {key: run[key] for key in ("study", "arm", "seed", "run")} | {"step": 0}
    for key, value in score.items():
        name = f"{offered(run['task']).score}_sem" if key == "sem" else key
        yield place | {"metric": f"final/{name}", "value": value}


def _place(run: Row) -> tuple[str, str]:
    """Policy and task: what a later score replaces."""
    return run["arm"], json.dumps(json.loads(run["config"])["env"], sort_keys=True)


def _rows(schema: pa.Schema, rows: Iterable[Row]) -> list[tuple[object, ...]]:
    return sorted(tuple(row[name] for name in schema.names) for row in rows)
