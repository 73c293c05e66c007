"""Evidence that the rule of a claim may look at, the comparisons that it makes, and the words that it answers with."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, get_args

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from reports.analyses.readings import Contrast, contrasts
from reports.claims.headlines import Headline
from reports.data.frame import ERRORS, FINAL, YARDSTICKS, Results
from reports.data.paper import Paper
from reports.data.stats import LEVEL, Interval, difference, equivalence_of_pairs, holm, welch

Verdict = Literal[
    "reproduced",
    "depends on the reading",
    "not reproduced",
    "too short to judge",
    "untestable",
    "contradicted by the paper itself",
]
VERDICTS: tuple[str, ...] = get_args(Verdict)
JUDGED = ("reproduced", "depends on the reading", "not reproduced")  # verdicts that rest on training runs

LONG, READINGS = "long", "readings"  # studies: at the paper's budget; of the readings of the text
BOUND = "_bound"  # end of a yardstick's name that no policy plays

Values = NDArray[np.float64]


class UntestableError(Exception):
    """The runs that a rule needs are not there; the message is the reason."""


class Finding(NamedTuple):
    """The result of a rule. `ours`: the quantities it looked at, by name; `headline`: the one that decides."""

    verdict: Verdict
    reason: str
    ours: Mapping[str, Interval] = {}
    headline: Headline | None = None


class Comparison(NamedTuple):
    """Two arms: the difference of their means, and Welch's p, corrected for the comparisons of the claim."""

    gap: Interval
    p: float

    @property
    def above(self) -> bool:
        """True if the first arm is better."""
        return self.p < 1 - LEVEL and self.gap.value > 0

    @property
    def below(self) -> bool:
        """True if the first arm is worse."""
        return self.p < 1 - LEVEL and self.gap.value < 0


def compare(pairs: Mapping[str, tuple[Values, Values]]) -> dict[str, Comparison]:
    """All comparisons of a claim, with Holm's correction over them."""
    corrected = holm(np.array([_p(x, y) for x, y in pairs.values()]))
    return {
        name: Comparison(difference(*both), float(p)) for (name, both), p in zip(pairs.items(), corrected, strict=True)
    }


def _p(x: Values, y: Values) -> float:
    """Of Welch's test; 0 or 1 where there is no spread at all."""
    if np.ptp(x) == 0 and np.ptp(y) == 0:
        return float(x[0] == y[0])
    return welch(x, y)


def gaps(found: Mapping[str, Comparison]) -> dict[str, Interval]:
    """The differences alone, by name."""
    return {name: one.gap for name, one in found.items()}


def near(values: Values, level: float, margin: float) -> bool:
    """True if two one-sided tests show that the mean is less than `margin` from a level. values: (n,), n >= 2."""
    return equivalence_of_pairs(values - level, margin) < 1 - LEVEL


@dataclass
class Evidence:
    """The runs that a rule may look at; it remembers which arms were used."""

    results: Results
    paper: Paper
    used: set[tuple[str, str]] = field(default_factory=set)
    asked: set[str] = field(default_factory=set)  # studies that the rule looked for, there or not
    remarks: list[str] = field(default_factory=list)  # why the verdict is provisional, beside seeds and steps

    def stated(self, claim: str) -> Mapping[str, float]:
        """The numbers of a claim."""
        return self.paper.claims[claim].numbers

    def first_of(self, *studies: str) -> str:
        """The first study that has a finished run, else the last."""
        there = (study for study in studies if (self.results.plan(study)["status"] == "finished").any())
        return next(there, studies[-1])

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

    def readings(self, without: str) -> Contrast | None:
        """The contrast of the whole method with an arm over the readings; None as long as none is finished."""
        every = contrasts(self.results, READINGS)
        found = next((one for one in every if one.without == without), None)
        if found is None or not len(found.effects):
            return None
        self.asked.add(READINGS)
        rows, others = self.results.levels, {one.without for one in every} - {without}
        mine = (rows["study"] == READINGS) & ~rows["contrast"].isin(others) & rows["reading"].isin(found.levels.index)
        self.used |= {(READINGS, str(arm)) for arm in rows.loc[mine, "arm"].unique()}
        if found.missing:
            self.remarks.append(f"{found.missing} of {found.missing + len(found.effects)} readings unfinished")
        return found

    def scripted(self, study: str, **env: int) -> Mapping[str, float]:
        """Final returns of the policies that do not learn, on a study's task; none where they were not run."""
        self.asked.add(YARDSTICKS)
        table = self.results.yardsticks_on(self.results.env(study) | env)
        if FINAL not in table:
            return {}
        return {str(name): float(x) for name, x in table[FINAL].items() if not str(name).endswith(BOUND)}

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
