"""The content of the page: its parts in their order, by the names of its template."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from reports.analyses import searches
from reports.claims import verdicts as rules
from reports.data.escaping import stem, words
from reports.data.frame import Results, mixed
from reports.pages import answer, forest, page, sheets
from reports.pages.gallery import ARMS, Picture
from reports.pages.report import Report, definitions, question
from reports.render.tables import SPAN, Table, joined

DRAWN = "rhmc drawings"
PAIRS = "pairs_"  # they carry the answer of a study's own report
MORE = ("profile_", "better_", PAIRS, "efficiency_", "steadiness_", "time_", "settings_", "yardsticks")
METHOD, SCALE = "method", "scale"  # parts that are no study's

Part = TypeVar("Part")


def of(report: Report) -> Mapping[str, Any]:
    """The content of the page, by the names of its template."""
    results = report.results
    runs = report.tables["runs"]
    results_of, method, others = _sections(report)
    return {
        **_head(report),
        "sections": [*results_of, *method],
        "others": others,
        "claims": [page.card(claim) for claim in report.claims],
        "folded": page.FOLDED,
        "filtered": page.FILTERED,
        "span": SPAN,
        "gaps": [words(gap) for gap in report.gaps],
        "definitions": definitions(results),
        "mixed": mixed(results.runs),
        "aside": words(results.set_aside) if report.paper else "",
        "provenance": page.provenance(results),
        "made": page.grid("provenance", report.tables["provenance"]),
        "runs": page.grid("runs", runs, _links(report)),
        "counted": "runs" if set(results.runs["study"]) <= set(results.studies) else "runs, with yardsticks",
        "ids": [f"run-{stem(run)}" if first else "" for run, first in _first_seen(runs)],
        "foot": f"Built from the exported tables of profile {results.profile}; the same tables give the same page.",
    }


def _head(report: Report) -> dict[str, Any]:
    """Head of the page: the answer of a report on the paper, the question of one on a study."""
    asked = report.paper is None
    return {
        "title": report.title,
        "lead": report.lead if asked else "",
        "paper": report.paper.source if report.paper else None,
        "profile": report.results.profile,
        "warnings": [words(report.smoke)] if report.smoke else [],
        "notes": [words(report.results.set_aside)] if asked and report.results.set_aside else [],
        "sentence": report.answer if asked else answer.sentence(report.claims),
        "questions": [] if asked else answer.questions(report),
        "open": report.open if asked else 0,
        "rows": [_row(row) for row in forest.rows(report.claims)],
        "ticks": forest.ticks(),
        "scale": forest.scale(report.claims),
        "middle": forest.place(0),
        "verdicts": page.verdicts(report.claims),
    }


def _row(row: forest.Row) -> dict[str, Any]:
    """A row of the plot with its looks."""
    return row._asdict() | page.looks(row.claim)


def _first_seen(runs: Table) -> Iterator[tuple[str, bool]]:
    """Run ids in the order of the table, and whether it is the first row of that run: it may stand in two studies."""
    seen: set[str] = set()
    for run in runs.numbers["run"].astype(str):
        yield run, run not in seen
        seen.add(run)


def _sections(report: Report) -> tuple[list[page.Section], list[page.Section], list[page.Section]]:
    """The paper's studies, the method and its tasks, and what goes beyond: further studies, searches, what is left.

    In the report of one study, which has no claims, that study is the first part.
    """
    first, rest = (report.own, report.others) if report.paper else (report.results.studies, [])
    owners = {stem(study): study for study in report.results.studies}
    of_table = {name: owner for name in report.tables if (owner := owners.get(_of_study(name)))}
    of_table |= {name: "ablation" for name in ("table_2",) if name in report.tables}

    def of_study(study: str) -> page.Section:
        names = [name for name, owner in of_table.items() if owner == study]
        return _section(report, f"study-{stem(study)}", _heading(report.results, study), study, names)

    found = {name: sheets.winners(name) for name in report.results.searches}
    searched = [
        _section(report, f"search-{stem(name)}", searches.heading(report.results, name), name, [table])
        for name, table in found.items()
    ]
    elsewhere = {"table_1", *sheets.LAST, *of_table, *found.values()}
    left = [name for name in report.tables if name not in elsewhere]
    method = _section(report, METHOD, "The method and its tasks", "", ["table_1"])
    scale = _section(report, SCALE, "Yardsticks, transfer, encoder, Theorem 1", "-", left)
    parts = [of_study(name) for name in first], [method], [*(of_study(name) for name in rest), *searched, scale]
    mine, how, others = ([part for part in some if part.plates or part.grids] for some in parts)
    return (mine, how, others) if report.paper else ([*mine, *others], how, [])


def _of_study(name: str) -> str:
    """The part of a table's name that follows its kind."""
    kind, _, rest = name.partition("_")
    return rest if kind in sheets.KINDS else ""


def _section(report: Report, name: str, title: str, study: str, names: Sequence[str]) -> page.Section:
    results = report.results
    known = study in (*results.studies, *results.searches)
    made = rules.command(study, results.profile) if study in results.studies else DRAWN
    own = {p.name: p for p in report.pictures if p.study == study}
    beside = {name for name, p in own.items() if _in_chart(name, own) and not p.fault}  # files, and not on the page
    plates = {
        name: page.plate(p, p.behind or made.partition(" && ")[0], arms=f"{name}{ARMS}" in beside)
        for name, p in own.items()
        if name not in beside
    }
    if name == METHOD:
        gifs = results.episodes.items()
        episodes = [page.episode(task, gif, report.tables_at, _whose(results, gif)) for task, gif in gifs]
        plates |= {plate.name: plate for plate in episodes}
    links = _links(report)
    grids = {key: page.grid(key, report.tables[key], links) for key in names if key in report.tables}
    folded = MORE if report.paper else tuple(kind for kind in MORE if kind != PAIRS)
    parts = *_parted(plates, folded), *_parted(grids, folded)
    return page.Section(name, title, question(results, study) if known else "", *parts)


def _links(report: Report) -> page.Links:
    """Place on the page of each arm."""
    charts = [(p.study, p.chart.places) for p in report.pictures if p.chart]
    return page.Links(
        {(study, arm): place for study, places in charts for arm, place in places.items()},
        {
            (row.study, row.arm, row.run): page.anchor(task)
            for task, gif in report.results.episodes.items()
            for row in _shown_in(report.results, gif)
        },
    )


class Shown(NamedTuple):
    """A run whose policy an animation shows; it may stand in several studies."""

    study: str
    arm: str
    seed: int
    run: str


def _shown_in(results: Results, gif: bytes) -> list[Shown]:
    rows = results.runs[(results.runs["run"] == page.shown_in(gif)) & results.runs["study"].isin(results.studies)]
    return [Shown(*row) for row in rows[list(Shown._fields)].itertuples(index=False)]


def _whose(results: Results, gif: bytes) -> str:
    """The policy of an animation, in words."""
    return joined(f"study {row.study}, arm {row.arm}, seed {row.seed}" for row in _shown_in(results, gif))


def _in_chart(name: str, pictures: Mapping[str, Picture]) -> bool:
    """True of the figure arm by arm of one that is a chart."""
    whole = pictures.get(name.removesuffix(ARMS)) if name.endswith(ARMS) else None
    return whole is not None and whole.chart is not None


def _parted(found: Mapping[str, Part], folded: tuple[str, ...]) -> tuple[list[Part], list[Part]]:
    """The parts that are shown at once, and those that are folded away: others, which look at the same runs anew."""
    away = {key for key in found if key.startswith(folded) or key.endswith(ARMS)}
    return [x for key, x in found.items() if key not in away], [x for key, x in found.items() if key in away]


def _heading(results: Results, study: str) -> str:
    done, plan = int((results.plan(study)["status"] == "finished").sum()), len(results.plan(study))
    return f"Study {study}" + ("" if done == plan else f" ({done} of {plan} runs finished)")
