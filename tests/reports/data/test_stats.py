"""Statistics against scipy, counting by hand, and what an interval is for: holding the truth."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import bootstrap, norm, t

from reports.data import stats

samples = st.lists(st.integers(-50, 50).map(float), min_size=2, max_size=10).map(np.array)


def drawn(n: int, seed: int = 0, centre: float = 60.0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(centre, 4, n)


@pytest.mark.parametrize("n", [3, 5, 10])
def test_interval_of_the_mean_is_scipys_at_the_widened_level(n: int) -> None:
    x = drawn(n)
    ours = stats.interval(x)
    level = 1 - 2 * stats.tail(n)
    theirs = bootstrap((x,), np.mean, n_resamples=40_000, confidence_level=level, method="percentile", rng=1)
    assert ours.value == pytest.approx(x.mean())
    assert (ours.low, ours.high) == pytest.approx(tuple(theirs.confidence_interval), abs=0.25)
    assert ours.n == n


@pytest.mark.parametrize("m", [8, 10])
def test_interval_of_a_difference_is_scipys(m: int) -> None:
    x, y = drawn(10), drawn(m, 1, 55.0)

    def gap(a: NDArray[np.float64], b: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
        return np.asarray(a.mean(axis) - b.mean(axis))

    level = 1 - 2 * stats.tail(m)
    theirs = bootstrap((x, y), gap, n_resamples=40_000, confidence_level=level, method="percentile", rng=1)
    ours = stats.difference(x, y)
    assert ours.value == pytest.approx(x.mean() - y.mean())
    assert (ours.low, ours.high) == pytest.approx(tuple(theirs.confidence_interval), abs=0.25)
    assert ours.n == m


@pytest.mark.parametrize("n", [3, 5, 10])
def test_level_makes_the_width_that_of_student(n: int) -> None:
    spread = np.sqrt((n - 1) / n)  # of the resampled means, in standard errors
    assert norm.ppf(stats.tail(n)) * spread == pytest.approx(-t.ppf(0.975, n - 1))


@pytest.mark.usefixtures("quick_resampling")
def test_intervals_hold_the_truth_as_often_as_documented() -> None:
    rng = np.random.default_rng(7)
    share = {
        n: np.mean([stats.interval(rng.normal(size=n)).holds(0.0) for _ in range(400)]) for n in (3, stats.FEW, 10)
    }
    assert share[3] == pytest.approx(0.755, abs=0.06)
    assert share[5] > 0.87
    assert share[10] > 0.91


def test_three_seeds_give_their_range() -> None:
    assert stats.interval(np.array([1.0, 5.0, 3.0])) == (3.0, 1.0, 5.0, 3)


def test_one_seed_gives_no_interval() -> None:
    found = stats.interval(np.array([4.0]))
    assert found.value == 4.0
    assert np.isnan([found.low, found.high]).all()
    assert [found.above(0), found.below(9), found.holds(4.0)] == [False] * 3
    assert np.isnan(stats.difference(np.array([4.0]), drawn(5)).low)


def test_iqm_by_hand() -> None:
    assert stats.iqm(np.array([100.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, -90.0])) == pytest.approx(3.5)  # of 2 to 5
    assert stats.iqm(np.array([0.0, 3.0, 9.0])) == pytest.approx(4.0)  # nothing to cut
    assert stats.iqm(np.array([[0.0, 2.0, 4.0, 90.0], [1.0, 1.0, 1.0, 1.0]])) == pytest.approx(np.array([3.0, 1.0]))


def test_change_by_hand() -> None:
    found = stats.change(np.array([35.6, 35.6]), np.array([70.5, 70.5]))
    assert found.value == pytest.approx(-49.5035, abs=1e-4)
    assert found.low == pytest.approx(found.value)
    assert stats.change(np.array([-30.0]), np.array([-20.0])).value == pytest.approx(-50)  # worse is below 0 here too


def test_pairs() -> None:
    x, noise = drawn(6), np.array([0.9, 1.0, 1.1, 1.0, 0.9, 1.1])
    paired, free = stats.paired_difference(x + noise, x), stats.difference(x + noise, x)
    assert paired.value == pytest.approx(free.value)
    assert paired.high - paired.low < 0.5 < free.high - free.low
    with pytest.raises(ValueError, match="6 and 5"):
        stats.paired_difference(x, x[:5])


@settings(deadline=None, max_examples=25)
@given(samples, samples)
def test_improvement_counts_pairs(x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
    wins = sum(float(a > b) + float(a == b) / 2 for a in x for b in y)
    assert stats.improvement(x, y).value == pytest.approx(wins / (len(x) * len(y)))


def test_improvement_interval() -> None:
    sure = stats.improvement(drawn(5, 0, 90.0), drawn(5))
    assert (sure.value, sure.high, sure.n) == (1.0, 1.0, 5)
    assert 0.5 < sure.low < 0.8
    even = stats.improvement(np.array([1.0, 2.0, 3.0, 4.0, 5.0]), np.array([1.0, 2.0, 3.0, 4.0, 5.0]))
    assert even.value == 0.5
    assert even.low < 0.25 < 0.75 < even.high


@settings(deadline=None, max_examples=25)
@given(samples, st.integers(-100, 100))
def test_intervals_move_with_their_values(x: NDArray[np.float64], shift: int) -> None:
    here, there = stats.interval(x), stats.interval(x + shift)
    assert here.low <= here.value + 1e-9
    assert here.high >= here.value - 1e-9
    assert (there.low, there.high) == pytest.approx((here.low + shift, here.high + shift))


def test_the_same_twice() -> None:
    assert stats.difference(drawn(5), drawn(6, 1)) == stats.difference(drawn(5), drawn(6, 1))


def test_curve_with_a_seed_behind() -> None:
    points = pd.DataFrame(
        [(0, 0, 1.0), (0, 10, 4.0), (0, 20, 6.0), (1, 0, 3.0), (1, 10, 8.0), (2, 0, 5.0)],
        columns=["seed", "step", "value"],
    )
    rows = stats.curve(points.sample(frac=1, random_state=3))
    assert rows["step"].tolist() == [0, 10, 20]
    assert rows["mean"].tolist() == [3.0, 6.0, 6.0]
    assert rows["n"].tolist() == [3, 2, 1]
    assert rows["low"].tolist()[0] == 1.0
    assert rows[["low", "high"]].iloc[2].isna().all()


def test_a_curve_has_the_interval_of_every_point() -> None:
    rng = np.random.default_rng(5)
    rows = [(seed, step, rng.normal(60, 4)) for seed in range(6) for step in range(0, 90, 10) if seed < 4 or step < 50]
    points = pd.DataFrame(rows, columns=["seed", "step", "value"])
    for row in stats.curve(points).itertuples():
        own = stats.interval(points[points["step"] == row.step]["value"].to_numpy())
        assert (row.mean, row.low, row.high, row.n) == pytest.approx(tuple(own))


def test_the_resamples_are_those_of_the_published_reports() -> None:
    assert stats.interval(drawn(5)) == pytest.approx((60.16262300178984, 58.180174115251404, 62.14993665829322, 5))
    found = stats.difference(drawn(5), drawn(6, 1))
    assert found == pytest.approx((-0.8681854109982297, -4.249533404232246, 3.887641473663647, 5), abs=1e-9)


@pytest.mark.parametrize("n", [2, 3, 4])
def test_fewer_than_five_seeds_give_their_range_and_no_interval(n: int) -> None:
    x, y = drawn(n), drawn(7, 1)
    assert type(stats.interval(x)) is stats.Range
    assert stats.interval(x) == pytest.approx((x.mean(), x.min(), x.max(), n))
    assert stats.interval(x, stats.iqm)[1:3] == pytest.approx((x.min(), x.max()))
    assert all(type(found) is stats.Range for found in (stats.difference(x, y), stats.change(y, x)))
    points = pd.DataFrame({"seed": range(n), "step": 0, "value": x})
    assert stats.curve(points)[["low", "high"]].to_numpy()[0] == pytest.approx((x.min(), x.max()))


def test_a_range_of_a_difference_is_every_seed_against_every_other() -> None:
    x, y = drawn(3), drawn(3, 1)
    assert stats.difference(x, y)[1:3] == pytest.approx((x.min() - y.max(), x.max() - y.min()))


def test_five_seeds_give_an_interval_and_so_does_what_is_no_bootstrap() -> None:
    x = drawn(5)
    assert type(stats.interval(x)) is stats.Interval
    assert x.min() < stats.interval(x).low < stats.interval(x).high < x.max()
    assert type(stats.improvement(drawn(3), drawn(3, 1))) is stats.Interval
    assert type(stats.interval(drawn(1))) is stats.Interval


def test_the_ends_of_an_interval_belong_to_it() -> None:
    found = stats.Interval(2.0, 1.0, 3.0, 5)
    assert [found.holds(x) for x in (0.9, 1.0, 3.0, 3.1)] == [False, True, True, False]
    assert [found.above(x) for x in (0.9, 1.0)] == [True, False]
    assert [found.below(x) for x in (3.0, 3.1)] == [False, True]
