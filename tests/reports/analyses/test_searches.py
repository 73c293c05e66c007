"""The best objective by number of trials and the winners, against trials that were planted."""

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.text import Text

from reports.analyses import searches
from reports.data.frame import Results, load
from reports.render.canvas import Drawing
from tests.reports.factory import NAVIGATION
from tests.reports.factory_trials import Values, trials, write_trials

ARMS: dict[str, Values] = {
    "RHMC": [60.0, "pruned", 62.0, "failed", 61.0],
    "IQL": ["failed", 64.0, 64.0, "partial", "missing"],
    "VDN": ["pruned", "pruned", "missing", "missing", "missing"],
}


@pytest.fixture
def results(tmp_path: Path) -> Results:
    return load(write_trials(tmp_path, trials(ARMS)), "quick")


def words(drawing: Drawing) -> list[str]:
    return [text.get_text() for text in drawing.figure.findobj(Text) if isinstance(text, Text)]


def test_the_best_so_far_counts_every_trial_that_is_over(results: Results) -> None:
    rows = searches.curve(results.tried("search_x")["RHMC"])
    assert rows["trials"].tolist() == [1, 2, 3, 4, 5]
    assert rows["best"].tolist() == [60, 60, 62, 62, 62]
    rows = searches.curve(results.tried("search_x")["IQL"])
    assert rows["trials"].tolist() == [1, 2, 3]  # up to the last that is over
    assert np.isnan(rows["best"][0])
    assert rows["best"].tolist()[1:] == [64, 64]


def test_an_arm_without_a_trial_has_no_curve() -> None:
    assert searches.curve(trials({"IQL": ["missing", "partial"]})).empty


def test_the_winner_is_the_earliest_of_the_best(results: Results) -> None:
    best = {arm: searches.winner(rows) for arm, rows in results.tried("search_x").items()}
    assert {arm: None if one is None else (one["value"], one["trial"]) for arm, one in best.items()} == {
        "RHMC": (62, 2),
        "IQL": (64, 1),
        "VDN": None,
    }


def test_words_on_the_budget(results: Results, tmp_path: Path) -> None:
    assert searches.heading(results, "search_x") == "Search search_x (8 of 15 trials finished)"
    assert searches.spoken(results, "search_x") == "3 arms, each of 5 trials of 2 seeds and 50 k steps"
    whole = load(write_trials(tmp_path / "whole", trials({"IQL": [1.0]})), "quick")
    assert searches.heading(whole, "search_x") == "Search search_x"
    assert searches.spoken(whole, "search_x") == "1 arm, each of 1 trial of 2 seeds and 50 k steps"


def test_the_figure_has_a_line_per_arm_with_a_complete_trial(results: Results) -> None:
    drawing = searches.fig_trials(results, "search_x")
    assert drawing is not None
    found = words(drawing)
    for text in ("RHMC 62.0", "IQL 64.0", "RHMC (4 of 5 trials)", "IQL (3 of 5 trials)", "VDN (2 of 5 trials)"):
        assert (text in found) == (text != "RHMC (4 of 5 trials)")
    assert "RHMC (5 trials)" in found
    assert "best final return so far (100 × mean reward per step)" in found
    numbers = drawing.numbers
    assert list(numbers) == searches.POINTS
    assert numbers.groupby("arm")["best"].max().to_dict() == {"IQL": 64, "RHMC": 62}
    assert numbers.loc[numbers["state"] == "pruned", "trials"].tolist() == [2]
    assert searches.described(results, "search_x").endswith("Best: RHMC 62.0 in t2 and IQL 64.0 in t1.")


def test_the_axis_says_what_a_return_is(tmp_path: Path) -> None:
    table = trials({"IQL": [-30.0, -20.0]}, env=NAVIGATION)
    drawing = searches.fig_trials(load(write_trials(tmp_path, table), "quick"), "search_x")
    assert drawing is not None
    assert "best final return so far (sum over an episode)" in words(drawing)


def test_without_a_complete_trial_there_is_a_table_and_no_figure(tmp_path: Path) -> None:
    results = load(write_trials(tmp_path, trials({"IQL": ["missing", "pruned"]})), "quick")
    assert searches.fig_trials(results, "search_x") is None
    assert searches.table_winners(results, "search_x").shown["Best"].tolist() == ["–"]


def test_the_winners(results: Results) -> None:
    table = searches.table_winners(results, "search_x")
    rows = table.numbers.set_index("arm")
    assert list(rows.index) == ["IQL", "RHMC", "VDN"]
    assert rows.loc["IQL", ["value", "trial", "complete", "failed", "partial", "missing"]].tolist() == [
        64,
        1,
        2,
        1,
        1,
        1,
    ]
    assert json.loads(str(rows.loc["IQL", "params"])) == {"lr": 0.002}
    assert rows["steps"].to_dict() == {"IQL": 200_000, "RHMC": 350_000, "VDN": 100_000}  # of two seeds
    assert np.isnan(float(rows["value"]["VDN"]))
    shown = table.shown.set_index("Arm")
    assert shown.loc["IQL", "Trials"] == "2 complete, 1 failed, 1 partial, 1 missing"
    assert shown.loc["IQL", ["Best", "In trial", "Settings of the best"]].tolist() == ["64.0", "t1", "lr=0.002"]
    assert shown.loc["VDN", ["Best", "In trial", "Settings of the best"]].tolist() == ["–"] * 3
    assert shown.loc["RHMC", "Steps trained in all"] == "350 k"
    assert table.note.startswith("3 arms, each of 5 trials of 2 seeds and 50 k steps. ")
