"""Faults on purpose: processes that kill themselves at a chosen write, damaged checkpoints, and what must be equal.

Drivers and servers are forked from one process that has imported everything, so that a launch takes a second and not
ten. Such a driver trains in its own process instead of Ray's workers; all else in it is what `rhmc study run` does.
"""

import hashlib
import logging
import multiprocessing
import os
import random
import resource
import signal
import socket
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable
from contextlib import nullcontext, suppress
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import ray.tune.trainable.trainable
import torch
from mlflow.entities import ViewType
from sqlalchemy import event
from sqlalchemy.engine import Engine
from werkzeug.serving import WSGIRequestHandler, make_server

from pipelines.bundles.bundle import unpack
from pipelines.execution import ray_driver, run
from pipelines.execution.joint_recorder import Recorders
from pipelines.execution.trainable import RunTrainable
from pipelines.specs.safe_names import full
from pipelines.specs.study import Study
from pipelines.tracking.mlflow_tracker import open_existing
from pipelines.tracking.plan import study_card
from pipelines.tracking.tracker import StudyCard
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import Home

ray.tune.trainable.trainable.DEFAULT_STORAGE_PATH = tempfile.gettempdir() + "/ray_results"  # not in a tester's home
PRELOAD = [  # whatever a launch or another verb imports: a forked process has it at once
    *("mlflow.server", "mlflow.store.tracking.sqlalchemy_store", "torch._dynamo"),
    *(
        "pipelines.policies.animation",
        "pipelines.bundles.bundle",
        "pipelines.tracking.registry",
        "pipelines.tuning.search_plots",
        "reports.pages.build",
        "tests.robustness.warm",
    ),
]
FORKS = multiprocessing.get_context("forkserver")
WRITES = ("INSERT", "UPDATE", "DELETE")
KILLED = -signal.SIGKILL
WORKER = "Trainable"  # in what Ray calls a process that trains, idle or at work
FOREVER = 0  # a fuse that never burns down
DAMAGES = ("cut short", "empty", "zeros inside", "noise inside", "noise")


# What must be equal


class Run(NamedTuple):
    """A run as MLflow has it; clocks only as steps."""

    name: str  # role, arm and seed
    status: str
    params: dict[str, str]
    history: dict[str, list[tuple[int, str]]]  # metric -> (step, value), doubled ones twice
    files: dict[str, str]  # name -> digest
    models: list[str]  # its versions in the registry, by name and what they are called there


def everything(study: Study, home: Path) -> list[Run]:
    """All that a study has logged and its parent, in an order that does not depend on when it was logged."""
    return logged(study_card(study), home)


def logged(card: StudyCard, home: Path) -> list[Run]:
    """See `everything`; of a study or a search."""
    tracker = open_existing(card, Home(home))
    assert tracker is not None
    found = tracker.client.search_runs([tracker.experiment], "", ViewType.ACTIVE_ONLY, 1000)
    return sorted(_run(tracker.client, one, home) for one in found)


def _run(client: Any, one: Any, home: Path) -> Run:
    tags, ref = one.data.tags, one.info.run_id
    name = "/".join(tags.get(key, "") for key in ("role", "arm", "seed", "spec"))
    history = {}
    for metric in sorted(one.data.metrics):
        values = [
            (m.step, "" if full(metric).startswith("time/") else m.value.hex())
            for m in client.get_metric_history(ref, metric)
        ]
        history[metric] = sorted(values)
    kept = {file.path: client.download_artifacts(ref, file.path) for file in client.list_artifacts(ref)}
    files = {name: _digest(Path(path)) for name, path in kept.items()}
    versions = client.search_model_versions(f"run_id = '{ref}'")
    models = [f"{v.name} {client.get_model_version(v.name, v.version).aliases}" for v in versions]
    return Run(name, one.info.status, one.data.params, history, files, models)


def _digest(path: Path) -> str:
    """Of a text, its bytes; of a policy, its tensors and numbers."""
    content = repr(_plain(torch.load(path, weights_only=True))).encode() if path.suffix == ".pt" else path.read_bytes()
    return hashlib.sha256(content).hexdigest()


def _plain(state: Any) -> Any:
    if isinstance(state, torch.Tensor):
        return str(state.dtype), tuple(state.shape), state.contiguous().flatten().view(torch.uint8).numpy().tobytes()
    if isinstance(state, dict):
        return [(key, _plain(state[key])) for key in sorted(state, key=str)]
    return [_plain(value) for value in state] if isinstance(state, list | tuple) else state


def faults(found: list[Run], expected: list[Run]) -> dict[str, int]:
    """Counts of each fault that must not happen: all zero where the study survived."""
    names = [one.name for one in found]
    wanted = {one.name: one for one in expected}
    both = [(one, wanted[one.name]) for one in found if one.name in wanted]
    return {
        "runs lost": len(wanted.keys() - set(names)),
        "runs doubled": len(names) - len(set(names)),
        "runs left open": sum(one.status != "FINISHED" for one in found),
        "values doubled": sum(len(h) - len({step for step, _ in h}) for one in found for h in one.history.values()),
        "histories that differ": sum(one.history != other.history for one, other in both),
        "policies that differ": sum(one.files.get("policy.pt") != other.files.get("policy.pt") for one, other in both),
        "models that differ": sum(one.models != other.models for one, other in both),
        "other files or params that differ": sum(
            (one.params, one.files.keys(), one.files.get("config.yaml"))
            != (other.params, other.files.keys(), other.files.get("config.yaml"))
            for one, other in both
        ),
    }


# Processes that kill themselves


class Fuse:
    """Kills its process at the `length`-th write: to a file below `home`, to MLflow's database, or of an answer."""

    def __init__(self, length: int) -> None:
        self.length, self.count = length, 0
        self.counts: Callable[[], bool] = lambda: True  # whether a write counts now

    def tick(self) -> None:
        """A write is about to happen."""
        if not self.counts():
            return
        self.count += 1
        if self.count == self.length:
            os.kill(os.getpid(), signal.SIGKILL)

    def lay(self, home: str) -> None:
        """From now on, count."""

        def hook(name: str, args: tuple[Any, ...]) -> None:
            writes = name in {"os.rename", "os.remove", "os.mkdir"}
            writes = writes or (name == "open" and bool(args[2] & (os.O_WRONLY | os.O_RDWR)))
            if writes and isinstance(args[0], str | os.PathLike) and os.fspath(args[0]).startswith(home):
                self.tick()

        def statement(connection: Any, cursor: Any, text: str, *rest: Any) -> None:
            if text.startswith(WRITES):
                self.tick()

        sys.addaudithook(hook)
        event.listen(Engine, "before_cursor_execute", statement)
        event.listen(Engine, "commit", lambda connection: self.tick())


def start_launch(
    study: Study, home: Path, length: int = FOREVER, uri: str | None = None, room: int | None = None
) -> ForkServerProcess:
    """A driver in a process of its own. One that ends says in `writes` how many there were.

    Args:
        study: what it drives.
        home: its work folder.
        length: at which write it is killed.
        uri: where it logs; a database in the work folder if None.
        room: bytes that a file may have, which is as good as a full disk.
    """
    return start(_drive, study.model_dump_json(), str(home), uri, length, room)


def launch(study: Study, home: Path, length: int = FOREVER, room: int | None = None) -> int:
    """The exit code of such a driver."""
    process = start_launch(study, home, length, room=room)
    process.join()
    assert process.exitcode is not None
    return process.exitcode


def import_in_a_process(bundle: Path, home: Path, length: int = FOREVER, room: int | None = None) -> int:
    """The exit code of a process that takes in a bundle; see `start_launch`."""
    process = start(_import, str(bundle), str(home), length, room)
    process.join()
    assert process.exitcode is not None
    return process.exitcode


def start(target: Any, *args: Any) -> ForkServerProcess:
    """Fork a process."""
    FORKS.set_forkserver_preload([__name__, *PRELOAD])
    process = FORKS.Process(target=target, args=args, daemon=True)
    process.start()
    return process


def _drive(study: str, home: str, uri: str | None, length: int, room: int | None) -> None:
    settle(Path(home) / "driver.log")
    if room:
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
    if uri:
        os.environ["MLFLOW_TRACKING_URI"] = uri
    os.environ["MLFLOW_HTTP_REQUEST_BACKOFF_FACTOR"] = "0"  # at most a second between two tries
    ray_driver.ray_session = lambda *args: nullcontext([])
    ray_driver.fit = fit_here
    fuse = Fuse(length)
    fuse.lay(home)
    status = run.run_studies([Study.model_validate_json(study)], Path(home))
    (Path(home) / "writes").write_text(str(fuse.count))
    sys.exit(status)


def _import(bundle: str, home: str, length: int, room: int | None) -> None:
    settle(Path(home) / "driver.log")
    if room:
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
    fuse = Fuse(length)
    fuse.lay(home)
    try:
        unpack(Path(bundle), Path(home))
    except InputError as error:
        print(error)
        sys.exit(2)
    (Path(home) / "writes").write_text(str(fuse.count))


def settle(log: Path) -> None:
    """Write to the log, and end when the tests do, however they do."""
    handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def fit_here(jobs: list[dict[str, Any]], recorder: Recorders, *rest: Any) -> None:
    """The work of `ray_driver.fit`, one job after the other in this process."""
    for job in jobs:
        worker = RunTrainable({"job": job})
        recorder.start(job["key"])
        done = False
        while not done:
            result = worker.step()
            done = result["done"]
            recorder.result(job["key"], result)
        worker.cleanup()


def launch_here(study: Study, home: Path) -> int:
    """The exit code of a launch in this process, without Ray."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ray_driver, "ray_session", lambda *args: nullcontext([]))
        patch.setattr(ray_driver, "fit", fit_here)
        return run.run_studies([study], home)


class Server:
    """An MLflow tracking server that keeps everything in a folder; it can be killed and comes back at its address."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.port = free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self.process: ForkServerProcess | None = None

    def start(self, length: int = FOREVER) -> None:
        """Serve, until the `length`-th write, which may be before the first answer."""
        self.process = start(_serve, str(self.home), self.port, length)
        while self.alive:
            with suppress(OSError), urllib.request.urlopen(f"{self.uri}/health", timeout=10):
                return
            time.sleep(0.02)
        assert self.process.exitcode == KILLED, (self.home / "server.log").read_text()

    @property
    def alive(self) -> bool:
        """True if it serves."""
        return self.process is not None and self.process.is_alive()

    def kill(self) -> None:
        """As `kill -9` does."""
        if self.process is not None:
            self.process.kill()
            self.process.join()


def free_port() -> int:
    """A port of this machine that nobody listens at."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


class _Quiet(WSGIRequestHandler):
    def log_request(self, *args: object) -> None:
        """Nothing."""


def _serve(home: str, port: int, length: int) -> None:
    settle(Path(home) / "server.log")
    logging.getLogger("alembic").setLevel(logging.ERROR)
    os.environ["_MLFLOW_SERVER_FILE_STORE"] = f"sqlite:///{home}/mlflow.db"
    os.environ["_MLFLOW_SERVER_ARTIFACT_ROOT"] = "mlflow-artifacts:/"
    os.environ["_MLFLOW_SERVER_ARTIFACT_DESTINATION"] = f"{home}/served"
    os.environ["_MLFLOW_SERVER_SERVE_ARTIFACTS"] = "true"
    from mlflow.server import app

    fuse = Fuse(length)

    def answered(response: Any) -> Any:
        fuse.tick()  # done, and nobody will be told
        return response

    app.after_request(answered)
    server = make_server("127.0.0.1", port, app, threaded=True, request_handler=_Quiet)
    fuse.lay(home)
    server.serve_forever()


# Damage as a power cut leaves it


def damage(home: Path, rng: random.Random) -> str:
    """Damage the newest checkpoint of a run under way, and its policy if there is one; say how, or nothing."""
    folders = sorted(folder for folder in home.glob("checkpoints/*") if list(folder.glob("[0-9]*.pt")))
    if not folders:
        return ""
    folder, kind = rng.choice(folders), rng.choice(DAMAGES)
    for file in (max(folder.glob("[0-9]*.pt")), folder / "policy.pt"):
        if file.exists():
            file.write_bytes(damaged(file.read_bytes(), kind, rng))
    return kind


def damaged(content: bytes, kind: str, rng: random.Random) -> bytes:
    """The content after a damage of `DAMAGES`."""
    if kind == "empty" or not content:  # emptied before, and nobody has looked since
        return b""
    if kind == "cut short":
        return content[: rng.randrange(len(content))]
    if kind == "noise":
        return rng.randbytes(len(content))
    size = min(512, len(content))
    start = rng.randrange(len(content) - size + 1)
    block = bytes(size) if kind == "zeros inside" else rng.randbytes(size)
    while sum(old != new for old, new in zip(content[start : start + size], block, strict=True)) < size // 2:
        start = rng.randrange(len(content) - size + 1)
    return content[:start] + block + content[start + size :]
