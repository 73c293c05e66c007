"""Scores of the scripted policies as tables of the form that runs are exported in."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from pipelines.export import METRICS, RUNS, read_parquet, write_parquet
from pipelines.fingerprint import fingerprint
from pipelines.plan import commit
from rhmc.envs import EnvConfig

STUDY = "yardsticks"
QUESTION = "What do scripted policies and bounds reach?"
SEM_OF = {"coverage": "coverage", "navigation": "return"}  # whose standard error a task's `sem` is

Scores = Mapping[str, Mapping[str, float]]
Row = dict[str, Any]


def export_yardsticks(env: EnvConfig, scores: Scores, episodes: int, seed: int, profile: str, out: Path) -> Path:
    """Write `yardsticks.parquet` and `yardsticks.runs.parquet` in a folder, or bring them up to date.

    Rows of other tasks and other policies stay if the present code made them. A bound without a return (the reward is
    local) is left out: no figure could place it.

    Args:
        env: the task.
        scores: as `rhmc.yardsticks.yardsticks` gives them.
        episodes: how many were played.
        seed: of the bank.
        profile: of the report that they are for.
        out: the folder.

    Returns:
        The file with the values.

    Raises:
        InputError: there is another file under one of the names.
        StoreError: the folder cannot be written to.
    """
    values_file, runs_file = out / f"{STUDY}.parquet", out / f"{STUDY}.runs.parquet"
    placed = {name: score for name, score in scores.items() if "return" in score}
    runs = [_run(env, name, episodes, seed, profile) for name in placed]
    values = [row for run, score in zip(runs, placed.values(), strict=True) for row in _values(run, score)]
    new = {_place(run) for run in runs}
    current = (fingerprint(), profile)
    kept = [
        r
        for r in read_parquet(runs_file, RUNS, STUDY)
        if (r["fingerprint"], r["profile"]) == current and _place(r) not in new
    ]
    ids = {run["run"] for run in kept}
    values += [row for row in read_parquet(values_file, METRICS, STUDY) if row["run"] in ids]
    write_parquet(values_file, METRICS, _rows(METRICS, values))
    write_parquet(runs_file, RUNS, _rows(RUNS, runs + kept))
    return values_file


def _run(env: EnvConfig, name: str, episodes: int, seed: int, profile: str) -> Row:
    config = {"env": env.model_dump(mode="json"), "episodes": episodes, "bank": seed, "policy": name}
    text = json.dumps(config, sort_keys=True, separators=(",", ":"))
    return {
        "study": STUDY,
        "arm": name,
        "seed": 0,
        "run": hashlib.sha256(text.encode()).hexdigest()[:12],
        "status": "finished",
        "algorithm": "scripted",
        "task": env.kind,
        "profile": profile,
        "config": text,
        "fingerprint": fingerprint(),
        "commit": commit(),
        "question": QUESTION,
        "seconds": 0.0,
    }


def _values(run: Row, score: Mapping[str, float]) -> Iterable[Row]:
    place = {key: run[key] for key in ("study", "arm", "seed", "run")} | {"step": 0}
    for key, value in score.items():
        name = f"{SEM_OF[run['task']]}_sem" if key == "sem" else key
        yield place | {"metric": f"final/{name}", "value": value}


def _place(run: Row) -> tuple[str, str]:
    """Policy and task: what a later score replaces."""
    return run["arm"], json.dumps(json.loads(run["config"])["env"], sort_keys=True)


def _rows(schema: pa.Schema, rows: Iterable[Row]) -> list[tuple[object, ...]]:
    return sorted(tuple(row[name] for name in schema.names) for row in rows)
