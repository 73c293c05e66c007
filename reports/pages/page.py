"""The report as one page of HTML that needs nothing else: figures inside, no network, the same bytes every time."""

import io
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape
from PIL import Image

from reports.claims.verdicts import VERDICTS, Claim, described
from reports.data.escaping import stem
from reports.data.frame import TOLD, Results, adopted
from reports.pages import embed
from reports.pages.gallery import ARMS, Picture
from reports.render.charts import Chart
from reports.render.tables import NONE, Table

TEMPLATE = "page.html.j2"
NUMBER = re.compile(r"^[+<\s]*(-?\d[\d,]*(?:\.\d+)?)\s*([kM]?)\b")
SHOWN = 2 / 3  # of a figure's pixels: all words on the page are then of one size
LEGIBLE = 0.63  # of a figure's pixels: letters of 6.5 points at 160 dots an inch are then 9 pixels high
FRAMED = 0.75  # the same of an animation's pixels, whose letters are 12 high
FILES: Mapping[str, str] = {"PDF": "pdf", "numbers": "csv"}
LONG = 66  # rows of a table that are shown at once: the pairs of twelve arms
FILTERED = 8  # rows of a table above which it has a field for words; a script makes it
FOLDED = 6  # quantities of a claim that are shown at once
EPISODE_WORDS: Mapping[str, str] = {
    "coverage": "Left a trained policy, its lines what its coordinator assigns; then each sensor seeking its own best "
    "window; right any headings at will, the bound. Green: a target in sight; red ring: unseen.",
    "navigation": "Left a trained policy; then each agent steering for its nearest landmark; right for the one that a "
    "matching gives it. Green: a landmark with an agent on it.",
}
EPISODE_NAMES = "Below each panel stand its policy, the seed that this was trained with, and the number of the episode."
UNITS = {"": 1.0, "k": 1e3, "M": 1e6}
MARKS: Mapping[str, str] = {  # a sign for each verdict, beside its colour
    "reproduced": "✓",
    "depends on the reading": "◐",
    "not reproduced": "✗",
    "too short to judge": "…",
    "untestable": "?",
    "contradicted by the paper itself": "≠",
}


class Cell(NamedTuple):
    """A cell's words and what it is sorted by."""

    text: Markup
    key: str


class Links(NamedTuple):
    """The places of the page that show an arm, by study and arm, or the policy of a run, by study, arm and run."""

    curves: Mapping[tuple[str, str], str]
    episodes: Mapping[tuple[str, str, str], str]


NOWHERE = Links({}, {})


class Grid(NamedTuple):
    """A table as the page shows it. `files`: stem of its CSV and LaTeX, or nothing."""

    id: str
    title: str
    note: str
    columns: list[str]
    rows: list[list[Cell]]
    files: str

    @property
    def long(self) -> bool:
        """True if its rows are folded away."""
        return len(self.rows) > LONG


class Plate(NamedTuple):
    """A figure or an animation as the page shows it. `files`: words and the files that they lead to."""

    name: str
    heading: str
    caption: str
    alt: str
    address: str
    width: int
    height: int
    shown: int  # pixels of the page that it takes, if there is room
    least: int  # pixels that it takes on a narrow page, where it scrolls: its words are legible
    behind: str
    files: list[tuple[str, str]]
    fault: str = ""  # why there is nothing to see
    chart: Chart | None = None  # instead of the picture


class Section(NamedTuple):
    """A part of the page; what is `more` is folded away."""

    id: str
    title: str
    words: str
    plates: list[Plate]
    more_plates: list[Plate]
    grids: list[Grid]
    more_grids: list[Grid]

    @property
    def short(self) -> str:
        """The title in a word, for the list of parts."""
        name = self.title.partition(" (")[0].removeprefix("Study ").partition(" and ")[0].removeprefix("The ")
        return name[:1].upper() + name[1:]

    @property
    def more(self) -> str:
        """The parts that are folded away, in words."""
        figures = [plate.heading.partition(", study ")[0] for plate in self.more_plates]
        sheets = [grid.title.partition(" study ")[0].removesuffix(",").removesuffix(" in") for grid in self.more_grids]
        return ", ".join(word[:1].lower() + word[1:] for word in figures + sheets)


def render(content: Mapping[str, Any]) -> str:
    """The page. content: see `page.html.j2`; a name that is missing there is an error."""
    folder = FileSystemLoader(Path(__file__).parent)
    env = Environment(loader=folder, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    env.filters["stem"] = stem
    return env.get_template(TEMPLATE).render(content)


def plate(picture: Picture, behind: str, *, arms: bool = False) -> Plate:
    """A figure as it was drawn, its chart, or its place.

    Args:
        picture: the figure.
        behind: the command that made its numbers.
        arms: whether the same arm by arm is a file beside the page.
    """
    there = bool(picture.shown or picture.chart)
    kinds = ("PDF", "numbers") if there else ("numbers",) if picture.drawing else ()
    files = [(word, f"figures/{picture.name}.{FILES[word]}") for word in kinds]
    files += [("arm by arm", f"figures/{picture.name}{ARMS}.pdf")] if arms else []
    about = (picture.name, picture.heading, picture.caption, picture.alt)
    if picture.shown is None:
        return Plate(*about, "", 0, 0, 0, 0, behind, files, picture.fault, picture.chart)
    width, height = picture.shown.size
    return Plate(
        *about, picture.shown.address, width, height, round(width * SHOWN), round(width * LEGIBLE), behind, files
    )


def episode(task: str, gif: bytes, folder: str, whose: str = "") -> Plate:
    """An animation from what `rhmc render` wrote, or its place.

    Args:
        task: that it shows.
        gif: the file.
        folder: of the GIF, which is linked; "" if far away.
        whose: the trained policy, in words; "" if it is not known.
    """
    words = f"{EPISODE_WORDS.get(task, 'A trained policy, and others in the same episode.')} {EPISODE_NAMES}"
    words += f" The trained policy: {whose}." if whose else ""
    about = (anchor(task), f"An episode of {task}", words, words)
    if fault := animation_fault(gif):
        return Plate(*about, "", 0, 0, 0, 0, "rhmc render", [], fault)
    address, (width, height) = embed.animation(gif)
    files = [("GIF", f"{folder}/{quote(f'episode_{task}.gif')}")] if folder else []
    return Plate(*about, address, width, height, width, round(width * FRAMED), "rhmc render", files)


def anchor(task: str) -> str:
    """The anchor of a task's animation."""
    return f"episode_{stem(task)}"


def shown_in(gif: bytes) -> str:
    """The run whose policy an animation shows, as `rhmc render` notes it in the file; nothing if it does not."""
    try:
        with Image.open(io.BytesIO(gif)) as image:
            return str(json.loads(image.info.get("comment", b"{}"))["run"])
    except (*embed.UNREADABLE, TypeError, KeyError):  # of another program, or no picture at all
        return ""


def animation_fault(gif: bytes) -> str:
    """The reason why a file is no animation; nothing if it is one."""
    whole = gif[:6] in (b"GIF87a", b"GIF89a") and gif[-1:] == b";" and any(gif[6:8]) and any(gif[8:10])
    return "" if whole else f"the file is not a whole GIF ({len(gif)} bytes)"


def grid(name: str, table: Table, links: Links = NOWHERE, *, files: bool = True) -> Grid:
    """A table, every cell with what it is sorted by, and its arms with links to their curves and animations."""
    columns = [str(column) for column in table.shown.columns]
    rows = [[cell(str(text)) for text in row] for row in table.shown.to_numpy(str)]
    numbers = table.numbers
    if {"study", "arm"} <= set(numbers) and len(numbers) == len(rows) and "arm" in (at := [c.lower() for c in columns]):
        place = at.index("arm")
        for row, found in zip(rows, numbers.to_dict("records"), strict=True):
            row[place] = linked(row[place], links, str(found["study"]), str(found["arm"]), found.get("run"))
    return Grid(f"table-{name}", table.title, table.note, columns, rows, f"{table.folder}/{name}" if files else "")


def linked(found: Cell, links: Links, study: str, arm: str, run: Any = None) -> Cell:
    """The name of an arm with links to its curve and to its animation where they exist.

    run: whose row it is, with the animation of this run alone; None for the arm, with that of any of its runs.
    """
    text, curve = found.text, links.curves.get((study, arm))
    if curve:
        text = Markup('<a href="#{}">{}</a>').format(curve, text)
    for (in_study, of_arm, shown), place in links.episodes.items():
        if (in_study, of_arm) == (study, arm) and run in (None, shown):
            text += Markup(' <a href="#{}">animation</a>').format(place)
    return Cell(text, found.key)


def cell(text: str) -> Cell:
    """Words with new lines kept and all else escaped; sorted as a number if they begin with one, and empty last."""
    words = Markup("<br>").join(escape(part) for part in text.splitlines())
    return Cell(words, sort_key(text))


def sort_key(text: str) -> str:
    """The sort key of a cell: its leading number in full, or its words; nothing where there is nothing to show."""
    if text in (NONE, "", "missing", "nan"):
        return ""
    found = NUMBER.match(text.replace("−", "-"))
    if not found:
        return text.casefold()
    return f"{float(found[1].replace(',', '')) * UNITS[found[2]]:.10g}"


def verdicts(claims: Sequence[Claim]) -> list[dict[str, Any]]:
    """The verdicts that claims have, with their looks."""
    there = {claim.verdict: claim for claim in claims}
    return [looks(there[verdict]) | {"verdict": verdict} for verdict in VERDICTS if verdict in there]


def looks(claim: Claim) -> dict[str, Any]:
    """The sign of a verdict, and the word that its colour and its marker go by."""
    return {"mark": MARKS[claim.verdict], "kind": claim.verdict.split()[0]}


def card(claim: Claim) -> dict[str, Any]:
    """A claim as the page shows it."""
    ours = [{"name": name, "value": value} for name, value in described(claim.ours)]
    return claim._asdict() | looks(claim) | {"ours": ours, "provisional": claim.provisional}


def provenance(results: Results) -> list[tuple[str, str]]:
    """The provenance of the runs: names and values."""
    runs = results.runs
    known = sorted(set(runs["fingerprint"].dropna().astype(str)) - {""})
    spent = duration(float(runs["seconds"].sum())) if runs["seconds"].notna().any() else "not exported"
    found = [("Profile", results.profile), ("Code", ", ".join(known) or "unknown")]
    for name in TOLD:
        if name == "adopted" and not adopted(runs):
            continue
        values = sorted(set(runs[name].astype(str)) - {""})
        found.append((name.capitalize(), "; ".join(values) or "not exported"))
    return [*found, ("Processor time of all runs", spent)]


def duration(seconds: float) -> str:
    """`3 h 12 min`, `45 s`."""
    minutes = round(seconds / 60)
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"
