"""The rule of every claim: what the runs have to show. A verdict is computed by its rule, never typed in.

The docstring of a rule is printed in the report as the rule's text. What the rules have in common:

- A result is the final return. "Above" and "below": p < 0.05 in Welch's test, corrected by Holm's method for all
  comparisons of the claim.
- "Near" and "about": two one-sided tests show that the mean is less than `NEAR` points from the stated value.
- A rule that lacks runs raises `UntestableError` with the reason.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
import pandas as pd

from reports.analyses.readings import MOST, SOME, Contrast, deciding, outcome, percent_of, sides
from reports.claims.evidence import (
    LONG,
    Evidence,
    Finding,
    UntestableError,
    Values,
    Verdict,
    compare,
    gaps,
    near,
)
from reports.claims.headlines import PERCENT, STEPS, about, ahead, at_most, at_odds, behind
from reports.data.frame import THEOREM
from reports.data.paper import Paper
from reports.data.stats import Interval, Range, change, difference, interval
from reports.render.tables import capital, joined, number, percent, steps

NEAR = 5.0  # points of return within which "about 70" and "near 60" hold
SIZE = 10.0  # percentage points within which a loss is of the stated size
CONVERGED = 0.95  # share of the final level from which a curve does not fall again
REACHED = 0.9  # share of its own final value that counts as reached
LAST = 0.1  # share of the points of a curve that make its final level
PEAK = 500_000  # steps by which a peak may miss the stated one; one step of the plot where a claim is about steps
PACE = 50_000  # the same where steps to a first level are compared
SPREAD = "median and range over readings"

SCALING = "scaling"  # the study of numbers of sensors

Rule = Callable[[Evidence], Finding]


def c1(see: Evidence) -> Finding:
    """reproduced: RHMC is above every other method. not reproduced: it is not above some method. untestable: it is
    above all that have runs, and methods of the paper have none."""
    return _best(see, "navigation")


def c2a(see: Evidence) -> Finding:
    """reproduced: QMIX is below IQL. not reproduced: it is not."""
    return _below(see, "navigation", "QMIX", "IQL")


def c2b(see: Evidence) -> Finding:
    """reproduced: COMA is below IQL. not reproduced: it is not."""
    return _below(see, "navigation", "COMA", "IQL")


def c3a(see: Evidence) -> Finding:
    """reproduced: RHMC is above every other method. not reproduced: it is not above some method. untestable: it is
    above all that have runs, and methods of the paper have none."""
    return _best(see, "coverage")


def c3b(see: Evidence) -> Finding:
    """reproduced: RHMC's mean is within 5 points of 70.5, by two one-sided tests. not reproduced: that is not shown."""
    return _near(see, "RHMC", see.stated("C3b")["level"])


def c4a(see: Evidence) -> Finding:
    """reproduced: HiT-MAC's mean is within 5 points of 60, by two one-sided tests. not reproduced: that is not
    shown."""
    return _near(see, "HiT-MAC", see.stated("C4a")["HiT-MAC"])


def c4b(see: Evidence) -> Finding:
    """reproduced: QMIX's mean is within 5 points of 60, by two one-sided tests. not reproduced: that is not shown."""
    return _near(see, "QMIX", see.stated("C4b")["QMIX"])


def c5a(see: Evidence) -> Finding:
    """In study `long`, or `coverage` without it. reproduced: the highest points of the mean curves of MADDPG and of
    MAPPO both lie between 1 M and 2 M steps. not reproduced: else. untestable: a method has no runs, or they end
    before 2 M steps."""
    study, peak = see.first_of(LONG, "coverage"), see.stated("C5a")["peak"]
    ours: dict[str, Interval] = {}
    for arm in ("MADDPG", "MAPPO"):
        rows = see.curves(study, arm).dropna()
        if see.budget(study) < 2e6:
            raise UntestableError(f"Runs of {steps(see.budget(study))} steps cannot show a peak near {steps(peak)}.")
        at = interval(np.asarray(rows.idxmax(), dtype=np.float64))
        ours[f"{arm}: highest at step"] = at._replace(value=float(str(rows.mean(axis=1).idxmax())))
    held = {name: abs(top.value - peak) <= PEAK for name, top in ours.items()}
    return _all(held, "within 1 M to 2 M", ours)._replace(headline=about(ours, peak, PEAK, unit=STEPS))


def c5b(see: Evidence) -> Finding:
    """In study `long`, or `coverage` without it. reproduced: MADDPG and MAPPO are both below RHMC, HiT-MAC and QMIX.
    not reproduced: else."""
    study = see.first_of(LONG, "coverage")
    finals = {arm: see.finals(study, arm) for arm in ("MADDPG", "MAPPO", "RHMC", "HiT-MAC", "QMIX")}
    others = ("RHMC", "HiT-MAC", "QMIX")
    found = compare({f"{a} − {b}": (finals[a], finals[b]) for a in ("MADDPG", "MAPPO") for b in others})
    came = _all({name: one.below for name, one in found.items()}, "below", gaps(found))
    return came._replace(headline=behind(gaps(found), NEAR))


def c6a(see: Evidence) -> Finding:
    """reproduced: RHMC reaches 90 % of its own final return in fewer steps than every other method does of its own.
    not reproduced: not than some. untestable: methods of the paper have no runs."""
    firsts = {arm: _reached(rows, see.finals("coverage", arm)) for arm, rows in _every_curve(see).items()}
    found = compare({arm: (firsts["RHMC"], theirs) for arm, theirs in firsts.items() if arm != "RHMC"})
    held = {arm: one.below for arm, one in found.items()}
    came = _all(held, "fewer steps than", {f"{arm}: steps to 90 %": interval(x) for arm, x in firsts.items()})
    apart = {f"to 90 %, RHMC − {arm}": one.gap for arm, one in found.items()}
    return came._replace(headline=behind(apart, PACE, unit=STEPS))


def c6b(see: Evidence) -> Finding:
    """reproduced: RHMC's mean return over all of training (the area under its curve) is above every other method's.
    not reproduced: not above some. untestable: methods of the paper have no runs."""
    areas = {arm: rows.mean().to_numpy(np.float64) for arm, rows in _every_curve(see).items()}
    found = compare({f"RHMC − {arm}": (areas["RHMC"], theirs) for arm, theirs in areas.items() if arm != "RHMC"})
    came = _all({name: one.above for name, one in found.items()}, "more area", gaps(found))
    return came._replace(headline=ahead(gaps(found), NEAR))


def c7a(see: Evidence) -> Finding:
    """By number of sensors, in study `scaling`. reproduced: RHMC is above every other method at each number. not
    reproduced: else. untestable: RHMC or every other method has no runs at some number."""
    pairs: dict[str, tuple[Values, Values]] = {}
    shorter: dict[str, str] = {}
    for count, arms in _by_sensors(see).items():
        others = see.present(SCALING, (arm for method, arm in arms.items() if method != "RHMC"))
        if not others:
            raise UntestableError(f"With {count} sensors no other method of study {SCALING} has two finished seeds.")
        ours = see.finals(SCALING, arms["RHMC"])
        pairs |= {f"{arms['RHMC']} − {arm}": (ours, see.finals(SCALING, arm)) for arm in others}
        shorter |= {f"{arms['RHMC']} − {arm}": f"{count} sensors: RHMC − {name}" for name, arm in arms.items()}
    found = compare(pairs)
    held = [one.above for one in found.values()]
    reason = f"Above another method in {sum(held)} of {len(held)} comparisons."
    shown = ahead({shorter[name]: gap for name, gap in gaps(found).items()}, NEAR)
    return Finding(_whether(all(held)), reason, gaps(found), shown)


def c7b(see: Evidence) -> Finding:
    """By number of sensors, in study `scaling`. reproduced: wherever a sensor is added, the 95 % interval of the change
    of RHMC's mean lies above a fall of 5 points. not reproduced: else. untestable: RHMC has no runs at some number."""
    arms = {count: by_method["RHMC"] for count, by_method in _by_sensors(see).items()}
    finals = {count: see.finals(SCALING, arm) for count, arm in arms.items()}
    added = {
        f"RHMC, {after} sensors − {before}": difference(finals[after], finals[before])
        for before, after in pairwise(finals)
    }
    stable = all(one.low > -NEAR for one in added.values())
    ours = {f"RHMC, {count} sensors": interval(x) for count, x in finals.items()}
    words = "Stable." if stable else "Not shown to be stable."
    reason = f"{words}{_steady_without_learning(see, list(arms))}"
    return Finding(_whether(stable), reason, ours, ahead(added, NEAR, least=-NEAR))


def c8a(see: Evidence) -> Finding:
    """Over all readings of study `readings`, the readings whose interval is above zero, or below. reproduced: above in
    two thirds or more, and below in a twentieth or fewer. depends on the reading: above in more than an eighth, and not
    reproduced. not reproduced: else. Without finished readings, in study `ablation`: whether full RHMC is above."""
    return _order(see, "no regulation")


def c8b(see: Evidence) -> Finding:
    """Over all readings of study `readings`, those in which the loss in percent is within 10 points of the paper's two
    numbers. reproduced: two thirds or more. depends on the reading: more than an eighth. not reproduced: else. Without
    finished readings, in study `ablation`: whether the whole interval of the loss is within these 10 points."""
    return _size(see, "C8b", "no regulation")


def c9a(see: Evidence) -> Finding:
    """Over all readings of study `readings`, the readings whose interval is above zero, or below. reproduced: above in
    two thirds or more, and below in a twentieth or fewer. depends on the reading: above in more than an eighth, and not
    reproduced. not reproduced: else. Without finished readings, in study `ablation`: whether full RHMC is above."""
    return _order(see, "no filter")


def c9b(see: Evidence) -> Finding:
    """Over all readings of study `readings`, those in which the loss in percent is within 10 points of the paper's two
    numbers. reproduced: two thirds or more. depends on the reading: more than an eighth. not reproduced: else. Without
    finished readings, in study `ablation`: whether the whole interval of the loss is within these 10 points."""
    return _size(see, "C9b", "no filter")


def c10a(see: Evidence) -> Finding:
    """Steps to convergence of a seed: from where its curve stays at or above 95 % of its final level (mean of the last
    tenth of the points). In study `long`, or `ablation` without it. reproduced: the mean of full RHMC is at most 1 M.
    not reproduced: else. untestable: runs end before 3 M steps."""
    return _in_time(see, "C10a", "full")


def c10b(see: Evidence) -> Finding:
    """As C10a. reproduced: the mean without the filter is at most 3 M. not reproduced: else."""
    return _in_time(see, "C10b", "no filter")


def c10c(see: Evidence) -> Finding:
    """As C10a. reproduced: full RHMC needs fewer steps than without the filter. not reproduced: else."""
    found = {arm: _convergence(see, "C10c", arm) for arm in ("full", "no filter")}
    (one,) = compare({"steps, full − no filter": (found["full"], found["no filter"])}).values()
    ours = {f"{arm}: steps": interval(x) for arm, x in found.items()}
    said = see.stated("C10c")
    apart, theirs = {"steps, full − no filter": one.gap}, said["full"] - said["no filter"]
    reason = f"The difference {'is' if one.below else 'is not'} clear."
    return Finding(_whether(one.below), reason, ours, behind(apart, PEAK, unit=STEPS, paper=theirs))


def c11(see: Evidence) -> Finding:
    """contradicted by the paper itself: the numbers are those of Table 2, another task's, or positive, which a sum of
    negative distances cannot be. Else untestable."""
    numbers = see.stated("C11")
    table = sorted(row.final for row in see.paper.table_2.rows)
    ours = {arm: interval(see.finals("navigation", arm)) for arm in see.present("navigation", numbers)}
    reasons = []
    if sorted(numbers.values()) == table:
        reasons.append("the three numbers are those of Table 2, where they belong to coverage and to other methods")
    if any(x > 0 for x in numbers.values()):
        reasons.append("a sum of negative distances cannot be positive")
    shown = at_odds("RHMC", ours["RHMC"], numbers["RHMC"], NEAR) if {"RHMC"} <= ours.keys() & numbers else None
    if reasons:
        return Finding("contradicted by the paper itself", f"{capital('; '.join(reasons))}.", ours, shown)
    return Finding("untestable", "Nothing in the text speaks against it.", ours, shown)


def c12(see: Evidence) -> Finding:
    """contradicted by the paper itself: the paper gives another final reward for the same method, task and budget
    (C3b, C4b), more than 5 points away. Beside it: whether RHMC's number is above the bound with free headings, by our
    own computation."""
    numbers = see.stated("C12")
    elsewhere = {"RHMC": see.stated("C3b")["level"], "QMIX": see.stated("C4b")["QMIX"]}
    apart = [f"{arm} {numbers[arm]:g} against {x:g}" for arm, x in elsewhere.items() if abs(numbers[arm] - x) > NEAR]
    bound, reason = see.bound("free_heading_bound"), "the bound was not computed"
    if bound:
        side = "above" if bound.high < numbers["RHMC"] else "not above"
        reason = f"{numbers['RHMC']:g} is {side} the {number(bound.value)} that free headings at every step would give"
    ours = {"bound with free headings": bound} if bound else {}
    theirs = numbers["RHMC"]
    shown = at_odds("bound with free headings", bound, theirs, NEAR, least=theirs) if bound else None
    if apart:
        return Finding("contradicted by the paper itself", f"The paper has {joined(apart)}; {reason}.", ours, shown)
    return Finding("untestable", f"{capital(reason)}.", ours, shown)


def c13(see: Evidence) -> Finding:
    """reproduced: Algorithm 1 reaches the optimum on every random instance tried. not reproduced: it does not on
    some. untestable: no instances were tried. Shown by size (agents x options x targets), over all densities."""
    see.asked.add(THEOREM)
    table = see.results.theorem
    if table.empty:
        raise UntestableError("No instances of Algorithm 1 against the optimum were exported.")
    sizes = table.groupby(table.index.str.split(",").str[0])[["instances", "lost"]].sum()
    ours = {f"{size}: % lost": _flat(100 * row["lost"] / row["instances"]) for size, row in sizes.iterrows()}
    most = max(ours, key=lambda size: ours[size].value)
    shown = at_most(most, ours[most], 0.0, SIZE, unit=PERCENT)
    if not table["lost"].any():
        return Finding("reproduced", f"No loss in {table['instances'].sum():,.0f} instances.", ours, shown)
    share = 100 * table["lost"] / table["instances"]
    reason = (
        f"Below the optimum in {share.min():.1f} % to {share.max():.1f} % of random instances, by size and density, "
        f"and by up to {table['max_gap'].max():.2f} of reward."
    )
    return Finding("not reproduced", reason, ours, shown)


# What the rules take from `paper.yaml`: numbers of claims, and arms of studies.
STATED: Mapping[str, tuple[str, ...]] = {
    "C3b": ("level",),
    "C4a": ("HiT-MAC",),
    "C4b": ("QMIX",),
    "C5a": ("peak",),
    "C8b": ("full", "without", "stated"),
    "C9b": ("full", "without", "stated"),
    "C10a": ("full", "no filter"),
    "C10b": ("full", "no filter"),
    "C10c": ("full", "no filter"),
    "C12": ("RHMC", "QMIX"),
}
LISTED = ("coverage", "navigation")

RULES: Mapping[str, Rule] = {
    "C1": c1,
    "C2a": c2a,
    "C2b": c2b,
    "C3a": c3a,
    "C3b": c3b,
    "C4a": c4a,
    "C4b": c4b,
    "C5a": c5a,
    "C5b": c5b,
    "C6a": c6a,
    "C6b": c6b,
    "C7a": c7a,
    "C7b": c7b,
    "C8a": c8a,
    "C8b": c8b,
    "C9a": c9a,
    "C9b": c9b,
    "C10a": c10a,
    "C10b": c10b,
    "C10c": c10c,
    "C11": c11,
    "C12": c12,
    "C13": c13,
}


def unstated(paper: Paper) -> Iterator[str]:
    """The reasons why rules cannot be applied."""
    for name in RULES:
        if name not in paper.claims:
            yield f"claims.{name}: missing; there is a rule for it"
        else:
            numbers = paper.claims[name].numbers
            for key in STATED.get(name, ()):
                if key not in numbers:
                    yield f"claims.{name}.numbers.{key}: missing; there are {', '.join(numbers) or 'none'}"
    for name in paper.claims:
        if name not in RULES:
            yield f"claims.{name}: no rule in rules.py; there are rules for {', '.join(RULES)}"
    for study in LISTED:
        if study not in paper.arms:
            yield f"arms.{study}: missing; the arms that the paper shows"


def _whether(holds: bool) -> Verdict:
    return "reproduced" if holds else "not reproduced"


def _all(parts: Mapping[str, bool], what: str, ours: Mapping[str, Interval]) -> Finding:
    """Reproduced if all parts hold; the reason names those that do, and those that do not."""
    held, failed = ([name for name, holds in parts.items() if holds is side] for side in (True, False))
    words = [f"{capital(what)}: {joined(held)}." if held else "", f"Not {what}: {joined(failed)}." if failed else ""]
    return Finding(_whether(not failed), " ".join(filter(None, words)), ours)


def _best(see: Evidence, study: str) -> Finding:
    """Judge whether RHMC is above every other method of a study."""
    ours, (others, absent) = see.finals(study, "RHMC"), see.rivals(study)
    found = compare({f"RHMC − {arm}": (ours, see.finals(study, arm)) for arm in others})
    failed = [arm for arm, one in zip(others, found.values(), strict=True) if not one.above]
    looked = gaps(found), ahead(gaps(found), NEAR)
    if failed:
        return Finding("not reproduced", f"It is not above {joined(failed)}.", *looked)
    if absent:
        return Finding("untestable", f"It is above {joined(others)}; no results of {joined(absent)}.", *looked)
    return Finding("reproduced", f"It is above {joined(others)}.", *looked)


def _below(see: Evidence, study: str, arm: str, other: str) -> Finding:
    (one,) = compare({"": (see.finals(study, arm), see.finals(study, other))}).values()
    reason = f"{arm} is {'' if one.below else 'not '}below {other}."
    ours = {f"{arm} − {other}": one.gap}
    return Finding(_whether(one.below), reason, ours, behind(ours, NEAR))


def _near(see: Evidence, arm: str, level: float) -> Finding:
    """Judge whether an arm of study `coverage` ends near a level; names policies that do so without learning."""
    values = see.finals("coverage", arm)
    holds, ours = near(values, level, NEAR), interval(values)
    rules = {name: x for name, x in see.scripted("coverage").items() if abs(x - level) < NEAR}
    words = f"{arm} ends at {number(ours.value)}, {'near' if holds else 'not shown to be near'} {level:g}."
    listed = joined(f"{name} ({number(x)})" for name, x in rules.items())
    return Finding(
        _whether(holds),
        words + (f" Policies that do not learn and end within {NEAR:g} points of it: {listed}." if rules else ""),
        {arm: ours},
        about({arm: ours}, level, NEAR),
    )


def _every_curve(see: Evidence) -> dict[str, pd.DataFrame]:
    """Curves of RHMC and of all other methods in study `coverage`. Raises `UntestableError` if a method has none."""
    ours, (others, absent) = see.curves("coverage", "RHMC"), see.rivals("coverage")
    if absent:
        raise UntestableError(f"No results of {joined(absent)}.")
    return {"RHMC": ours} | {arm: see.curves("coverage", arm) for arm in others}


def _by_sensors(see: Evidence) -> dict[int, dict[str, str]]:
    """Arms of study `scaling` by number of sensors and method. Raises `UntestableError` where RHMC is missing."""
    see.asked.add(SCALING)
    groups = see.results.by_agents(SCALING)
    if len(groups) < 2:
        raise UntestableError(f"Study {SCALING} has no results for several numbers of sensors.")
    for count, arms in groups.items():
        if "RHMC" not in arms:
            raise UntestableError(f"Study {SCALING} lacks RHMC with {count} sensors.")
    return groups


def _steady_without_learning(see: Evidence, counts: Sequence[int]) -> str:
    """The policies that do not learn and do not fall by `NEAR` points either, in a sentence."""
    tables = [see.scripted(SCALING, agents=count) for count in counts]
    common = [name for name in tables[0] if all(name in table for table in tables)]
    steady = [name for name in common if np.all(np.diff([table[name] for table in tables]) > -NEAR)]
    return f" Policies that do not learn and fall by no more either: {joined(steady)}." if steady else ""


def _order(see: Evidence, arm: str) -> Finding:
    """Judge whether the whole method is above an arm without a part: over the readings, or in the ablation's."""
    name, theirs = f"full − {arm}", _table_2_gap(see, arm)
    if found := see.readings(arm):
        verdicts: Mapping[str, Verdict] = {"holds": "reproduced", "depends on the reading": "depends on the reading"}
        came, factors = outcome(found), deciding(found)
        words = f"Over {_readings(found)}: {came}."
        words += f" It is decided by {joined(factors)}." if factors else " No single factor decides it."
        shown = ahead({f"{name}, {SPREAD}": _spread(found.effects)}, NEAR, paper=theirs)
        return Finding(verdicts.get(came, "not reproduced"), words, _over_readings(found), shown)
    full, without = see.finals("ablation", "full"), see.finals("ablation", arm)
    see.remarks.append("one reading of the text")
    (one,) = compare({"": (full, without)}).values()
    reason = f"The full method is {'' if one.above else 'not clearly '}above."
    ours = {"full": interval(full), arm: interval(without), name: one.gap}
    return Finding(_whether(one.above), reason, ours, ahead({name: one.gap}, NEAR, paper=theirs))


def _table_2_gap(see: Evidence, arm: str) -> float:
    """The paper's final return of the full method less that of an arm; NaN where Table 2 lacks one of both."""
    theirs = {row.arm: row.final for row in see.paper.table_2.rows}
    return theirs.get("full", np.nan) - theirs.get(arm, np.nan)


def _spread(values: Values) -> Range:
    """The median over readings, and the range from the least to the greatest. values: (R,)."""
    return Range(float(np.median(values)), float(values.min()), float(values.max()), len(values))


def _over_readings(found: Contrast) -> dict[str, Interval]:
    above, below = sides(found)
    return {
        "readings clearly above, %": _flat(100 * above),
        "readings clearly below, %": _flat(100 * below),
        "median effect": _flat(float(np.median(found.effects))),
    }


def _size(see: Evidence, claim: str, arm: str) -> Finding:
    """Judge whether the loss without a part is of the paper's size: over the readings, or in the ablation's."""
    said = see.stated(claim)
    theirs = 100 * (said["without"] / said["full"] - 1)
    paper = f"the paper's numbers give {percent(theirs)} (stated: −{said['stated']:g} %)"
    if found := see.readings(arm):
        lost = 100 * (found.other.mean(1) / found.full.mean(1) - 1)
        share = float(np.mean(np.abs(lost - theirs) <= SIZE))
        verdict: Verdict = "depends on the reading" if SOME < share < MOST else _whether(share >= MOST)
        reason = f"Of that size in {percent_of(share)} of {_readings(found)}; {paper}."
        ours = {"median change in %": _flat(float(np.median(lost))), "largest loss in %": _flat(float(lost.min()))}
        shown = about({f"change without it, {SPREAD}": _spread(lost)}, theirs, SIZE, unit=PERCENT, sign=-1)
        return Finding(verdict, reason, ours, shown)
    full, without = see.finals("ablation", "full"), see.finals("ablation", arm)
    see.remarks.append("one reading of the text")
    loss = change(without, full)
    alike = loss.low >= theirs - SIZE and loss.high <= theirs + SIZE
    reason = f"{percent(loss.value)} is {'' if alike else 'not shown to be '}of that size; {paper}."
    shown = about({"change without it": loss}, theirs, SIZE, unit=PERCENT, sign=-1)
    return Finding(_whether(alike), reason, {"change in %": loss}, shown)


def _readings(found: Contrast) -> str:
    count = len(found.effects)
    return f"{count} reading{'s' * (count > 1)} of the text"


def _convergence(see: Evidence, claim: str, arm: str) -> Values:
    """Steps to convergence of an arm's seeds: (n,). Raises `UntestableError` where runs are shorter than claimed."""
    study, limits = see.first_of(LONG, "ablation"), see.stated(claim)
    rows = see.curves(study, "RHMC" if (study, arm) == (LONG, "full") else arm)
    longest = max(limits.values())
    if see.budget(study) < longest:
        raise UntestableError(f"Runs of {steps(see.budget(study))} steps cannot show convergence by {steps(longest)}.")
    return np.array([_converged(rows[seed]) for seed in rows])


def _in_time(see: Evidence, claim: str, arm: str) -> Finding:
    found, limit = _convergence(see, claim, arm), see.stated(claim)[arm]
    mean = float(found.mean())
    held = mean <= limit
    reason = f"It converges in {steps(mean)}, {'within' if held else 'not within'} {steps(limit)}."
    ours = {f"{arm}: steps": interval(found)}
    shown = at_most(f"{arm}: converged at step", interval(found), limit, PEAK, unit=STEPS)
    return Finding(_whether(held), reason, ours, shown)


def _flat(value: float) -> Interval:
    """A number without an interval."""
    return Interval(float(value), np.nan, np.nan, 1)


def _reached(rows: pd.DataFrame, finals: Values) -> Values:
    """First step at which each seed is at 90 % of its own final return: (n,). rows: by step, a column a seed."""
    return np.array([_first_step(rows[seed].dropna() >= REACHED * x) for seed, x in zip(rows, finals, strict=True)])


def _converged(values: "pd.Series[float]") -> float:
    """Step from which a curve stays at or above 95 % of its final level. values: by step."""
    kept = values.dropna()
    at, heights = kept.index.to_numpy(np.float64), kept.to_numpy(np.float64)
    level = heights[-max(1, round(LAST * len(heights))) :].mean()
    low = np.flatnonzero(heights < CONVERGED * level)
    return float(at[min(low[-1] + 1, len(at) - 1)] if len(low) else at[0])


def _first_step(mask: "pd.Series[bool]") -> float:
    """First step where it holds, the last step of all if it never does."""
    at = mask.index.to_numpy(np.float64)
    return float(at[mask.to_numpy(bool).argmax()] if mask.any() else at[-1])
