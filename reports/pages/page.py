"""The report as one page of HTML that needs nothing else: figures inside, no network, the same bytes every time."""

import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from reports.claims.verdicts import JUDGED, VERDICTS, Claim, described
from reports.data.escaping import stem
from reports.data.frame import TOLD, Results, adopted
from reports.pages.gallery import Picture
from reports.render.tables import NONE, Table

TEMPLATE = "page.html.j2"
NUMBER = re.compile(r"^[+<\s]*(-?\d[\d,]*(?:\.\d+)?)\s*([kM]?)\b")
SHOWN = 2 / 3  # of a figure's pixels: all words on the page are then of one size
FOLDED = 6  # quantities of a claim that are shown at once
EPISODE_WORDS: Mapping[str, str] = {
    "coverage": "Left a trained policy, its lines what its coordinator assigns; then each sensor seeking its own best "
    "window; right any headings at will, the bound. Green: a target in sight; red ring: unseen.",
    "navigation": "Left a trained policy; then each agent steering for its nearest landmark; right for the one that a "
    "matching gives it. Green: a landmark with an agent on it.",
}
UNITS = {"": 1.0, "k": 1e3, "M": 1e6}
MARKS: Mapping[str, str] = {  # a sign for each verdict, beside its colour
    "reproduced": "✓",
    "depends on the reading": "◐",
    "not reproduced": "✗",
    "too short to judge": "…",
    "untestable": "?",
    "contradicted by the paper itself": "⚡",
}


class Cell(NamedTuple):
    """A cell's words and what it is sorted by."""

    text: Markup
    key: str


class Grid(NamedTuple):
    """A table as the page shows it. `files`: stem of its CSV and LaTeX, or nothing."""

    id: str
    title: str
    note: str
    columns: list[str]
    rows: list[list[Cell]]
    files: str


class Plate(NamedTuple):
    """A figure or an animation as the page shows it. `files`: words and the files that they lead to."""

    name: str
    heading: str
    caption: str
    alt: str
    kind: str
    data: str
    width: int
    height: int
    shown: int  # pixels of the page that it takes, if there is room
    behind: str
    files: list[tuple[str, str]]
    fault: str = ""  # why there is nothing to see


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


def plate(picture: Picture, folder: Path, behind: str) -> Plate:
    """A figure from its PNG in a folder, or its place. behind: the command that made its numbers."""
    kinds = {"PDF": "pdf", "numbers": "csv"}
    names = {word: f"{picture.name}.{kind}" for word, kind in kinds.items()}
    files = [(word, f"figures/{name}") for word, name in names.items() if (folder / name).exists()]
    if picture.fault:
        about = (picture.name, picture.heading, picture.caption, "", "", "")
        return Plate(*about, 0, 0, 0, behind, files, picture.fault)
    data = (folder / f"{picture.name}.png").read_bytes()
    width, height = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")  # of the PNG's header
    about = (picture.name, picture.heading, picture.caption, picture.alt, "png", b64encode(data).decode())
    return Plate(*about, width, height, round(width * SHOWN), behind, files)


def episode(task: str, gif: bytes) -> Plate:
    """An animation from what `rhmc render` wrote, or its place."""
    width, height = int.from_bytes(gif[6:8], "little"), int.from_bytes(gif[8:10], "little")  # of the GIF's header
    words = EPISODE_WORDS.get(task, "A trained policy, and others in the same episode.")
    about = (f"episode_{stem(task)}", f"An episode of {task}", words, words, "gif", b64encode(gif).decode())
    return Plate(*about, width, height, width, "rhmc render", [], animation_fault(gif))


def animation_fault(gif: bytes) -> str:
    """The reason why a file is no animation; nothing if it is one."""
    whole = gif[:6] in (b"GIF87a", b"GIF89a") and gif[-1:] == b";" and any(gif[6:8]) and any(gif[8:10])
    return "" if whole else f"the file is not a whole GIF ({len(gif)} bytes)"


def grid(name: str, table: Table, *, files: bool = True) -> Grid:
    """A table, every cell with what it is sorted by."""
    columns = [str(column) for column in table.shown.columns]
    rows = [[cell(str(text)) for text in row] for row in table.shown.to_numpy(str)]
    return Grid(f"table-{name}", table.title, table.note, columns, rows, f"{table.folder}/{name}" if files else "")


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
    """The number of claims with each verdict, and the number of them that are provisional."""
    found = []
    for verdict in VERDICTS:
        mine = [claim for claim in claims if claim.verdict == verdict]
        if mine:
            provisional = sum(claim.provisional for claim in mine)
            found.append({"verdict": verdict, "mark": MARKS[verdict], "count": len(mine), "provisional": provisional})
    return found


def card(claim: Claim) -> dict[str, Any]:
    """A claim as the page shows it."""
    ours = [{"name": name, "value": value} for name, value in described(claim.ours)]
    shown = {"ours": ours, "mark": MARKS[claim.verdict], "kind": claim.verdict.split()[0]}
    return claim._asdict() | shown | {"provisional": claim.provisional, "judged": claim.verdict in JUDGED}


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
