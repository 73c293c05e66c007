"""Ray Tune as a pool of workers for trainings; the only module that starts Ray."""

import logging
import os
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator
from contextlib import chdir, contextmanager
from pathlib import Path
from typing import Any

import ray
from pyarrow.fs import LocalFileSystem
from ray import tune
from ray.exceptions import RayError
from ray.tune.experiment import Trial
from ray.tune.search import Searcher

from pipelines.execution.cluster import (
    DEATHS,
    Deaths,
    Place,
    address,
    exposed,
    knock,
    outline,
    survey,
    travelling,
    watched,
)
from pipelines.execution.joint_recorder import Recorders
from pipelines.execution.private_node import allow_files, closed, private_folder, read_again
from pipelines.execution.progress import StopFile
from pipelines.execution.ray_settings import OWN_NODE, RAY_SETTINGS, set_up_ray
from pipelines.execution.trainable import RunTrainable
from pipelines.workspace.work_folder import StoreError, one_line

INSTALLED = Path(__file__).parents[2]  # what this project's packages are imported from
HERE = "Ray cannot be used, on this machine"  # how an error begins that Ray met while it started
QUIET: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.CRITICAL}


@contextmanager
def ray_session(concurrent: int, cpus: int = 1, name: str = "", home: Path | None = None) -> Iterator[list[str]]:
    """The cluster at `$RAY_ADDRESS`, or one on this machine, closed to all others, for as long as it is needed.

    Args:
        concurrent: trainings at a time.
        cpus: processors of each.
        name: see `private_folder`; this process if empty.
        home: the work folder, which all nodes of a cluster have to share; not looked at if None.

    Yields:
        What a person should know of a cluster, line by line.

    Raises:
        StoreError: the cluster cannot be reached, is open to strangers, or one of its nodes cannot train; or none can
            be started here.
    """
    if ray.is_initialized():
        yield []
        return
    with _joined(address()) if address() else _started(concurrent * cpus, name):
        yield [outline(concurrent, cpus), *exposed(), *(survey(home) if home else [])] if address() else []


# Ray puts the folder that it is started in before all else that its workers import from. A person may have a folder
# `pipelines` there, so it is started where this project is installed.


@contextmanager
def _joined(where: str) -> Iterator[None]:
    knock(where)
    read_again()
    with _explained(f"Ray cannot be used, the cluster at RAY_ADDRESS={where}"), chdir(INSTALLED):
        ray.init(address=where, runtime_env=travelling(RAY_SETTINGS), **QUIET)
    try:
        head = ray.get_runtime_context().gcs_address
        knock(head)  # again, for `auto`
        with watched(head):
            yield
    finally:
        ray.shutdown()


@contextmanager
def _started(cpus: int, name: str) -> Iterator[None]:
    allow_files(cpus)
    with private_folder(name or str(os.getpid())) as folder, closed():
        with _explained(HERE), chdir(INSTALLED):
            set_up_ray(OWN_NODE)
            ray.init(
                address="local",
                num_cpus=cpus,
                include_dashboard=False,
                object_store_memory=100 * 2**20,
                _temp_dir=str(folder / "ray"),
                **QUIET,
            )
        try:
            yield
        finally:
            ray.shutdown()


@contextmanager
def _explained(where: str) -> Iterator[None]:
    try:
        yield
    except (ConnectionError, OSError, RuntimeError, ValueError, RayError) as error:
        raise StoreError(f"{where}: {one_line(error)}") from error


def fit(jobs: list[dict[str, Any]], recorder: Recorders, scratch: Path, concurrent: int, cpus: int, stop: Path) -> None:
    """Run the jobs, `concurrent` at a time with `cpus` each.

    Raises:
        StoreError: what the recorder raised, the jobs are then stopped; or Ray itself broke down.
    """
    logging.getLogger("ray").setLevel(logging.CRITICAL)
    bridge = Bridge(recorder, stop)
    tuner = tune.Tuner(
        tune.with_resources(RunTrainable, {"cpu": cpus}),
        tune_config=tune.TuneConfig(
            search_alg=Queue(jobs), num_samples=len(jobs), max_concurrent_trials=concurrent, reuse_actors=True
        ),
        run_config=tune.RunConfig(
            name="trials",
            storage_path=str(scratch),
            storage_filesystem=LocalFileSystem(),  # the path is one, and no address, whatever characters it has
            verbose=0,
            callbacks=[bridge],
            stop=Halt(bridge),
            failure_config=tune.FailureConfig(max_failures=DEATHS - 1),
            # Left open, Tune would save every run once more at its end, also one that was stopped before it began.
            checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),
        ),
    )
    try:
        tuner.fit()
    except Exception as error:  # a full disk, a killed raylet: whatever it is, the next launch continues
        if bridge.error is None:
            raise StoreError(f"Ray cannot go on: {type(error).__name__}: {one_line(error)}") from error
    if bridge.error:
        raise bridge.error


class Queue(Searcher):
    """Hands out the jobs in their order, each when a worker is free.

    Tune's own grid makes all trials before the first one starts and copies the whole grid for each: a quarter of an
    hour for 10,000 jobs. It also writes all that are left to a file again and again.
    """

    def __init__(self, jobs: Iterable[dict[str, Any]]) -> None:
        super().__init__()
        self.jobs = deque(jobs)

    def suggest(self, trial_id: str) -> Any:
        """The configuration of the next trial."""
        return {"job": self.jobs.popleft()} if self.jobs else Searcher.FINISHED

    def on_trial_complete(self, trial_id: str, result: dict[str, Any] | None = None, error: bool = False) -> None:
        """Nothing depends on it."""

    def save(self, checkpoint_path: str) -> None:
        """Nothing is restored from what Tune writes."""

    def restore(self, checkpoint_path: str) -> None:
        """See `save`."""


class Bridge(tune.Callback):
    """Hands Ray's events to the recorder. Tune must not see the recorder's errors: it would swallow or repeat them."""

    def __init__(self, recorder: Recorders, stop: Path) -> None:
        self.recorder, self.stop = recorder, StopFile(stop, recorder.board)
        self.error: StoreError | None = None
        self.live: set[str] = set()
        self.places: dict[str, Place] = {}  # key -> where its worker is, once it has told
        self.deaths: dict[str, Deaths] = defaultdict(Deaths)
        self.furthest: dict[str, float] = {}  # key -> last step of its points; a continued run tells old ones again

    def __getstate__(self) -> dict[str, Any]:
        """Tune writes its callbacks to a file, from which nothing is ever restored here."""
        return {}

    def on_trial_start(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """Ray calls this when a trial has a worker."""
        self.live.add(key_of(trial))
        if not self.stop.exists():
            self._safely(self.recorder.start, key_of(trial))

    def on_trial_result(
        self, iteration: int, trials: list[Trial], trial: Trial, result: dict[str, Any], **info: Any
    ) -> None:
        """Ray calls this after each step."""
        key = key_of(trial)
        last = max((point["step"] for point in result["points"]), default=-1.0)
        if last > self.furthest.get(key, -1.0):
            self.furthest[key] = last
            self.deaths.pop(key, None)
            trial.max_failures = trial.num_failures + DEATHS - 1
        if result["done"]:
            self.live.discard(key)
        if key in self.recorder.logs:
            self._placed(key, Place(*result["place"]))
            self._safely(self.recorder.result, key, result)

    def _placed(self, key: str, place: Place) -> None:
        """Tell once where a training goes on. On one machine there is nothing to tell."""
        if self.places.get(key) != place and address():
            self._safely(self.recorder.placed, key, str(place))
        self.places[key] = place

    def on_trial_recover(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """Ray calls this when a worker died and another one will take its trial."""
        key = key_of(trial)
        self._died(key, trial)
        trial.max_failures = trial.num_failures + self.deaths[key].left - 1
        self._safely(self.recorder.died, key)

    def on_trial_error(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """Ray calls this when a worker died and none will take its trial."""
        key = key_of(trial)
        trace = self._died(key, trial)
        last = next((line.strip() for line in reversed(trace.splitlines()) if line.strip()), "no reason given")
        if key not in self.recorder.logs and self.stop.exists():
            return  # what had not begun when all was stopped just waits
        if self.deaths[key].left > 0:
            self._safely(self.recorder.lost, key)
        else:
            self._safely(self.recorder.failed, key, f"its worker died: {last[:300]}", trace)

    def _died(self, key: str, trial: Trial) -> str:
        """Count the death of a worker, and say what Ray wrote of all of them."""
        self.live.discard(key)
        trace = Path(trial.error_file).read_text(encoding="utf-8", errors="replace") if trial.error_file else ""
        place = self.places.pop(key, None)
        self.deaths[key].add(place.node if place else "", trace.rpartition("Failure #")[2])
        return trace

    def _safely(self, call: Any, *args: Any) -> None:
        if self.error:
            return
        try:
            call(*args)
        except StoreError as error:
            self.error = error

    @property
    def over(self) -> bool:
        """True if nothing more should run."""
        return self.error is not None or (self.stop.exists() and not self.live)


class Halt(tune.Stopper):
    """Ends the experiment when the bridge says so."""

    def __init__(self, bridge: Bridge) -> None:
        self.bridge = bridge

    def __call__(self, trial_id: str, result: dict[str, Any]) -> bool:
        """No single trial is stopped from here."""
        return False

    def stop_all(self) -> bool:
        """Asked by Tune after every event."""
        return self.bridge.over


def key_of(trial: Trial) -> str:
    """The key of the training that a trial runs."""
    return str(trial.config["job"]["key"])
