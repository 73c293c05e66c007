"""Statistics over seeds. Intervals of means come from a bootstrap with one fixed generator: same numbers in, same out.

Which bootstrap. Seeds are few (3 to 10), where the plain percentile interval is too narrow, and so is BCa. Measured on
normal data (3000 samples each), a "95 %" interval of the mean held the truth in this share of cases, by chance a
hundredth more or less (`benchmarks/interval_coverage.py` measures every interval in use, with skewed data too):

    n          3     4     5     7     10
    percentile .76   .81   .83   .88   .90
    BCa        .73   .84   .82   .85   .91
    expanded   .76   .88   .91   .94   .94

`expanded` is the percentile interval at a wider nominal level, so chosen that it is as wide as Student's t interval
would be (Hesterberg 2015, "What teachers should know about the bootstrap", 10.1080/00031305.2015.1089789). It is what
this module uses from `FEW` seeds on. No resampling can reach beyond the smallest and largest value: of fewer seeds
there is their `Range`, which is shown as one and not as a 95 % interval. Comparisons of two samples take the level of
the smaller one, which is somewhat wide from five seeds on.
"""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import mannwhitneyu, norm, t, trim_mean, ttest_1samp, ttest_ind, ttest_ind_from_stats

SEED = 20_240
RESAMPLES = 40_000  # the cut tails of few seeds are thin
LEVEL = 0.95
FEW = 5  # with fewer seeds a bootstrap ends at the smallest and largest value

Values = NDArray[np.float64]
Statistic = Callable[[Values], Values]  # (..., n) -> (...)
Contrast = Callable[[Values, Values], Values]  # (..., n), (..., m) -> (...)


class Interval(NamedTuple):
    """An estimate with its 95 % interval; the ends are NaN when fewer than two seeds are there."""

    value: float
    low: float
    high: float
    n: int  # seeds; of the smaller sample in a comparison

    def above(self, x: float) -> bool:
        """True if the whole interval lies above x. False when there is no interval."""
        return bool(self.low > x)

    def below(self, x: float) -> bool:
        """True if the whole interval lies below x. False when there is no interval."""
        return bool(self.high < x)

    def holds(self, x: float) -> bool:
        """True if x lies in the interval. False when there is no interval."""
        return bool(self.low <= x <= self.high)


class Range(Interval):
    """An estimate of fewer than `FEW` seeds with the least and the greatest value that their resamples have.

    Of a mean these are the worst and the best seed; of a difference, every seed of one sample against every one of the
    other lies between them. No 95 % interval: the module's docstring has what three seeds' range holds.
    """

    __slots__ = ()


def mean(x: Values) -> Values:
    """Mean over the last axis."""
    return np.asarray(np.mean(x, axis=-1))


def iqm(x: Values) -> Values:
    """Interquartile mean over the last axis: a quarter, rounded down, is cut off at each end (below 4 values: none)."""
    return np.asarray(trim_mean(x, 0.25, axis=-1))


@cache
def tail(n: int) -> float:
    """Probability cut off at each end of n values' bootstrap distribution (see the module's docstring)."""
    return float(norm.cdf(-np.sqrt(n / (n - 1)) * t.ppf((1 + LEVEL) / 2, n - 1)))


def interval(x: Values, statistic: Statistic = mean) -> Interval:
    """A statistic of one arm's seeds; a `Range` below `FEW`. x: (n,), n >= 1."""
    x = np.asarray(x, dtype=np.float64)
    return _interval(float(statistic(x)), lambda: statistic(_resample(x)), len(x))


def difference(x: Values, y: Values) -> Interval:
    """mean(x) - mean(y) of independent seeds. x: (n,), y: (m,)."""
    return contrast(lambda a, b: mean(a) - mean(b), x, y)


def paired_difference(x: Values, y: Values) -> Interval:
    """Mean of x - y where value i of both belongs together. x, y: (n,).

    Raises:
        ValueError: the lengths differ.
    """
    if len(x) != len(y):
        raise ValueError(f"pairs need equal lengths, not {len(x)} and {len(y)}")
    return interval(np.asarray(x) - np.asarray(y))


def change(x: Values, reference: Values) -> Interval:
    """Change of mean(x) against mean(reference), in percent of the latter's size: -50 is half lost."""
    return contrast(lambda a, b: 100 * (mean(a) - mean(b)) / np.abs(mean(b)), x, reference)


def improvement(x: Values, y: Values) -> Interval:
    """Probability that a random seed of x beats one of y, ties counting half: Mann-Whitney's U / (n m).

    The interval is Newcombe's score interval (2006, "Confidence intervals for an effect size measure based on the
    Mann-Whitney statistic. Part 2", method 5, 10.1002/sim.2324), no bootstrap: where every seed of x beats every seed
    of y, each resample says 1, and a bootstrap would claim certainty. Three seeds against three that win all nine
    comparisons give 0.50 to 1; fewer cannot exclude a coin.
    """
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    n, m = len(x), len(y)
    value = float(mannwhitneyu(x, y).statistic) / (n * m)
    if min(n, m) < 2:
        return Interval(value, np.nan, np.nan, min(n, m))
    return Interval(value, _score_bound(value, n, m, 0.0), _score_bound(value, n, m, 1.0), min(n, m))


def welch(x: Values, y: Values) -> float:
    """Two-sided p of Welch's test that two samples have one mean; NaN below two values or without any spread."""
    if min(len(x), len(y)) < 2 or (np.ptp(x) == 0 and np.ptp(y) == 0):
        return float("nan")
    # From the moments: `ttest_ind` itself warns of a sample whose values are all alike.
    moments = [(np.mean(one), np.std(one, ddof=1), len(one)) for one in (x, y)]
    return float(ttest_ind_from_stats(*moments[0], *moments[1], equal_var=False).pvalue)


def equivalence(x: Values, y: Values, margin: float) -> float:
    """p of two one-sided Welch tests that the means differ by less than `margin`: below 0.05 they are level.

    NaN below two values in a sample; 0 or 1 where there is no spread at all.
    """
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if min(len(x), len(y)) < 2:
        return float("nan")
    if np.ptp(x) == 0 and np.ptp(y) == 0:
        return float(abs(x[0] - y[0]) >= margin)
    below = ttest_ind(x, y - margin, equal_var=False, alternative="greater").pvalue
    above = ttest_ind(x, y + margin, equal_var=False, alternative="less").pvalue
    return float(max(below, above))


def equivalence_of_pairs(gaps: Values, margin: float) -> float:
    """As `equivalence`, of differences between values that belong together. gaps: (n,)."""
    if len(gaps) < 2:
        return float("nan")
    if np.ptp(gaps) == 0:
        return float(abs(gaps[0]) >= margin)
    below = ttest_1samp(gaps, -margin, alternative="greater").pvalue
    above = ttest_1samp(gaps, margin, alternative="less").pvalue
    return float(max(below, above))


def holm(p: Values) -> Values:
    """p values corrected for how many they are (Holm 1979): below 0.05 together at most once in twenty families.

    Args:
        p: (k,); NaN (no test) is not counted and stays.
    """
    p = np.asarray(p, dtype=np.float64)
    out = p.copy()
    tested = np.flatnonzero(~np.isnan(p))
    order = tested[np.argsort(p[tested], kind="stable")]
    factors = np.arange(len(order), 0, -1)
    out[order] = np.minimum(1.0, np.maximum.accumulate(factors * p[order])) if len(order) else p[order]
    return out


def area(steps: Values, values: Values) -> float:
    """Mean height of a curve: its area over its width, by trapezoids. steps, values: (k,), k >= 1, steps rising."""
    width = float(steps[-1] - steps[0])
    return float(np.trapezoid(values, steps) / width) if width > 0 else float(values[-1])


def first_at(steps: Values, values: Values, level: float) -> float:
    """First step at which a curve is at or above a level; NaN if it never is."""
    reached = np.flatnonzero(np.asarray(values) >= level)
    return float(steps[reached[0]]) if len(reached) else float("nan")


def contrast(function: Contrast, x: Values, y: Values) -> Interval:
    """A function of two independent samples, each resampled by itself; a `Range` where one has fewer than `FEW`."""
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    n = min(len(x), len(y))
    return _interval(float(function(x, y)), lambda: function(_resample(x), _resample(y, 1)), n)


def curve(points: pd.DataFrame) -> pd.DataFrame:
    """Mean and interval over seeds at every step, below `FEW` seeds their range.

    Args:
        points: columns seed, step, value; one row per seed and step.

    Returns:
        Columns step, mean, low, high, n, by step. Where a seed has not come so far, n is smaller; low and high are NaN
        where n = 1.
    """
    table = points.pivot_table(index="seed", columns="step", values="value")
    counts = table.notna().sum()
    parts = [_means(table[table.columns[counts == n]], int(n)) for n in sorted(set(counts))]
    columns = ["step", "mean", "low", "high", "n"]
    rows = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)
    return rows.sort_values("step", ignore_index=True)[columns]


def _means(table: pd.DataFrame, n: int) -> pd.DataFrame:
    """`interval` of each column of a table (seeds x steps) with n seeds each, all columns at once."""
    x = np.array([table[step].dropna().to_numpy(np.float64) for step in table.columns]).T  # (n, k)
    found = pd.DataFrame({"step": table.columns, "mean": x.mean(0), "low": np.nan, "high": np.nan, "n": n})
    if n > 1:
        found["low"], found["high"] = np.quantile(x.T @ _shares(n), _cuts(n), axis=1)
    return found


def _score_bound(value: float, n: int, m: int, end: float) -> float:
    """The value at which the score interval of U / (n m) ends towards `end`, 0 or 1."""
    if abs(value - end) < 1e-12:
        return end
    z, half = float(norm.ppf((1 + LEVEL) / 2)), (n + m) / 2 - 1

    def excess(p: float) -> float:
        variance = p * (1 - p) * (1 + half * ((1 - p) / (2 - p) + p / (1 + p))) / (n * m)
        return (value - p) ** 2 - z**2 * variance

    inner = value + (end - value) * 1e-9  # at value = 0 or 1 itself both sides are 0
    return float(brentq(excess, end, inner))


def _resample(x: Values, stream: int = 0) -> Values:
    return x[_picks(len(x), stream)]


@cache
def _picks(n: int, stream: int) -> NDArray[np.int64]:
    """Indices of the values in each resample: (RESAMPLES, n). Samples of different streams are drawn independently."""
    return np.random.default_rng((SEED, stream)).integers(0, n, (RESAMPLES, n))


@cache
def _shares(n: int) -> Values:
    """Share of each value in the mean of each resample: (n, RESAMPLES)."""
    return np.stack([(_picks(n, 0) == k).mean(1) for k in range(n)])


def _interval(value: float, draw: Callable[[], Values], n: int) -> Interval:
    if n < 2:
        return Interval(value, np.nan, np.nan, n)
    low, high = np.quantile(draw(), _cuts(n))
    return (Range if n < FEW else Interval)(value, float(low), float(high), n)


def _cuts(n: int) -> list[float]:
    """The quantiles of the resamples at which an interval ends, or a range."""
    return [0.0, 1.0] if n < FEW else [tail(n), 1 - tail(n)]
