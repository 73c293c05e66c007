"""From a log to the three files that the reports read."""

from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq
import pytest

from pipelines.export.pace import estimated, estimated_search, paces
from pipelines.export.tables import export_study, write_tables
from pipelines.specs.readings import Cell, Plan
from pipelines.specs.search import Search
from pipelines.specs.study import RunSpec, Study
from pipelines.tracking.plan import Item, items, study_card
from pipelines.workspace.provenance import Host, host
from pipelines.workspace.work_folder import StoreError
from reports.data.frame import TableError, load
from reports.data.schema import MADE, METRICS, RUNS
from tests.memory_tracker import MemoryRun, MemoryTracker
from tests.pipelines.support import CODE, plan, tiny

POINTS = [
    {"step": float(step), "eval/return": step / 3, "train/loss": 0.1, "time/seconds": step / 100, "time/x": 1.0}
    for step in (0, 200, 400)
]


@pytest.fixture
def tracker(shelf: list[MemoryRun]) -> MemoryTracker:
    return MemoryTracker(study_card(tiny()), shelf)


def log(tracker: MemoryTracker, item: Item, points: int = 3, status: str = "finished") -> None:
    """Log a run."""
    run = tracker.start(item.card)
    run.log(POINTS[:points])
    run.finish(status)


def read(folder: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Values and planned runs."""
    return pd.read_parquet(folder / "tiny.parquet"), pd.read_parquet(folder / "tiny.runs.parquet")


def made(folder: Path) -> pd.DataFrame:
    """The provenance of the runs, by arm."""
    return pd.read_parquet(folder / "tiny.made.parquet").set_index("arm")


def test_one_row_per_metric_and_point(tracker: MemoryTracker, tmp_path: Path) -> None:
    runs = plan()
    for item in reversed(runs):
        log(tracker, item)
    assert write_tables(tiny(), runs, tracker, tmp_path) == 0
    values, table = read(tmp_path)
    assert list(values) == METRICS.names == ["study", "arm", "seed", "run", "step", "metric", "value"]
    assert list(table) == RUNS.names
    assert pq.read_schema(tmp_path / "tiny.made.parquet").names == MADE.names
    assert len(values) == 2 * 3 * 2
    assert values.equals(values.sort_values(list(values)[:6], ignore_index=True))
    slow = values[(values.arm == "slow") & (values.metric == "eval/return")]
    assert list(zip(slow.step, slow.value, strict=True)) == [(0, 0.0), (200, 200 / 3), (400, 400 / 3)]
    assert set(values.run) == {item.card.spec_id for item in runs}
    assert set(values.metric) == {"eval/return", "train/loss"}


def test_where_a_run_was_started_is_told_where_it_is_known(tracker: MemoryTracker, tmp_path: Path) -> None:
    here, unknown = items(tiny(), "abc", Host("a machine", "torch 2"))[0], plan()[1]
    log(tracker, here)
    log(tracker, unknown)  # of an earlier version, or brought in from elsewhere
    write_tables(tiny(), plan(), tracker, tmp_path)
    told = made(tmp_path)[["machine", "versions"]]
    assert told.loc["slow"].tolist() == ["a machine", "torch 2"]
    assert told.loc["fast"].tolist() == ["", ""]
    assert f"torch {version('torch')}" in host().versions


def test_one_row_per_planned_run(tracker: MemoryTracker, tmp_path: Path) -> None:
    runs = plan()
    log(tracker, runs[0])
    assert write_tables(tiny(), runs, tracker, tmp_path) == 1
    fast, slow = read(tmp_path)[1].to_dict("records")
    assert (slow["arm"], slow["status"]) == ("slow", "finished")
    assert (fast["arm"], fast["status"]) == ("fast", "missing")
    (known,) = made(tmp_path).reset_index().to_dict("records")  # of the other there is nothing to tell
    assert (known["arm"], known["seconds"], known["commit"]) == ("slow", 4.0, "abc-dirty")
    assert known["run"] == slow["run"]
    assert RunSpec.model_validate_json(slow["config"]) == runs[0].spec
    expected = {"algorithm": "iql", "task": "navigation", "profile": "quick", "fingerprint": CODE, "seed": 0}
    assert slow.items() >= (expected | {"question": "Does the whole chain hold?"}).items()


def test_a_run_under_way_is_partial(tracker: MemoryTracker, tmp_path: Path) -> None:
    runs = plan()
    log(tracker, runs[0])
    log(tracker, runs[1], points=1, status="interrupted")
    assert write_tables(tiny(), runs, tracker, tmp_path) == 1
    values, table = read(tmp_path)
    assert list(table.status) == ["partial", "finished"]
    assert list(values[values.arm == "fast"].step.unique()) == [0]


def test_what_is_not_planned_or_of_other_code_stays_behind(tracker: MemoryTracker, tmp_path: Path) -> None:
    runs = plan()
    for item in runs:
        log(tracker, item)
        log(tracker, item._replace(card=item.card._replace(fingerprint="0ther")))
        log(tracker, item._replace(card=item.card._replace(spec_id="0ther")))
    write_tables(tiny(), runs[:1], tracker, tmp_path)
    values, table = read(tmp_path)
    assert len(values) == 6
    assert len(table) == 1


def test_the_same_log_gives_the_same_bytes(shelf: list[MemoryRun], tmp_path: Path) -> None:
    runs = plan()
    for folder, order in (("a", runs), ("b", runs[::-1])):
        tracker = MemoryTracker(study_card(tiny()), [])
        for item in order:
            log(tracker, item)
        write_tables(tiny(), runs, tracker, tmp_path / folder)
        write_tables(tiny(), runs[::-1], tracker, tmp_path / folder / "again")
    names = ("tiny.parquet", "tiny.runs.parquet", "tiny.made.parquet")
    folders = ("a", "a/again", "b", "b/again")
    assert all(len({(tmp_path / folder / name).read_bytes() for folder in folders}) == 1 for name in names)
    assert sorted(path.name for path in (tmp_path / "b").iterdir() if path.is_file()) == sorted(names)


def read_study() -> Study:
    """The tiny study's arms as one arm under two readings."""
    study = tiny()
    plan = Plan(factors={"lr": ("low", "high")}, kind="every combination")
    levels = {"slow": Cell(arm="full", reading="reading=1", levels={"lr": "low"})}
    levels |= {"fast": Cell(arm="full", reading="reading=2", levels={"lr": "high"})}
    return study.model_copy(update={"readings": plan, "cells": levels})


def test_the_levels_of_readings_go_along(tracker: MemoryTracker, tmp_path: Path) -> None:
    study = read_study()
    for item in plan():
        log(tracker, item, status="interrupted")
    write_tables(study, plan(study), tracker, tmp_path)
    assert pd.read_parquet(tmp_path / "tiny.readings.parquet").to_dict("records") == [
        {"study": "tiny", "arm": arm, "contrast": "full", "reading": reading, "factor": "lr", "place": 0}
        | {"level": level, "number": number}
        for arm, reading, level, number in (("fast", "reading=2", "high", 1), ("slow", "reading=1", "low", 0))
    ]
    levels = load(tmp_path, "quick").levels
    assert dict(zip(levels["arm"], levels["level"], strict=True)) == {"fast": "high", "slow": "low"}


LEVELS = {
    "of an arm that is not planned": (
        lambda t: t.assign(arm=t["arm"].replace("slow", "gone")),
        ["tiny, arm 'gone': has a reading, and is not in the plan"],
    ),
    "twice": (lambda t: pd.concat([t, t[:1]]), ["tiny, arm 'fast': two levels of factor 'lr'"]),
    "none": (
        lambda t: pd.concat([t, t[:1].assign(factor="alpha", place=1)]),
        ["tiny, arm 'slow': a factor has no level"],
    ),
}


@pytest.mark.parametrize(("change", "said"), LEVELS.values(), ids=LEVELS)
def test_levels_that_do_not_fit_the_plan_are_refused(
    tracker: MemoryTracker, tmp_path: Path, change: Callable[[pd.DataFrame], pd.DataFrame], said: list[str]
) -> None:
    study = read_study()
    for item in plan():
        log(tracker, item, status="interrupted")
    write_tables(study, plan(study), tracker, tmp_path)
    file = tmp_path / "tiny.readings.parquet"
    change(pd.read_parquet(file)).to_parquet(file, index=False)
    with pytest.raises(TableError) as caught:
        load(tmp_path, "quick")
    assert str(caught.value).splitlines() == said


def test_the_hours_of_a_study_follow_the_pace_of_finished_runs(tracker: MemoryTracker, tmp_path: Path) -> None:
    assert estimated(tiny(), tmp_path) == ""
    log(tracker, plan()[0])
    log(tracker, plan()[1], points=2, status="interrupted")
    write_tables(tiny(), plan(), tracker, tmp_path)
    assert paces(tmp_path) == {"iql": 600 / 4}  # of the run that is finished
    study = tiny(points=9_000)  # two runs of 1.8 M steps
    assert estimated(study, tmp_path).startswith("about 6.7 hours of one run at a time, 3.3 of 2, at the median pace")
    once = study.model_copy(update={"arms": {"slow": study.arms["slow"], "same": study.arms["slow"]}})
    assert estimated(once, tmp_path).startswith("about 3.3 hours of one run at a time")
    (tmp_path / "tiny.made.parquet").write_bytes(b"PAR1")
    assert estimated(study, tmp_path) == ""


SEARCH = """
question: Which?
base: {env: {kind: navigation}, algo: {kind: iql, encoder: mlp}}
arms:
  IQL: {space: {lr: {low: 1e-4, high: 1e-2}}}
  other: {algo: {kind: KIND, encoder: mlp}, space: {lr: {low: 1e-4, high: 1e-2}}}
trials: 5
seeds: 2
steps: 54_000
"""


@pytest.mark.parametrize(("pruner", "end"), [("none", ")"), ("median", "less where trials are pruned")])
def test_the_hours_of_a_search_are_those_of_its_whole_budget(
    tracker: MemoryTracker, tmp_path: Path, pruner: str, end: str
) -> None:
    for item in plan():
        log(tracker, item)
    write_tables(tiny(), plan(), tracker, tmp_path)
    (tmp_path / "s.yaml").write_text(SEARCH.replace("KIND", "iql") + f"pruner: {{kind: {pruner}}}\n")
    said = estimated_search(Search.load(tmp_path / "s.yaml"), tmp_path)
    assert said.startswith("about 2.0 hours of one trial at a time, 1.0 of 2, at the median pace")
    assert said.endswith(end)


def test_a_method_without_runs_has_no_hours(tracker: MemoryTracker, tmp_path: Path) -> None:
    log(tracker, plan()[0])
    write_tables(tiny(), plan(), tracker, tmp_path)
    (tmp_path / "s.yaml").write_text(SEARCH.replace("KIND", "vdn"))
    assert estimated_search(Search.load(tmp_path / "s.yaml"), tmp_path) == ""


@pytest.mark.parametrize(("done", "code"), [(1, 3), (2, 0)])
def test_half_a_study_is_written_and_has_its_exit_code(
    done: int,
    code: int,
    tracker: MemoryTracker,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for item in plan()[:done]:
        log(tracker, item)
    monkeypatch.setattr("pipelines.tracking.mlflow_tracker.open_existing", lambda *given: tracker)
    assert export_study(tiny(), tmp_path / "out", tmp_path / "none") == code
    assert capsys.readouterr().err == ("tiny (quick): 1 of 2 runs are not finished\n" if code else "")
    _, table = read(tmp_path / "out")
    assert sorted(table.status) == sorted(["finished"] * done + ["missing"] * (2 - done))


def test_nothing_logged_yet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export_study(tiny(), tmp_path / "out", tmp_path / "none") == 3
    assert "2 of 2 runs are not finished" in capsys.readouterr().err
    values, table = read(tmp_path / "out")
    assert (list(values), len(values)) == (METRICS.names, 0)
    assert list(table.status) == ["missing", "missing"]


def test_a_folder_that_cannot_be_written(tracker: MemoryTracker, tmp_path: Path) -> None:
    (tmp_path / "out").touch()
    with pytest.raises(StoreError, match=r"out/tiny\.parquet: cannot be written"):
        write_tables(tiny(), plan(), tracker, tmp_path / "out")
