"""Workers for the trials of a search, as Ray actors.

Not as trials of Ray Tune, which trains the runs of a study. A search decides anew after every point which trial goes on
and what is tried next, and the decision has to be the same after an interruption. Tune asks its search algorithm ahead
of time, keeps its own copy of the search's state, and runs callbacks, schedulers and stoppers in an order of its own.
Asking and telling in plain sight needs none of that: a worker trains to the next point, the driver decides. The
training itself, its checkpoints and the way it is stopped are those of the studies (`RunTrainable`).
"""

from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import ray
from ray.exceptions import RayActorError, RayError

from pipelines.execution.cluster import Deaths, Place
from pipelines.execution.seed_group import Seeds
from pipelines.execution.trainable import Job, RunTrainable, ending
from pipelines.specs.study import Setting
from pipelines.workspace.work_folder import one_line
from rhmc.types import Metrics


class TrialJob(Job):
    """The input of a worker. `spec` is the setting alone."""

    seeds: list[int]


class Failed(NamedTuple):
    """A trial that raised, or whose worker died."""

    error: str  # one line
    trace: str


class TrialTraining(RunTrainable):
    """A trial trained point by point; made by hand, without Tune and the folder that it keeps in the home directory."""

    def __init__(self, job: TrialJob) -> None:
        self.seeds = job["seeds"]
        self.setup({"job": job})

    def make_trainer(self) -> Seeds:
        """All seeds of the trial."""
        return Seeds(Setting.model_validate_json(self.job["spec"]), self.seeds)


class Worker:
    """The process of a worker: one trial at a time."""

    def __init__(self) -> None:
        self.training: TrialTraining | None = None

    def ready(self) -> None:
        """Answers once there is a processor for it."""

    def begin(self, job: TrialJob) -> dict[str, Any]:
        """Take a trial, continue it where it was left, and train to the next point."""
        result: dict[str, Any] = {"busy": True}
        for _ in range(2):  # the second time whoever had it, the worker of a killed driver, has let go
            self.end()
            self.training = TrialTraining(job)
            result = self.step()
            if not result.get("busy"):
                return result
        return ending(error=f"{job['folder']}: another process is training this trial", trace="")

    def step(self) -> dict[str, Any]:
        """Train to the next point. See `RunTrainable` for the result."""
        assert self.training is not None
        return self.training.step()

    def end(self) -> None:
        """Let go of the trial."""
        if self.training is not None:
            self.training.cleanup()
            self.training = None


@dataclass
class Taken:
    """A trial that a worker has."""

    job: TrialJob
    actor: Any
    room: Any = None  # a call that ends once the actor has its processors; None if it had them before
    seen: int = 0  # points that this worker told
    told: int = 0  # points that went out, of all workers that had it
    place: Place | None = None
    deaths: Deaths = field(default_factory=Deaths)

    def new(self, points: list[Metrics]) -> list[Metrics]:
        """The points that no worker told before: one that continues a trial tells all of them once more."""
        self.seen += len(points)
        fresh = points[len(points) - max(0, self.seen - self.told) :]
        if fresh:
            self.told, self.deaths = self.seen, Deaths()
        return fresh


class Pool:
    """`size` workers with `cpus` processors each; a worker is made when it is first needed.

    The trial of a worker that died is handed to another one, which continues it, as long as it gets further.
    """

    def __init__(self, size: int, cpus: int) -> None:
        self.size, self.cpus = size, cpus
        self.idle: list[Any] = []
        self.busy: dict[str, Taken] = {}  # by key of the trial
        self.waiting: dict[Any, str] = {}  # a call that is under way -> key

    @property
    def free(self) -> int:
        """Trials that could begin now."""
        return self.size - len(self.busy)

    def begin(self, job: TrialJob) -> None:
        """Hand a trial to a worker."""
        self.busy[job["key"]] = taken = Taken(job, self.idle.pop() if self.idle else None)
        self._hand_over(taken)

    def _hand_over(self, taken: Taken) -> None:
        """Let the trial's actor begin with it, a new one if it has none."""
        if taken.actor is None:
            taken.actor = ray.remote(Worker).options(num_cpus=self.cpus).remote()
            taken.room = taken.actor.ready.remote()
        self.waiting[taken.actor.begin.remote(taken.job)] = taken.job["key"]

    def next(self, timeout: float) -> dict[str, dict[str, Any] | Failed]:
        """Results that have come, by key; empty if none comes in `timeout` seconds. Call `go_on` or `end` for each.

        A trial whose worker died has no points and `died`, and has another worker already: call neither for it.
        """
        ready, _ = ray.wait(list(self.waiting), num_returns=1, timeout=timeout)
        return {self.waiting[call]: self._result(self.waiting.pop(call), call) for call in ready}

    def _result(self, key: str, call: Any) -> dict[str, Any] | Failed:
        taken = self.busy[key]
        try:
            result: dict[str, Any] = ray.get(call)
        except RayActorError as error:
            return self._died(key, taken, str(error))
        except RayError as error:
            return Failed(f"{type(error).__name__}: {one_line(error)}", str(error))
        if "error" in result and not result.get("diverged"):
            return Failed(result["error"], result["trace"])
        taken.place = result["place"]
        return result | {"points": taken.new(result["points"])}

    def _died(self, key: str, taken: Taken, text: str) -> dict[str, Any] | Failed:
        taken.deaths.add(taken.place.node if taken.place else "", text)
        if taken.deaths.left <= 0:
            del self.busy[key]
            return Failed("the worker died", text)
        taken.actor, taken.seen, taken.place = None, 0, None
        self._hand_over(taken)
        return {"died": True, "points": []}

    def go_on(self, key: str) -> None:
        """Let a trial train to the next point."""
        self.waiting[self.busy[key].actor.step.remote()] = key

    def end(self, key: str) -> None:
        """Let go of a trial; its worker is free."""
        taken = self.busy.pop(key, None)
        if taken is not None:
            with suppress(RayError):
                ray.get(taken.actor.end.remote())
                self._spare(taken.actor)

    def _spare(self, actor: Any) -> None:
        """Give a free worker to a trial whose own one has found no room: it would wait for this one's processors."""
        for taken in self.busy.values():
            if taken.room is not None and not ray.wait([taken.room], timeout=0)[0]:
                self.waiting = {call: key for call, key in self.waiting.items() if key != taken.job["key"]}
                ray.kill(taken.actor)
                taken.actor, taken.room = actor, None
                self._hand_over(taken)
                return
        self.idle.append(actor)
