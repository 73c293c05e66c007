"""The display of a running study: a live line per run on a terminal, plain lines elsewhere."""

import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Table
from rich.text import Text

from pipelines.workspace.best_effort import decoration
from pipelines.workspace.errors import visible
from rhmc.types import Metrics

EVERY = 10.0  # seconds between two plain lines of a run


@dataclass
class Line:
    """The state of one running run."""

    name: str
    total: int  # environment steps
    step: int = 0
    rate: float = 0.0  # environment steps per second
    score: float = float("nan")  # last return
    shown: float = field(default=float("-inf"))  # when it was last printed

    def take(self, point: Metrics) -> None:
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

    def start(self, name: str, total: int, reached: int = 0) -> None:
        """A run begins, or continues where it has `reached`; `total` environment steps."""
        ...

    def points(self, name: str, points: list[Metrics]) -> None:
        """A run got further."""
        ...

    def end(self, name: str, outcome: str) -> None:
        """A run ended."""
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

    def start(self, name: str, total: int, reached: int = 0) -> None:
        """See `Board`."""
        self._pass(lambda inner: inner.start(name, total, reached))

    def points(self, name: str, points: list[Metrics]) -> None:
        """See `Board`."""
        self._pass(lambda inner: inner.points(name, points))

    def end(self, name: str, outcome: str) -> None:
        """See `Board`."""
        self._pass(lambda inner: inner.end(name, outcome))

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
    """Lines for a log file: a run's start and end, and what it did at most every ten seconds."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self.lines: dict[str, Line] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def start(self, name: str, total: int, reached: int = 0) -> None:
        """See `Board`."""
        self.lines[name] = Line(name, total, shown=time.monotonic())
        self.say(f"{name}: {began(reached, total)}")

    def points(self, name: str, points: list[Metrics]) -> None:
        """See `Board`."""
        line = self.lines[name]
        for point in points:
            line.take(point)
        if points and time.monotonic() - line.shown >= EVERY:
            line.shown = time.monotonic()
            self.say(str(line))

    def end(self, name: str, outcome: str) -> None:
        """See `Board`."""
        line = self.lines.pop(name, None)
        score = f", return {line.score:.2f}" if line and line.score == line.score else ""
        self.say(f"{name}: {outcome}{score}")

    def say(self, text: str) -> None:
        """See `Board`."""
        self.console.print(visible(text), markup=False, emoji=False, highlight=False, soft_wrap=True)


class LiveBoard:
    """One line per running run, redrawn in place; what ended stays above."""

    def __init__(self, console: Console) -> None:
        text = ("{task.fields[steps]}", "{task.fields[rate]}", "{task.fields[score]}", "{task.fields[left]}")
        first, *rest = (TextColumn(t, markup=False) for t in ("{task.description}", *text))
        columns = [first, BarColumn(20), *rest]
        self.progress = Progress(*columns, console=console, transient=True)
        self.lines: dict[str, tuple[Line, TaskID]] = {}

    def __enter__(self) -> Self:
        self.progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.progress.stop()

    def start(self, name: str, total: int, reached: int = 0) -> None:
        """See `Board`."""
        task = self.progress.add_task(name, total=total, steps="starting", rate="", score="", left="")
        if reached:
            self.say(f"{name}: {began(reached, total)}")
        self.lines[name] = Line(name, total), task

    def points(self, name: str, points: list[Metrics]) -> None:
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

    def end(self, name: str, outcome: str) -> None:
        """See `Board`."""
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
