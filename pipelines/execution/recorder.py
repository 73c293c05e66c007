"""From results of training to the log and the board; knows neither Ray nor MLflow."""

from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from pipelines.execution.progress import Board
from pipelines.tracking.overview import Overview
from pipelines.tracking.plan import Item, finished, resolved_yaml
from pipelines.tracking.policy import CONFIG, FILE
from pipelines.tracking.tracker import VALUES_ONLY, Recorded, RunLog, Status, StudyCard, Tracker, points_of
from pipelines.workspace.best_effort import EPISODE, WHY_NOT, decoration
from pipelines.workspace.leftovers import scratch
from pipelines.workspace.work_folder import Checkpoints, Home
from rhmc.training.trainer import grid_step
from rhmc.types import Metrics

EXTRAS = (EPISODE, WHY_NOT)  # what a training may leave beside its policy


class Recorder:
    """Keeps a study's log in step with its trainings, which are named by key.

    Runs of different arms with the same key are one training and one log each.

    Args:
        study: whose runs.
        plan: all of them.
        tracker: the log.
        home: where checkpoints lie.
        board: where progress is shown.
        arms: what this launch trains; the others stay as they are. All arms if empty.
    """

    def __init__(
        self,
        study: StudyCard,
        plan: list[Item],
        tracker: Tracker,
        home: Home,
        board: Board,
        arms: Collection[str] = (),
    ) -> None:
        self.study, self.plan, self.tracker, self.home, self.board = study, plan, tracker, home, board
        self.logs: dict[str, RunLog] = {}
        self.arms: dict[str, str] = {}  # of the runs that were started, by key
        self.failures: dict[str, str] = {}  # name of the run -> one line
        self.waiting: dict[str, list[Item]] = defaultdict(list)
        self.places: dict[str, list[str]] = defaultdict(list)  # key -> the nodes that trained it in this launch
        self.busy = False  # whether one of them was out of reach, and may be trained by now
        recorded = tracker.recorded()
        done = finished(recorded)
        self.wanted = [item for item in plan if not arms or item.card.arm in arms]  # of this launch
        others = [item for item in plan if arms and item.card.arm not in arms]
        self.later = {item.key for item in others if (item.card.arm, item.key) not in done}  # left to another launch
        for item in self.wanted:
            if (item.card.arm, item.key) not in done:
                self.waiting[item.key].append(item)
        self.skipped = len(self.wanted) - self.left
        self.overview = Overview(study, plan, tracker, recorded, board.say)
        self.overview.describe()
        self._set_aside(recorded)
        self._tidy()

    def _set_aside(self, recorded: list[Recorded]) -> None:
        """Keep what was logged under another plan, other steps say, from being averaged with the runs of this one."""
        planned = {(item.card.arm, item.key) for item in self.plan}
        for run in recorded:
            if run.stale == ((run.arm, run.key) in planned):
                self.tracker.mark(run.ref, stale=not run.stale)

    def _tidy(self) -> None:
        """Remove what a launch left that was killed between finishing a run and removing its checkpoints."""
        for key in {item.key for item in self.plan} - self.waiting.keys() - self.later:
            Checkpoints(self.home.checkpoints(key)).clear_unused()

    @property
    def left(self) -> int:
        """Runs of this launch that are not finished."""
        return sum(len(items) for items in self.waiting.values())

    @property
    def status(self) -> Status:
        """The status of the study when the launch ends."""
        return "failed" if self.failures else "interrupted" if self.left or self.later else "finished"

    def reuse(self) -> None:
        """Copy what was finished already, for another arm or in another study, instead of training it again."""
        if not self.waiting:
            return
        there = self.tracker.finished_anywhere(self.waiting)
        for key in [key for key in self.waiting if key in there]:
            self.adopt(key, there[key])
            Checkpoints(self.home.checkpoints(key)).clear_unused()

    def adopt(self, key: str, source: str) -> None:
        """Copy a finished run of another study, if this one waits for the training."""
        if key in self.waiting:
            self._copy(source, self.waiting[key])
            del self.waiting[key]

    def _copy(self, source: str, items: list[Item]) -> None:
        points = points_of(self.tracker.rows([source])) if items else []
        for item in items:
            copy_run(self.tracker, self.study, source, item, points, {"reused_from": source}, self.board.say)
            self.overview.points(item.card.arm, item.key, points)
            self.overview.ended(item.card.arm, item.key, "finished")
            self.board.end(item.name, "the same training was finished before; copied", "finished")

    def todo(self) -> list[Item]:
        """One run for each training that is needed and did not fail, in the order of the plan."""
        return [items[0] for items in self.waiting.values() if items[0].name not in self.failures]

    def start(self, key: str) -> None:
        """A training begins or continues."""
        item = self.waiting[key][0]
        self.arms[key] = item.card.arm
        self.logs[key] = self.tracker.start(item.card)
        self.logs[key].text(CONFIG, resolved_yaml(item, self.study))
        self.board.start(item.name, item.spec.trainer.steps, self._reached(item), kind_of(item))

    def _reached(self, item: Item) -> int:
        """Environment steps at the newest checkpoint, 0 without one."""
        points = Checkpoints(self.home.checkpoints(item.key)).points()
        return grid_step(item.spec.trainer, points - 1) if points else 0

    def result(self, key: str, result: dict[str, Any]) -> None:
        """New points of a training; the last ones finish its run, or tell that it failed."""
        if points := result["points"]:
            self._points(key, points)
        item = self.waiting[key][0]
        if error := result.get("error"):
            self.failed(key, error, result["trace"])
        elif result["stopped"]:
            self._end(key, "interrupted")
            if result.get("busy"):
                self.busy = True
                self.board.end(item.name, "another process is training it; waiting for that")
            else:
                self.board.end(item.name, "stopped; the next launch continues it")
        elif result["done"]:
            self._finish(key)

    def _points(self, key: str, points: list[Metrics]) -> None:
        item = self.waiting[key][0]
        self.logs[key].log(points)
        self.board.points(item.name, points)
        self.overview.points(item.card.arm, key, points)

    def _finish(self, key: str) -> None:
        log, items, folder = self.logs[key], self.waiting[key], self.home.checkpoints(key)
        keep(log, folder, items[0].name, self.board.say)
        self._end(key, "finished")
        self.board.end(items[0].name, "finished", "finished")
        self._copy(log.ref, items[1:])
        del self.waiting[key]  # now that nothing of it can fail any more
        Checkpoints(folder).clear()

    def placed(self, key: str, node: str) -> None:
        """A training goes on at a node of a cluster."""
        self.places[key].append(node)
        self.logs[key].tag("nodes", ", ".join(self.places[key]))

    def died(self, key: str) -> None:
        """The process that did a training is gone; another one will continue it."""
        self.board.end(self.waiting[key][0].name, "its worker died; another one continues it")

    def lost(self, key: str) -> None:
        """As `died`, but none will continue it before all others have ended."""
        if key in self.logs:
            self._end(key, "interrupted")
        self.busy = True
        self.board.end(self.waiting[key][0].name, "its node died; it is continued later")

    def failed(self, key: str, error: str, trace: str) -> None:
        """A training failed: keep why, go on with the others."""
        item = self.waiting[key][0]
        if key not in self.logs:
            self.start(key)
        self.failures[item.name] = error
        log = self.logs[key]
        log.tag("error", error)
        log.text("error.txt", trace)
        self._end(key, "failed")
        self.board.end(item.name, f"failed: {error}", "failed")

    def _end(self, key: str, status: Status) -> None:
        self.logs.pop(key).finish(status)
        self.overview.ended(self.arms[key], key, status)


def kind_of(item: Item) -> str:
    """Names the runs that train at one pace: of one method in one task."""
    return f"{item.card.algorithm} in {item.card.task}"


def copy_run(
    tracker: Tracker,
    study: StudyCard,
    source: str,
    item: Item,
    points: list[Metrics],
    tags: Mapping[str, str],
    say: Callable[[str], None],
) -> None:
    """Log a planned run as finished, with the values and files of another one. say: see `keep`."""
    log = tracker.start(item.card)
    log.log(points)
    log.text(CONFIG, resolved_yaml(item, study))
    with scratch() as folder:
        with decoration(f"{item.name}: its animation", say):
            for name in EXTRAS:
                tracker.file(source, name, folder)
        config = resolved_yaml(item, study)  # for a policy without its spec
        (folder / CONFIG).write_text(config, encoding="utf-8")
        if tracker.file(source, FILE, folder):
            keep(log, folder, item.name, say)
        else:
            log.tag(VALUES_ONLY, "yes")
    for name, value in tags.items():
        log.tag(name, value)
    log.finish("finished")


def keep(log: RunLog, folder: Path, name: str = "run", say: Callable[[str], None] = lambda _: None) -> None:
    """Keep what a finished training left in a folder, and offer its policy as a model.

    Args:
        name: what a person calls the run.
        say: where it is said that it has no animation.
    """
    log.artifact(folder / FILE)
    with decoration(f"{name}: its animation", say):
        for extra in EXTRAS:
            if (folder / extra).exists():
                log.artifact(folder / extra)
        if (folder / WHY_NOT).exists():
            say(f"{name}: no animation ({(folder / WHY_NOT).read_text(encoding='utf-8').strip()})")
    log.model(folder / FILE)
