"""Assignments, transfer, bounds by number and the encoder, each against numbers that were planted."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from reports.analyses import beyond
from reports.data.frame import Results, TableError, load
from tests.reports.factory import (
    COVERAGE,
    YARDSTICK_RETURNS,
    Tables,
    assignments,
    noisy,
    study,
    transfer,
    write,
    yardsticks,
)

pytestmark = pytest.mark.usefixtures("quick_resampling")
SIZES = {(4, 5): 70.0, (2, 5): 40.0, (6, 5): 80.0, (4, 3): 75.0}


def watched() -> tuple[Tables, pd.DataFrame]:
    """A study with what the first of its two arms assigned: twenty points, Algorithm 1 short at the last two."""
    tables = study("reach", {"one": noisy(67), "two": noisy(63)}, points=4)
    pairs = np.linspace(12, 8, 20)
    return tables, assignments(tables[0], "one", pairs.tolist(), [0.0] * 18 + [0.1, 0.2])


def of_folder(folder: Path, *tables: Tables, name: str, more: pd.DataFrame) -> Results:
    write(folder, *tables)
    more.to_parquet(folder / name, index=False)
    return load(folder, "quick")


@pytest.fixture
def results(tmp_path: Path) -> Results:
    tables, more = watched()
    return of_folder(tmp_path, tables, yardsticks(), name="reach.assignments.parquet", more=more)


def test_assignments_are_shown_as_they_were_seen(results: Results) -> None:
    drawing = beyond.fig_assignments(results, "reach")
    assert drawing is not None
    rows = drawing.numbers.set_index(["arm", "quantity", "step"])["mean"].sort_index()
    assert set(drawing.numbers["arm"]) == {"one"}  # the other was not watched
    assert rows["one", "pairs", 1000] == 12
    assert rows["one", "conflicts", 20_000] == 2
    assert rows["one", "free"].tolist() == [0.5] * 20


def test_the_table_of_assignments_weighs_by_states(results: Results) -> None:
    table = beyond.table_assignments(results, "reach")
    assert table is not None
    row = table.numbers.set_index("arm").loc["one"]
    states, pairs = 100.0 * np.arange(1, 21), np.linspace(12, 8, 20)
    assert row["states"] == states.sum()
    assert row["pairs_first"] == pytest.approx((states[:2] * pairs[:2]).sum() / states[:2].sum())
    assert row["pairs_last"] == pytest.approx((states[-2:] * pairs[-2:]).sum() / states[-2:].sum())
    lost = np.array([0.0] * 18 + [0.1, 0.2]) * states
    assert row["lost_h6"] == pytest.approx(lost.sum() / states.sum())
    assert row["gap_h6"] == pytest.approx((lost * (0.4 + np.arange(20))).sum() / lost.sum())
    assert np.isnan(row["gap_h1"])  # nothing was lost: no gap, not one of zero
    assert table.shown["Seeds"][0] == "1 of 3 seeds"
    assert table.shown["Mean gap there, horizon 1"][0] == "–"


def test_without_them_nothing_is_shown(tmp_path: Path) -> None:
    results = load(write(tmp_path, study("reach", {"one": noisy(67)})), "quick")
    assert beyond.fig_assignments(results, "reach") is None
    assert beyond.table_assignments(results, "reach") is None
    assert beyond.fig_transfer(results) is None
    assert beyond.table_transfer(results) is None
    assert beyond.table_numbers(results) is None
    assert beyond.table_encoder(results) is None


def test_what_belongs_to_no_planned_run_is_left_out_and_said(tmp_path: Path) -> None:
    tables, more = watched()
    results = of_folder(tmp_path, tables, name="reach.assignments.parquet", more=more.assign(run="000000000000"))
    assert beyond.assigning(results, "reach") == []
    line = "Study `reach`: `rhmc assignments` was run on runs that are no longer planned; left out."
    assert line in results.gaps({})  # which the page prints


def test_a_value_that_is_no_number_is_a_fault(tmp_path: Path) -> None:
    tables, more = watched()
    more.loc[0, "value"] = np.nan
    with pytest.raises(TableError, match=r"reach, arm 'one', seed 0, run .*: assign/pairs is nan"):
        of_folder(tmp_path, tables, name="reach.assignments.parquet", more=more)


def test_a_run_that_was_watched_and_not_yet_trained_is_missing_all_the_same(tmp_path: Path) -> None:
    (points, runs), more = watched()
    first = runs["run"].iloc[0]
    tables = points[points["run"] != first], runs.assign(status=["missing", *runs["status"][1:]])
    results = of_folder(tmp_path, tables, name="reach.assignments.parquet", more=more)
    assert beyond.assigning(results, "reach") == ["one"]
    assert results.finals("reach", "one").tolist() == [67, 68]


def moved(folder: Path) -> Results:
    tables = study("coverage", {"RHMC": noisy(70), "IQL": noisy(66)}, points=4)
    four = yardsticks()
    six = yardsticks({"best_window": 78.0}, COVERAGE | {"agents": 6})
    six = tuple(part.assign(run=part["run"] + "6") for part in six)
    both = tuple(pd.concat(part, ignore_index=True) for part in zip(four, six, strict=True))
    more = pd.concat([transfer(tables[0], SIZES), transfer(tables[0], {(4, 5): 60.0, (6, 5): 62.0}, "IQL")])
    return of_folder(folder, tables, (both[0], both[1]), name="transfer.parquet", more=more)


def test_transfer_is_the_mean_over_seeds(tmp_path: Path) -> None:
    table = beyond.table_transfer(moved(tmp_path))
    assert table is not None
    rows = table.numbers.set_index(["arm", "agents", "targets"])
    assert rows.loc[("RHMC", 6, 5), "value"] == 81.0  # seeds 80, 81, 82
    assert (rows.loc[("RHMC", 6, 5), "low"], rows.loc[("RHMC", 6, 5), "high"]) == (80, 82)
    assert rows.loc[("best_window", 6, 5), "value"] == 78.0
    assert rows.loc[("planner", 4, 5), "value"] == YARDSTICK_RETURNS["planner"]
    shown = table.shown.set_index("Arm")
    assert list(shown.columns) == ["2 x 5", "4 x 3", "4 x 5", "6 x 5"]
    assert shown.loc["IQL", "2 x 5"] == "–"  # not played, and no zero
    assert shown.loc["planner", "6 x 5"] == "–"


def test_the_figure_of_transfer_moves_one_number_at_a_time(tmp_path: Path) -> None:
    drawing = beyond.fig_transfer(moved(tmp_path))
    assert drawing is not None
    rows = drawing.numbers.set_index(["along", "name"]).sort_index()
    assert rows.loc[("agents", "RHMC"), "count"].tolist() == [2, 4, 6]
    assert rows.loc[("agents", "RHMC"), "value"].tolist() == [41, 71, 81]  # those with other targets are not in it
    assert rows.loc[("targets", "RHMC"), "count"].tolist() == [3, 5]
    assert ("targets", "IQL") not in rows.index  # played with one number of targets only
    assert rows.loc[("agents", "best_window"), "value"].tolist() == [65.3, 78.0]


def test_transfer_of_another_plan_is_left_out(tmp_path: Path) -> None:
    tables = study("coverage", {"RHMC": noisy(70)}, points=4)
    more = transfer(tables[0], SIZES).assign(arm="RHMC, before")
    results = of_folder(tmp_path, tables, name="transfer.parquet", more=more)
    assert results.moved.empty
    assert any("`rhmc transfer` was run on runs that are no longer planned" in line for line in results.gaps({}))


def test_bounds_by_number(tmp_path: Path) -> None:
    table = beyond.table_numbers(moved(tmp_path))
    assert table is not None
    shown = table.shown.set_index("Policy")
    assert list(shown.columns) == ["4 x 5", "6 x 5"]
    assert shown.loc["best window"].tolist() == ["65.3", "78.0"]
    assert shown.loc["free heading (bound)"].tolist() == ["86.4", "–"]


def test_the_encoder_is_compared_where_nothing_else_differs(tmp_path: Path) -> None:
    points, runs = study("nets", {"a": noisy(70), "b": noisy(60), "c": noisy(50), "d": noisy(40)}, points=4)
    algo = {
        "a": {"kind": "iql", "encoder": "pairwise"},
        "b": {"kind": "iql", "encoder": "mlp"},
        "c": {"kind": "iql", "encoder": "mlp", "lr": 0.1},  # differs in another setting too
        "d": {"kind": "iql", "encoder": "pairwise", "lr": 0.1},
    }
    named = zip(runs["arm"], runs["config"], strict=True)
    configs = [json.dumps(json.loads(text) | {"algo": algo[arm]}) for arm, text in named]
    status = ["missing" if arm == "d" else "finished" for arm in runs["arm"]]
    runs = runs.assign(config=configs, status=status)
    table = beyond.table_encoder(load(write(tmp_path, (points[points["arm"] != "d"], runs)), "quick"))
    assert table is not None
    rows = table.numbers.set_index("pairwise")
    assert rows["flat"].to_dict() == {"a": "b", "d": "c"}
    assert rows.loc["a", "difference"] == pytest.approx(10.0)
    assert np.isnan(rows.loc["d", "difference"])
    assert table.shown.set_index("Pairwise").loc["d", "Pairwise, final"] == "–"
    assert table.shown.set_index("Pairwise").loc["d", "Seeds"] == "0 of 3; 3"


def test_two_arms_that_were_watched_are_told_apart(tmp_path: Path) -> None:
    tables = study("reach", {"one": noisy(67), "two": noisy(63)}, points=4)
    both = [assignments(tables[0], arm, [x] * 20, [0.0] * 20) for arm, x in (("one", 12.0), ("two", 6.0))]
    results = of_folder(tmp_path, tables, name="reach.assignments.parquet", more=pd.concat(both))
    drawing, table = beyond.fig_assignments(results, "reach"), beyond.table_assignments(results, "reach")
    assert drawing is not None
    assert table is not None
    pairs = drawing.numbers[drawing.numbers["quantity"] == "pairs"]
    assert pairs.groupby("arm")["mean"].unique().map(list).to_dict() == {"one": [12.0], "two": [6.0]}
    assert table.numbers.set_index("arm")["pairs_first"].to_dict() == {"one": 12.0, "two": 6.0}
