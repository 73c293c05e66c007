"""Build a report, as `rhmc report` does. The same tables give the same bytes."""

import fcntl
import json
import os
import shutil
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

from reports.claims import verdicts as rules
from reports.claims.verdicts import Claim
from reports.data.frame import TableError, load
from reports.data.paper import PaperError, read
from reports.pages import content, embed, index, page
from reports.pages.gallery import ARMS, Picture, reason
from reports.pages.metrics import metrics
from reports.pages.report import Report, single, whole
from reports.render.canvas import save, write_csv
from reports.render.glyphs import LOST
from reports.render.tables import MEASURED, TABLES, Table
from reports.render.vector import svg

Outcome = Literal["whole", "undrawn", "refused"]  # of a report
PART = ".report-"  # begins the name of the folder in which a report is made
RUNS = "runs"  # the folder of the tables beside the page
METRICS = "metrics.json"
MADE = ("figures", TABLES, MEASURED, "claims.md", "claims.csv", "claims.json", METRICS, "index.md", "index.html")


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
    made = whole(results, paper) if study is None else single(results, paper, study)
    made = made._replace(tables_at=RUNS if runs.resolve() == (out / RUNS).resolve() else "")
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
        built = build(runs or home / RUNS, out, profile, study)
    except (TableError, PaperError, OutError) as error:
        print(shown(str(error)), file=sys.stderr)
        return "refused"
    for line in [*built.undrawn, *([f"note: {built.note}"] if built.note else [])]:
        print(shown(line), file=sys.stderr)
    print(shown(f"{len(built.files)} files; start with {out / 'index.html'}"))
    return "undrawn" if built.undrawn else "whole"


def _write(report: Report, folder: Path) -> Report:
    """Write a report to an empty folder, and return it as it came out."""
    pictures = folder / "figures"
    for name in ("figures", TABLES, MEASURED):
        (folder / name).mkdir()
    for name, table in report.tables.items():
        _save(table, folder / table.folder, name)
    if report.claims:
        _write_claims(report.claims, folder)
        _write_text(folder / METRICS, json.dumps(metrics(report), indent=1, ensure_ascii=False) + "\n")
    saved: list[Picture] = []
    for picture in report.pictures:
        saved.append(_saved(picture, pictures, {one.name for one in saved if one.chart}))
    report = report._replace(pictures=saved)
    _write_text(folder / "index.md", "\n".join(index.page(report)) + "\n")
    _write_text(folder / "index.html", page.render(content.of(report)))
    return report


def _saved(picture: Picture, folder: Path, charts: Collection[str]) -> Picture:
    """Write the files of a figure. One that cannot be drawn has its numbers alone, and says why.

    charts: figures that the page has as charts: these show the same arm by arm, so that is no picture there.
    """
    if picture.drawing is None:
        return picture
    try:
        lost = save(picture.drawing, folder, picture.name)
        charted = picture.chart or (picture.name.endswith(ARMS) and picture.name.removesuffix(ARMS) in charts)
        drawn = "" if charted else svg(picture.drawing.figure)
    except Exception as error:
        if isinstance(error, OSError):  # a full disk is no fault of the figure
            raise
        for kind in ("png", "pdf"):
            (folder / f"{picture.name}.{kind}").unlink(missing_ok=True)
        return picture._replace(fault=reason(error), chart=None)
    caption = f"{picture.caption} {LOST}" if lost else picture.caption
    shown = embed.figure(drawn, (folder / f"{picture.name}.png").read_bytes()) if drawn else None
    return picture._replace(caption=caption, shown=shown)


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
    plain = json.dumps([index.plain(claim) for claim in found], indent=1, ensure_ascii=False)
    _write_text(folder / "claims.json", plain + "\n")
    _write_text(folder / "claims.md", "\n".join(index.claims(found)) + "\n")


def _save(table: Table, folder: Path, name: str) -> None:
    write_csv(table.numbers, folder / f"{name}.csv", digits="%.6g")
    _write_text(folder / f"{name}.md", f"{table.markdown()}\n")
    _write_text(folder / f"{name}.tex", table.latex())


def _replace(new: Path, old: Path, aside: Path) -> None:
    """Put a finished file or folder in the place of the old one, which goes to the folder `aside`."""
    with suppress(FileNotFoundError):
        old.replace(aside / f"old-{old.name}")
    new.replace(old)
