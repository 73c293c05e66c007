"""The recorders of studies that are launched together, as one."""

from collections.abc import Sequence
from typing import Any

from pipelines.execution.progress import Board
from pipelines.execution.recorder import Recorder, kind_of
from pipelines.execution.tally import Tally, Training
from pipelines.tracking.plan import Item
from pipelines.tracking.tracker import RunLog


class Recorders:
    """Hands what comes of a training to the recorders that wait for it.

    A training that several studies want is the first one's. The others copy it as soon as it is finished; if it fails,
    it has failed for them as well.

    Args:
        each: a recorder per study, in the order in which their runs are trained.
    """

    def __init__(self, each: Sequence[Recorder]) -> None:
        self.each = list(each)
        self.board: Board = self.each[0].board

    def _waiting(self, key: str) -> list[Recorder]:
        """The recorders that wait for a training; the first one has it."""
        return [one for one in self.each if key in one.waiting]

    @property
    def logs(self) -> dict[str, RunLog]:
        """Of the trainings that are under way, by key."""
        return {key: log for one in self.each for key, log in one.logs.items()}

    def reuse(self) -> bool:
        """See `Recorder.reuse`. Whether anything is left to train."""
        for one in self.each:
            one.reuse()
        return bool(self.todo())

    def again(self) -> bool:
        """True if it has to be trained once more: trainings of other processes may be free by now, or finished."""
        busy = any(one.busy for one in self.each)
        for one in self.each:
            one.busy = False
        return busy and self.reuse()

    def todo(self) -> list[Item]:
        """One run for each training that is needed and did not fail."""
        wanted: dict[str, Item] = {}
        for item in (item for one in self.each for item in one.todo()):
            wanted.setdefault(item.key, item)
        return list(wanted.values())

    def tally(self, at_a_time: int) -> Tally:
        """All runs of all studies, as they are now. at_a_time: trainings side by side."""
        total, left = (sum(counts) for counts in zip(*((len(one.wanted), one.left) for one in self.each), strict=True))
        waiting = [Training(kind_of(item), item.spec.trainer.steps) for item in self.todo()]
        tally = Tally(total, total - left, waiting, at_a_time)
        tally.failed = sum(len(one.failures) for one in self.each)
        return tally

    def start(self, key: str) -> None:
        """See `Recorder.start`, as for all that follow."""
        self._waiting(key)[0].start(key)

    def result(self, key: str, result: dict[str, Any]) -> None:
        """New points of a training; finished or failed, it is so for every study that wants it."""
        owner, *others = self._waiting(key)
        source = owner.logs[key].ref
        owner.result(key, result)
        if error := result.get("error"):
            for one in others:
                one.failed(key, error, result["trace"])
        elif key not in owner.waiting:
            for one in others:
                one.adopt(key, source)

    def placed(self, key: str, node: str) -> None:
        """A training goes on at a node of a cluster."""
        self._waiting(key)[0].placed(key, node)

    def died(self, key: str) -> None:
        """The process that did a training is gone."""
        self._waiting(key)[0].died(key)

    def lost(self, key: str) -> None:
        """As `died`, but none will continue it before all others have ended."""
        self._waiting(key)[0].lost(key)

    def failed(self, key: str, error: str, trace: str) -> None:
        """A training failed."""
        for one in self._waiting(key):
            one.failed(key, error, trace)
