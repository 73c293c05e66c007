"""`rhmc ui`: the logged runs in MLflow's web interface."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from pipelines.commands.common import DONE, UNFINISHED, say, tell
from pipelines.errors import InputError

HOST = "127.0.0.1"
LOG = "ui.log"  # in the work folder: what MLflow says of every request
PATIENCE = 10.0  # seconds for the server to end by itself


def ui(port: Annotated[int, typer.Option(min=1, max=65535, help="Where to listen on this machine.")] = 5000) -> None:
    """Show the logged runs in the browser: MLflow on this machine only, until Ctrl-C."""
    from pipelines.store import Home, StoreError, work_folder

    uri = os.environ.get("MLFLOW_TRACKING_URI")
    if uri and uri.startswith(("http://", "https://")):
        print(f"{uri.rstrip('/')}/#/experiments?workflowType=machine_learning")
        return
    home = Home(work_folder())
    if not uri and not home.database.exists():
        raise InputError(f"{home.database}: nothing is logged yet; `rhmc study run FILE` does it")
    from pipelines.mlflow_tracker import addresses
    from pipelines.mlflow_tracker import check as check_store

    try:
        home.prepare()
        check_store(uri or f"sqlite:///{home.database}")
        saved = addresses(uri or f"sqlite:///{home.database}", f"http://{HOST}:{port}")
    except StoreError as error:
        raise InputError(str(error)) from error
    _free(port)
    _serve(uri or f"sqlite:///{home.database}", home.artifacts, port, saved)


def _free(port: int) -> None:
    import socket

    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise InputError(f"--port: {port} cannot be used ({error.strerror}); choose another") from error


def _serve(uri: str, artifacts: Path, port: int, saved: Iterable[tuple[str, str, str]]) -> None:
    command = [sys.executable, "-m", "mlflow", "server", "--backend-store-uri", uri]
    command += ["--host", HOST, "--port", str(port), "--workers", "1", "--artifacts-destination", str(artifacts)]
    quiet = {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "true"}

    def leave(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, leave)
    log = artifacts.parent / LOG
    with log.open("wb") as said:
        # A session of its own: the server is several processes, and whatever ends us ends all of them.
        server = subprocess.Popen(
            command, env=os.environ | quiet, start_new_session=True, stdout=said, stderr=subprocess.STDOUT
        )
    try:
        if _answers(server, port):
            _tell(port, saved)
        code = server.wait()
    except KeyboardInterrupt:
        _end(server)
        return
    if code:
        tell(f"rhmc: MLflow's server ended with exit code {code}; {log} says why")
    raise typer.Exit(UNFINISHED if code else DONE)


def _answers(server: "subprocess.Popen[bytes]", port: int) -> bool:
    """Wait until the server can be opened, or has ended: an address is not printed before it works."""
    from urllib.request import urlopen

    while server.poll() is None:
        try:
            urlopen(f"http://{HOST}:{port}/health", timeout=10).close()
            return True
        except OSError:
            time.sleep(0.2)
    return False


def _tell(port: int, saved: Iterable[tuple[str, str, str]]) -> None:
    """The addresses: all experiments, and the views of each."""
    say(f"http://{HOST}:{port}/#/experiments?workflowType=machine_learning  (Ctrl-C ends it)")
    for experiment, views in groupby(saved, key=lambda one: one[0]):
        say(f"\n{experiment}")
        for _, view, address in views:
            say(f"  {view + ':':15} {address}")


def _end(server: "subprocess.Popen[bytes]") -> None:
    """End the server and its workers: politely, then at once."""
    os.killpg(server.pid, signal.SIGTERM)
    try:
        server.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait()
