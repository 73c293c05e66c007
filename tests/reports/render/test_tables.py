"""Tables: what they show of planted numbers."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from reports.data.frame import load
from reports.data.stats import Interval, Range
from reports.render import tables
from tests.reports.factory import Tables, noisy, study, theorem, write


def test_theorem_1_in_percent_of_the_instances(tmp_path: Path) -> None:
    found = tables.theorem(load(write(tmp_path, study("coverage", {"RHMC": [70.0, 71.0]}), theorem(40)), "quick"))
    assert found is not None
    assert found.numbers["share"].tolist() == [4.0, 8.0]
    assert found.shown["Tried"].tolist() == ["1,000", "1,000"]
    assert found.shown["Below the optimum"].tolist() == ["4.00 %", "8.00 %"]
    assert found.shown["Largest gap"].tolist() == ["1.10", "1.10"]


def test_a_range_has_round_brackets_in_every_form(tmp_path: Path) -> None:
    arms = {"RHMC": noisy(-70.0, 3), "IQL": noisy(60.0, 5, spread=2.0)}
    plan = write(tmp_path, study("reach", {"RHMC": arms["RHMC"]}), study("far", {"IQL": arms["IQL"]}))
    few, many = (tables.finals(load(plan, "quick"), name) for name in ("reach", "far"))
    assert few.shown[f"Final return {tables.SPAN}"].tolist() == ["−70.0 (−71.0 to −69.0)"]
    assert many.shown[f"Final return {tables.SPAN}"].iloc[0].startswith("60.0 [5")
    assert "| RHMC | −70.0 (−71.0 to −69.0) |" in few.markdown()
    assert "($-$71.0 to $-$69.0)" in few.latex()
    assert (few.numbers["level"].isna().all(), many.numbers["level"].tolist()) == (True, [0.95])


def test_what_is_no_bootstrap_of_few_seeds_is_no_range() -> None:
    assert tables.estimate(Interval(1.0, 0.5, 2.0, 2)) == "1.0 [0.5, 2.0]"
    assert tables.estimate(Range(1.0, 0.5, 2.0, 2)) == "1.0 (0.5 to 2.0)"
    assert tables.estimate(Range(-1.0, -2.0, 0.5, 2)._replace(value=0.0), tables.percent) == "+0.0 % (−2.0 % to +0.5 %)"
    assert tables.estimate(Interval(1.0, np.nan, np.nan, 1)) == "1.0"


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        ([5, 7], "95 % bootstrap interval"),
        ([2, 4], "range over fewer than 5 seeds"),
        ([3, 10], "95 % bootstrap interval or range over fewer than 5 seeds"),
        ([1, 3], "range over fewer than 5 seeds, none with one seed"),
        ([1, 1], "none with one seed"),
    ],
)
def test_the_words_of_a_figure_for_what_is_around_its_means(counts: list[int], words: str) -> None:
    assert tables.spans(counts) == words


def with_errors(tables_: Tables, errors: dict[int, float]) -> Tables:
    """The same with the standard error of each seed's final return over its episodes, in studies of 500 episodes."""
    points, runs = tables_
    own = points[points["metric"] == "final/return"].assign(metric="final/return_sem")
    own = own[own["seed"].isin(errors)].assign(value=lambda rows: rows["seed"].map(errors))
    config = runs["config"].str.replace('"evaluations"', '"final_episodes": 500, "evaluations"')
    return pd.concat([points, own], ignore_index=True), runs.assign(config=config)


def test_the_luck_of_the_episodes_stands_below_the_finals(tmp_path: Path) -> None:
    plan = study("reach", {"RHMC": noisy(70.0), "IQL": noisy(60.0)})
    found = tables.finals(load(write(tmp_path, with_errors(plan, {0: 0.41, 1: 0.3, 2: 0.459})), "quick"), "reach")
    assert "standard error of one run's final return is 0.30 to 0.46 points (500 episodes)." in found.note
    assert found.numbers["episode_error"].tolist() == pytest.approx([np.sqrt(np.mean([0.41**2, 0.3**2, 0.459**2]))] * 2)


def test_one_error_is_no_span_and_one_episode_has_no_error(tmp_path: Path) -> None:
    plan = study("reach", {"RHMC": noisy(70.0)})
    same = tables.finals(load(write(tmp_path / "a", with_errors(plan, {0: 0.4, 1: 0.4})), "quick"), "reach")
    assert "is 0.40 points (" in same.note
    single = tables.finals(load(write(tmp_path / "b", with_errors(plan, {0: 0.0})), "quick"), "reach")
    none = tables.finals(load(write(tmp_path / "c", plan), "quick"), "reach")
    assert (single.note, none.note) == ("", "")
    assert none.numbers["episode_error"].isna().all()
