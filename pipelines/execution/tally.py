"""Progress of a whole queue of runs or trials, and about how long it will take; nothing is printed here."""

import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

Ended = Literal["finished", "failed", "waiting"]  # what a run is that ended; one that waits is taken up again


class Training(NamedTuple):
    """Work that waits: a training of a kind, whose trainings go at one pace, with its environment steps."""

    kind: str
    steps: int


@dataclass
class Going:
    """A training under way. Seconds are by the clock, as of `time.monotonic`."""

    training: Training
    reached: int  # environment steps that it had when it was started here
    step: int  # at its last point
    began: float
    seen: float  # when its last point came


class Tally:
    """Counts what of a queue is finished and estimates the time for the rest.

    The estimate goes by the clock: evaluations, checkpoints and whatever else keeps the processors busy are in it. A
    kind of which nothing has been seen yet counts with the pace of all others.

    Args:
        total: runs or trials in the queue, those included that were finished before or need no training.
        finished: of these.
        waiting: trainings to come.
        at_a_time: trainings that may run side by side.
        unit: what they are called, in the plural.
    """

    def __init__(
        self, total: int, finished: int, waiting: Iterable[Training], at_a_time: int, unit: str = "runs"
    ) -> None:
        self.total, self.finished, self.failed = total, finished, 0
        self.waiting, self.at_a_time, self.unit = Counter(waiting), at_a_time, unit
        self.going: dict[str, Going] = {}
        self.steps: dict[str, float] = defaultdict(float)  # trained here by trainings that ended, by kind
        self.seconds: dict[str, float] = defaultdict(float)

    def start(self, name: str, training: Training, reached: int = 0) -> None:
        """A training begins, or continues from where it has `reached`."""
        if self.waiting[training] > 0:
            self.waiting[training] -= 1
        now = time.monotonic()
        self.going[name] = Going(training, reached, reached, now, now)

    def point(self, name: str, step: int) -> None:
        """A training got further."""
        if name in self.going and step > self.going[name].step:
            self.going[name].step, self.going[name].seen = step, time.monotonic()

    def end(self, name: str, ended: Ended) -> None:
        """A training ended; or a run that needed none, such as a copy."""
        self.finished += ended == "finished"
        self.failed += ended == "failed"
        one = self.going.pop(name, None)
        if one is not None:
            self.steps[one.training.kind] += one.step - one.reached
            self.seconds[one.training.kind] += one.seen - one.began
            if ended == "waiting":
                self.waiting[one.training] += 1

    def left(self) -> float | None:
        """Seconds for all that is left, by the pace of what was seen; None before there is any."""
        steps, seconds = defaultdict(float, self.steps), defaultdict(float, self.seconds)
        for one in self.going.values():
            steps[one.training.kind] += one.step - one.reached
            seconds[one.training.kind] += one.seen - one.began
        trained, took = sum(steps.values()), sum(seconds.values())
        if trained <= 0 or took <= 0:
            return None
        each = {kind: seconds[kind] / steps[kind] for kind in steps if steps[kind] > 0 and seconds[kind] > 0}
        usual, now = took / trained, time.monotonic()
        work = [
            max(0.0, (one.training.steps - one.step) * each.get(one.training.kind, usual) - (now - one.seen))
            for one in self.going.values()
        ]
        for training, count in self.waiting.items():
            work += [training.steps * each.get(training.kind, usual)] * count
        return max(sum(work) / self.at_a_time, max(work)) if work else 0.0

    def __str__(self) -> str:
        failed = f", {self.failed} failed" if self.failed else ""
        running = f", {len(self.going)} running" if self.going else ""
        return f"{self.finished:,} of {self.total:,} {self.unit} finished{failed}{running}"
