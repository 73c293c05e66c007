"""The answer in words: one sentence over all verdicts, and a reader's next questions, each from what was computed."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from markupsafe import Markup

from reports.claims.verdicts import JUDGED, Claim
from reports.pages.forest import rows
from reports.pages.report import Report

HOLDS = "reproduced"
SAID: Mapping[str, tuple[str, str]] = {  # a verdict after a number: of one claim, of several
    "not reproduced": ("does not", "do not"),
    "depends on the reading": ("depends on how the text is read", "depend on how the text is read"),
    "contradicted by the paper itself": ("is contradicted by the paper itself", "are contradicted by the paper itself"),
    "too short to judge": ("has runs too short to judge it", "have runs too short to judge them"),
    "untestable": ("cannot be tested", "cannot be tested"),
}
REGULATOR = ("C8a", "C8b")


class Answer(NamedTuple):
    """A question and the lines of its answer."""

    question: str
    lines: list[Markup]


def sentence(claims: Sequence[Claim]) -> str:
    """Answer in one sentence: the number of claims with each verdict, and how many of these are provisional."""
    counts, total = Counter(str(claim.verdict) for claim in claims), len(claims)
    rest = [f"{counts[verdict]} {said[counts[verdict] > 1]}" for verdict, said in SAID.items() if counts[verdict]]
    provisional = sum(claim.provisional for claim in claims)
    ending = (
        f"; {provisional} of these verdicts {'is' if provisional == 1 else 'are'} provisional." if provisional else "."
    )
    if not any(counts[verdict] for verdict in JUDGED):
        return f"Of {total} claims none is judged: {', '.join(rest)}{ending}"
    held = counts[HOLDS]
    first = "none holds" if not held else "all hold" if held == total else f"{held} hold{'s' * (held == 1)}"
    return f"Of {total} claims {', '.join([first, *rest])}{ending}"


def questions(report: Report) -> list[Answer]:
    """Questions that a reader asks next."""
    every = {
        "Which method is best?": [Markup.escape(line) for line in report.short]
        or [Markup("No runs to tell from yet.")],
        "What does the regulator do?": list(_regulator(report.claims)),
        "How sure is this?": list(_sure(report)),
        "How do I run it?": list(_run(report.results.profile)),
    }
    return [Answer(question, lines) for question, lines in every.items() if lines]


def _regulator(claims: Sequence[Claim]) -> Iterator[Markup]:
    """Words on regulation, and its worth here."""
    yield Markup(
        "Where agents earn less than Algorithm 1 says that they could have, it pays the coordinator that reward: "
        "executors that still miss then spoil no assignment."
    )
    for row in rows([claim for claim in claims if claim.id in REGULATOR]):
        found = f" {row.what} {row.ours};" if row.what else ""
        line = Markup('{} (<a href="#{}">{}</a>): {}.{} paper: {}.')
        yield line.format(row.claim.label, row.claim.id, row.claim.id, row.claim.judgement, found, row.paper)


def _sure(report: Report) -> Iterator[Markup]:
    """The data behind the verdicts, and why these are provisional."""
    yield Markup.escape(report.lead)
    reasons = Counter(caveat for claim in report.claims if claim.provisional for caveat in claim.caveats)
    if reasons:
        listed = ", ".join(f"{reason} ({count})" for reason, count in reasons.most_common())
        line = Markup('<a href="#definitions">Provisional</a> verdicts rest on less than they should, by claims: {}.')
        yield line.format(listed)
    if older := report.results.older:
        line = Markup('Made by an older version: {} {}, see <a href="#provenance">provenance</a>.')
        yield line.format(len(older), "table" if len(older) == 1 else "tables")
    if report.open:
        line = Markup(
            '<strong>Not everything is there yet.</strong> {} {}: see <a href="#missing">what is missing</a>.'
        )
        yield line.format(report.open, "gap" if report.open == 1 else "gaps")


def _run(profile: str) -> Iterator[Markup]:
    yield Markup(
        "<code>make repro</code> trains and reports on the profile in <code>params.yaml</code>; <code>rhmc report "
        "--profile {}</code> makes this page anew from the tables of the runs."
    ).format(profile)
