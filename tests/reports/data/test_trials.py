"""A fault in a table of trials is reported in one line; what is not there yet is listed."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from reports.data.exported import SHOWN
from reports.data.frame import Results, TableError, load
from tests.reports.factory import study, write
from tests.reports.factory_trials import trials, write_trials

ARMS = {"RHMC": [60.0, "pruned", "missing"], "IQL": [50.0, 51.0, 52.0]}
PLACE = "search_x, arm 'RHMC', trial 0: "


def read(folder: Path, table: pd.DataFrame) -> Results:
    return load(write_trials(folder, table), "quick")


def faults(folder: Path, table: pd.DataFrame) -> list[str]:
    with pytest.raises(TableError) as error:
        read(folder, table)
    return str(error.value).splitlines()


def changed(row: int, **cells: object) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """A table with other cells in a row."""

    def change(table: pd.DataFrame) -> pd.DataFrame:
        return table.assign(**{name: [*table[name][:row], x, *table[name][row + 1 :]] for name, x in cells.items()})

    return change


@pytest.mark.parametrize(
    ("plant", "line"),
    [
        (changed(0, state="done"), f"{PLACE}state 'done' is none of complete, pruned, failed, partial, missing"),
        (changed(0, value=np.nan), f"{PLACE}marked complete, and its value is nan"),
        (changed(0, value=np.inf), f"{PLACE}marked complete, and its value is inf"),
        (changed(1, value=1.0), "search_x, arm 'RHMC', trial 1: marked pruned, and has a value"),
        (changed(2, steps=600), "search_x, arm 'RHMC', trial 2: marked missing, and has steps"),
        (changed(0, profile="paper"), f"{PLACE}made with profile 'paper', and this report is of 'quick'"),
        (changed(0, config="oops"), f"{PLACE}column 'config' is no JSON object"),
        (changed(0, params="[]"), f"{PLACE}column 'params' is no JSON object"),
        (changed(0, params="{"), f"{PLACE}column 'params' is no JSON object"),
        (lambda table: pd.concat([table, table.head(1)]), f"{PLACE}is there twice"),
        (lambda table: table.drop(index=1), "search_x, arm 'RHMC': 1 of 3 trials have no row; the first is 1"),
        (
            changed(5, search="other"),
            "search_x.trials.parquet: column 'search' says 'other'; a table of that name is of search",
        ),
        (changed(0, seeds=-1), "search_x.trials.parquet: column 'seeds' goes down to -1; 0 is the least"),
        (lambda table: table.assign(value="many"), "search_x.trials.parquet: column 'value' holds words, not numbers"),
        (
            lambda table: table.drop(columns="state"),
            "search_x.trials.parquet: no column 'state'; there are search, arm",
        ),
    ],
)
def test_a_planted_fault_is_one_line(tmp_path: Path, plant: Callable[[pd.DataFrame], pd.DataFrame], line: str) -> None:
    (found,) = faults(tmp_path, plant(trials(ARMS)))
    assert found.startswith(line)


def test_an_index_far_beyond_the_others_is_found_at_once(tmp_path: Path) -> None:
    budget = 2**40
    lines = faults(tmp_path, changed(5, trial=budget - 1)(trials(ARMS)))
    assert lines == [
        f"search_x, arm 'IQL': {budget - 3} of {budget} trials have no row; the first is 2",
        f"search_x, arm 'RHMC': {budget - 3} of {budget} trials have no row; the first is 3",
    ]


def test_many_faults_of_trials_are_counted(tmp_path: Path) -> None:
    lines = faults(tmp_path, trials({"IQL": [1.0] * (SHOWN + 3)}).assign(params="oops"))
    assert len(lines) == SHOWN + 1
    assert lines[-1] == "... and 3 more of this kind"


def test_a_study_and_a_search_have_names_of_their_own(tmp_path: Path) -> None:
    write(tmp_path, study("search_x", {"RHMC": [1.0, 2.0]}, points=2))
    assert faults(tmp_path, trials(ARMS)) == [
        "search_x.trials.parquet: a study is named 'search_x' as well; rename one of the two files"
    ]


def test_trials_without_a_result_are_listed(tmp_path: Path) -> None:
    table = trials({"IQL": [1.0, "failed", "partial"], "R|x": ["missing", "missing", "pruned"]})
    assert read(tmp_path, table).gaps({}) == [
        "Search `search_x`, arm IQL: of 3 trials 1 not finished, 1 failed.",
        "Search `search_x`, arm R\\|x: of 3 trials 2 not begun.",
    ]


def test_trials_of_an_older_version_are_set_aside(tmp_path: Path) -> None:
    assert read(tmp_path, trials(ARMS)).set_aside == ""
    write(tmp_path, study("reach", {"RHMC": [1.0, 2.0]}, points=2))
    pd.read_parquet(tmp_path / "reach.runs.parquet").to_parquet(tmp_path / "reach.runs.parquet")
    write_trials(tmp_path, trials(ARMS), older=True)
    results = load(tmp_path, "quick")
    assert results.older == ("reach", "search_x")
    said = "made by an older version and set aside, until"
    assert results.set_aside == (
        f"Tables of reach: {said} `rhmc study run` and `rhmc export` make them anew. "
        f"Tables of search_x: {said} `rhmc search run` and `rhmc search export` make them anew."
    )


def test_one_search_is_read_alone(tmp_path: Path) -> None:
    write(tmp_path, study("reach", {"RHMC": [1.0, 2.0]}, points=2))
    write_trials(tmp_path, trials(ARMS, "search_y"))
    write_trials(tmp_path, trials(ARMS))
    results = load(tmp_path, "quick", "search_x")
    assert (results.searches, results.studies) == (["search_x"], [])
    assert load(tmp_path, "quick", "reach").searches == []
    assert list(results.tried("search_x")) == ["RHMC", "IQL"]
