"""The report in Markdown, for reading in the repository, and its claims as Markdown and JSON."""

import math
from collections.abc import Iterator, Mapping, Sequence

from reports.analyses import searches
from reports.claims import verdicts as rules
from reports.claims.headlines import Headline
from reports.claims.verdicts import Claim
from reports.data.escaping import code, markdown, prose
from reports.data.frame import Results, mixed
from reports.data.stats import Interval, Range
from reports.pages import sheets
from reports.pages.answer import sentence
from reports.pages.gallery import Picture
from reports.pages.page import LONG
from reports.pages.report import Report, definitions
from reports.render.tables import MEASURED, Table, joined, steps

COMPLETE = "Nothing: every planned run is finished."


def page(report: Report) -> Iterator[str]:
    """The lines of the whole report."""
    results = report.results
    yield f"# {markdown(report.title)}\n"
    if report.paper:
        about = ". ".join(filter(None, (report.paper.source.title, report.paper.source.about)))
        yield f"{markdown(about)}.\n"
    if report.claims:
        yield f"**{sentence(report.claims)}**\n"
    if report.answer:
        yield f"**{markdown(report.answer)}**\n"
    yield "The same with everything in one page: `index.html`.\n"
    for warning in filter(None, (report.smoke, results.set_aside)):
        yield f"**{warning}**\n"
    yield f"{_summary(results)}\n"
    if report.short:
        yield "\n".join(f"- {markdown(line)}" for line in report.short) + "\n"
    if report.open:
        yield "Not everything is there yet: see [what is missing](#what-is-missing).\n"
    yield "## Figures\n"
    for picture in report.pictures:
        yield from _figure(picture)
    if not report.pictures:
        yield "No study has a curve yet.\n"
    if report.claims:
        listed = rules.table(report.claims)
        yield "## The paper's claims\n"
        yield "A rule computes each verdict: [claims.md](claims.md) prints it beside the runs used.\n"
        yield f"{listed.markdown()}\n"
    for name, table in report.tables.items():
        if name not in sheets.LAST:
            yield f"## {markdown(table.title)}\n"
            if table.note:
                yield f"{prose(table.note)}\n"
            yield f"{_body(table)}\n"
            yield f"{_links(table.folder, name, 'CSV', 'LaTeX')}\n"
    yield "## Definitions\n"
    yield "\n".join(f"- **{name}**: {words}" for name, words in definitions(results)) + "\n"
    yield "## What is missing\n"
    yield "\n".join(f"- {gap}" for gap in report.gaps) + "\n" if report.gaps else f"{COMPLETE}\n"
    yield "## Runs behind the numbers\n"
    yield f"{_origin(results)}\n"
    yield f"{report.tables['provenance'].markdown()}\n"
    yield f"Run by run: {_links(MEASURED, 'made', 'CSV', 'LaTeX')}\n"
    yield report.tables["runs"].markdown()


def _body(table: Table) -> str:
    """A table; of a long one the first rows, and how many more there are."""
    more = len(table.shown) - LONG
    if more <= 0:
        return table.markdown()
    return f"{table._replace(shown=table.shown.head(LONG)).markdown()}\n\n{more} more rows:"


def _figure(picture: Picture) -> Iterator[str]:
    heading = markdown(picture.heading)
    if picture.fault:
        yield f"*{heading}.* Could not be drawn: {markdown(picture.fault)}\n"
        return
    yield f"![{heading}](figures/{picture.name}.png)\n"
    yield f"*{heading}.* {markdown(picture.caption)} {_links('figures', picture.name, 'PDF', 'numbers')}\n"


def _links(folder: str, name: str, first: str, second: str) -> str:
    kinds = {"PDF": "pdf", "numbers": "csv", "CSV": "csv", "LaTeX": "tex"}
    return ", ".join(f"[{word}]({folder}/{name}.{kinds[word]})" for word in (first, second))


def _summary(results: Results) -> str:
    """Budget and seeds of each study, in one sentence."""
    lines = []
    for study in results.studies:
        plan, budget = results.plan(study), results.budget(study)
        done = int((plan["status"] == "finished").sum())
        question = str(plan["question"].iloc[0])
        said = f"{done} of {len(plan)} runs finished, {steps(budget) if budget else 'unknown'} steps each"
        episodes = results.final_episodes(study)
        said += f", final return over {episodes} episodes" if episodes else ""
        arms = len(results.arms(study))
        lines.append(f"- **{markdown(study)}**: {prose(question)} ({arms} arm{'s' * (arms > 1)}, {said})")
    for search in results.searches:
        said = f"{prose(searches.question(results, search))} ({searches.spoken(results, search)})"
        lines.append(f"- **{markdown(search)}**, a search: {said}")
    return "\n".join(lines) or "No study has runs yet."


def _origin(results: Results) -> str:
    """Code and commit that made the runs."""
    found = []
    for column, word in (("fingerprint", "code"), ("commit", "commit")):
        values = sorted(set(results.runs[column].dropna().astype(str)) - {""})
        found.append(f"{word} {joined(map(code, values)) or 'unknown'}")
    warning = " (**the runs were not all made by the same code**)" if mixed(results.runs) else ""
    return f"Made by {found[0]}{warning}, {found[1]}."


def claims(found: Sequence[Claim]) -> Iterator[str]:
    """The lines of a page on every claim."""
    yield "# The paper's claims\n"
    yield f"{sentence(found)}\n"
    for claim in found:
        yield f"## {claim.id}: {claim.judgement}\n"
        yield f"> {markdown(f'{claim.text} ({claim.place})')}\n"
        yield f"- Paper: {markdown(claim.paper)}"
        yield f"- Ours: {markdown(rules.describe(claim.ours)) or 'nothing to show'}"
        yield f"- Why: {markdown(claim.reason)}"
        if claim.provisional:
            yield f"- Provisional: {markdown('; '.join(claim.caveats))}"
        yield f"- Rule: {claim.rule}"
        yield f"- Runs: {', '.join(map(code, claim.runs)) or 'none'}\n"


def plain(claim: Claim) -> dict[str, object]:
    """A claim as JSON: null for what JSON has not, which is NaN and an end that is open."""
    ours = {name: _interval(x) for name, x in claim.ours.items()}
    decides = _headline(claim.headline) if claim.headline else None
    return claim._asdict() | {"ours": ours, "provisional": claim.provisional, "headline": decides}


def _interval(x: Interval) -> Mapping[str, object]:
    return {key: _finite(value) for key, value in x._asdict().items()} | {"range": isinstance(x, Range)}


def _headline(found: Headline) -> Mapping[str, object]:
    """`holds`: whether there is a value at which the claim would hold; its ends are null where they are open."""
    numbers = {name: _finite(getattr(found, name)) for name in ("paper", "low", "high", "origin", "pace")}
    words = {"what": found.what, "unit": found.unit, "ours": _interval(found.ours)}
    return words | numbers | {"holds": not (math.isnan(found.low) and math.isnan(found.high))}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
