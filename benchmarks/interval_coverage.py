"""How often each interval of the report holds the truth, and how often its tests raise a false alarm.

Values are made up with a known truth, and the report's own functions make intervals of them. Normal: seeds spread
alike to both sides. Skewed: chi-square with 3 degrees of freedom, the long tail downwards, as where a seed now and then
fails. Both have the mean 60 and the spread 4. Prints Markdown tables. An arrow marks a share that is more than a
hundredth off its nominal value, and further than chance takes it in 99 of 100 cases.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import binomtest, chi2, norm

from reports.analyses import readings
from reports.data import stats
from reports.data.stats import Interval

Values = NDArray[np.float64]

MEAN, SPREAD, GAP = 60.0, 4.0, 2.0
SEEDS = (3, 5, 10)
ARMS = 8  # equal ones, each compared with one more
STEPS = 100  # of a curve
MARGIN = 4 * SPREAD  # of the test of equivalence: wide enough that one side of it decides
FACTORS = {"a": 4, "b": 4, "c": 4}  # levels; every combination is a reading
FEW_SEEDS = 2  # of a reading
NEAR, CHANCE = 0.01, 0.01  # what an arrow does not mark
RESAMPLES, SAMPLES = 4_000, 2_000


class Shape(NamedTuple):
    """A distribution with mean 0 and spread 1. `points`: its quantiles in the middle of equal shares."""

    name: str
    draw: Callable[[np.random.Generator, tuple[int, ...]], Values]
    below: Callable[[Values], Values]
    points: Values


_MIDDLES = (np.arange(20_000) + 0.5) / 20_000
_WIDE = np.sqrt(6.0)  # of chi-square with 3 degrees
SHAPES = (
    Shape("normal", lambda rng, size: rng.normal(size=size), norm.cdf, norm.ppf(_MIDDLES)),
    Shape(
        "skewed",
        lambda rng, size: (3 - rng.chisquare(3, size)) / _WIDE,
        lambda x: chi2.sf(3 - _WIDE * x, 3),
        (3 - chi2.isf(_MIDDLES, 3)) / _WIDE,
    ),
)


class Share(NamedTuple):
    """How many of so many samples hold the truth, or raise an alarm, against the nominal share."""

    held: int
    of: int
    nominal: float

    def __str__(self) -> str:
        return f"{self.held / self.of:.3f}{self.mark}"

    @property
    def mark(self) -> str:
        """An arrow where the share is off by more than `NEAR` and than chance."""
        off = self.held / self.of - self.nominal
        if abs(off) <= NEAR or binomtest(self.held, self.of, self.nominal).pvalue >= CHANCE:
            return ""
        return " ↓" if off < 0 else " ↑"


def coverage(found: Sequence[Interval], truth: float) -> tuple[int, int]:
    """How many intervals hold the truth, of how many."""
    return sum(x.holds(truth) for x in found), len(found)


def values(rng: np.random.Generator, shape: Shape, *size: int) -> Values:
    """Final returns."""
    return MEAN + SPREAD * shape.draw(rng, size)


# Intervals over seeds


def of_mean(rng: np.random.Generator, shape: Shape, n: int, samples: int) -> tuple[int, int]:
    """Of the mean."""
    return coverage([stats.interval(x) for x in values(rng, shape, samples, n)], MEAN)


def of_iqm(rng: np.random.Generator, shape: Shape, n: int, samples: int) -> tuple[int, int]:
    """Of the mean of the middle half of all seeds that there could be."""
    middle = shape.points[len(shape.points) // 4 : -len(shape.points) // 4].mean()
    found = [stats.interval(x, stats.iqm) for x in values(rng, shape, samples, n)]
    return coverage(found, MEAN + SPREAD * float(middle))


def of_difference(rng: np.random.Generator, shape: Shape, n: int, samples: int) -> tuple[int, int]:
    """Of the difference of two means."""
    pairs = zip(values(rng, shape, samples, n) + GAP, values(rng, shape, samples, n), strict=True)
    return coverage([stats.difference(x, y) for x, y in pairs], GAP)


def of_pairs(rng: np.random.Generator, shape: Shape, n: int, samples: int) -> tuple[int, int]:
    """Of the mean difference of values that belong together."""
    y = values(rng, shape, samples, n)
    x = y + GAP + shape.draw(rng, y.shape)
    return coverage([stats.paired_difference(*pair) for pair in zip(x, y, strict=True)], GAP)


def of_change(rng: np.random.Generator, shape: Shape, n: int, samples: int) -> tuple[int, int]:
    """Of the change in percent."""
    pairs = zip(values(rng, shape, samples, n) - GAP, values(rng, shape, samples, n), strict=True)
    return coverage([stats.change(x, y) for x, y in pairs], -100 * GAP / MEAN)


def of_improvement(rng: np.random.Generator, shape: Shape, n: int, samples: int) -> tuple[int, int]:
    """Of the probability that a seed of one arm beats one of another, which is half a spread below."""
    truth = float(shape.below(shape.points + GAP / SPREAD).mean())
    pairs = zip(values(rng, shape, samples, n) + GAP, values(rng, shape, samples, n), strict=True)
    return coverage([stats.improvement(x, y) for x, y in pairs], truth)


def of_curve(rng: np.random.Generator, shape: Shape, n: int, samples: int) -> tuple[int, int]:
    """Of the points of a curve."""
    held = 0
    for _ in range(curves := -(-samples // STEPS)):
        seed, step = np.indices((n, STEPS))
        table = {"seed": seed.ravel(), "step": step.ravel(), "value": values(rng, shape, n * STEPS)}
        rows = stats.curve(pd.DataFrame(table))
        held += int(((rows["low"] <= MEAN) & (rows["high"] >= MEAN)).sum())
    return held, curves * STEPS


# Tests


def alarms_of_holm(rng: np.random.Generator, shape: Shape, n: int, samples: int) -> tuple[int, int]:
    """Families in which an arm seems to differ from the first, though all are equal."""
    families = values(rng, shape, samples, ARMS + 1, n)
    found = (stats.holm(np.array([stats.welch(x, first) for x in others])) for first, *others in families)
    return sum(bool(np.nanmin(p) < 0.05) for p in found), samples


def alarms_of_equivalence(rng: np.random.Generator, shape: Shape, n: int, samples: int) -> tuple[int, int]:
    """Arms that seem to be level, though they are the margin apart."""
    pairs = zip(values(rng, shape, samples, n) + MARGIN, values(rng, shape, samples, n), strict=True)
    return sum(stats.equivalence(x, y, MARGIN) < 0.05 for x, y in pairs), samples


# Readings


def contrast(rng: np.random.Generator, shape: Shape, spreads: Values, effects: Values) -> readings.Contrast:
    """A contrast over all combinations of levels. spreads, effects: by reading, (R,)."""
    noise = SPREAD * spreads[:, None] * shape.draw(rng, (2, len(spreads), FEW_SEEDS))
    return readings.Contrast("a part", levels(), noise[0] + effects[:, None], noise[1], 0)


def levels() -> pd.DataFrame:
    """The level of each factor by reading."""
    return pd.DataFrame(list(product(*(map(str, range(n)) for n in FACTORS.values()))), columns=list(FACTORS))


def contrasts(samples: int) -> int:
    """How many contrasts give so many intervals of readings and of levels; their intervals are not independent."""
    return -(-samples // 4)


def planted() -> Values:
    """Effects to which every level of every factor adds its number."""
    return levels().astype(float).sum(axis=1).to_numpy()


def uneven() -> Values:
    """Spreads of the readings from a half to twice, rising."""
    return np.geomspace(0.5, 2.0, len(levels()))


def of_readings(rng: np.random.Generator, shape: Shape, spreads: Values, samples: int) -> tuple[int, int]:
    """Of the effect under each reading."""
    held = _held(rng, shape, spreads, samples)
    return int(held.sum()), held.size


def of_noisy_readings(rng: np.random.Generator, shape: Shape, spreads: Values, samples: int) -> tuple[int, int]:
    """The same of the quarter of readings whose seeds spread most, where spreads differ."""
    held = _held(rng, shape, spreads, samples)[:, -len(spreads) // 4 :]
    return int(held.sum()), held.size


def _held(rng: np.random.Generator, shape: Shape, spreads: Values, samples: int) -> NDArray[np.bool_]:
    """Whether the interval of each reading holds its effect: (contrasts, R)."""
    effects = planted()
    found = [readings.intervals(contrast(rng, shape, spreads, effects)) for _ in range(contrasts(samples))]
    return np.array([[x.holds(truth) for x, truth in zip(row, effects, strict=True)] for row in found])


def of_levels(rng: np.random.Generator, shape: Shape, spreads: Values, samples: int) -> tuple[int, int]:
    """Of the effect at each level of each factor."""
    effects, table = planted(), levels()
    truth = np.array([effects[table[name] == level].mean() for name in table for level in table[name].unique()])
    fits = [contrast(rng, shape, spreads, effects).fit.levels for _ in range(contrasts(samples))]
    held = sum(int(((fit["low"] <= truth) & (fit["high"] >= truth)).sum()) for fit in fits)
    return held, len(fits) * len(truth)


def alarms_of_factors(rng: np.random.Generator, shape: Shape, spreads: Values, samples: int) -> tuple[int, int]:
    """Contrasts of which a factor seems to decide, though none does."""
    none = np.zeros(len(levels()))
    return sum(bool(readings.deciding(contrast(rng, shape, spreads, none))) for _ in range(samples)), samples


INTERVALS: dict[str, Callable[[np.random.Generator, Shape, int, int], tuple[int, int]]] = {
    "mean": of_mean,
    "IQM": of_iqm,
    "difference of means": of_difference,
    "paired difference": of_pairs,
    "change in percent": of_change,
    "P(first better)": of_improvement,
    "point of a curve": of_curve,
}
TESTS = {f"Holm, {ARMS} equal arms": alarms_of_holm, "equivalence, at the margin": alarms_of_equivalence}
READINGS = {
    "effect of a reading": (of_readings, stats.LEVEL),
    "main effect at a level": (of_levels, stats.LEVEL),
    "deciding factors, none decides": (alarms_of_factors, 1 - stats.LEVEL),
    "effect of a reading, noisiest quarter": (of_noisy_readings, stats.LEVEL),
}


def over_seeds(samples: int) -> Iterator[list[str]]:
    """Rows of intervals and tests over seeds."""
    kinds = [(name, make, stats.LEVEL) for name, make in INTERVALS.items()]
    kinds += [(name, make, 1 - stats.LEVEL) for name, make in TESTS.items()]
    for place, (name, make, nominal) in enumerate(kinds):
        cells = []
        for n, (number, shape) in product(SEEDS, enumerate(SHAPES)):
            rng = np.random.default_rng((stats.SEED, place, n, number))
            cells.append(str(Share(*make(rng, shape, n, samples), nominal)))
        yield [name, f"{nominal:.2f}", *cells]


def over_readings(samples: int) -> Iterator[list[str]]:
    """Rows of what the report has of a study with readings."""
    for place, (name, (make, nominal)) in enumerate(READINGS.items()):
        cells = []
        for number, (shape, spreads) in enumerate(product(SHAPES, (np.ones(len(levels())), uneven()))):
            rng = np.random.default_rng((stats.SEED, 100 + place, number))
            cells.append(str(Share(*make(rng, shape, spreads, samples), nominal)))
        yield [name, f"{nominal:.2f}", *cells]


def table(heads: Sequence[str], rows: Iterator[list[str]]) -> str:
    """As Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in [heads, ["---"] * len(heads), *rows])


def main() -> None:
    """Print both tables and what they took."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=SAMPLES, help=f"behind each share (default: {SAMPLES:,})")
    parser.add_argument("--resamples", type=int, default=RESAMPLES, help=f"of a bootstrap (default: {RESAMPLES:,})")
    args = parser.parse_args()
    stats.RESAMPLES = args.resamples
    start = time.process_time()
    heads = [f"{n} seeds, {shape.name}" for n, shape in product(SEEDS, SHAPES)]
    print(table(["Over seeds", "nominal", *heads], over_seeds(args.samples)))
    heads = [f"{shape.name}{words}" for shape, words in product(SHAPES, ("", ", spreads differ"))]
    readings_of = f"Over {len(levels())} readings, {FEW_SEEDS} seeds"
    print(f"\n{table([readings_of, 'nominal', *heads], over_readings(args.samples))}")
    spent = time.process_time() - start
    print(f"\n{args.samples:,} samples, {args.resamples:,} resamples; {spent:.0f} s of processor time.")


if __name__ == "__main__":
    main()
