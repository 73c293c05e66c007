"""Ray Tune as a pool of workers for trainings; the only module that starts Ray."""

import logging
import os
import pickle
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import ray
from ray import tune
from ray.tune.experiment import Trial

from pipelines.recorder import Recorder
from pipelines.store import StoreError, one_line
from pipelines.trainable import RunTrainable

KNOCK = 5.0  # seconds to wait for a cluster to answer


def _knock(address: str | None) -> None:
    """Raise `StoreError` if nobody listens at host:port: Ray itself would try for minutes."""
    host, colon, port = (address or "").rpartition(":")
    if not colon or not port.isdigit() or "://" in host:
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), KNOCK).close()
    except OSError as error:
        raise StoreError(f"Ray cannot be used, the cluster at RAY_ADDRESS={address}: {one_line(error)}") from error


@contextmanager
def ray_session(cpus: int) -> Iterator[None]:
    """The cluster at `$RAY_ADDRESS`, or one on this machine for as long as it is needed.

    Raises:
        StoreError: the cluster cannot be reached, or none can be started.
    """
    if ray.is_initialized():
        yield
        return
    address = os.environ.get("RAY_ADDRESS")
    _knock(address)
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.CRITICAL}
    # The paths of Ray's sockets may hold 107 characters, so they cannot lie in the work folder.
    with tempfile.TemporaryDirectory(prefix="ray", ignore_cleanup_errors=True) as sockets:
        try:
            if address:
                ray.init(address=address, **quiet)
            else:
                os.environ.setdefault("RAY_AUTH_MODE", "disabled")
                ray.init(
                    address="local",
                    num_cpus=cpus,
                    include_dashboard=False,
                    object_store_memory=100 * 2**20,
                    _temp_dir=sockets,
                    **quiet,
                )
        except (ConnectionError, OSError, RuntimeError, ValueError) as error:
            where = f"the cluster at RAY_ADDRESS={address}" if address else "on this machine"
            raise StoreError(f"Ray cannot be used, {where}: {one_line(error)}") from error
        try:
            yield
        finally:
            ray.shutdown()


def fit(jobs: list[dict[str, Any]], recorder: Recorder, scratch: Path, concurrent: int, cpus: int, stop: Path) -> None:
    """Run the jobs, `concurrent` at a time with `cpus` each.

    Raises:
        StoreError: what the recorder raised; the jobs are then stopped.
    """
    logging.getLogger("ray").setLevel(logging.CRITICAL)
    bridge = Bridge(recorder, stop)
    tuner = tune.Tuner(
        tune.with_resources(RunTrainable, {"cpu": cpus}),
        param_space={"job": tune.grid_search(jobs)},
        tune_config=tune.TuneConfig(max_concurrent_trials=concurrent, reuse_actors=True),
        run_config=tune.RunConfig(
            name="trials",
            storage_path=str(scratch),
            verbose=0,
            callbacks=[bridge],
            stop=Halt(bridge),
            failure_config=tune.FailureConfig(max_failures=0),
            # Left open, Tune would save every run once more at its end, also one that was stopped before it began.
            checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),
        ),
    )
    tuner.fit()
    if bridge.error:
        raise bridge.error


class Bridge(tune.Callback):
    """Hands Ray's events to the recorder. Tune must not see the recorder's errors: it would swallow or repeat them."""

    def __init__(self, recorder: Recorder, stop: Path) -> None:
        self.recorder, self.stop = recorder, stop
        self.error: StoreError | None = None
        self.live: set[str] = set()

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
        if result["done"]:
            self.live.discard(key)
        if key in self.recorder.logs:
            self._safely(self.recorder.result, key, result)

    def on_trial_error(self, iteration: int, trials: list[Trial], trial: Trial, **info: Any) -> None:
        """Ray calls this when a worker raised or died."""
        key = key_of(trial)
        self.live.discard(key)
        if key in self.recorder.logs or not self.stop.exists():  # what had not begun when all was stopped just waits
            self._safely(self.recorder.failed, key, *why(trial))

    def _safely(self, call: Any, *args: Any) -> None:
        if self.error:
            return
        try:
            call(*args)
        except StoreError as error:
            self.error = error

    @property
    def over(self) -> bool:
        """Whether nothing more should run."""
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


def why(trial: Trial) -> tuple[str, str]:
    """(one line, full text) of a trial's error, from the files that Tune wrote before it told us."""
    trace = Path(trial.error_file).read_text() if trial.error_file else ""
    error: BaseException | None = None
    if trial.pickled_error_file:
        with suppress(Exception):  # what a library raised need not survive being pickled
            error = pickle.loads(Path(trial.pickled_error_file).read_bytes())
    if error is None:
        lines = [line.strip() for line in trace.splitlines() if line.strip()]
        return (lines[-1] if lines else "no reason given"), trace
    return cause_of(error), trace


def cause_of(error: BaseException) -> str:
    """One line on what a worker raised, from what Ray made of it."""
    cause = getattr(error, "cause", None) or error
    if isinstance(cause, StoreError):
        return str(cause)
    lines = [line.strip() for line in str(cause).splitlines() if line.strip()]
    if len(lines) > 1 and "creation task" in lines[0]:  # setup raised; the error ends Ray's traceback
        return lines[-1].removeprefix("pipelines.store.StoreError: ")
    return f"{type(cause).__name__}: {one_line(cause)}"
