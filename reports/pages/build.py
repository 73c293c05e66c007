"""Build a report, as `rhmc report` does. The same tables give the same bytes."""

import fcntl
import json
import math
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple, TypeVar

from reports.analyses import alpha, beyond, comparison, readings, scaling, searches, settings
from reports.claims import verdicts as rules
from reports.claims.verdicts import ENOUGH, SHORT, VERDICTS, Claim
from reports.data.escaping import code, markdown, prose, stem, words
from reports.data.frame import Results, TableError, load, mixed
from reports.data.paper import Paper, PaperError, read
from reports.data.stats import FEW, Range
from reports.pages import page
from reports.pages.gallery import Picture, gallery, in_short, reason, search_gallery, study_gallery
from reports.render import tables
from reports.render.canvas import save, write_csv
from reports.render.glyphs import LOST
from reports.render.tables import MEASURED, SPAN, TABLES, Table, joined, steps

Outcome = Literal["whole", "undrawn", "refused"]  # of a report
PART = ".report-"  # begins the name of the folder in which a report is made
MADE = ("figures", TABLES, MEASURED, "claims.md", "claims.csv", "claims.json", "index.md", "index.html")

DEFINITIONS = (
    (
        "Final return",
        "mean over seeds of final/return, the greedy policy after the last step in {episodes} that no curve "
        "uses. Coverage: 100 × mean reward per step; navigation: sum over an episode.",
    ),
    (
        "Curve",
        "mean over seeds of eval/return, the greedy policy in fewer fixed episodes, on one grid of steps. Faint where "
        "fewer seeds have come so far.",
    ),
    (
        "[95 %]",
        "bootstrap over seeds (40 000 resamples, one fixed generator), the percentile interval widened to the width of "
        "Student's t; of P Newcombe's, over readings from the pooled variance.",
    ),
    (
        "(range)",
        f"with fewer than {FEW} seeds a bootstrap ends at the worst and the best seed. Round brackets have this range "
        "of the resamples, which is no 95 % interval; rules take it for one. Three seeds' range holds the true mean in "
        "about 3 of 4 cases.",
    ),
    ("IQM", "mean without the lowest and the highest quarter of seeds; with fewer than four seeds that is the mean."),
    ("Change", "of the mean against full RHMC, in percent."),
    (
        "P(full better), P(first better)",
        "probability that a random seed of the first arm beats a random one of the other, with Newcombe's score "
        "interval. A bootstrap would say [0, 0] or [1, 1] where every seed of one arm wins. Three seeds that all win "
        "against three can show no more than [0.50, 1.00].",
    ),
    (
        "provisional",
        f"the verdict rests on less than {readings.percent_of(ENOUGH)} of the paper's training budget, on fewer than "
        f"{FEW} seeds, on unfinished runs, or on one reading of the text.",
    ),
    ("depends on the reading", "what the text leaves open decides it: the specification curve has the factors."),
    ("too short to judge", f"the runs have less than {readings.percent_of(SHORT)} of the paper's training budget."),
)


Part = TypeVar("Part")
FIRST = ("navigation", "coverage", "scaling", "ablation")  # studies of the paper, in its order
MORE = ("profile_", "better_", "pairs_", "steadiness_", "time_", "settings_", "yardsticks")
KINDS = (  # of tables of a study
    *("effects", "factors", "readings", "mechanism"),
    *("final", "pairs", "efficiency", "time", "assignments", "steadiness", "agents", "settings"),
)
LAST = ("provenance", "runs", "made")  # tables with a part of their own at the end
COMPLETE = "Nothing: every planned run is finished."
DRAWN = "rhmc drawings"


class Report(NamedTuple):
    """Everything that is written, before it is."""

    results: Results
    title: str
    lead: str
    pictures: list[Picture]
    tables: dict[str, Table]
    claims: list[Claim]
    gaps: list[str]
    short: list[str]  # what came out, a sentence a figure of the paper
    smoke: str = ""  # a warning that the runs are too short


class OutError(ValueError):
    """The report cannot be written where it should be; the message is one line."""


class Built(NamedTuple):
    """A report that is written: its files, and a line for each figure that could not be drawn."""

    files: list[Path]
    undrawn: list[str]
    note: str = ""  # on tables of an older version


def build(runs: Path, out: Path, profile: str, study: str | None = None) -> Built:
    """Read the tables in `runs`, and write the report to `out`.

    Everything is made in a folder beside the old report first, so that a failure leaves the old one as it was. What a
    report that was killed left there is removed. A figure that cannot be drawn leaves its place on the page.

    Args:
        runs: folder of the exported tables.
        out: folder of the report.
        profile: that made the runs.
        study: the one study to report on, without the paper's claims; None for the whole report.

    Raises:
        TableError: the tables are missing or faulty; nothing is written.
        PaperError: so is `paper.yaml`.
        OutError: `out` is no folder, cannot be written to, or another report is being written there.
    """
    results, paper = load(runs, profile, study), read()
    made = _whole(results, paper) if study is None else _single(results, paper, study)
    try:
        with _held(out), TemporaryDirectory(prefix=PART, dir=out) as folder:
            written = _write(made, Path(folder))
            names = [name for name in MADE if (Path(folder) / name).exists()]
            for name in names:
                _replace(Path(folder) / name, out / name, Path(folder))
    except OSError as error:
        raise OutError(f"{error.filename or out}: cannot be written ({error.strerror or error})") from error
    files = sorted(path for name in names for path in [out / name, *(out / name).rglob("*")] if path.is_file())
    return Built(files, _undrawn(written), results.set_aside)


@contextmanager
def _held(out: Path) -> Iterator[None]:
    """Hold the folder of a report while it is written, without what one that was killed left there."""
    out.mkdir(parents=True, exist_ok=True)
    folder = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)  # on the folder itself: ends with the process, no file
        except BlockingIOError as error:
            raise OutError(f"{out}: another report is being written there; wait for it, or give --out") from error
        for left in out.glob(f"{PART}*"):
            shutil.rmtree(left)
        yield
    finally:
        os.close(folder)


def write_report(
    runs: Path | None,
    out: Path | None,
    profile: str = "quick",
    study: str | None = None,
    shown: Callable[[str], str] = str,
) -> Outcome:
    """Build a report as `build` does, and say on the terminal what became of it.

    Args:
        runs: folder of the tables; results/PROFILE/runs if None.
        out: folder of the report; results/PROFILE, with study/STUDY after it for one study, if None.
        profile: that made the runs.
        study: report on this one alone.
        shown: how a message is printed, which names folders as they were typed.

    Returns:
        `undrawn` if a figure could not be drawn; `refused` if the tables are faulty: then nothing is written.
    """
    home = Path("results") / profile
    out = out or (home / "study" / study if study else home)
    try:
        built = build(runs or home / "runs", out, profile, study)
    except (TableError, PaperError, OutError) as error:
        print(shown(str(error)), file=sys.stderr)
        return "refused"
    for line in [*built.undrawn, *([f"note: {built.note}"] if built.note else [])]:
        print(shown(line), file=sys.stderr)
    print(shown(f"{len(built.files)} files; start with {out / 'index.html'}"))
    return "undrawn" if built.undrawn else "whole"


def _whole(results: Results, paper: Paper) -> Report:
    gaps = [] if results.methods else ["Table 1: no methods; `rhmc methods --out` writes them."]
    gaps += [] if results.modules else ["Figures 1 to 3: no networks; `rhmc drawings --out` writes them."]
    gaps += [] if results.scenes else ["Figures 4, 5 and 8: no scenes; `rhmc drawings --out` writes them."]
    gaps += [] if results.episodes else ["Animations: none; `rhmc render --out` writes them."]
    gaps += results.gaps(paper.arms | {scaling.STUDY: ()})
    title = f"Does it hold? The paper's results, profile {results.profile}"
    pictures, claims = gallery(results, paper), rules.judge(results, paper)
    made = _tables(results, paper)
    return Report(
        results,
        title,
        _lead(results),
        pictures,
        made,
        claims,
        gaps,
        in_short(results, paper),
        rules.smoke_test(results, paper),
    )


def _single(results: Results, paper: Paper, study: str) -> Report:
    own = _alone(results)
    if study in results.searches:
        made, title = _search_tables(results, study) | _last(own), f"Search {study}, profile {results.profile}"
        lead = f"{_question(results, study)} {searches.spoken(results, study)}."
        return Report(results, title, lead, list(search_gallery(results, study)), made, [], results.gaps({}), [])
    made = _study_tables(results, study) | _last(own)
    title = f"Study {study}, profile {results.profile}"
    lead = f"{_question(results, study)} {_lead(results)}"
    return Report(
        results,
        title,
        lead,
        study_gallery(results, paper, study),
        made,
        [],
        results.gaps({}),
        [],
        rules.smoke_test(own, paper),
    )


def definitions(results: Results) -> list[tuple[str, str]]:
    """The meaning of the words, with the number of final evaluation episodes."""
    counts = sorted({n for study in results.studies if (n := results.final_episodes(study))})
    episodes = f"{' to '.join(map(str, dict.fromkeys((counts[0], counts[-1]))))} episodes" if counts else "episodes"
    return [(name, words.replace("{episodes}", episodes)) for name, words in DEFINITIONS]


def _write(report: Report, folder: Path) -> Report:
    """Write a report to an empty folder, and return it as it came out."""
    pictures = folder / "figures"
    for name in ("figures", TABLES, MEASURED):
        (folder / name).mkdir()
    for name, table in report.tables.items():
        _save(table, folder / table.folder, name)
    if report.claims:
        _write_claims(report.claims, folder)
    report = report._replace(pictures=[_saved(picture, pictures) for picture in report.pictures])
    _write_text(folder / "index.md", "\n".join(_index(report)) + "\n")
    _write_text(folder / "index.html", page.render(_content(report, pictures)))
    return report


def _saved(picture: Picture, folder: Path) -> Picture:
    """Write the files of a figure. One that cannot be drawn has its numbers alone, and says why."""
    if picture.drawing is None:
        return picture
    try:
        lost = save(picture.drawing, folder, picture.name)
    except Exception as error:
        if isinstance(error, OSError):  # a full disk is no fault of the figure
            raise
        for kind in ("png", "pdf"):
            (folder / f"{picture.name}.{kind}").unlink(missing_ok=True)
        return picture._replace(drawing=None, fault=reason(error))
    return picture._replace(caption=f"{picture.caption} {LOST}") if lost else picture


def _undrawn(report: Report) -> list[str]:
    """A line for each figure and each animation that a report only has a place for."""
    pictures = [f"{picture.name}: could not be drawn ({picture.fault})" for picture in report.pictures if picture.fault]
    faults = {task: page.animation_fault(gif) for task, gif in report.results.episodes.items()}
    return pictures + [f"episode_{task}.gif: could not be shown ({fault})" for task, fault in faults.items() if fault]


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _write_claims(found: Sequence[Claim], folder: Path) -> None:
    listed = rules.table(found)
    write_csv(listed.numbers, folder / "claims.csv")
    plain = json.dumps([_plain(claim) for claim in found], indent=1, ensure_ascii=False)
    _write_text(folder / "claims.json", plain + "\n")
    _write_text(folder / "claims.md", "\n".join(_claims_page(found, listed)) + "\n")


def _tables(results: Results, paper: Paper) -> dict[str, Table]:
    """Tables by file name; those with nothing to show are left out."""
    made = {"table_1": tables.table_1(results)} if results.methods else {}
    made |= {"table_2": tables.table_2(results, paper)} if results.arms("ablation") else {}
    for study in results.studies:
        made |= _study_tables(results, study)
    for search in results.searches:
        made |= _search_tables(results, search)
    made |= {"yardsticks": tables.yardsticks(results)} if results.yardsticks else {}
    every = {
        "numbers": beyond.table_numbers(results),
        "transfer": beyond.table_transfer(results),
        "encoder": beyond.table_encoder(results),
        "theorem": tables.theorem(results),
    }
    made |= {name: table for name, table in every.items() if table}
    return made | _last(results)


def _last(results: Results) -> dict[str, Table]:
    return {"provenance": tables.provenance(results), "runs": tables.runs(results), "made": tables.made(results)}


def _study_tables(results: Results, study: str) -> dict[str, Table]:
    """The tables that a study has. One with readings has too many arms for those that compare each pair."""
    if results.has_readings(study):
        made = readings.tables(results, study) | {"final": tables.finals(results, study)}
        return {f"{name}_{stem(study)}": table for name, table in made.items()}
    found = scaling.sweep(results, study)
    steadiness = tables.steadiness(results, study)
    every: dict[str, Table | None] = {
        "effects": alpha.table_effects(results, study) if alpha.is_of(study) else None,
        "mechanism": alpha.table_mechanism(results, study) if alpha.is_of(study) else None,
        "final": tables.finals(results, study),
        "pairs": comparison.pairs_table(results, study),
        "efficiency": comparison.efficiency(results, study),
        "time": comparison.time_to_level(results, study),
        "assignments": beyond.table_assignments(results, study),
        "steadiness": steadiness if len(steadiness.shown) else None,
        "agents": scaling.table(results, found) if found else None,
        "settings": settings.table(results, study),
    }
    return {f"{name}_{stem(study)}": table for name, table in every.items() if table}


def _search_tables(results: Results, search: str) -> dict[str, Table]:
    return {_winners(search): searches.table_winners(results, search)}


def _winners(search: str) -> str:
    """The name of a search's table."""
    return f"winners_{stem(search)}"


def _save(table: Table, folder: Path, name: str) -> None:
    write_csv(table.numbers, folder / f"{name}.csv", digits="%.6g")
    _write_text(folder / f"{name}.md", f"{table.markdown()}\n")
    _write_text(folder / f"{name}.tex", table.latex())


def _index(report: Report) -> Iterator[str]:
    results = report.results
    yield f"# {markdown(report.title)}\n"
    yield "The same with everything in one page: `index.html`.\n"
    for warning in filter(None, (report.smoke, results.set_aside)):
        yield f"**{warning}**\n"
    yield f"{_summary(results)}\n"
    if report.short:
        yield "\n".join(f"- {markdown(line)}" for line in report.short) + "\n"
    if report.gaps:
        yield "Not everything is there yet: see [what is missing](#what-is-missing).\n"
    yield "## Figures\n"
    for picture in report.pictures:
        yield from _figure(picture)
    if not report.pictures:
        yield "No study has a curve yet.\n"
    if report.claims:
        listed = rules.table(report.claims)
        yield "## The paper's claims\n"
        yield f"{_count(listed)} A rule computes each verdict: [claims.md](claims.md) prints it beside the runs used.\n"
        yield f"{listed.markdown()}\n"
    for name, table in report.tables.items():
        if name not in LAST:
            yield f"## {markdown(table.title)}\n"
            if table.note:
                yield f"{prose(table.note)}\n"
            yield f"{table.markdown()}\n"
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


def _content(report: Report, pictures: Path) -> Mapping[str, Any]:
    """The content of the page, by the names of its template."""
    results = report.results
    runs = report.tables["runs"]
    return {
        "title": report.title,
        "lead": report.lead,
        "warnings": [words(text) for text in (report.smoke, results.set_aside) if text],
        "short": report.short,
        "folded": page.FOLDED,
        "span": SPAN,
        "tally": page.verdicts(report.claims),
        "gaps": [words(gap) for gap in report.gaps],
        "claims": [page.card(claim) for claim in report.claims],
        "sections": _sections(report, pictures),
        "definitions": definitions(results),
        "mixed": mixed(results.runs),
        "provenance": page.provenance(results),
        "made": page.grid("provenance", report.tables["provenance"]),
        "runs": page.grid("runs", runs),
        "counted": "runs" if set(results.runs["study"]) <= set(results.studies) else "runs, with yardsticks",
        "ids": [f"run-{stem(run)}" if first else "" for run, first in _first_seen(runs)],
        "foot": f"Built from the exported tables of profile {results.profile}; the same tables give the same page.",
    }


def _first_seen(runs: Table) -> Iterator[tuple[str, bool]]:
    """Run ids in the order of the table, and whether it is the first row of that run: it may stand in two studies."""
    seen: set[str] = set()
    for run in runs.numbers["run"].astype(str):
        yield run, run not in seen
        seen.add(run)


def _sections(report: Report, pictures: Path) -> list[page.Section]:
    """The method and its tasks, a part per study (those of the paper first), one per search, what belongs to none."""
    others = [name for name in report.results.studies if name not in FIRST]
    studies = [name for name in FIRST if name in report.results.studies] + others
    owners = {stem(study): study for study in studies}
    of_table = {name: owner for name in report.tables if (owner := owners.get(_of_study(name)))}
    of_table |= {name: "ablation" for name in ("table_2",) if name in report.tables}
    whole = [_section(report, pictures, "method", "The method and its tasks", "", ("table_1",))]
    whole += [
        _section(report, pictures, f"study-{stem(study)}", _heading(report.results, study), study, names)
        for study in studies
        for names in [tuple(name for name, owner in of_table.items() if owner == study)]
    ]
    of_search = {name: (_winners(name),) for name in report.results.searches}
    whole += [
        _section(report, pictures, f"search-{stem(name)}", searches.heading(report.results, name), name, names)
        for name, names in of_search.items()
    ]
    elsewhere = {"table_1", *LAST, *of_table, *(name for names in of_search.values() for name in names)}
    rest = tuple(name for name in report.tables if name not in elsewhere)
    whole.append(_section(report, pictures, "scale", "Yardsticks, transfer, encoder, Theorem 1", "-", rest))
    return [section for section in whole if section.plates or section.grids]


def _of_study(name: str) -> str:
    """The part of a table's name that follows its kind."""
    kind, _, rest = name.partition("_")
    return rest if kind in KINDS else ""


def _section(report: Report, pictures: Path, name: str, title: str, study: str, names: Sequence[str]) -> page.Section:
    mine = [picture for picture in report.pictures if picture.study == study]
    made = rules.command(study, report.results.profile) if study in report.results.studies else DRAWN
    plates = {p.name: page.plate(p, pictures, p.behind or made.partition(" && ")[0]) for p in mine}
    if not study:
        episodes = [page.episode(task, gif) for task, gif in report.results.episodes.items()]
        plates |= {plate.name: plate for plate in episodes}
    grids = {key: page.grid(key, report.tables[key]) for key in names if key in report.tables}
    words = _question(report.results, study) if study in (*report.results.studies, *report.results.searches) else ""
    return page.Section(name, title, words, *_parted(plates), *_parted(grids))


def _parted(found: Mapping[str, Part]) -> tuple[list[Part], list[Part]]:
    """The parts that are shown at once, and those that are folded away."""
    shown = [x for key, x in found.items() if not _folded(key)]
    return shown, [x for key, x in found.items() if _folded(key)]


def _folded(name: str) -> bool:
    """True if a figure or a table is folded away: what looks at the same runs in yet another way."""
    return name.startswith(MORE) or name.endswith("_arms")


def _heading(results: Results, study: str) -> str:
    done, plan = int((results.plan(study)["status"] == "finished").sum()), len(results.plan(study))
    return f"Study {study}" + ("" if done == plan else f" ({done} of {plan} runs finished)")


def _alone(results: Results) -> Results:
    """Without the yardsticks, which are no runs of a study."""
    return Results(results.points, results.runs[results.runs["study"].isin(results.studies)], results.profile)


def _question(results: Results, study: str) -> str:
    """What a study or a search asks."""
    if study in results.searches:
        return searches.question(results, study)
    return str(results.plan(study)["question"].iloc[0])


def _lead(results: Results) -> str:
    """The amount of data behind the report, in a sentence or two."""
    runs = results.runs[results.runs["study"].isin(results.studies)]
    done, budgets = int((runs["status"] == "finished").sum()), [results.budget(study) for study in results.studies]
    known = sorted({budget for budget in budgets if budget})
    span = f", {' to '.join(dict.fromkeys((steps(known[0]), steps(known[-1]))))} steps each" if known else ""
    count = len(results.studies)
    return (
        f"{done} of {len(runs)} planned runs finished in {count} {'study' if count == 1 else 'studies'}{span}. Every "
        "number comes from logged runs; what is not there is missing, never zero."
    )


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


def _count(claims: Table) -> str:
    """The number of claims with each verdict."""
    counts = claims.numbers["verdict"].value_counts()
    parts = [f"{counts[verdict]} {verdict}" for verdict in VERDICTS if verdict in counts]
    return f"Of {len(claims.numbers)} claims: {', '.join(parts)}."


def _claims_page(found: Sequence[Claim], listed: Table) -> Iterator[str]:
    yield "# The paper's claims\n"
    yield f"{_count(listed)}\n"
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


def _plain(claim: Claim) -> dict[str, object]:
    """A claim as JSON: NaN, which JSON has not, as null."""
    ours = {
        name: {key: None if math.isnan(value) else value for key, value in x._asdict().items()}
        | {"range": isinstance(x, Range)}
        for name, x in claim.ours.items()
    }
    return claim._asdict() | {"ours": ours, "provisional": claim.provisional}


def _replace(new: Path, old: Path, aside: Path) -> None:
    """Put a finished file or folder in the place of the old one, which goes to the folder `aside`."""
    with suppress(FileNotFoundError):
        old.replace(aside / f"old-{old.name}")
    new.replace(old)
