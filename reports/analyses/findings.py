"""Finding of a figure, in one sentence that is computed from its numbers: who is ahead, by how much, how surely."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from reports.analyses import alpha, searches
from reports.analyses.comparison import CLEAR, Pair, compared, pairs
from reports.analyses.scaling import Sweep, estimates
from reports.data.frame import Results
from reports.data.stats import improvement
from reports.render.tables import describe_task, joined, number


def of_curves(results: Results, study: str) -> str:
    """The arm that ends highest, the gap to the next, whether seeds overlap, and how many arms are clearly lower."""
    found = pairs(results, study)
    if not found:
        arms = compared(results, study)
        return f"{_ends(results, study, arms[0])}." if arms else "No arm has two finished seeds yet."
    tasks = [(env, [pair for pair in found if pair.first in arms]) for env, arms in results.by_task(study)]
    tasks = [(env, own) for env, own in tasks if own]
    if len(tasks) == 1:
        return _ahead(results, study, tasks[0][1])
    said = []
    for env, own in tasks:
        first, sure = own[0], "clear" if own[0].corrected < CLEAR else "not clear"
        said.append(f"{first.first} in {describe_task(env)} by {number(first.difference.value)} ({sure})")
    return f"Each frame's highest arm, with its gap to the next: {'; '.join(said)}."


def _ends(results: Results, study: str, arm: str) -> str:
    return f"{arm} ends highest, at {number(float(results.finals(study, arm).mean()))}"


def _ahead(results: Results, study: str, found: Sequence[Pair]) -> str:
    best, second = found[0].first, found[0].second
    others = [pair for pair in found if pair.first == best]
    clear = sum(pair.corrected < CLEAR for pair in others)
    overlap = results.finals(study, best).min() <= results.finals(study, second).max()
    seeds = "whose seeds overlap with its own" if overlap else "whose seeds all end lower"
    gap = number(found[0].difference.value)
    gap = f"level with {second}, {seeds}" if gap == number(0) else f"{gap} above {second}, {seeds}"
    count = "none" if not clear else "all" if clear == len(others) else f"{clear}"
    sure = (
        f"the gap is clear to {count} of the other {len(others)} arms"
        if len(others) > 1
        else f"the gap is {_sure(clear)}"
    )
    return f"{_ends(results, study, best)}, {gap}; {sure}."


def _sure(clear: int) -> str:
    return "clear" if clear else "not clear"


def of_spread(results: Results, study: str) -> str:
    """The arms whose seeds end furthest apart, and closest together."""
    wide = {arm: float(np.ptp(x)) for arm in results.arms(study) if len(x := results.finals(study, arm)) > 1}
    if not wide:
        return "No arm has two finished seeds yet."
    most, least = max(wide, key=wide.__getitem__), min(wide, key=wide.__getitem__)
    ends = f"The seeds of {most} end furthest apart, over {number(wide[most])} points"
    return f"{ends}; those of {least} closest, over {number(wide[least])}."


def of_profile(results: Results, study: str) -> str:
    """Count the arms that lie wholly below the worst seed of the best one."""
    arms = compared(results, study)
    best, worst = arms[0], float(results.finals(study, arms[0]).min())
    below = [arm for arm in arms[1:] if float(results.finals(study, arm).max()) < worst]
    return f"The worst seed of {best} ends above every seed of {len(below)} of the other {len(arms) - 1} arms."


def of_matrix(results: Results, study: str) -> str:
    """The chance of the best arm against the next, and the number of clear pairs."""
    arms, found = compared(results, study), pairs(results, study)
    chance = improvement(results.finals(study, arms[0]), results.finals(study, arms[1])).value
    clear = sum(pair.corrected < CLEAR for pair in found)
    return (
        f"A seed of {arms[0]} beats one of {arms[1]}, the next, with probability {chance:.2f}; {clear} of "
        f"{len(found)} pairs are clear."
    )


def of_sweep(results: Results, found: Sweep) -> str:
    """The best method at each number of agents, its gaps, and where a line falls."""
    values = {method: {n: x.value for n, x in by.items()} for method, by in estimates(results, found).items() if by}
    best = {n: order for n in found.counts if (order := _order(values, n))}
    heads = {order[0] for order in best.values()}
    gaps = [values[order[0]][n] - values[order[1]][n] for n, order in best.items() if len(order) > 1]
    if len(heads) == 1:
        by = f", by {_span(gaps)}" if gaps else ""
        first = f"{heads.pop()} is highest at every number of agents{by}"
    else:
        first = f"The highest is {joined(f'{order[0]} with {n}' for n, order in best.items())}"
    falls = [method for method, by in values.items() if any(np.diff(list(by.values())) < 0)]
    fall = f"{joined(falls)} {'falls' if len(falls) == 1 else 'fall'} somewhere" if falls else "no line falls"
    return f"{first}; {fall} as agents are added."


def _order(values: Mapping[str, Mapping[int, float]], n: int) -> list[str]:
    there = [method for method, by in values.items() if n in by]
    return sorted(there, key=lambda method: -values[method][n])


def _span(gaps: Sequence[float]) -> str:
    low, high = number(min(gaps)), number(max(gaps))
    return low if low == high else f"{low} to {high}"


def of_effects(results: Results, study: str) -> str:
    """Count the effects of each part that have an interval, or a range, that leaves zero."""
    said = []
    for part in dict.fromkeys(one.part for one in alpha.effects(results, study)):
        values = [alpha.measured(results, study, one) for one in alpha.effects(results, study) if one.part == part]
        known = [x for x in values if x]
        above, below = sum(x.above(0) for x in known), sum(x.below(0) for x in known)
        said += [f"of {len(known)} effects of {part} {above} are above zero and {below} below it"] if known else []
    return f"By interval or range, {' and '.join(said)}." if said else "No two arms to compare are finished."


def of_mechanism(numbers: pd.DataFrame) -> str:
    """Assigned pairs at the end at the largest alpha, with regulation and without. numbers: those of the figure."""
    last = numbers[(numbers["alpha"] == numbers["alpha"].max()) & (numbers["quantity"] == "assigned")]
    ends = {str(arm): float(rows["mean"].iloc[-1]) for arm, rows in last.groupby("arm", sort=False)}
    words = joined(f"{number(x, 2)} pairs with {arm}" for arm, x in ends.items())
    return f"At alpha {numbers['alpha'].max():g} the last point has {words}." if ends else ""


def of_assigned(numbers: pd.DataFrame) -> str:
    """Assigned pairs at the first and the last point, over arms. numbers: those of the figure."""
    rows = numbers[numbers["quantity"] == "pairs"].groupby("arm")["mean"]
    first, last = rows.first(), rows.last()
    fewer = int((last < first).sum())
    ends = f"Pairs are {_span(list(first))} at the first point and {_span(list(last))} at the last"
    return f"{ends}; in {fewer} of {len(first)} arms they grow fewer."


def of_moved(numbers: pd.DataFrame) -> str:
    """The policy that is highest most often. numbers: those of the figure."""
    rows = numbers[numbers["kind"] == "method"]
    best = rows.loc[rows.groupby(["along", "count"])["value"].idxmax(), "name"]
    counts = best.value_counts()
    return f"{counts.index[0]} is highest in {counts.iloc[0]} of {len(best)} places."


def of_trials(results: Results, search: str) -> str:
    """The arm with the best trial, and the gap to the next arm."""
    best = {
        arm: float(one["value"])
        for arm, rows in results.tried(search).items()
        if (one := searches.winner(rows)) is not None
    }
    order = sorted(best, key=lambda arm: -best[arm])
    first = f"The best trial is of {order[0]}, at {number(best[order[0]])}"
    return (
        f"{first}, {number(best[order[0]] - best[order[1]])} above that of {order[1]}."
        if len(order) > 1
        else f"{first}."
    )
