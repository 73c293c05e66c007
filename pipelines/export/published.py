"""Published results: what the repository holds of a profile, results here in that form, and its runs trained anew.

`results/published/<profile>` has the finals and curves of a profile that is too quick to keep whole; of the paper
profile the exported tables themselves are in the repository.
"""

import json
import random
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pyarrow as pa

from pipelines.export.tables import write_parquet, write_tables
from pipelines.specs.plugins import UnnamedError
from pipelines.specs.study import RunSpec, Study
from pipelines.tracking.initial import begun
from pipelines.tracking.plan import items, study_card
from pipelines.workspace.errors import InputError
from pipelines.workspace.process_pool import side_by_side
from pipelines.workspace.work_folder import Home, one_line
from reports.data.schema import METRICS, PLACE, VERSION

RESULTS = Path("results")
NAME = "results"  # of the tables of a profile in small form
CURVE, FINALS = "eval/return", "final/"
RUNS = pa.schema([*PLACE, pa.field("profile", pa.string())], metadata=VERSION)
CONFIG = pa.field("config", pa.string())  # the spec as canonical JSON


def folder(profile: str) -> Path:
    """The folder where the repository holds the results of a profile."""
    small = RESULTS / "published" / profile
    return small if small.is_dir() else RESULTS / profile / "runs"


def publish(values: pd.DataFrame, runs: pd.DataFrame, profile: str) -> Path:
    """Write finals and curves to where they are published from; the folder.

    Args:
        values: exported values of all studies.
        runs: their runs.
        profile: whose.

    Raises:
        InputError: a run is not finished.
    """
    left = runs[runs["status"] != "finished"]
    if len(left):
        raise InputError(f"{len(left)} of {len(runs)} runs are not finished; only whole results are published")
    out = RESULTS / "published" / profile
    kept = values[(values["metric"] == CURVE) | values["metric"].str.startswith(FINALS)]
    for name, schema, table in ((NAME, METRICS, kept), (f"{NAME}.runs", RUNS.append(CONFIG), runs)):
        rows = table[schema.names].sort_values(schema.names[:-1]).itertuples(index=False, name=None)
        write_parquet(out / f"{name}.parquet", schema, list(rows))
    return out


def trained(values: pd.DataFrame, runs: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Values and runs of trainings alone, without yardsticks and Theorem 1, of which no log knows."""
    if "algorithm" not in runs:  # results in small form are of trainings
        return values, runs
    mine = runs[~runs["algorithm"].isin(["yardstick", "theorem"])]
    return values[values["study"].isin(mine["study"])], mine


def export_log(studies: Sequence[str], profile: str, home: Path, out: Path) -> None:
    """Write what the log holds of these studies as exported tables.

    Args:
        studies: names, `stem` or `stem@variant`, of files in `studies/`.
        profile: of each.
        home: the work folder.
        out: the folder of the tables.

    Raises:
        StudyError: one of them has no file, or a faulty one.
        StoreError: the log cannot be read.
    """
    from pipelines.tracking.initial import finder
    from pipelines.tracking.mlflow_tracker import open_existing

    find = finder(home)
    for name in studies:
        stem, _, variant = name.partition("@")
        study = Study.load(Path("studies") / f"{stem}.yaml", profile, variant=variant or None, find=find)
        write_tables(study, items(study), open_existing(study_card(study), Home(home)), out)


# Trained anew


class Again(NamedTuple):
    """A published run and what training it again gave: (step, metric, value)."""

    study: str
    arm: str
    seed: int
    run: str
    points: Sequence[tuple[int, str, float]]


def retrain(runs: pd.DataFrame, count: int, seed: int, jobs: int) -> Iterator[Again]:
    """Train some of the published runs anew.

    Args:
        runs: published ones, with their configuration.
        count: how many.
        seed: decides which.
        jobs: at a time.

    Raises:
        InputError: the configuration of one is none of this code.
        StoreError: a training was killed.
    """
    rows = runs.sort_values(["study", "arm", "seed"]).to_dict("records")
    chosen = random.Random(seed).sample(rows, min(count, len(rows)))
    specs = [_spec(row) for row in chosen]
    for row, values in zip(chosen, side_by_side(_train, specs, jobs), strict=True):
        yield Again(row["study"], row["arm"], int(row["seed"]), row["run"], values)


def _spec(row: Mapping[Any, Any]) -> RunSpec:
    name = f"{row['study']}, arm '{row['arm']}', seed {row['seed']}"
    try:
        spec = RunSpec.model_validate(json.loads(row["config"]))
    except UnnamedError as error:
        raise InputError(f"{name}: {error}") from error
    except (ValueError, TypeError) as error:
        raise InputError(f"{name}: its published settings are none that this code knows ({one_line(error)})") from error
    if spec.id != row["run"]:
        raise InputError(f"{name}: published as run {row['run']}, and its settings are those of {spec.id}")
    return spec


def _train(spec: RunSpec) -> list[tuple[int, str, float]]:
    trainer = begun(spec)
    return [(int(p["step"]), name, value) for p in trainer for name, value in p.items() if name != "step"]
