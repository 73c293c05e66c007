"""Every claim with its verdict: the rules applied, what makes a verdict provisional, and the table of it all."""

from collections.abc import Callable, Mapping, Sequence
from inspect import cleandoc
from typing import NamedTuple

import numpy as np
import pandas as pd

from reports.claims.evidence import JUDGED, READINGS, VERDICTS, Evidence, Finding, UntestableError, Verdict
from reports.claims.headlines import Headline
from reports.claims.rules import RULES, Rule, unstated
from reports.data.escaping import markdown
from reports.data.frame import THEOREM, YARDSTICKS, Results
from reports.data.paper import Paper, PaperError
from reports.data.stats import FEW, LEVEL, Interval, Range
from reports.render.tables import NONE, SPAN, Table, capital, estimate, joined, number, percent, steps

__all__ = [
    "JUDGED",
    "VERDICTS",
    "Claim",
    "command",
    "describe",
    "described",
    "judge",
    "smoke_test",
    "table",
    "too_short",
]

# Shares of the paper's training budget: below the first nothing is judged; from the second on a verdict is not
# provisional: 1 M of 5 M steps, by when the text has full RHMC converge (section 5.3).
SHORT, ENOUGH = 0.02, 0.2


class Claim(NamedTuple):
    """A claim with its verdict.

    `label`: the claim in a few words; `caveats`: why a verdict is provisional; `runs`: the ids behind it; `commands`:
    what makes the numbers again; `headline`: the quantity that decides, None where the rule had nothing to look at.
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
    headline: Headline | None = None
    label: str = ""

    @property
    def provisional(self) -> bool:
        """True if the verdict rests on less than it should."""
        return bool(self.caveats) and self.verdict in JUDGED

    @property
    def judgement(self) -> str:
        """The verdict in words."""
        return f"{self.verdict} (provisional)" if self.provisional else self.verdict


def judge(results: Results, paper: Paper) -> list[Claim]:
    """Every claim of the paper, in its order.

    Raises:
        PaperError: what a rule looks at is not stated, or a claim has no rule.
    """
    if faults := [f"paper.yaml: {fault}" for fault in unstated(paper)]:
        raise PaperError("\n".join(faults))
    return [_judge(name, rule, results, paper) for name, rule in RULES.items()]


def too_short(results: Results, paper: Paper, study: str) -> bool:
    """True if a study's runs are so short that they show nothing of the paper's results.

    Where the text names no budget for a study, its longest counts.
    """
    theirs, ours = paper.steps.get(study, max(paper.steps.values(), default=0)), results.budget(study)
    return ours is not None and ours < SHORT * theirs


def smoke_test(results: Results, paper: Paper) -> str:
    """A warning in Markdown that runs are too short to be compared with the paper; empty if none is."""
    studies = [study for study in results.studies if too_short(results, paper, study)]
    if not studies:
        return ""
    every = len(studies) == len(results.studies)
    which = "Every run here has" if every else f"The runs of {joined(map(markdown, studies))} have"
    most = steps(max(paper.steps.values()))
    said = f"less than {100 * SHORT:g} % of the paper's {most} steps: they show that everything works, and no more"
    return f"Smoke test. {which} {said}."


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
        | _deciding(claim.headline)
        for claim in claims
    )
    shown = pd.DataFrame(
        {
            "Claim": claim.id,
            "The paper says": markdown(claim.text),
            "Paper": markdown(f"{claim.paper} ({claim.place})"),
            f"Ours {SPAN}": "<br>".join(markdown(f"{name} {value}") for name, value in described(claim.ours)) or NONE,
            "Verdict": f"**{claim.judgement}**",
            "Why": " ".join(
                [markdown(claim.reason)]
                + ([f"*{markdown(capital('; '.join(claim.caveats)))}.*"] if claim.provisional else [])
            ),
        }
        for claim in claims
    )
    return Table("The paper's claims", numbers, shown, marked=True)


def _deciding(found: Headline | None) -> dict[str, object]:
    """The columns of a table for the quantity that decides a claim. `level`: of its interval, NaN beside a range."""
    if found is None:
        return {}
    ours = found.ours
    level = np.nan if isinstance(ours, Range) or np.isnan(ours.low) else LEVEL
    return {
        "quantity": found.what,
        "unit": found.unit,
        "value": ours.value,
        "value_low": ours.low,
        "value_high": ours.high,
        "level": level,
        "paper_value": found.paper,
        "holds_from": found.low,
        "holds_to": found.high,
        "origin": found.origin,
        "pace": found.pace,
    }


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
    found = _if_long_enough(found, see)
    plans = [results.finished(study, arm) for study, arm in sorted(see.used)]
    behind = tuple(str(run) for plan in plans for run in plan["run"])
    text = " ".join(cleandoc(rule.__doc__ or "").split())
    caveats = tuple(_caveats(see)) if found.verdict in JUDGED else ()
    about = (name, said.text, said.value, said.place, found.verdict, found.reason, found.ours, caveats, behind, text)
    commands = tuple(command(study, results.profile) for study in sorted(see.asked))
    return Claim(*about, commands, found.headline, said.label or said.text)


def _if_long_enough(found: Finding, see: Evidence) -> Finding:
    """The finding; or, if a study behind it is too short, that."""
    studies = sorted({study for study, _ in see.used if too_short(see.results, see.paper, study)})
    if found.verdict not in JUDGED or not studies:
        return found
    each = joined(f"{study} has {steps(see.results.budget(study) or 0)}" for study in studies)
    share, most = 100 * SHORT, steps(max(see.paper.steps.values()))
    reason = f"Study {each} steps, less than {share:g} % of the paper's {most}. So far: {found.verdict}. {found.reason}"
    return found._replace(verdict="too short to judge", reason=reason)


def _caveats(see: Evidence) -> list[str]:
    """The reasons why a verdict from these arms is provisional."""
    out = []
    for study in sorted({study for study, _ in see.used}):
        theirs, ours = see.paper.steps.get(study), see.results.budget(study)
        if theirs and ours and ours < ENOUGH * theirs:
            out.append(f"{steps(ours)} of the paper's {steps(theirs)} steps ({100 * ours / theirs:.2g} %)")
    # The interval of a reading rests on the seeds of all.
    counts = [len(see.results.finals(study, arm)) for study, arm in see.used if study != READINGS]
    if counts and min(counts) < FEW:
        out.append(f"{min(counts)} seeds")
    open_arms = [arm for study, arm in sorted(see.used) if not _complete(see.results, study, arm)]
    return [*out, *see.remarks, *([f"unfinished: {joined(open_arms)}"] if open_arms else [])]


def _complete(results: Results, study: str, arm: str) -> bool:
    return len(results.finished(study, arm)) == len(results.plan(study, arm))


def _show(name: str) -> Callable[[float], str]:
    """The format of a quantity, by what its name says it is."""
    return steps if "step" in name else percent if name.endswith("in %") else number
