"""A small site for tests: PostgreSQL, an MLflow server on it, and a Ray cluster of node processes, all on this machine.

Each program is started in a session of its own, and whatever is left in that session is killed at the end.
"""

import os
import pwd
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil
import psycopg

from tests.pipelines.support import started_by
from tests.robustness.chaos import free_port

ROOT = Path(__file__).parents[2]
PATIENCE = 180.0  # seconds for a program to answer, on a busy machine
SETTINGS = {  # of all programs
    "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_health_check_period_ms": "1000",  # a dead node is seen after five of them
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": secrets.token_hex(32),
}


def postgres_programs() -> Path | None:
    """The folder with `initdb` and `postgres`; None if there is none."""
    found = [Path(path).resolve().parent for name in ("initdb", "postgres") if (path := shutil.which(name))]
    found += sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda folder: folder.parent.name, reverse=True)
    return next((one for one in found if (one / "initdb").exists() and (one / "postgres").exists()), None)


def kill(leader: int) -> None:
    """Kill -9 all of a session, again until nothing is left."""
    while left := started_by(leader):
        for process in left:
            with suppress(psutil.Error):
                process.kill()
        time.sleep(0.05)


def wait_for(ready: Callable[[], Any], what: str) -> Any:
    """The result of `ready` once it is true; an error of a network or a database counts as no."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        with suppress(OSError, psycopg.Error):
            if found := ready():
                return found
        time.sleep(0.1)
    raise AssertionError(f"{what}: not within {PATIENCE:.0f} s")


@contextmanager
def program(command: list[str], log: Path, **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    """A program in a session of its own, with all that it starts, until the end of the block."""
    environment = os.environ | SETTINGS | options.pop("env", {})
    with log.open("ab") as out:
        pipes = {"stdin": subprocess.DEVNULL, "stdout": out, "stderr": out}
        process = subprocess.Popen(command, env=environment, start_new_session=True, **pipes, **options)
    try:
        yield process
    finally:
        kill(process.pid)
        process.wait()


@contextmanager
def short_folder(owner: int | None = None) -> Iterator[Path]:
    """A folder whose name leaves room for the names of sockets, and which another user may be given."""
    folder = Path(tempfile.mkdtemp(prefix="rhmc-"))
    try:
        if owner is not None:
            os.chown(folder, owner, -1)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def postgres(programs: Path, *databases: str) -> Iterator[str]:
    """A PostgreSQL with these databases, for anybody on this machine; yields its address without the database.

    It refuses to run as root: then it runs as another user.
    """
    owner = None
    if os.geteuid() == 0:
        names = {one.pw_name: one.pw_uid for one in pwd.getpwall()}
        owner = names.get("postgres", names.get("nobody"))
    with short_folder(owner) as folder:
        options: dict[str, Any] = {"cwd": folder} | ({"user": owner, "extra_groups": []} if owner is not None else {})
        make = [str(programs / "initdb"), "-D", str(folder / "data"), "-A", "trust", "-U", "rhmc", "--no-sync"]
        made = subprocess.run([*make, "-E", "UTF8", "--locale=C"], capture_output=True, text=True, **options)
        assert made.returncode == 0, made.stderr
        port = free_port()
        command = [str(programs / "postgres"), "-D", str(folder / "data"), "-k", str(folder), "-p", str(port)]
        with program([*command, "-c", "listen_addresses=127.0.0.1", "-c", "fsync=off"], folder / "log", **options):
            url = f"postgresql://rhmc@127.0.0.1:{port}"
            with wait_for(lambda: psycopg.connect(f"{url}/postgres", autocommit=True), "PostgreSQL") as connection:
                for name in databases:
                    connection.execute(f"CREATE DATABASE {name}")  # type: ignore[arg-type]
            yield url


@contextmanager
def tracking_server(store: str, folder: Path) -> Iterator[str]:
    """An MLflow server on a database that hands out and takes in files as well; yields its address.

    Args:
        store: the database.
        folder: where it keeps files, and its log.
    """
    port = free_port()
    uri = f"http://127.0.0.1:{port}"
    command = [sys.executable, "-W", "ignore", "-m", "mlflow", "server", "--backend-store-uri", store]
    command += ["--artifacts-destination", str(folder / "served"), "--host", "127.0.0.1", "--port", str(port)]
    with program([*command, "--workers", "1"], folder / "mlflow.log") as server:

        def answers() -> bool:
            assert server.poll() is None, (folder / "mlflow.log").read_text()
            with urllib.request.urlopen(f"{uri}/health", timeout=10):
                return True

        wait_for(answers, "the MLflow server")
        yield uri


class Node:
    """A node of a Ray cluster: its own processes, resources and temporary folder."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process
        (raylet,) = started_by(process.pid, "raylet/raylet")
        (self.id,) = (word.partition("=")[2] for word in raylet.cmdline() if word.startswith("--node_id="))

    def trained(self, place: str) -> bool:
        """True if a word of the tag `nodes` means this node."""
        return place.endswith(f"({self.id[:8]})")

    def kill(self) -> None:
        """As a power cut does: all of it at once."""
        kill(self.process.pid)


class Cluster:
    """A Ray cluster on this machine. Use as a context.

    Args:
        folder: for the logs of its nodes.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.stack = folder, ExitStack()
        self.address = f"127.0.0.1:{free_port()}"
        self.count = 0

    def __enter__(self) -> "Cluster":
        self.stack.__enter__()
        return self

    def __exit__(self, *exception: Any) -> None:
        self.stack.close()

    def start(self, cpus: int = 1) -> Node:
        """Start a node and wait until it has joined; the first one is the head."""
        self.count += 1
        log = self.folder / f"node{self.count}.log"
        command = [sys.executable, "-W", "ignore", "-m", "ray.scripts.scripts", "start", "--block"]
        if self.count == 1:
            command += ["--head", "--port", self.address.rpartition(":")[2], "--include-dashboard=false"]
        else:
            command += ["--address", self.address]
        command += ["--node-ip-address", "127.0.0.1", "--num-cpus", str(cpus), "--object-store-memory", "100000000"]
        command += ["--temp-dir", str(self.stack.enter_context(short_folder()))]
        process = self.stack.enter_context(program(command, log, cwd=ROOT))

        def joined() -> bool:
            assert process.poll() is None, log.read_text()
            return "Ray runtime started" in log.read_text()

        wait_for(joined, "Ray's node")
        return Node(process)
