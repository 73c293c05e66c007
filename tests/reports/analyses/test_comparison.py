"""Arms against each other: corrections, profiles and areas against independent computations."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import norm, t

from reports.analyses import comparison
from reports.data import stats
from reports.data.frame import Results, load
from reports.render.tables import NONE
from tests.reports.factory import NAVIGATION, noisy, study, write, yardsticks

chances = st.lists(st.floats(0, 1), min_size=1, max_size=6).map(np.array)


@pytest.fixture
def results(tmp_path: Path) -> Results:
    """Three arms with five seeds, and VDN with one of five."""
    arms = {"RHMC": noisy(70, 5), "IQL": noisy(66, 5), "QMIX": noisy(69.5, 5), "VDN": noisy(60, 5)}
    points, runs = study("coverage", arms)
    gone = (runs["arm"] == "VDN") & (runs["seed"] > 0)
    points = points[~points["run"].isin(runs["run"][gone])]
    return load(
        write(tmp_path, (points, runs.assign(status=runs["status"].mask(gone, "missing"))), yardsticks()), "quick"
    )


@given(chances)
def test_holm_is_closed_testing(p: NDArray[np.float64]) -> None:
    """A hypothesis falls at the largest Bonferroni p of all families that it is in: counted over every family."""
    index = range(len(p))
    families = [f for k in range(1, len(p) + 1) for f in combinations(index, k)]
    closed = [max(min(1.0, len(f) * min(p[i] for i in f)) for f in families if j in f) for j in index]
    assert stats.holm(p) == pytest.approx(closed)


def test_holm_does_not_count_what_was_not_tested() -> None:
    found = stats.holm(np.array([0.01, np.nan, 0.04]))
    assert found[[0, 2]] == pytest.approx([0.02, 0.04])
    assert np.isnan(found[1])
    assert np.isnan(stats.holm(np.array([np.nan]))).all()


def test_welch_by_hand() -> None:
    x, y = np.array([1.0, 2.0, 4.0]), np.array([3.0, 5.0, 5.5, 7.0])
    a, b = x.var(ddof=1) / 3, y.var(ddof=1) / 4
    df = (a + b) ** 2 / (a**2 / 2 + b**2 / 3)
    assert stats.welch(x, y) == pytest.approx(2 * t.sf(abs(x.mean() - y.mean()) / np.sqrt(a + b), df))
    assert np.isnan(stats.welch(np.array([1.0, 1.0]), np.array([2.0, 2.0])))  # no spread, no test
    assert np.isnan(stats.welch(np.array([1.0]), y))


@pytest.mark.parametrize(("n", "m", "wins"), [(3, 3, 9), (3, 3, 0), (5, 5, 25), (5, 5, 13), (3, 5, 12.5)])
def test_the_score_interval_holds_what_the_score_does_not_reject(n: int, m: int, wins: float) -> None:
    """Found on a grid: all p whose distance to the estimate is within 1.96 of their own standard errors."""
    value, p = wins / (n * m), np.linspace(0, 1, 200_001)
    half = (n + m) / 2 - 1
    variance = p * (1 - p) * (1 + half * (1 - p) / (2 - p) + half * p / (1 + p)) / (n * m)
    kept = p[(value - p) ** 2 <= norm.ppf(0.975) ** 2 * variance + 1e-15]
    ends = [stats._score_bound(value, n, m, end) for end in (0.0, 1.0)]
    assert ends == pytest.approx([kept.min(), kept.max()], abs=1e-4)


def test_three_seeds_that_all_win_are_not_certain() -> None:
    found = stats.improvement(np.array([7.0, 8.0, 9.0]), np.array([1.0, 2.0, 3.0]))
    assert (found.value, found.high) == (1.0, 1.0)
    assert found.low == pytest.approx(0.50, abs=0.01)
    turned = stats.improvement(np.array([1.0, 2.0, 3.0]), np.array([7.0, 8.0, 9.0]))
    assert (turned.value, turned.low, turned.high) == (0.0, 0.0, pytest.approx(1 - found.low))


def test_the_score_interval_holds_the_truth() -> None:
    """Normal samples a standard deviation apart: P(x > y) = Phi(1 / sqrt 2)."""
    rng, truth = np.random.default_rng(3), norm.cdf(1 / np.sqrt(2))
    for n in (3, 5, 10):
        held = [stats.improvement(rng.normal(1, 1, n), rng.normal(0, 1, n)).holds(truth) for _ in range(300)]
        assert np.mean(held) > 0.9


def test_area_and_first_step_by_hand() -> None:
    at, heights = np.array([0.0, 10.0, 40.0]), np.array([0.0, 2.0, 4.0])
    assert stats.area(at, heights) == pytest.approx((10 * 1 + 30 * 3) / 40)
    assert stats.area(at[:1], heights[:1]) == 0.0
    assert stats.first_at(at, heights, 2.0) == 10.0
    assert np.isnan(stats.first_at(at, heights, 5.0))


@pytest.mark.usefixtures("quick_resampling")
def test_every_pair_once_the_better_arm_first(results: Results) -> None:
    found = comparison.pairs(results, "coverage")
    assert [(x.first, x.second) for x in found] == [("RHMC", "QMIX"), ("RHMC", "IQL"), ("QMIX", "IQL")]
    assert [x.difference.value for x in found] == pytest.approx([0.5, 4.0, 3.5])
    raw = np.array([x.p for x in found])
    assert [x.corrected for x in found] == pytest.approx(stats.holm(raw))
    table = comparison.pairs_table(results, "coverage")
    assert table is not None
    assert table.shown["Clear"].tolist() == ["no", "yes", "yes"]
    assert table.shown["P(first better) [95 %]"][1].startswith("1.00 [0.")


def test_the_profile_counts_seeds(results: Results) -> None:
    drawing = comparison.profile(results, "coverage")
    assert drawing is not None
    for arm, rows in drawing.numbers.groupby("arm"):
        finals = results.finals("coverage", str(arm))
        assert rows["share"].tolist() == pytest.approx([np.mean(finals >= score) for score in rows["score"]])
    assert set(drawing.numbers["arm"]) == {"RHMC", "IQL", "QMIX"}


def test_the_matrix_is_of_wins(results: Results) -> None:
    drawing = comparison.matrix(results, "coverage")
    assert drawing is not None
    table = drawing.numbers.set_index(["arm", "against"])["probability"]
    assert table["RHMC", "IQL"] == 1.0
    wins = np.mean([float(a > b) + float(a == b) / 2 for a in noisy(70, 5) for b in noisy(69.5, 5)])
    assert table["RHMC", "QMIX"] == pytest.approx(wins)
    assert table["QMIX", "RHMC"] == pytest.approx(1 - wins)


@pytest.mark.usefixtures("quick_resampling")
def test_efficiency_is_to_the_level_of_a_yardstick(results: Results) -> None:
    level = comparison.reference(results, "coverage")
    assert level == (65.3, "the score of the yardstick best window")
    table = comparison.efficiency(results, "coverage")
    assert table is not None
    rows = table.numbers.set_index("arm")
    assert rows["reached"].to_dict() == {"RHMC": 5, "QMIX": 5, "IQL": 4, "VDN": 0}
    steps = []
    for _, points in results.curve("coverage", "RHMC").groupby("seed"):
        steps.append(points[points["value"] >= 65.3]["step"].min())
    assert rows["median_steps"]["RHMC"] == np.median(steps)
    assert np.isnan(rows["median_steps"]["IQL"])  # a seed never reaches it: missing, not the seeds that do
    time = comparison.time_to_level(results, "coverage")
    assert time is not None
    seconds = time.numbers.set_index("arm")["median_seconds"]
    assert seconds["RHMC"] == pytest.approx(1.5 * np.median(steps) / 150_000)
    assert np.isnan(seconds["IQL"])
    assert time.shown.set_index("Arm").loc["IQL"].tolist() == [NONE]
    areas = [np.trapezoid(x["value"], x["step"]) / 150_000 for _, x in results.curve("coverage", "IQL").groupby("seed")]
    assert rows["area"]["IQL"] == pytest.approx(np.mean(areas))


def test_time_is_shown_where_it_is_known_of_every_seed(results: Results) -> None:
    some = results.runs.assign(seconds=results.runs["seconds"].mask(results.runs["seed"] == 0))
    table = comparison.time_to_level(replace(results, runs=some), "coverage")
    assert table is None  # of every arm one seed's is not known
    one = results.runs["seconds"].mask((results.runs["seed"] == 0) & (results.runs["arm"] == "RHMC"))
    table = comparison.time_to_level(replace(results, runs=results.runs.assign(seconds=one)), "coverage")
    assert table is not None
    known = table.numbers.set_index("arm")["median_seconds"].notna()
    assert known.to_dict() == {"RHMC": False, "QMIX": True, "IQL": False, "VDN": False}


def test_without_a_yardstick_the_best_arm_gives_it(tmp_path: Path) -> None:
    found = load(write(tmp_path, study("coverage", {"RHMC": noisy(70)})), "quick")
    assert comparison.reference(found, "coverage") == (pytest.approx(63.0), "90 % of the best arm's mean final return")
    low = load(write(tmp_path / "low", study("navigation", {"RHMC": noisy(-30)}, env=NAVIGATION)), "quick")
    assert comparison.reference(low, "navigation") is None  # 90 % of a negative return is above it


def test_one_arm_is_no_comparison(tmp_path: Path) -> None:
    found = load(write(tmp_path, study("coverage", {"RHMC": noisy(70)})), "quick")
    assert comparison.pairs_table(found, "coverage") is None
    assert comparison.profile(found, "coverage") is None
    assert comparison.matrix(found, "coverage") is None


@pytest.mark.parametrize(
    ("p", "shown", "clear"),
    [
        (0.0009, "< 0.001", "yes"),
        (0.001, "0.001", "yes"),
        (0.0499, "0.050", "yes"),
        (0.05, "0.050", "no"),
        (float("nan"), NONE, NONE),
    ],
)
def test_a_pair_is_clear_below_five_percent(
    results: Results, monkeypatch: pytest.MonkeyPatch, p: float, shown: str, clear: str
) -> None:
    even = stats.Interval(0.5, 0.4, 0.6, 5)
    monkeypatch.setattr(comparison, "pairs", lambda *given: [comparison.Pair("a", "b", even, even, p, p)])
    table = comparison.pairs_table(results, "coverage")
    assert table is not None
    assert table.shown.loc[0, ["p", "p, Holm", "Clear"]].tolist() == [shown, shown, clear]


@pytest.mark.parametrize(("seeds", "limit"), [(2, "0.33"), (3, "0.1"), (4, "")])
def test_few_seeds_bound_what_ranks_can_show(tmp_path: Path, seeds: int, limit: str) -> None:
    found = load(write(tmp_path, study("coverage", {"RHMC": noisy(70, seeds), "IQL": noisy(60, seeds)})), "quick")
    table = comparison.pairs_table(found, "coverage")
    assert table is not None
    assert table.note.endswith(f" With {seeds} seeds a side no test by ranks can come below p = {limit}.") == bool(
        limit
    )


@pytest.mark.parametrize(("arms", "drawn"), [(2, False), (3, True), (12, True), (13, False)])
def test_a_matrix_is_of_three_to_twelve_arms(tmp_path: Path, arms: int, drawn: bool) -> None:
    levels = {f"arm {n}": noisy(50 + n, 2) for n in range(arms)}
    found = load(write(tmp_path, study("coverage", levels, points=2)), "quick")
    assert (comparison.matrix(found, "coverage") is not None) == drawn


@pytest.mark.parametrize(("mean", "level"), [(0.5, 0.45), (0.0, None)])
def test_a_level_needs_a_return_above_zero(tmp_path: Path, mean: float, level: float | None) -> None:
    found = load(write(tmp_path, study("navigation", {"RHMC": [mean, mean]}, env=NAVIGATION)), "quick")
    reached = comparison.reference(found, "navigation")
    assert (reached and reached.value) == (level and pytest.approx(level))
