"""The display of a launch, of studies or a search: a live line per run and one for all on a terminal, plain lines
elsewhere.
"""

import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Table
from rich.text import Text

from pipelines.execution.tally import Ended, Tally, Training
from pipelines.workspace.best_effort import decoration
from pipelines.workspace.errors import visible

if TYPE_CHECKING:
    from rhmc.types import Metrics

EVERY, SELDOM = 10.0, 600.0  # seconds between two plain lines of a run, or of all: the least, and the most
SHARE = 0.1  # of what has passed since the first: an hour's run does not fill the log
STARTS = "Ray is starting, which takes some seconds"


@dataclass
class Line:
    """The state of one running run."""

    name: str
    total: int  # environment steps
    step: int = 0
    rate: float = 0.0  # environment steps per second
    score: float = float("nan")  # last return
    timer: "Timer" = field(default_factory=lambda: Timer())

    def take(self, point: "Metrics") -> None:
        """Read a new point."""
        self.step = int(point["step"])
        self.score = point.get("final/return", point.get("eval/return", self.score))
        if self.step > 0:
            self.rate = point.get("time/steps_per_second", self.rate)

    @property
    def left(self) -> str:
        """Time left at the present rate."""
        return duration((self.total - self.step) / self.rate) if self.rate > 0 else "?"

    def __str__(self) -> str:
        steps = f"{min(self.step, self.total):,} of {self.total:,} steps"
        return f"{self.name}: {steps}, {self.rate:,.0f} steps/s, return {self.score:.2f}, {self.left} left"


class Timer:
    """Says when a line is due: soon at first, then less and less often."""

    def __init__(self) -> None:
        self.began = self.shown = time.monotonic()

    def due(self, *, news: bool = False) -> bool:
        """True if it is time for a line, which then counts as shown. news: it need not wait longer than at first."""
        now = time.monotonic()
        if now - self.shown < (EVERY if news else min(max(EVERY, SHARE * (now - self.began)), SELDOM)):
            return False
        self.shown = now
        return True


def for_all(tally: Tally) -> str:
    """Progress of the whole queue, in a line."""
    left = tally.left()
    return str(tally) if left is None else f"{tally}, about {duration(left)} left for all"


def began(reached: int, total: int) -> str:
    """The start of a run, in words."""
    return f"continues at step {min(reached, total):,} of {total:,}" if reached else "started"


def duration(seconds: float) -> str:
    """Seconds as 12 s, 3:05 or 1:03:05."""
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


class Board(Protocol):
    """The display of progress."""

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def expect(self, tally: Tally) -> None:
        """Announce the runs, before the first of it begins. The board keeps the tally."""
        ...

    def start(self, name: str, total: int, reached: int = 0, kind: str = "") -> None:
        """A run begins, or continues where it has `reached`; `total` environment steps. kind: see `Training`."""
        ...

    def points(self, name: str, points: "list[Metrics]") -> None:
        """A run got further."""
        ...

    def end(self, name: str, outcome: str, ended: Ended = "waiting") -> None:
        """A run ended: in words, and for the tally."""
        ...

    def say(self, text: str) -> None:
        """A line that stays."""
        ...


class SafeBoard:
    """A board that never ends a launch: what it cannot show is left out, which is said once on stderr.

    Args:
        make: the board itself.
    """

    def __init__(self, make: Callable[[], Board]) -> None:
        self.told = False
        self.inner: Board | None = None
        with self._guarded():
            self.inner = make()

    def __enter__(self) -> Self:
        self._pass(lambda inner: inner.__enter__())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pass(lambda inner: inner.__exit__(kind, error, trace))

    def expect(self, tally: Tally) -> None:
        """See `Board`."""
        self._pass(lambda inner: inner.expect(tally))

    def start(self, name: str, total: int, reached: int = 0, kind: str = "") -> None:
        """See `Board`."""
        self._pass(lambda inner: inner.start(name, total, reached, kind))

    def points(self, name: str, points: "list[Metrics]") -> None:
        """See `Board`."""
        self._pass(lambda inner: inner.points(name, points))

    def end(self, name: str, outcome: str, ended: Ended = "waiting") -> None:
        """See `Board`."""
        self._pass(lambda inner: inner.end(name, outcome, ended))

    def say(self, text: str) -> None:
        """See `Board`."""
        self._pass(lambda inner: inner.say(text))

    def _pass(self, do: Callable[[Board], object]) -> None:
        if self.inner is not None:
            inner = self.inner
            with self._guarded():
                do(inner)

    def _guarded(self) -> AbstractContextManager[None]:
        return decoration("progress", self._tell)

    def _tell(self, text: str) -> None:
        if not self.told:
            self.told = True
            print(f"rhmc: {text}", file=sys.stderr)


class PlainBoard:
    """Lines for a log file: start and end of a run, and now and then what it did and how far all of them are."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self.lines: dict[str, Line] = {}
        self.tally: Tally | None = None
        self.timer = Timer()  # of the tally

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def expect(self, tally: Tally) -> None:
        """See `Board`."""
        self.tally, self.timer = tally, Timer()
        self.say(for_all(tally))

    def start(self, name: str, total: int, reached: int = 0, kind: str = "") -> None:
        """See `Board`."""
        self.lines[name] = Line(name, total)
        if self.tally:
            self.tally.start(name, Training(kind, total), reached)
        self.say(f"{name}: {began(reached, total)}")

    def points(self, name: str, points: "list[Metrics]") -> None:
        """See `Board`."""
        line = self.lines[name]
        for point in points:
            line.take(point)
        if points and line.timer.due():
            self.say(str(line))
        if self.tally:
            self.tally.point(name, line.step)
            self._all(self.tally)

    def end(self, name: str, outcome: str, ended: Ended = "waiting") -> None:
        """See `Board`."""
        line = self.lines.pop(name, None)
        score = f", return {line.score:.2f}" if line and line.score == line.score else ""
        self.say(f"{name}: {outcome}{score}")
        if self.tally:
            self.tally.end(name, ended)
            self._all(self.tally, news=True)

    def _all(self, tally: Tally, *, news: bool = False) -> None:
        if self.timer.due(news=news):
            self.say(for_all(tally))

    def say(self, text: str) -> None:
        """See `Board`."""
        self.console.print(visible(text), markup=False, emoji=False, highlight=False, soft_wrap=True)


class LiveBoard:
    """A line for all runs and one per running run, redrawn in place; what ended stays above."""

    def __init__(self, console: Console) -> None:
        text = ("{task.fields[steps]}", "{task.fields[rate]}", "{task.fields[score]}", "{task.fields[left]}")
        first, *rest = (TextColumn(t, markup=False) for t in ("{task.description}", *text))
        columns = [first, BarColumn(20), *rest]
        self.progress = Progress(*columns, console=console, transient=True)
        self.lines: dict[str, tuple[Line, TaskID]] = {}
        self.tally: Tally | None = None
        self.all: TaskID | None = None  # the first line

    def __enter__(self) -> Self:
        self.progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.progress.stop()

    def expect(self, tally: Tally) -> None:
        """See `Board`."""
        if self.all is not None:
            self.progress.remove_task(self.all)
        self.tally = tally
        self.all = self.progress.add_task("all", total=tally.total, steps="", rate="", score="", left="")
        self._all()

    def _all(self) -> None:
        """Redraw the line for all."""
        if self.tally is None or self.all is None:
            return
        tally, left = self.tally, self.tally.left()
        failed = f"{tally.failed} failed" if tally.failed else ""
        self.progress.update(
            self.all,
            completed=tally.finished,
            steps=f"{tally.finished:,} of {tally.total:,} {tally.unit}",
            rate=f"{len(tally.going)} running",
            score=failed,
            left="" if left is None else f"about {duration(left)} left for all",
        )

    def start(self, name: str, total: int, reached: int = 0, kind: str = "") -> None:
        """See `Board`."""
        task = self.progress.add_task(name, total=total, steps="starting", rate="", score="", left="")
        if reached:
            self.say(f"{name}: {began(reached, total)}")
        self.lines[name] = Line(name, total), task
        if self.tally:
            self.tally.start(name, Training(kind, total), reached)
        self._all()

    def points(self, name: str, points: "list[Metrics]") -> None:
        """See `Board`."""
        line, task = self.lines[name]
        for point in points:
            line.take(point)
        self.progress.update(
            task,
            completed=line.step,
            steps=f"{line.step:,}/{line.total:,}",
            rate=f"{line.rate:,.0f} steps/s",
            score=f"return {line.score:.2f}",
            left=f"{line.left} left",
        )
        if self.tally:
            self.tally.point(name, line.step)
        self._all()

    def end(self, name: str, outcome: str, ended: Ended = "waiting") -> None:
        """See `Board`."""
        if self.tally:
            self.tally.end(name, ended)
        self._all()
        line, task = self.lines.pop(name, (None, None))
        if line is None or task is None:
            self.say(f"{name}: {outcome}")
            return
        self.progress.remove_task(task)
        score = f", return {line.score:.2f}" if line.score == line.score else ""
        self.say(f"{name}: {outcome}{score}")

    def say(self, text: str) -> None:
        """See `Board`."""
        self.progress.console.print(visible(text), markup=False, emoji=False, highlight=False, soft_wrap=True)


class StopFile:
    """The file that asks every run to save itself and end. Whoever finds it first says so on the board.

    The handler of a signal makes it and must not print itself: it may have come in the middle of a print, which Python
    answers with an error in whatever was printing.
    """

    def __init__(self, path: Path, display: Board) -> None:
        self.path, self.board, self.told = path, display, False

    def exists(self) -> bool:
        """True if it exists."""
        there = self.path.exists()
        if there and not self.told:
            self.told = True
            self.board.say("interrupted: each run stops at its next point and saves itself; again to leave at once")
        return there


def board(console: Console) -> Board:
    """The board that suits where the output goes; a `terminal`."""
    return SafeBoard(lambda: LiveBoard(console) if console.is_terminal else PlainBoard(console))


def print_table(console: Console, header: list[str], rows: list[list[str]]) -> None:
    """A small table on a `terminal`; every column but the first is numbers."""
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0))
    for place, title in enumerate(header):
        table.add_column(Text(title), justify="right" if place else "left", no_wrap=True)
    for row in rows:
        table.add_row(*map(Text, row))
    if not console.is_terminal:  # nothing to fit into: no column is cut
        wide = console.options.update(max_width=10_000)
        console.width = max(console.width, console.measure(table, options=wide).maximum)
    console.print(table)
