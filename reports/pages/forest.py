"""Every claim as a row of one plot: the paper's value and ours, on an axis that all claims share.

An axis for all: the distance from the paper's number, or from a tie where the paper states an order, in what the rule
of the claim counts as one step. It is linear around zero and logarithmic further out, so that nothing is cut off.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from reports.claims.headlines import PERCENT, STEPS, Headline
from reports.claims.verdicts import Claim
from reports.render.tables import NONE, estimate, joined, number, steps, tick

LIMIT = 20.0  # steps from the middle to either end
TICKS = (-10, -3, -1, 0, 1, 3, 10)
Span = tuple[float, float]  # where it begins and how long it is, in percent of the axis


class Row(NamedTuple):
    """A claim in the plot; what has no number has no place there. Places are in percent of the axis."""

    claim: Claim
    paper: str
    ours: str
    what: str
    sentence: str  # for those who do not see it
    band: Span | None = None  # where the claim would hold
    bar: Span | None = None  # interval or range
    dot: float | None = None
    stated: float | None = None  # the paper's number


def rows(claims: Sequence[Claim]) -> list[Row]:
    """A row for each claim, in their order."""
    return [_row(claim) for claim in claims]


def ticks() -> list[tuple[float, str]]:
    """Places and words of the axis."""
    return [(place(x), f"{x:+d}".replace("-", "−") if x else "0") for x in TICKS]


def place(x: float) -> float:
    """Steps from the middle as percent of the axis."""
    share = math.asinh(max(-LIMIT, min(LIMIT, x))) / math.asinh(LIMIT)
    return round(50 + 50 * share, 2)


def scale(claims: Sequence[Claim]) -> str:
    """One step of the axis for each unit: `5 points of return, 10 % or 50 k to 500 k steps`."""
    sizes: dict[str, set[float]] = {}
    for claim in claims:
        if claim.headline:
            sizes.setdefault(claim.headline.unit, set()).add(abs(claim.headline.pace))
    shown = {unit: [_size(x, unit) for x in sorted(found)] for unit, found in sizes.items()}
    return joined([f"{' or '.join(found)} {unit}" for unit, found in shown.items()]).replace(" and ", " or ")


def show(x: float, unit: str) -> str:
    """A number of a headline without its unit; steps have a sign of their own."""
    return f"{'−' * (x < 0)}{steps(abs(x))}" if unit == STEPS else number(x)


def _size(x: float, unit: str) -> str:
    return steps(x) if unit == STEPS else f"{x:g}"


def _row(claim: Claim) -> Row:
    found = claim.headline
    if found is None or math.isnan(found.ours.value):
        return Row(claim, claim.paper, NONE, "", _sentence(claim, None))
    ours = estimate(found.ours, lambda x: show(x, found.unit)) + (" %" if found.unit == PERCENT else "")
    bar = None if math.isnan(found.ours.low) else _span(found, found.ours.low, found.ours.high)
    return Row(
        claim,
        _stated(found),
        ours,
        found.what,
        _sentence(claim, ours),
        band=None if math.isnan(found.low) else _span(found, found.low, found.high),
        bar=bar,
        dot=place(found.place(found.ours.value)),
        stated=None if math.isnan(found.paper) else place(found.place(found.paper)),
    )


def _span(found: Headline, low: float, high: float) -> Span:
    """The part of the axis between two values."""
    ends = sorted(place(found.place(x)) for x in (low, high))
    return ends[0], round(ends[1] - ends[0], 2)


def _stated(found: Headline) -> str:
    """Value of the paper: its number, or the side on which it has ours."""
    if not math.isnan(found.paper):
        return show(found.paper, found.unit) + (" %" if found.unit == PERCENT else "")
    end, sign = (found.low, ">") if math.isinf(found.high) else (found.high, "<")
    return f"{sign} {show(end, found.unit) if found.unit == STEPS else tick(end)}"


def _sentence(claim: Claim, ours: str | None) -> str:
    """A row in words."""
    unit = "" if claim.headline is None or claim.headline.unit == PERCENT else f" {claim.headline.unit}"
    said = f"Ours: {claim.headline.what}, {ours}{unit}." if claim.headline and ours else "Nothing of ours to show."
    return f"{claim.id}, {claim.label}: {claim.judgement}. Paper: {claim.paper}. {said}"
