"""The paper's claims and what the runs say of each. A verdict is computed by the rule of its claim, never typed in.

The docstring of a rule is printed in the report as the rule's text. What the rules have in common:

- A result is the final return; "above" and "below" mean that the 95 % interval of the difference excludes 0.
- A rule that lacks runs raises `UntestableError` with the reason.
- A verdict from less than the paper's training budget or from fewer than `FEW` seeds is provisional, and says why.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from inspect import cleandoc
from typing import Literal, NamedTuple, get_args

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from reports.data.escaping import markdown
from reports.data.frame import ERRORS, FINAL, THEOREM, YARDSTICKS, Results
from reports.data.paper import Paper, PaperError
from reports.data.stats import FEW, Interval, change, difference, interval
from reports.render.tables import NONE, Table, estimate, joined, number, percent, steps

Verdict = Literal["reproduced", "partly", "not reproduced", "untestable", "contradicted by the paper itself"]
VERDICTS: tuple[str, ...] = get_args(Verdict)
JUDGED = ("reproduced", "partly", "not reproduced")  # verdicts that rest on training runs

NEAR = 5.0  # points of return within which "about 70" and "near 60" hold
SIZE = 10.0  # percentage points within which a loss is of the stated size
CONVERGED = 0.95  # share of the final level from which a curve does not fall again
REACHED = 0.9  # share of its own final value that counts as reached
LAST = 0.1  # share of the points of a curve that make its final level

SCALING = "scaling"  # the study of numbers of sensors

Values = NDArray[np.float64]


class UntestableError(Exception):
    """The runs that a rule needs are not there; the message is the reason."""


class Finding(NamedTuple):
    """The result of a rule. `ours`: the quantities it looked at, by name."""

    verdict: Verdict
    reason: str
    ours: Mapping[str, Interval] = {}


class Claim(NamedTuple):
    """A claim with its verdict.

    `caveats`: why a verdict is provisional; `runs`: the ids behind it; `commands`: what makes the numbers again.
    """

    id: str
    text: str
    paper: str
    place: str
    verdict: Verdict
    reason: str
    ours: Mapping[str, Interval]
    caveats: tuple[str, ...]
    runs: tuple[str, ...]
    rule: str
    commands: tuple[str, ...] = ()

    @property
    def provisional(self) -> bool:
        """True if the verdict rests on less than it should."""
        return bool(self.caveats) and self.verdict in JUDGED

    @property
    def judgement(self) -> str:
        """The verdict in words."""
        return f"{self.verdict} (provisional)" if self.provisional else self.verdict


@dataclass
class Evidence:
    """The runs that a rule may look at; it remembers which arms were used."""

    results: Results
    paper: Paper
    used: set[tuple[str, str]] = field(default_factory=set)
    asked: set[str] = field(default_factory=set)  # studies that the rule looked for, there or not

    def stated(self, claim: str) -> Mapping[str, float]:
        """The numbers of a claim."""
        return self.paper.claims[claim].numbers

    def finals(self, study: str, arm: str) -> Values:
        """Final returns of an arm's seeds. Raises `UntestableError` with fewer than two."""
        self.asked.add(study)
        values = self.results.finals(study, arm)
        if len(values) < 2:
            planned, done = len(self.results.plan(study, arm)), ("no", "one")[len(values)]
            found = f"has {done} finished seed, and an interval needs two" if planned else "is missing"
            raise UntestableError(f"Arm {arm} of study {study} {found}.")
        self.used.add((study, arm))
        return values

    def curves(self, study: str, arm: str) -> pd.DataFrame:
        """Curves of an arm's finished seeds: rows are steps, columns seeds. Raises like `finals`."""
        self.finals(study, arm)
        points = self.results.curve(study, arm)
        table = points.pivot_table(index="step", columns="seed", values="value")
        return table[list(self.results.finished(study, arm)["seed"])]

    def present(self, study: str, arms: Iterable[str]) -> list[str]:
        """The arms that have at least two finished seeds."""
        return [arm for arm in arms if len(self.results.finals(study, arm)) > 1]

    def rivals(self, study: str) -> tuple[list[str], list[str]]:
        """Every other method of the study with results, and those of the paper's that have none.

        An arm that is RHMC with other settings is no other method.
        """
        own = self.results.kind(study, "RHMC")
        arms = [arm for arm in self.results.arms(study) if arm != "RHMC" and self.results.kind(study, arm) != own]
        others = self.present(study, arms)
        absent = [arm for arm in self.paper.arms[study] if arm != "RHMC" and arm not in others]
        if not others:
            raise UntestableError(f"Study {study} has no results of another method to compare with.")
        return others, absent

    def budget(self, study: str) -> int:
        """Environment steps per run. Raises `UntestableError` if unknown."""
        self.asked.add(study)
        found = self.results.budget(study)
        if found is None:
            raise UntestableError(f"Study {study} has no runs.")
        return found

    def bound(self, policy: str) -> Interval | None:
        """A yardstick on the task of the coverage studies: mean and twice its standard error, if it was run."""
        self.asked.add(YARDSTICKS)
        for table in map(self.results.yardsticks_of, ("coverage", "ablation")):
            if policy in table.index and FINAL in table:
                value = float(table[FINAL][policy])
                errors = [float(table[name][policy]) for name in ERRORS if name in table]
                error = max((x for x in errors if np.isfinite(x)), default=0.0)
                return Interval(value, value - 2 * error, value + 2 * error, 1)
        return None


Rule = Callable[[Evidence], Finding]


def judge(results: Results, paper: Paper) -> list[Claim]:
    """Every claim of the paper, in its order.

    Raises:
        PaperError: what a rule looks at is not stated, or a claim has no rule.
    """
    if faults := [f"paper.yaml: {fault}" for fault in _unstated(paper)]:
        raise PaperError("\n".join(faults))
    return [_judge(name, rule, results, paper) for name, rule in RULES.items()]


def c1(see: Evidence) -> Finding:
    """reproduced: RHMC is above every other method. not reproduced: it is not above some method. untestable: it is
    above all that have runs, and methods of the paper have none."""
    return _best(see, "navigation")


def c2(see: Evidence) -> Finding:
    """reproduced: QMIX and COMA are both below IQL. partly: one is. not reproduced: neither is."""
    iql = see.finals("navigation", "IQL")
    gaps = {f"{arm} − IQL": difference(see.finals("navigation", arm), iql) for arm in ("QMIX", "COMA")}
    return _count({name: (gap, gap.below(0)) for name, gap in gaps.items()}, "below")


def c3(see: Evidence) -> Finding:
    """Two parts: RHMC is above every other method, and its mean is within 5 points of 70.5. reproduced: both hold.
    partly: one holds. not reproduced: neither. untestable: the verdict depends on methods that have no runs."""
    level = see.stated("C3")["level"]
    ours = interval(see.finals("coverage", "RHMC"))
    near = abs(ours.value - level) <= NEAR
    first = _best(see, "coverage")
    quantities = {"RHMC": ours, **first.ours}
    words = f"RHMC ends at {number(ours.value)}, {'near' if near else 'not near'} {level:g}"
    if first.verdict == "untestable":
        return Finding("untestable", f"{words}. {first.reason}", quantities)
    held = near + (first.verdict == "reproduced")
    return Finding(("not reproduced", "partly", "reproduced")[held], f"{words}. {first.reason}", quantities)


def c4(see: Evidence) -> Finding:
    """reproduced: the means of HiT-MAC and QMIX are both within 5 points of 60. partly: one is. not reproduced:
    neither."""
    found = {arm: interval(see.finals("coverage", arm)) for arm in ("HiT-MAC", "QMIX")}
    numbers = see.stated("C4")
    return _count({arm: (x, abs(x.value - numbers[arm]) <= NEAR) for arm, x in found.items()}, "near 60")


def c5(see: Evidence) -> Finding:
    """Parts, for MADDPG and for MAPPO: the highest point of the mean curve lies between 1 M and 2 M steps; the final
    return is below that of RHMC, HiT-MAC and QMIX. reproduced: all four hold. partly: some do. not reproduced: none.
    untestable: a method has no runs, or they end before 2 M steps."""
    peak, ours, held = see.stated("C5")["peak"], {}, []
    for arm in ("MADDPG", "MAPPO"):
        rows = see.curves("coverage", arm).dropna()
        if see.budget("coverage") < 2e6:
            raise UntestableError(
                f"Runs of {steps(see.budget('coverage'))} steps cannot show a peak near {steps(peak)}."
            )
        at = interval(np.asarray(rows.idxmax(), dtype=np.float64))
        ours[f"{arm}: highest at step"] = at._replace(value=float(str(rows.mean(axis=1).idxmax())))
        held.append(abs(ours[f"{arm}: highest at step"].value - peak) <= 5e5)
        values = see.finals("coverage", arm)
        held.append(all(difference(values, see.finals("coverage", a)).below(0) for a in ("RHMC", "HiT-MAC", "QMIX")))
    return Finding(_share(held), f"{sum(held)} of {len(held)} parts hold.", ours)


def c6(see: Evidence) -> Finding:
    """Two parts, against every method: RHMC reaches 90 % of its own final return in fewer steps, and its mean return
    over all of training (area under the curve) is above. reproduced: both. partly: one. not reproduced: neither.
    untestable: methods of the paper have no runs."""
    ours, (others, absent) = see.curves("coverage", "RHMC"), see.rivals("coverage")
    if absent:
        raise UntestableError(f"No results of {joined(absent)}.")
    first = _reached(ours, see.finals("coverage", "RHMC"))
    quick, area, quantities = [], [], {"RHMC: steps to 90 %": interval(first)}
    for arm in others:
        rows = see.curves("coverage", arm)
        theirs = _reached(rows, see.finals("coverage", arm))
        quick.append(difference(first, theirs).below(0))
        area.append(difference(ours.mean().to_numpy(), rows.mean().to_numpy()).above(0))
        quantities[f"{arm}: steps to 90 %"] = interval(theirs)
    reason = f"Fewer steps than {sum(quick)} and more area than {sum(area)} of {len(others)} methods."
    return Finding(_share([all(quick), all(area)]), reason, quantities)


def c7(see: Evidence) -> Finding:
    """By number of sensors, in study `scaling`: RHMC is above every other method at each number (best), and its mean
    never falls by more than 5 points when sensors are added (stable). reproduced: both. partly: one. not reproduced:
    neither. untestable: the study has no runs, or RHMC or every other method has none at some number."""
    see.asked.add(SCALING)
    groups = see.results.by_agents(SCALING)
    if len(groups) < 2:
        raise UntestableError(f"Study {SCALING} has no results for several numbers of sensors.")
    best, means = [], {}
    for count, arms in groups.items():
        if "RHMC" not in arms:
            raise UntestableError(f"Study {SCALING} lacks RHMC with {count} sensors.")
        others = see.present(SCALING, (arm for method, arm in arms.items() if method != "RHMC"))
        if not others:
            raise UntestableError(f"With {count} sensors no other method of study {SCALING} has two finished seeds.")
        ours = see.finals(SCALING, arms["RHMC"])
        best += [difference(ours, see.finals(SCALING, arm)).above(0) for arm in others]
        means[f"RHMC, {count} sensors"] = interval(ours)
    stable = bool(np.all(np.diff([x.value for x in means.values()]) >= -NEAR))
    words = "stable" if stable else "not stable"
    return Finding(
        _share([all(best), stable]), f"Above another method in {sum(best)} of {len(best)} comparisons; {words}.", means
    )


def c8(see: Evidence) -> Finding:
    """reproduced: full RHMC is above the ablation, and the loss in percent is within 10 points of the paper's two
    numbers, or the paper's is in its interval. partly: above, by another size. not reproduced: not above."""
    return _ablation(see, "C8", "no regulation")


def c9(see: Evidence) -> Finding:
    """reproduced: full RHMC is above the ablation, and the loss in percent is within 10 points of the paper's two
    numbers, or the paper's is in its interval. partly: above, by another size. not reproduced: not above."""
    return _ablation(see, "C9", "no filter")


def c10(see: Evidence) -> Finding:
    """Steps to convergence of a seed: from where its curve stays at or above 95 % of its final level (mean of the
    last tenth of the points). Parts: full RHMC needs at most 1 M, without the filter at most 3 M, and full needs
    fewer. reproduced: all three. partly: full needs fewer, or both budgets are kept. not reproduced: else.
    untestable: runs end before 3 M steps."""
    limits, ours = see.stated("C10"), {}
    for arm in limits:
        rows = see.curves("ablation", arm)
        ours[arm] = np.array([_converged(rows[seed]) for seed in rows])
    longest = max(limits.values())
    if see.budget("ablation") < longest:
        raise UntestableError(
            f"Runs of {steps(see.budget('ablation'))} steps cannot show convergence by {steps(longest)}."
        )
    kept = [float(ours[arm].mean()) <= limits[arm] for arm in limits]
    faster = difference(ours["full"], ours["no filter"]).below(0)
    verdict: Verdict = "reproduced" if all(kept) and faster else "partly" if all(kept) or faster else "not reproduced"
    words = joined(f"{arm} in {steps(float(x.mean()))}" for arm, x in ours.items())
    reason = f"Steps to convergence: {words}; the difference {'is' if faster else 'is not'} clear."
    return Finding(verdict, reason, {f"{arm}: steps": interval(x) for arm, x in ours.items()})


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
    if reasons:
        return Finding("contradicted by the paper itself", f"{_capital('; '.join(reasons))}.", ours)
    return Finding("untestable", "Nothing in the text speaks against it.", ours)


def c12(see: Evidence) -> Finding:
    """contradicted by the paper itself: the paper gives another final reward for the same method, task and budget
    (C3, C4), more than 5 points away. Beside it: whether RHMC's number is above the bound with free headings, by our
    own computation."""
    numbers = see.stated("C12")
    elsewhere = {"RHMC": see.stated("C3")["level"], "QMIX": see.stated("C4")["QMIX"]}
    apart = [f"{arm} {numbers[arm]:g} against {x:g}" for arm, x in elsewhere.items() if abs(numbers[arm] - x) > NEAR]
    bound, reason = see.bound("free_heading_bound"), "the bound was not computed"
    if bound:
        side = "above" if bound.high < numbers["RHMC"] else "not above"
        reason = f"{numbers['RHMC']:g} is {side} the {number(bound.value)} that free headings at every step would give"
    ours = {"bound with free headings": bound} if bound else {}
    if apart:
        return Finding("contradicted by the paper itself", f"The paper has {joined(apart)}; {reason}.", ours)
    return Finding("untestable", f"{_capital(reason)}.", ours)


def c13(see: Evidence) -> Finding:
    """reproduced: Algorithm 1 reaches the optimum on every random instance tried. not reproduced: it does not on
    some. untestable: no instances were tried. Shown by size (agents x options x targets), over all densities."""
    see.asked.add(THEOREM)
    table = see.results.theorem
    if table.empty:
        raise UntestableError("No instances of Algorithm 1 against the optimum were exported.")
    sizes = table.groupby(table.index.str.split(",").str[0])[["instances", "lost"]].sum()
    ours = {f"{size}: % lost": _flat(100 * row["lost"] / row["instances"]) for size, row in sizes.iterrows()}
    if not table["lost"].any():
        return Finding("reproduced", f"No loss in {table['instances'].sum():,.0f} instances.", ours)
    share = 100 * table["lost"] / table["instances"]
    reason = (
        f"Below the optimum in {share.min():.1f} % to {share.max():.1f} % of random instances, by size and density, "
        f"and by up to {table['max_gap'].max():.2f} of reward."
    )
    return Finding("not reproduced", reason, ours)


# What the rules take from `paper.yaml`: numbers of claims, and arms of studies.
STATED: Mapping[str, tuple[str, ...]] = {
    "C3": ("level",),
    "C4": ("HiT-MAC", "QMIX"),
    "C5": ("peak",),
    "C8": ("full", "without", "stated"),
    "C9": ("full", "without", "stated"),
    "C10": ("full", "no filter"),
    "C12": ("RHMC", "QMIX"),
}
LISTED = ("coverage", "navigation")


def _unstated(paper: Paper) -> Iterator[str]:
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
            yield f"claims.{name}: no rule in claims.py; there are rules for {', '.join(RULES)}"
    for study in LISTED:
        if study not in paper.arms:
            yield f"arms.{study}: missing; the arms that the paper shows"


RULES: Mapping[str, Rule] = {
    "C1": c1,
    "C2": c2,
    "C3": c3,
    "C4": c4,
    "C5": c5,
    "C6": c6,
    "C7": c7,
    "C8": c8,
    "C9": c9,
    "C10": c10,
    "C11": c11,
    "C12": c12,
    "C13": c13,
}


def table(claims: Sequence[Claim]) -> Table:
    """One row per claim."""
    numbers = pd.DataFrame(
        {
            "id": claim.id,
            "claim": claim.text,
            "paper": claim.paper,
            "place": claim.place,
            "ours": describe(claim.ours),
            "verdict": claim.verdict,
            "provisional": claim.provisional,
            "reason": claim.reason,
            "caveats": "; ".join(claim.caveats),
            "rule": claim.rule,
            "runs": " ".join(claim.runs),
            "commands": "; ".join(claim.commands),
        }
        for claim in claims
    )
    shown = pd.DataFrame(
        {
            "Claim": claim.id,
            "The paper says": markdown(claim.text),
            "Paper": markdown(f"{claim.paper} ({claim.place})"),
            "Ours [95 %]": "<br>".join(markdown(f"{name} {value}") for name, value in described(claim.ours)) or NONE,
            "Verdict": f"**{claim.judgement}**",
            "Why": " ".join(
                [markdown(claim.reason)]
                + ([f"*{markdown(_capital('; '.join(claim.caveats)))}.*"] if claim.provisional else [])
            ),
        }
        for claim in claims
    )
    return Table("The paper's claims", numbers, shown, marked=True)


def describe(ours: Mapping[str, Interval]) -> str:
    """The quantities behind a verdict in one line: `full − no filter 2.4 [0.4, 4.4]; ...`."""
    return "; ".join(f"{name} {value}" for name, value in described(ours))


def described(ours: Mapping[str, Interval]) -> list[tuple[str, str]]:
    """The quantities behind a verdict: names, and values with their intervals."""
    return [(name, estimate(x, _show(name))) for name, x in ours.items()]


def command(study: str, profile: str) -> str:
    """The command that makes a study's numbers, and the report from them, again. The study is named as its table is."""
    report = f"rhmc report --profile {profile}"
    if study == THEOREM:
        return f"rhmc theorem --out results/{profile}/runs && {report}"
    if study == YARDSTICKS:
        return f"rhmc yardsticks all --profile {profile} --out results/{profile}/runs && {report}"
    file, _, variant = study.partition("@")
    which = f"studies/{file}.yaml --profile {profile}" + (f" --variant {variant}" if variant else "")
    return f"rhmc study run {which} && rhmc export {which} && {report}"


def _judge(name: str, rule: Rule, results: Results, paper: Paper) -> Claim:
    see, said = Evidence(results, paper), paper.claims[name]
    try:
        found = rule(see)
    except UntestableError as reason:
        found = Finding("untestable", str(reason))
    plans = [results.finished(study, arm) for study, arm in sorted(see.used)]
    behind = tuple(str(run) for plan in plans for run in plan["run"])
    text = " ".join(cleandoc(rule.__doc__ or "").split())
    caveats = tuple(_caveats(see)) if found.verdict in JUDGED else ()
    about = (name, said.text, said.value, said.place, found.verdict, found.reason, found.ours, caveats, behind, text)
    return Claim(*about, tuple(command(study, results.profile) for study in sorted(see.asked)))


def _caveats(see: Evidence) -> list[str]:
    """The reasons why a verdict from these arms is provisional."""
    out = []
    for study in sorted({study for study, _ in see.used}):
        theirs, ours = see.paper.steps.get(study), see.results.budget(study)
        if theirs and ours and ours < theirs:
            out.append(f"{steps(ours)} of the paper's {steps(theirs)} steps ({100 * ours / theirs:.2g} %)")
    counts = [len(see.results.finals(study, arm)) for study, arm in see.used]
    if counts and min(counts) < FEW:
        out.append(f"{min(counts)} seeds")
    open_arms = [arm for study, arm in sorted(see.used) if not _complete(see.results, study, arm)]
    return out + ([f"unfinished: {joined(open_arms)}"] if open_arms else [])


def _complete(results: Results, study: str, arm: str) -> bool:
    return len(results.finished(study, arm)) == len(results.plan(study, arm))


def _best(see: Evidence, study: str) -> Finding:
    """True if RHMC is above every other method of a study."""
    ours, (others, absent) = see.finals(study, "RHMC"), see.rivals(study)
    gaps = {f"RHMC − {arm}": difference(ours, see.finals(study, arm)) for arm in others}
    behind = [arm for arm, gap in zip(others, gaps.values(), strict=True) if not gap.above(0)]
    if behind:
        return Finding("not reproduced", f"It is not above {joined(behind)}.", gaps)
    if absent:
        return Finding("untestable", f"It is above {joined(others)}; no results of {joined(absent)}.", gaps)
    return Finding("reproduced", f"It is above {joined(others)}.", gaps)


def _ablation(see: Evidence, claim: str, arm: str) -> Finding:
    full, without = see.finals("ablation", "full"), see.finals("ablation", arm)
    said = see.stated(claim)
    theirs = 100 * (said["without"] / said["full"] - 1)
    gap, loss = difference(full, without), change(without, full)
    ours = {"full": interval(full), arm: interval(without), f"full − {arm}": gap, "change in %": loss}
    numbers = f"{percent(loss.value)}, the paper's numbers give {percent(theirs)} (stated: −{said['stated']:g} %)"
    if not gap.above(0):
        return Finding("not reproduced", f"The full method is not clearly above: {numbers}.", ours)
    alike = abs(loss.value - theirs) <= SIZE or loss.holds(theirs)
    words = "The loss is there and of that size" if alike else "The loss is there, and of another size"
    return Finding("reproduced" if alike else "partly", f"{words}: {numbers}.", ours)


def _flat(value: float) -> Interval:
    """A number without an interval."""
    return Interval(float(value), np.nan, np.nan, 1)


def _count(parts: Mapping[str, tuple[Interval, bool]], what: str) -> Finding:
    """A verdict from parts that count alike."""
    held = [name for name, (_, holds) in parts.items() if holds]
    failed = [name for name in parts if name not in held]
    words = [f"{_capital(what)}: {joined(held)}." if held else "", f"Not {what}: {joined(failed)}." if failed else ""]
    quantities = {name: value for name, (value, _) in parts.items()}
    return Finding(_share([holds for _, holds in parts.values()]), " ".join(filter(None, words)), quantities)


def _share(held: Sequence[bool]) -> Verdict:
    return "reproduced" if all(held) else "partly" if any(held) else "not reproduced"


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


def _show(name: str) -> Callable[[float], str]:
    """The format of a quantity, by what its name says it is."""
    return steps if "step" in name else percent if name.endswith("in %") else number


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
