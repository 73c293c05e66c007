"""The one quantity of a claim that is shown beside the paper's value, and where the claim would hold."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from reports.data.stats import Interval

POINTS, STEPS, PERCENT = "points of return", "steps", "%"  # units
OPEN = float("inf")


class Headline(NamedTuple):
    """The quantity of a claim that decides it; of several comparisons the one that is least in the claim's favour.

    Attributes:
        what: the quantity.
        unit: of every number here.
        ours: with its interval or range; NaN where there is none.
        paper: the paper's number; NaN where it states an order alone.
        low, high: the claim holds for values between them; both NaN where no value would make it hold.
        origin: the paper's number; a tie or no change where it states an order.
        pace: what counts as one step away from the origin; negative where less is more than the paper says.
    """

    what: str
    unit: str
    ours: Interval
    paper: float
    low: float
    high: float
    origin: float
    pace: float

    def place(self, value: float) -> float:
        """A value as steps from the origin: right of zero is as the paper says, or more."""
        return (value - self.origin) / self.pace


def ahead(
    gaps: Mapping[str, Interval], pace: float, *, unit: str = POINTS, paper: float = np.nan, least: float = 0.0
) -> Headline:
    """The smallest of gaps that should all be above `least`."""
    name = min(gaps, key=lambda one: gaps[one].value)
    return Headline(name, unit, gaps[name], paper, least, OPEN, 0.0, pace)


def behind(gaps: Mapping[str, Interval], pace: float, *, unit: str = POINTS, paper: float = np.nan) -> Headline:
    """The largest of gaps that should all be below zero."""
    name = max(gaps, key=lambda one: gaps[one].value)
    return Headline(name, unit, gaps[name], paper, -OPEN, 0.0, 0.0, -pace)


def about(found: Mapping[str, Interval], level: float, margin: float, *, unit: str = POINTS, sign: int = 1) -> Headline:
    """The quantity that is furthest from a level; all should be within a margin of it. sign: -1 if less is more."""
    name = max(found, key=lambda one: abs(found[one].value - level))
    return Headline(name, unit, found[name], level, level - margin, level + margin, level, sign * margin)


def at_most(what: str, ours: Interval, limit: float, pace: float, *, unit: str) -> Headline:
    """A quantity that should not be above the paper's."""
    return Headline(what, unit, ours, limit, -OPEN, limit, limit, -pace)


def at_odds(what: str, ours: Interval, paper: float, pace: float, *, least: float = np.nan) -> Headline:
    """A number of the paper that cannot be, beside ours. least: from where ours would leave room for it, if at all."""
    return Headline(what, POINTS, ours, paper, least, np.nan if np.isnan(least) else OPEN, paper, pace)
