"""One run of a study as a Ray trial: a step trains to the next point of the grid.

The trial is idempotent: whoever starts a run again, in whatever process, continues from its newest checkpoint. Ray's
own checkpoints are therefore not used.
"""

import json
import time
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from filelock import Timeout
from ray.tune import Trainable

from pipelines.execution.cluster import check_code, check_plugins, here
from pipelines.execution.finite import DivergedError, check, defined
from pipelines.execution.seed_group import Seeds
from pipelines.specs.study import RunSpec
from pipelines.tracking.initial import kept
from pipelines.tracking.policy import FILE, SPEC, Saved, acting
from pipelines.workspace.best_effort import EPISODE, WHY_NOT
from pipelines.workspace.own_packages import take
from pipelines.workspace.work_folder import Checkpoints, StoreError, one_line, save_atomically
from rhmc.learning.learner import Learners
from rhmc.training.trainer import Trainer
from rhmc.types import Metrics, State

FRAMES = 30  # of an animation that a run keeps
PATIENCE = 60.0  # seconds to wait for the worker of a killed driver to let go of a run


class Job(TypedDict):
    """The input of a worker: plain values."""

    key: str  # spec id and fingerprint
    spec: str  # JSON
    folder: str  # of the run's checkpoints
    checkpoint_every: int  # points of the grid
    stop: str  # a file: once it exists, the run saves itself at the next point and ends
    animate: NotRequired[bool]  # leave an animation of an episode beside the policy
    home: NotRequired[str]  # the work folder, which has a copy of the policy that the run starts from, if any
    imports: NotRequired[dict[str, str]]  # modules that the study's user has named, each with its package's folder


class RunTrainable(Trainable):
    """See the module. Configuration: `{"job": Job}`.

    A result has `done`, `stopped`, `seconds`, `place` (a `cluster.Place`) and `points`: the new point of the grid, and
    at the first step of a continued run every point before it as well, so that a log can be made whole. `busy` is true
    where another process is training this run. What goes wrong is a result as well, with `error` (one line) and
    `trace`: were it raised, Ray could not be told to replace a worker that died and to leave alone one that failed.
    `diverged` is true where a value is not finite: the same settings will come to the same end. The points then end
    before it.
    """

    def setup(self, config: dict[str, Any]) -> None:
        """Take the run and load its newest checkpoint."""
        job: Job = config["job"]
        self.job = job
        self.stop_file = Path(job["stop"])
        self.checkpoints = Checkpoints(Path(job["folder"]))
        self.lock = self.checkpoints.lock()
        self.trainer: Trainer | Seeds | None = None
        self.history: list[Metrics] = []
        self.seconds = 0.0
        self.reported = self.saved = 0  # points told to the driver; points in the newest checkpoint
        self.ended: dict[str, Any] = {}  # why there is nothing to train
        take(job.get("imports", {}))
        if self.stop_file.exists():
            self.ended = ending(stopped=True)
            return
        try:
            self._begin()
        except Timeout:
            self.ended = ending(stopped=True, busy=True)
        except Exception as error:
            self.ended = failure(error)

    def _begin(self) -> None:
        check_code()
        Path(self.job["folder"]).parent.mkdir(parents=True, exist_ok=True)
        try:
            self.lock.acquire(timeout=0)
        except Timeout:
            with suppress(Timeout), self.lock.acquire(timeout=PATIENCE):
                pass
            raise  # free now or not: whoever had it may have finished the run, so the driver looks first
        self.trainer = self.make_trainer()
        if state := self.checkpoints.newest():
            if state.get(SPEC, self.job["spec"]) != self.job["spec"]:
                raise StoreError(f"{self.checkpoints.folder}: the checkpoints are of another run; move the folder away")
            self.load_state(state)
        elif policy := json.loads(self.job["spec"])["trainer"].get("init"):
            self.trainer.start_from(kept(policy, Path(self.job["home"])).algorithm)

    def make_trainer(self) -> Trainer | Seeds:
        """The trainings of the job, untrained."""
        spec = RunSpec.model_validate_json(self.job["spec"])
        check_plugins(spec, self.job["key"])
        return Trainer(spec.env, spec.algo, spec.trainer, spec.seed)

    def step(self) -> dict[str, Any]:
        """Train to the next point."""
        return self._result() | {"place": here()}

    def _result(self) -> dict[str, Any]:
        if self.trainer is None or self.ended:
            return self.ended
        try:
            return self._step(self.trainer)
        except DivergedError as error:
            return failure(error) | {"diverged": True, "points": self.history[self.reported :]}
        except Exception as error:
            return failure(error)

    def _step(self, trainer: Trainer | Seeds) -> dict[str, Any]:
        if not trainer.done:
            self._advance(trainer)
        done, stopped = trainer.done, self.stop_file.exists()
        if done or stopped or len(self.history) - self.saved >= self.job["checkpoint_every"]:
            self._save(trainer)
        points, self.reported = self.history[self.reported :], len(self.history)
        return {"done": done or stopped, "stopped": stopped and not done, "points": points, "seconds": self.seconds}

    def _advance(self, trainer: Trainer | Seeds) -> None:
        start, busy, before = time.perf_counter(), time.process_time(), trainer.step
        metrics = next(trainer)
        spent = time.perf_counter() - start
        self.seconds += time.process_time() - busy  # a waiting worker on a shared machine spends none
        timing = {"time/seconds": self.seconds, "time/steps_per_second": (trainer.step - before) / spent}
        point = defined(metrics)
        check(point, {"learners": [one.state_dict() for one in learners(trainer)]})
        self.history.append(point | timing)

    def _save(self, trainer: Trainer | Seeds) -> None:
        state = self.state()
        lean = to_act(json.loads(self.job["spec"])["algo"]["kind"], state["trainer"])
        check({"step": float(trainer.step)}, lean)  # the rest of it, such as statistics of rewards
        if trainer.done:  # also where nothing is left to train: the file that a killed worker left may be damaged
            state["trainer"] = lean  # nothing more is learned from it
            kept = state["trainer"] | {SPEC: self.job["spec"]}
            save_atomically(self.checkpoints.folder / FILE, kept)
            if self.job.get("animate"):
                self._animate(kept)
        if len(self.history) > self.saved:
            self.checkpoints.save(len(self.history), state | {SPEC: self.job["spec"]})
        self.saved = len(self.history)

    def _animate(self, kept: State) -> None:
        """Draw an episode. Training is over and a copy of the policy acts; what goes wrong here is only noted."""
        try:
            from pipelines.policies.render import episode_gif, write

            spec = RunSpec.model_validate_json(self.job["spec"])
            write(self.checkpoints.folder / EPISODE, episode_gif(Saved(spec, kept["algorithm"]), frames=FRAMES))
        except Exception as error:
            with suppress(OSError):  # no room for the note either
                words = f"{type(error).__name__}: {one_line(error)}\n"
                (self.checkpoints.folder / WHY_NOT).write_text(words, encoding="utf-8")

    def state(self) -> State:
        """All of the run between two points: the trainer, and the metrics so far for a log that missed some."""
        assert self.trainer is not None
        return {"trainer": self.trainer.state_dict(), "history": self.history, "seconds": self.seconds}

    def load_state(self, state: State) -> None:
        """Continue from `state`."""
        assert self.trainer is not None
        self.trainer.load_state_dict(state["trainer"])
        self.history, self.seconds = list(state["history"]), state["seconds"]
        self.saved = len(self.history)

    def save_checkpoint(self, checkpoint_dir: str) -> None:
        """Ray's own way to save; the studies do not use it."""
        Checkpoints(Path(checkpoint_dir)).save(len(self.history), self.state())

    def load_checkpoint(self, checkpoint: Any) -> None:
        """Ray's own way to load."""
        state = Checkpoints(Path(checkpoint)).newest()
        if state is None:
            raise StoreError(f"{checkpoint}: no readable checkpoint")
        self.load_state(state)

    def reset_config(self, new_config: dict[str, Any]) -> bool:
        """Let the next run use this process."""
        self.cleanup()
        self.setup(new_config)
        return True

    def cleanup(self) -> None:
        """Let go of the run."""
        self.trainer = None
        self.lock.release()


def to_act(method: str, state: State) -> State:
    """The state of a training, or of several seeds, without what the method keeps to learn from."""
    if "seeds" in state:
        return state | {"seeds": [to_act(method, one) for one in state["seeds"]]}
    return state | {"algorithm": acting(method, state["algorithm"])}


def learners(trainer: Trainer | Seeds) -> Learners:
    """Every network that learns, of all seeds."""
    each = trainer.trainers.values() if isinstance(trainer, Seeds) else [trainer]
    return [learner for one in each for learner in one.algorithm.learners()]


def ending(*, stopped: bool = False, **more: Any) -> dict[str, Any]:
    """A last result without points."""
    return {"done": True, "stopped": stopped, "points": [], "seconds": 0.0} | more


def failure(error: Exception) -> dict[str, Any]:
    """The last result of a run that cannot go on."""
    line = str(error) if isinstance(error, StoreError | DivergedError) else f"{type(error).__name__}: {one_line(error)}"
    return ending(error=line, trace=traceback.format_exc())
