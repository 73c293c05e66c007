"""The content of a study's parent run: its question and arms, the results so far, their curves and table.

Means and ranges over seeds only, to look at while a study runs. Intervals and verdicts are the report's.
"""

import csv
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from io import BytesIO, StringIO
from textwrap import wrap
from typing import TYPE_CHECKING, Any, NamedTuple

from pipelines.specs.plugins import finals
from pipelines.tracking import arm_colours
from pipelines.tracking.plan import LISTED, Item, more
from pipelines.tracking.tracker import Recorded, Row, Status, StudyCard, Tracker
from pipelines.workspace.best_effort import decoration
from reports.data.escaping import cell, markdown
from rhmc.types import Metrics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAUSE = 30.0  # seconds between two refreshes while a study runs
CURVE, FINAL = "eval/return", "final/return"
FIGURE, TABLE = "curves.png", "finals.csv"  # artifacts of the parent run
LETTERS = 40  # of an arm's name on a line of the legend
MOST = 12  # arms in the figure; more are not told apart
Point = tuple[int, float]  # step, value


class Run(NamedTuple):
    """The part of a run that is shown."""

    arm: str
    seed: int
    status: Status | None  # None: not begun
    curve: Sequence[Point]
    finals: Mapping[str, float]


class Overview:
    """Keeps the parent run's description and files up to date, as far as that works: a launch does without.

    Args:
        study: whose.
        plan: its runs.
        tracker: its log, asked once for the values that earlier launches left there.
        recorded: the runs in it.
        say: where it is said, once for each part, that it could not be shown.
    """

    def __init__(
        self,
        study: StudyCard,
        plan: Sequence[Item],
        tracker: Tracker,
        recorded: Iterable[Recorded],
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.study, self.tracker, self.say = study, tracker, say
        self.told: set[str] = set()
        self.runs = {(item.card.arm, item.key): Run(item.card.arm, item.card.seed, None, (), {}) for item in plan}
        there = {run.ref: run for run in recorded if (run.arm, run.key) in self.runs}
        rows: dict[str, list[Row]] = {ref: [] for ref in there}
        for row in tracker.rows(list(there), {CURVE, *finals()}) if there else []:
            rows[row.ref].append(row)
        for ref, run in there.items():
            self._take(run.arm, run.key, run.status, [(row.step, {row.metric: row.value}) for row in rows[ref]])
        self.shown = float("-inf")

    def points(self, arm: str, key: str, points: Iterable[Metrics]) -> None:
        """New points of a run that is under way."""
        self._take(arm, key, "running", [(int(point["step"]), point) for point in points])

    def ended(self, arm: str, key: str, status: Status) -> None:
        """A run ended; what the log shows is refreshed now and then."""
        self._take(arm, key, status, [])
        if time.monotonic() - self.shown >= PAUSE:
            self.publish()

    def _take(self, arm: str, key: str, status: Status, points: Iterable[tuple[int, Mapping[str, float]]]) -> None:
        run = self.runs[arm, key]
        curve, ends = dict(run.curve), dict(run.finals)
        for step, values in points:
            if CURVE in values:
                curve.setdefault(step, values[CURVE])
            ends |= {name: values[name] for name in finals() if name in values}
        self.runs[arm, key] = run._replace(status=status, curve=sorted(curve.items()), finals=ends)

    def describe(self) -> None:
        """Refresh the description alone."""
        with self._decorating("description"):
            self.tracker.publish(self._note(list(self.runs.values())), {})

    def _decorating(self, part: str) -> AbstractContextManager[None]:
        """A part of what the log shows: that it fails is said the first time."""
        return decoration(f"{self.study.study}: {part} in the log", lambda text: self._once(part, text))

    def _once(self, part: str, text: str) -> None:
        if part not in self.told:
            self.told.add(part)
            self.say(text)

    def publish(self) -> None:
        """Refresh the description, the figure and the table."""
        self.shown = time.monotonic()
        runs = list(self.runs.values())
        files = {TABLE: table(runs).encode()}
        if any(run.curve for run in runs):
            with self._decorating("figure"):
                files[FIGURE] = figure(self.study, runs)
        with self._decorating("overview"):
            self.tracker.publish(self._note(runs), files)

    def _note(self, runs: Sequence[Run]) -> str:
        """The question, what is known by now, and the rest of the study's own note."""
        question, _, rest = self.study.note.partition("\n\n")
        return f"{question}\n\n{so_far(runs)}\n\n{rest}".rstrip()


def by_arm(runs: Iterable[Run]) -> dict[str, list[Run]]:
    """The runs of each arm, in the order given."""
    arms: dict[str, list[Run]] = {}
    for run in runs:
        arms.setdefault(run.arm, []).append(run)
    return arms


def so_far(runs: Sequence[Run]) -> str:
    """Markdown: which seeds are finished, the mean of each final metric over them, and who is ahead."""
    shown = {key: name for key, name in finals().items() if any(key in run.finals for run in runs)}
    heads = ["arm", "finished seeds", "others", *(f"final {name}" for name in shown.values())]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    arms = by_arm(runs)
    for arm, mine in list(arms.items())[:LISTED]:
        done = [run for run in mine if run.status == "finished"]
        seeds = ", ".join(str(run.seed) for run in done) or "none"
        means = [_mean_and_range([run.finals[key] for run in done if key in run.finals]) for key in shown]
        lines.append(f"| {' | '.join([markdown(arm), seeds, _others(mine), *means])} |")
    return "\n".join([f"### So far\n\n{_ahead(runs)}\n", *lines, *more(list(arms))])


def _ahead(runs: Sequence[Run]) -> str:
    means = {
        arm: sum(values) / len(values)
        for arm, mine in by_arm(runs).items()
        if (values := [run.finals[FINAL] for run in mine if run.status == "finished" and FINAL in run.finals])
    }
    finished = sum(run.status == "finished" for run in runs)
    count = f"{finished} of {len(runs)} runs are finished"
    if len(means) < 2:
        return f"{count}."
    best = max(means, key=lambda arm: means[arm])
    first = f"{count}; the highest mean final return is that of **{markdown(best)}**."
    return f"{first} `rhmc report` gives intervals and verdicts."


def _others(mine: Sequence[Run]) -> str:
    """Seeds that are not finished, by what they are."""
    words: dict[str, list[str]] = {}
    for run in mine:
        if run.status != "finished":
            words.setdefault(run.status or "missing", []).append(str(run.seed))
    return "; ".join(f"{status}: {', '.join(seeds)}" for status, seeds in words.items())


def _mean_and_range(values: Sequence[float]) -> str:
    if not values:
        return "–"
    mean = f"{sum(values) / len(values):.2f}"
    return f"{mean} ({min(values):.2f} to {max(values):.2f})" if len(values) > 1 else mean


def table(runs: Sequence[Run]) -> str:
    """CSV: every planned run with its final values."""
    out = StringIO()
    writer = csv.writer(out, lineterminator="\n")
    shown = [key for key in finals() if any(key in run.finals for run in runs)]
    writer.writerow(["arm", "seed", "status", *shown])
    for run in runs:
        writer.writerow([cell(run.arm), run.seed, run.status or "missing", *(run.finals.get(key, "") for key in shown)])
    return out.getvalue()


def figure(study: StudyCard, runs: Sequence[Run]) -> bytes:
    """PNG: the mean return of every arm over its finished seeds at each step, and their range.

    An arm without a finished seed is shown by what its seeds have in common so far.
    """
    from matplotlib import rc_context  # 1 s, and only where something is finished

    from reports.render import glyphs

    with rc_context(glyphs.settings()):
        sheet = _drawn(study, runs)
        glyphs.settle(sheet)
        out = BytesIO()
        sheet.savefig(out, format="png", dpi=110, metadata={"Software": None})
    return out.getvalue()


def _drawn(study: StudyCard, runs: Sequence[Run]) -> "Figure":
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    sheet = Figure(figsize=(8, 4.5), layout="constrained")
    FigureCanvasAgg(sheet)
    axes = sheet.add_subplot(xlabel="environment steps", ylabel="return in evaluation episodes")
    axes.set_prop_cycle(color=[arm_colours.colour(place) for place in range(MOST)])
    curves = {arm: found for arm, mine in by_arm(runs).items() if (found := _common(mine))}
    lines, names = [], []  # named in the legend by hand: of itself it leaves out what begins with `_`
    for arm, (seeds, steps, values) in list(curves.items())[:MOST]:
        lines += axes.plot(steps, [sum(at) / seeds for at in values], lw=1.5)
        names.append("\n".join(wrap(f"{arm} ({seeds})", LETTERS)))
        axes.fill_between(steps, [min(at) for at in values], [max(at) for at in values], alpha=0.15, lw=0)
    left = f", {MOST} of {len(curves)} arms" if len(curves) > MOST else ""
    axes.set_title(f"{study.study} ({study.profile}): mean and range over seeds{left}", fontsize=10)
    axes.grid(alpha=0.3)
    how: dict[str, Any] = {"title": "arm (seeds)", "loc": "center left", "bbox_to_anchor": (1, 0.5)}
    axes.legend(lines, names, fontsize=8, title_fontsize=8, **how)
    return sheet


def _common(mine: Sequence[Run]) -> tuple[int, list[int], list[list[float]]] | None:
    """The number of runs, the steps that all of them have, and their values there."""
    begun = [run for run in mine if run.curve]
    curves = [dict(run.curve) for run in begun if run.status == "finished"] or [dict(run.curve) for run in begun]
    if not curves:
        return None
    steps = sorted(set.intersection(*map(set, curves)))
    return len(curves), steps, [[curve[step] for curve in curves] for step in steps]
