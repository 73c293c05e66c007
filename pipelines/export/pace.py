"""The time that a study or a search will take, judged by the runs that were exported here before."""

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from statistics import median

from pipelines.export.tables import read_parquet
from pipelines.specs.search import Search
from pipelines.specs.study import Study
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import StoreError
from reports.data.schema import MADE, RUNS


def estimated(study: Study, folder: Path) -> str:
    """Processor hours of a study, in a line; nothing where its methods have no finished runs to go by.

    Each method counts with the median pace of its runs, whatever their settings.

    Args:
        study: what is planned.
        folder: of exported tables.
    """
    steps: dict[str, int] = {}
    for spec in {run.spec.id: run.spec for run in study.runs()}.values():
        steps[spec.algo.kind] = steps.get(spec.algo.kind, 0) + spec.trainer.steps
    return _hours(steps, study.resources.concurrent, folder, "run")


def estimated_search(search: Search, folder: Path) -> str:
    """As `estimated`, of a search whose trials all go to their end; those that are pruned take less."""
    steps: dict[str, int] = {}
    for arm in search.arms.values():
        kind = arm.setting.algo.kind
        steps[kind] = steps.get(kind, 0) + search.trials * search.seeds * search.steps
    hours = _hours(steps, search.resources.concurrent, folder, "trial")
    return f"{hours}; less where trials are pruned" if hours and search.pruner.kind != "none" else hours


def _hours(steps: Mapping[str, int], concurrent: int, folder: Path, unit: str) -> str:
    """The hours for the environment steps of each method; nothing where one has no pace."""
    pace = paces(folder)
    if not steps or not steps.keys() <= pace.keys():
        return ""
    hours = sum(count / pace[kind] for kind, count in steps.items()) / 3600
    wall = hours / concurrent
    rates = ", ".join(f"{kind} {pace[kind]:,.0f}" for kind in steps)
    each = f"{hours:.1f} hours of one {unit} at a time, {wall:.1f} of {concurrent}"
    return f"about {each}, at the median pace of the runs in {folder} (steps/s: {rates})"


def paces(folder: Path) -> dict[str, float]:
    """Environment steps per processor second of training: the median over the finished runs of each method.

    Tables that cannot be read count for nothing.
    """
    found: dict[str, list[float]] = {}
    for path in sorted(folder.glob("*.made.parquet")):
        with suppress(InputError, StoreError):
            seconds = {row["run"]: row["seconds"] for row in read_parquet(path, MADE, "how runs were made")}
            for row in read_parquet(path.with_name(path.name.replace(".made.", ".runs.")), RUNS, "runs"):
                if row["status"] == "finished" and seconds.get(row["run"], 0) > 0:
                    rate = json.loads(row["config"])["trainer"]["steps"] / seconds[row["run"]]
                    found.setdefault(row["algorithm"], []).append(rate)
    return {kind: median(rates) for kind, rates in found.items()}
