"""`rhmc ui`: the logged runs in MLflow's web interface."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from threading import Thread
from types import FrameType
from typing import Annotated

import typer

from pipelines.cli.common import say, tell
from pipelines.workspace.addresses import fault, scrubbed, without_password
from pipelines.workspace.errors import InputError
from pipelines.workspace.exit_codes import Exit

HOST = "127.0.0.1"
LOG = "ui.log"  # in the work folder: what MLflow says of every request
PATIENCE = 10.0  # seconds for the server to end by itself


def ui(port: Annotated[int, typer.Option(min=1, max=65535, help="Where to listen on this machine.")] = 5000) -> None:
    """Show the logged runs in the browser: MLflow on this machine only, until Ctrl-C."""
    from pipelines.workspace.work_folder import Home, work_folder

    uri = os.environ.get("MLFLOW_TRACKING_URI")
    if uri and (said := fault("MLFLOW_TRACKING_URI", uri)):
        raise InputError(said)
    if uri and uri.startswith(("http://", "https://")):
        print(f"{without_password(uri).rstrip('/')}/#/experiments?workflowType=machine_learning")
        return
    home = Home(work_folder())
    if not uri and not home.database.exists():
        raise InputError(f"{home.database}: nothing is logged yet; `rhmc study run FILE` does it")
    from pipelines.tracking.mlflow_tracker import addresses, prepared

    home.prepare()
    store = prepared(home)
    _free(port)
    tell("starting MLflow; its address follows")
    saved = addresses(store, f"http://{HOST}:{port}")
    # MLflow makes the folders of a SQLite address as it is written, with %20 for a space; a bare name has none.
    _serve(uri or f"sqlite:///{home.database.name}", home.artifacts, port, saved)


def _free(port: int) -> None:
    import socket

    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise InputError(f"--port: {port} cannot be used ({error.strerror}); choose another") from error


def _serve(uri: str, artifacts: Path, port: int, saved: Iterable[tuple[str, str, str]]) -> None:
    """Run MLflow's server in the work folder.

    Args:
        uri: of the database, a SQLite file of the work folder by its name. It may hold a password, and the arguments
            of a process are seen by everybody: it goes by the environment.
        artifacts: where files are that are uploaded to the server.
        port: where to listen.
        saved: what to print once it answers.
    """
    command = [sys.executable, "-m", "mlflow", "server", "--host", HOST, "--port", str(port), "--workers", "1"]
    command += ["--artifacts-destination", artifacts.as_uri()]
    settings = {
        "MLFLOW_BACKEND_STORE_URI": uri,
        "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",
        "MLFLOW_DISABLE_TELEMETRY": "true",
        "MLFLOW_ENABLE_AI_GATEWAY": "false",  # of no use here, and a place in the menu
        "DO_NOT_TRACK": "true",
        "PYTHONSAFEPATH": "1",  # no module of the work folder is taken for one of Python's
    }

    def leave(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, leave)
    log = artifacts.parent / LOG
    log.touch()  # see that it can be written before anything is started
    # A session of its own: the server is several processes, and whatever ends us ends all of them.
    server = subprocess.Popen(
        command,
        cwd=artifacts.parent,
        env=os.environ | settings,
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    try:
        talk = Thread(target=_write_down, args=(server, log), daemon=True)
        talk.start()
        if _answers(server, port):
            _tell(port, saved)
        code = server.wait()
        talk.join(1.0)  # what it said last
    except KeyboardInterrupt:
        _end(server)
        return
    if code:
        tell(f"rhmc: MLflow's server ended with exit code {code}; {log} says why")
    raise typer.Exit(Exit.BROKEN if code else Exit.DONE)


def _write_down(server: "subprocess.Popen[bytes]", log: Path) -> None:
    """The output of the server, line by line, without passwords; to the end, for it waits where nobody reads on."""
    assert server.stdout is not None
    with suppress(OSError), log.open("w", encoding="utf-8") as file:
        for line in server.stdout:
            print(scrubbed(line.decode(errors="replace").rstrip("\n")), file=file, flush=True)
    for _ in server.stdout:  # the disk is full
        pass


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
    """The addresses: all experiments, and the first view of each, which leads to the others."""
    say(f"http://{HOST}:{port}/#/experiments?workflowType=machine_learning  (Ctrl-C ends it)")
    first = {experiment: next(views)[2] for experiment, views in groupby(saved, key=lambda one: one[0])}
    width = max(map(len, first), default=0)
    for experiment, address in first.items():
        say(f"{experiment:{width}}  {address}")


def _end(server: "subprocess.Popen[bytes]") -> None:
    """End the server and its workers: politely, then at once."""
    os.killpg(server.pid, signal.SIGTERM)
    try:
        server.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait()
