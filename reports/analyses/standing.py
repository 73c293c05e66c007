"""Standing of the arms of a study against the best one: clearly below, level, or not to be told with these seeds.

Clear is Welch's test below 0.05 after Holm's correction over all pairs of the study, as in the table of pairs. Level is
equivalence within `MARGIN`, corrected over the arms that are not clear. What is neither had too few seeds: about how
many would show the gap that is there, if spreads stay what they are, is the power of a t test at the level that Holm's
correction leaves to the pairs that are not clear yet.
"""

from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from statsmodels.stats.power import TTestIndPower

from reports.analyses.comparison import CLEAR, compared, pairs
from reports.analyses.equivalence import MARGIN
from reports.data.frame import Results
from reports.data.stats import Values, equivalence, holm
from reports.render.tables import describe_task, joined, number

POWER = 0.8
LIMIT = 1_000  # seeds; more are not counted
NAMED = 4  # arms of one standing that a sentence names


class Open(NamedTuple):
    """An arm that cannot be told from the best one. seeds: of each arm that would be needed; None above `LIMIT`."""

    arm: str
    gap: float
    seeds: int | None


class Standing(NamedTuple):
    """The arms of one task, best mean first. `fewest`: seeds of the arm with the fewest; `lone`: arms with one seed."""

    best: str
    value: float
    worse: tuple[str, ...]
    gaps: tuple[float, float]  # least and largest gap to these
    level: tuple[str, ...]
    open: tuple[Open, ...]
    fewest: int


def standings(results: Results, study: str) -> list[tuple[str, Standing]]:
    """Each task of a study in words, and where its arms stand; a task with no two comparable arms is left out."""
    found = []
    order = compared(results, study)
    for env, own in results.by_task(study):
        arms = [arm for arm in order if arm in own]
        if len(arms) > 1:
            found.append((describe_task(env), _standing(results, study, arms)))
    return found


def _standing(results: Results, study: str, arms: Sequence[str]) -> Standing:
    best, values = arms[0], {arm: results.finals(study, arm) for arm in arms}
    every = pairs(results, study)
    against = {pair.second: pair for pair in every if pair.first == best}
    waiting = max(1, sum(pair.corrected >= CLEAR for pair in every))
    worse = [arm for arm in arms[1:] if against[arm].corrected < CLEAR]
    rest = [arm for arm in arms[1:] if arm not in worse]
    p = holm(np.array([equivalence(values[best], values[arm], MARGIN) for arm in rest]))
    level = [arm for arm, one in zip(rest, p, strict=True) if one < CLEAR]
    gap = {arm: float(values[best].mean() - values[arm].mean()) for arm in arms}
    left = [Open(arm, gap[arm], _more(values[best], values[arm], CLEAR / waiting)) for arm in rest if arm not in level]
    gaps = (min(gap[arm] for arm in worse), max(gap[arm] for arm in worse)) if worse else (np.nan, np.nan)
    fewest = min(len(one) for one in values.values())
    return Standing(best, float(values[best].mean()), tuple(worse), gaps, tuple(level), tuple(left), fewest)


def _more(x: Values, y: Values, alpha: float) -> int | None:
    """As `needed`, and more than there are: these did not do."""
    found = needed(x, y, alpha)
    return None if found is None else max(found, min(len(x), len(y)) + 1)


def needed(x: Values, y: Values, alpha: float) -> int | None:
    """Seeds of each arm at which a two-sided t test at `alpha` finds the gap of two samples with a power of `POWER`.

    The gap and the spread are those of the samples, of three seeds a rough guess. None above `LIMIT`; 2 without spread.
    """
    gap = abs(float(np.mean(x) - np.mean(y)))
    spread = float(np.sqrt((np.var(x, ddof=1) + np.var(y, ddof=1)) / 2))
    if gap == 0:
        return None
    if spread == 0:
        return 2

    def enough(seeds: int) -> bool:
        # The side of the gap alone: the far one adds next to nothing, and is NaN where it is too small for the library.
        found = TTestIndPower().power(gap / spread, seeds, alpha / 2, alternative="larger")
        return not found < POWER  # NaN where it is 1 within rounding

    found = 2 + bisect_left(range(2, LIMIT + 1), True, key=enough)
    return found if found <= LIMIT else None


def sentence(results: Results, study: str) -> str:
    """Standing of the arms, in a sentence a task; the first sentence of a study's report."""
    found = standings(results, study)
    if not found:
        return _alone(results, study)
    several = len(results.by_task(study)) > 1
    return " ".join(f"{f'{task}: ' if several else ''}{spoken(one)}" for task, one in found)


def _alone(results: Results, study: str) -> str:
    done = [arm for arm in results.arms(study) if len(results.finals(study, arm))]
    if not done:
        return "No answer yet: no run is finished."
    if len(results.arms(study)) == 1:
        return f"{_quoted(done[0])} ends at {number(float(results.finals(study, done[0]).mean()))}; it is the only arm."
    best = max(done, key=lambda arm: float(results.finals(study, arm).mean()))
    ends = f"{_quoted(best)} ends highest, at {number(float(results.finals(study, best).mean()))}"
    return f"{ends}, which says little: no two arms have two finished seeds each, and one seed has no spread."


def spoken(found: Standing) -> str:
    """A standing in words."""
    parts = []
    if found.worse:
        low, high = (number(gap) for gap in found.gaps)
        by = low if low == high else f"{low} to {high}"
        parts.append(f"clearly better than {_listed(found.worse)} (by {by})")
    if found.level:
        verb = "are" if len(found.level) > 1 else "is"
        parts.append(f"{_listed(found.level)} {verb} level with it (within {MARGIN:g})")
    if found.open:
        parts.append(f"{_untold(found.open)}, where there are {found.fewest}")
    first = f"{_quoted(found.best)} ends highest, at {number(found.value)}"
    return f"{first}{', ' if found.worse else '; '}{'; '.join(parts)}."


def _untold(open_: Sequence[Open]) -> str:
    """Arms that cannot be told from the best one, and about how many seeds would be needed."""
    counts = [one.seeds for one in open_]
    least = min((n for n in counts if n is not None), default=None)
    most = None if None in counts else max(n for n in counts if n is not None)
    words = f"more than {LIMIT:,}" if most is None else f"about {most:,}"
    if least is not None and least != most:
        words = f"about {least:,} to {words.removeprefix('about ')}"
    names = _listed([one.arm for one in open_])
    return f"too few seeds to tell it from {names}: {words} seeds an arm would be needed"


def _quoted(arm: str) -> str:
    return f"“{arm}”" if ", " in arm else arm


def _listed(arms: Sequence[str]) -> str:
    """Names, of many the first ones and how many more."""
    names = [_quoted(arm) for arm in arms]
    if len(names) <= NAMED + 1:
        return joined(names)
    return joined([*names[:NAMED], f"{len(names) - NAMED} others"])
