"""Statistics over seeds. Every interval comes from a bootstrap with one fixed generator: same numbers in, same out.

Which bootstrap. Seeds are few (3 to 10), where the plain percentile interval is too narrow, and so is BCa. Measured on
normal data (3000 samples each), a "95 %" interval of the mean held the truth in this share of cases:

    n          3     4     5     7     10
    percentile .76   .81   .83   .88   .90
    BCa        .73   .84   .82   .85   .91
    expanded   .76   .88   .91   .94   .94

`expanded` is the percentile interval at a wider nominal level, so chosen that it is as wide as Student's t interval
would be (Hesterberg 2015, "What teachers should know about the bootstrap", 10.1080/00031305.2015.1089789). It is what
this module uses. No resampling can reach beyond the smallest and largest value, so of three seeds the interval is
their range: `Interval.few` marks what rests on fewer than `FEW`. Comparisons of two samples take the level of the
smaller one; the same measurement gives .90 for 3 and 3 seeds, .96 for 5 and 5, .97 for 10 and 10.
"""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import mannwhitneyu, norm, t, trim_mean

SEED = 20_240
RESAMPLES = 40_000  # the cut tails of few seeds are thin
LEVEL = 0.95
FEW = 5  # below it the measured coverage is under 90 %

Values = NDArray[np.float64]
Statistic = Callable[[Values], Values]  # (..., n) -> (...)
Contrast = Callable[[Values, Values], Values]  # (..., n), (..., m) -> (...)


class Interval(NamedTuple):
    """An estimate with its 95 % interval; the ends are NaN when fewer than two seeds are there."""

    value: float
    low: float
    high: float
    n: int  # seeds; of the smaller sample in a comparison

    @property
    def few(self) -> bool:
        """Whether the interval rests on too few seeds to be trusted at its nominal level."""
        return self.n < FEW

    def above(self, x: float) -> bool:
        """Whether the whole interval lies above x. False when there is no interval."""
        return bool(self.low > x)

    def below(self, x: float) -> bool:
        """Whether the whole interval lies below x. False when there is no interval."""
        return bool(self.high < x)

    def holds(self, x: float) -> bool:
        """Whether x lies in the interval. False when there is no interval."""
        return bool(self.low <= x <= self.high)


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
    """A statistic of one arm's seeds. x: (n,), n >= 1."""
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
    """Probability that a random seed of x beats one of y, ties counting half: Mann-Whitney's U / (n m)."""
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    value = float(mannwhitneyu(x, y).statistic) / (len(x) * len(y))
    return contrast(_wins, x, y)._replace(value=value)


def contrast(function: Contrast, x: Values, y: Values) -> Interval:
    """A function of two independent samples, each resampled by itself."""
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    n = min(len(x), len(y))
    return _interval(float(function(x, y)), lambda: function(_resample(x), _resample(y, 1)), n)


def curve(points: pd.DataFrame) -> pd.DataFrame:
    """Mean and interval over seeds at every step.

    Args:
        points: columns seed, step, value; one row per seed and step.

    Returns:
        Columns step, mean, low, high, n, by step. Where a seed has not come so far, n is smaller; low and high are NaN
        where n = 1.
    """
    table = points.pivot_table(index="seed", columns="step", values="value")
    rows = []
    for step in table.columns:
        value, low, high, n = interval(table[step].dropna().to_numpy())
        rows.append((step, value, low, high, n))
    return pd.DataFrame(rows, columns=["step", "mean", "low", "high", "n"])


def _wins(x: Values, y: Values) -> Values:
    gap = x[..., :, None] - y[..., None, :]
    return np.asarray(((np.sign(gap) + 1) / 2).mean((-2, -1)))


def _resample(x: Values, stream: int = 0) -> Values:
    return x[_picks(len(x), stream)]


@cache
def _picks(n: int, stream: int) -> NDArray[np.int64]:
    """Which values each resample takes: (RESAMPLES, n). Samples of different streams are drawn independently."""
    return np.random.default_rng((SEED, stream)).integers(0, n, (RESAMPLES, n))


def _interval(value: float, draw: Callable[[], Values], n: int) -> Interval:
    if n < 2:
        return Interval(value, np.nan, np.nan, n)
    cut = tail(n)
    low, high = np.quantile(draw(), [cut, 1 - cut])
    return Interval(value, float(low), float(high), n)
