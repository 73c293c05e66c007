"""Where arms stand: planted data of each kind, and needed seeds against a closed form and a simulation."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from scipy.stats import nct, t, ttest_ind

from reports.analyses import standing
from reports.analyses.comparison import pairs
from reports.data.frame import Results, load
from tests.reports.factory import COVERAGE, Tables, noisy, study, write

pytestmark = pytest.mark.usefixtures("quick_resampling")
ARMS = {
    "best": noisy(70, 5, spread=0.2),
    "level": noisy(69.9, 5, spread=0.2),
    "worse": noisy(60, 5, spread=0.2),
    "open, wide": noisy(68, 5, spread=6.0),
}


def results(folder: Path, *tables: Tables) -> Results:
    return load(write(folder, *tables), "quick")


def power(x: NDArray[np.float64], y: NDArray[np.float64], seeds: int, alpha: float) -> float:
    """Of a two-sided t test: the noncentral t distribution beyond both critical values (NaN: too small to count)."""
    effect = (x.mean() - y.mean()) / np.sqrt((x.var(ddof=1) + y.var(ddof=1)) / 2)
    df, shift = 2 * seeds - 2, effect * np.sqrt(seeds / 2)
    edge = t.ppf(1 - alpha / 2, df)
    return float(nct.sf(edge, df, shift) + np.nan_to_num(nct.cdf(-edge, df, shift)))


@pytest.mark.parametrize(
    ("gap", "alpha"),
    [(20.0, 0.05), (9.0, 0.001), (4.0, 0.05), (2.0, 0.05), (1.0, 0.05), (2.0, 0.005), (0.6, 0.001), (0.3, 0.05)],
)
def test_needed_seeds_are_the_fewest_of_the_closed_form(gap: float, alpha: float) -> None:
    x, y = np.array(noisy(60 + gap, 5, spread=2.0)), np.array(noisy(60, 5, spread=3.0))
    found = standing.needed(x, y, alpha)
    assert found is not None
    assert power(x, y, found, alpha) >= 0.8
    assert found == 2 or power(x, y, found - 1, alpha) < 0.8


def test_needed_seeds_find_the_gap_in_four_of_five_simulations() -> None:
    x, y = np.array([61.0, 63.0, 62.0]), np.array([60.0, 61.5, 61.0])
    seeds, spread = standing.needed(x, y, 0.05), np.sqrt((x.var(ddof=1) + y.var(ddof=1)) / 2)
    assert seeds is not None
    rng = np.random.default_rng(1)
    drawn = [rng.normal(one.mean(), spread, (seeds, 4000)) for one in (x, y)]
    assert np.mean(ttest_ind(*drawn).pvalue < 0.05) == pytest.approx(0.8, abs=0.06)
    few = [one[: seeds // 2] for one in drawn]
    assert np.mean(ttest_ind(*few).pvalue < 0.05) < 0.65


def test_a_gap_of_nothing_is_not_found() -> None:
    x = np.array([60.0, 61.0, 62.0])
    assert standing.needed(x, x, 0.05) is None
    assert standing.needed(x, x + 0.01, 0.05) is None
    assert standing.needed(np.array([60.0, 60.0]), np.array([61.0, 61.0]), 0.05) == 2


def test_better_level_and_too_few_seeds_in_one_sentence(tmp_path: Path) -> None:
    found = results(tmp_path, study("reach", ARMS, points=3))
    ((task, one),) = standing.standings(found, "reach")
    assert task == "coverage flat, 4 sensors x 5 targets"
    assert (one.best, one.worse, one.level) == ("best", ("worse",), ("level",))
    assert [(x.arm, x.gap) for x in one.open] == [("open, wide", pytest.approx(2.0))]
    waiting = sum(pair.corrected >= 0.05 for pair in pairs(found, "reach"))
    alpha = 0.05 / waiting  # what Holm leaves to the pairs that are not clear yet
    x, y = np.array(ARMS["best"]), np.array(ARMS["open, wide"])
    seeds = one.open[0].seeds
    assert seeds is not None
    assert power(x, y, seeds, alpha) >= 0.8 > power(x, y, seeds - 1, alpha)
    assert standing.sentence(found, "reach") == (
        "best ends highest, at 70.0, clearly better than worse (by 10.0); level is level with it (within 1); too few "
        f"seeds to tell it from “open, wide”: about {seeds} seeds an arm would be needed, where there are 5."
    )


def test_all_clear_and_all_open(tmp_path: Path) -> None:
    clear = {f"arm {n}": noisy(50 + 5 * n, 5, spread=0.1) for n in range(7)}
    words = standing.sentence(results(tmp_path / "a", study("reach", clear, points=3)), "reach")
    assert (
        words
        == "arm 6 ends highest, at 80.0, clearly better than arm 5, arm 4, arm 3, arm 2 and 2 others (by 5.0 to 30.0)."
    )
    alike = {"one": noisy(60, 3), "two": noisy(59.99, 3)}
    words = standing.sentence(results(tmp_path / "b", study("reach", alike, points=3)), "reach")
    assert words == (
        "one ends highest, at 60.0; too few seeds to tell it from two: more than 1,000 seeds an arm would be needed, "
        "where there are 3."
    )


def test_at_least_one_seed_more_than_there_are(tmp_path: Path) -> None:
    """Welch's test has fewer degrees of freedom than the t test of the power, where spreads differ."""
    arms = {"one": [60.0, 60.01, 59.99], "two": [57.0, 54.0, 60.0]}
    ((_, one),) = standing.standings(results(tmp_path, study("reach", arms, points=3)), "reach")
    assert all(x.seeds is None or x.seeds > 3 for x in one.open)


@pytest.mark.parametrize(
    ("arms", "words"),
    [
        ({"one": [60.0]}, "one ends at 60.0; it is the only arm."),
        (
            {"one": [60.0], "two": [61.0]},
            "two ends highest, at 61.0, which says little: no two arms have two finished seeds each, and one seed has "
            "no spread.",
        ),
    ],
)
def test_what_cannot_be_compared_says_so(tmp_path: Path, arms: dict[str, list[float]], words: str) -> None:
    assert standing.sentence(results(tmp_path, study("reach", arms, points=3)), "reach") == words


def test_without_a_finished_run_there_is_no_answer(tmp_path: Path) -> None:
    points, runs = study("reach", {"one": noisy(60)}, points=3)
    points = points[~points["metric"].str.startswith("final/")]
    found = results(tmp_path, (points, runs.assign(status="partial")))
    assert standing.sentence(found, "reach") == "No answer yet: no run is finished."


def test_arms_of_two_tasks_are_not_compared(tmp_path: Path) -> None:
    parts = [
        study(
            "reach",
            {f"{name}, agents={n}": noisy(10 * n + gap, 5, spread=0.1) for name, gap in (("A", 5), ("B", 0))},
            env=COVERAGE | {"agents": n},
            points=3,
        )
        for n in (2, 6)
    ]
    points, runs = (pd.concat(tables, ignore_index=True) for tables in zip(*parts, strict=True))
    found = results(tmp_path, (points, runs))
    assert [(x.first, x.second) for x in pairs(found, "reach")] == [
        ("A, agents=6", "B, agents=6"),
        ("A, agents=2", "B, agents=2"),
    ]
    assert standing.sentence(found, "reach") == (
        "coverage flat, 2 sensors x 5 targets: “A, agents=2” ends highest, at 25.0, clearly better than “B, agents=2” "
        "(by 5.0). coverage flat, 6 sensors x 5 targets: “A, agents=6” ends highest, at 65.0, clearly better than “B, "
        "agents=6” (by 5.0)."
    )
