"""The recorders of studies that are launched together, as one."""

from collections.abc import Sequence
from typing import Any

from pipelines.plan import Item
from pipelines.progress import Board
from pipelines.recorder import Recorder
from pipelines.tracker import RunLog


class Recorders:
    """Hands what comes of a training to the recorder that asked for it.

    A training that several studies want is the first one's; the others copy it as soon as it is finished.

    Args:
        each: a recorder per study, in the order in which their runs are trained.
    """

    def __init__(self, each: Sequence[Recorder]) -> None:
        self.each = list(each)
        self.board: Board = self.each[0].board
        self.of: dict[str, Recorder] = {}  # key -> who asked for it

    @property
    def logs(self) -> dict[str, RunLog]:
        """Of the trainings that are under way, by key."""
        return {key: log for one in self.each for key, log in one.logs.items()}

    def reuse(self) -> bool:
        """See `Recorder.reuse`."""
        for one in self.each:
            one.reuse()
        return bool(self.todo())

    def again(self) -> bool:
        """Whether to train once more: what other processes were training may be free by now, or finished; and what
        failed for one study is tried for the next that wants it, as in a launch of its own."""
        waiting = [one for one in self.each if one.busy or any(self.of.get(i.key) is not one for i in one.todo())]
        for one in waiting:
            one.busy = False
            one.reuse()
        return bool(waiting and self.todo())

    def todo(self) -> list[Item]:
        """One run for each training that is needed and did not fail, and note whose it is."""
        self.of, wanted = {}, []
        for one in self.each:
            new = [item for item in one.todo() if item.key not in self.of]
            self.of |= {item.key: one for item in new}
            wanted += new
        return wanted

    def start(self, key: str) -> None:
        """See `Recorder.start`, as for all that follow."""
        self.of[key].start(key)

    def result(self, key: str, result: dict[str, Any]) -> None:
        """New points of a training; finished, it is finished for every study that wants it."""
        owner, source = self.of[key], self.of[key].logs[key].ref
        owner.result(key, result)
        if key not in owner.waiting:
            for one in self.each:
                one.adopt(key, source)

    def placed(self, key: str, node: str) -> None:
        """A training goes on at a node of a cluster."""
        self.of[key].placed(key, node)

    def died(self, key: str) -> None:
        """The process that did a training is gone."""
        self.of[key].died(key)

    def lost(self, key: str) -> None:
        """As `died`, but none will continue it before all others have ended."""
        self.of[key].lost(key)

    def failed(self, key: str, error: str, trace: str) -> None:
        """A training failed."""
        self.of[key].failed(key, error, trace)
