"""Several machines as one Ray cluster: joining it, what its nodes must have in common, and what a dead node means.

`RAY_ADDRESS` names a cluster that runs already. The driver is on one of its nodes, trainings are on any. This project's
code travels with the launch; Python, the libraries and the work folder have to be there.
"""

import os
import socket
import sys
import threading
import uuid
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import ray
from filelock import FileLock, Timeout
from ray.exceptions import GetTimeoutError, RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from pipelines.specs.identity import PACKAGE, code_id, fingerprint, folder_of
from pipelines.specs.study import RunSpec
from pipelines.workspace.leftovers import dead, owner, remove
from pipelines.workspace.own_packages import named, top_of
from pipelines.workspace.work_folder import StoreError, one_line

KNOCK = 5.0  # seconds to wait for a cluster to answer
PULSE, MISSES = 8.0, 3  # seconds between two looks at the head, and how many in a row may find nobody
CODE = "RHMC_CODE"  # a variable that tells workers the driver's fingerprint
GONE = 2  # exit code where the head is: environment error
ANSWER = 90.0  # seconds to wait for a node to look around: it may start a process and import torch
DEATHS = 3  # workers that may die in a row on one training without getting it further
NODE_DIED = "its node has died"  # in what Ray says of an actor
HELLO = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"  # how a client of HTTP/2, which gRPC is, begins
DATA, HEADERS, SETTINGS = 0, 1, 4  # types of its frames
LAST, WHOLE = 1, 4  # flags of frames: of a request, of its headers
ALIVE = "/ray.rpc.NodeInfoGcsService/CheckAlive"  # what Ray's head answers to anybody, unless it wants a token
STATUS = b"grpc-status"  # in its answer; the length of a number and the number follow
REFUSAL = STATUS + b"\x0216"  # of one who has no token


def address() -> str:
    """`$RAY_ADDRESS`; empty where Ray is to run on this machine alone."""
    where = os.environ.get("RAY_ADDRESS", "")
    return "" if where == "local" else where


def knock(where: str) -> None:
    """See that a cluster answers at host:port, where Ray itself would try for minutes, and is closed to strangers.

    Raises:
        StoreError: nobody listens there, or something that is not Ray; or anybody can run code there, and
            `RAY_AUTH_MODE=disabled` does not say that this is meant; or an address that cannot be used here.
    """
    if "://" in where:
        raise _refused(where, "only HOST:PORT or auto, from a node of the cluster, can be used")
    host, colon, port = where.rpartition(":")
    if not colon or not port.isdigit():
        return
    try:
        answered = ask(host.strip("[]"), int(port))
    except (OSError, OverflowError) as error:
        raise _refused(where, one_line(error)) from error
    if os.environ.get("RAY_USE_TLS", "0") != "0":
        return  # who has no certificate gets no answer
    if answered[3:4] != bytes([SETTINGS]) or not _told(answered):
        raise _refused(where, "what answers there is not Ray")
    if fault := _mismatch(locked=REFUSAL in answered):
        raise _refused(where, fault)


def ask(host: str, port: int, call: str = ALIVE) -> bytes:
    """The answer of a program that speaks gRPC to a call without a token, as bytes; `STATUS` is in it.

    Raises:
        OSError: nobody listens, or nothing comes for `KNOCK` seconds.
    """
    headers = {":method": "POST", ":scheme": "http", ":path": call, ":authority": "ray", "te": "trailers"}
    packed = b"".join(_field(*header) for header in (headers | {"content-type": "application/grpc"}).items())
    request = _frame(SETTINGS, 0, 0, b"") + _frame(HEADERS, WHOLE, 1, packed) + _frame(DATA, LAST, 1, bytes(5))
    answered = b""
    with socket.create_connection((host, port), KNOCK) as line:
        line.settimeout(KNOCK)
        line.sendall(HELLO + request)
        while not _told(answered) and (more := line.recv(4096)):
            answered += more
    return answered


def _told(answered: bytes) -> bool:
    status = answered.partition(STATUS)[2]
    return bool(status) and len(status) > status[0]


def _frame(kind: int, flags: int, stream: int, body: bytes) -> bytes:
    return len(body).to_bytes(3, "big") + bytes([kind, flags]) + stream.to_bytes(4, "big") + body


def _field(name: str, value: str) -> bytes:
    """A header as HPACK has it, uncompressed; up to 126 characters each."""
    return b"".join([b"\0", *(bytes([len(word)]) + word.encode() for word in (name, value))])


def _opened() -> bool:
    return os.environ.get("RAY_AUTH_MODE", "").lower() == "disabled"


def _mismatch(*, locked: bool) -> str:
    """The reason why a cluster is not joined that asks for a token, or does not; empty if it is."""
    if locked and _opened():
        return "it asks for a token, and RAY_AUTH_MODE=disabled gives none: set RAY_AUTH_MODE=token"
    if not locked and not _opened():
        return (
            "it asks nobody for a token, so whoever reaches it can run code on its nodes: start it with "
            "RAY_AUTH_MODE=token, or set RAY_AUTH_MODE=disabled here if that is meant"
        )
    return ""


@contextmanager
def watched(where: str, pulse: float = PULSE) -> Iterator[None]:
    """While a cluster is used: should its head die, end this process with one line.

    Ray would hold on for a minute and then end the process itself, as if a run had failed.

    Args:
        where: the head, host:port.
        pulse: seconds between two looks.
    """
    host, _, port = where.rpartition(":")
    over = threading.Event()

    def watch() -> None:
        missed = 0
        while missed < MISSES and not over.wait(pulse):
            try:
                socket.create_connection((host.strip("[]"), int(port)), KNOCK).close()
                missed = 0
            except OSError:
                missed += 1
        if not over.is_set():
            print(f"rhmc: the cluster at {where} is gone; the same command continues", file=sys.stderr, flush=True)
            os._exit(GONE)

    threading.Thread(target=watch, name="head", daemon=True).start()
    try:
        yield
    finally:
        over.set()


def _refused(where: str, why: str) -> StoreError:
    return StoreError(f"Ray cannot be used, the cluster at RAY_ADDRESS={where}: {why}")


def travelling(settings: dict[str, str]) -> dict[str, Any]:
    """The parts that a launch brings to every node: the code that the driver runs, and Ray's settings for workers."""
    own = {top_of(module) for module in named()}  # packages that the user has named
    folders = [folder_of(name) for name in (PACKAGE, "pipelines", *sorted(own))]
    return {"py_modules": [str(folder) for folder in folders], "env_vars": settings | {CODE: own_code()}}


@cache
def own_code() -> str:
    """The fingerprint of what this process runs."""
    return fingerprint()


def check_code() -> None:
    """In a worker: see that it runs what the driver does. A node may have joined after all others were asked.

    Raises:
        StoreError: it does not.
    """
    wanted = os.environ.get(CODE) or own_code()
    if own_code() != wanted:
        raise StoreError(f"node {here()} {_other_code(own_code(), wanted)}")


def check_plugins(spec: RunSpec, key: str) -> None:
    """In a worker: see that packages outside this project are those that the driver named the run by.

    Args:
        spec: a run.
        key: its settings id and code id.

    Raises:
        StoreError: they are not.
    """
    if spec.imports and code_id(spec.algo.kind, spec.env.kind, spec.imports) != key.rpartition("-")[2]:
        packages = ", ".join(sorted({top_of(module) for module in spec.imports}))
        raise StoreError(f"node {here()} has other code of {packages} than the launch began with: launch it again")


def _other_code(found: str, wanted: str) -> str:
    return f"computes with another torch, numpy or code ({found} instead of {wanted}): install requirements.lock there"


class Fence(NamedTuple):
    """The token that keeps strangers from Ray's head."""

    host: str  # that it listens on
    locked: bool  # whether it refuses who has no token


def fence() -> Fence:
    """Of the session of this process, found by asking as a stranger does."""
    host, _, port = ray.get_runtime_context().gcs_address.rpartition(":")
    return Fence(host, REFUSAL in ask(host.strip("[]"), int(port)))


# Nodes


class Place(NamedTuple):
    """The place of a process."""

    node: str  # Ray's id, hex; empty outside Ray
    host: str

    def __str__(self) -> str:
        return f"{self.host} ({self.node[:8]})"


def here() -> Place:
    """Of this process."""
    return Place(ray.get_runtime_context().get_node_id() if ray.is_initialized() else "", socket.gethostname())


def alive() -> dict[str, dict[str, Any]]:
    """Ray's words on every node that is alive, by id."""
    return {node["NodeID"]: node for node in ray.nodes() if node["Alive"]}


def outline(concurrent: int, cpus: int) -> str:
    """A line on the cluster that was joined, for a launch with `concurrent` runs of `cpus` processors at a time."""
    have = [int(node["Resources"].get("CPU", 0)) for node in alive().values()]
    room = sum(count // cpus for count in have)
    parts = {"node": len(have), "processor": sum(have), "run": min(room, concurrent)}
    words = ", ".join(f"{count} {name}{'s' * (count != 1)}" for name, count in parts.items())
    text = f"cluster at {address()}: {words} at a time"
    if not room:
        return f"{text}; waiting for a node that has {cpus} processors for a run"
    return text if room <= concurrent else f"{text} (room for {room}: see resources.concurrent)"


def exposed() -> list[str]:
    """A line on a cluster that was joined although it is open; none if it is not."""
    text = "the cluster asks nobody for a token (RAY_AUTH_MODE=disabled): whoever reaches it can run code on its nodes"
    return [text] if _opened() else []


class Sight(NamedTuple):
    """The observations of a node."""

    code: str  # fingerprint, which names torch and numpy as well
    processor: str  # what torch makes use of
    sees: bool  # the work folder
    locks: bool  # what another node locked


def look(probe: str, node: str) -> Sight:
    """Look around on a node: whether a file that the driver locked is there, and locked; leave another beside it."""
    import torch

    file, locks = Path(probe), True
    sees = file.exists()
    if sees:
        with suppress(Timeout), FileLock(file).acquire(timeout=0):
            locks = False
        file.with_name(f"{file.name}.{node}").touch()
    return Sight(own_code(), torch.backends.cpu.get_cpu_capability(), sees, locks)


def survey(home: Path) -> list[str]:
    """See that every node can train: it has the libraries, and shares the work folder and its locks.

    Returns:
        What is worth knowing and no fault, one line each.

    Raises:
        StoreError: a node cannot; nothing was started.
    """
    with probing(home) as probe:
        strategy = NodeAffinitySchedulingStrategy
        calls = {
            node: ray.remote(look)
            .options(num_cpus=0, max_retries=0, scheduling_strategy=strategy(node, soft=False))
            .remote(str(probe), node)
            for node in alive()
        }
        seen = {node: _answer(node, call) for node, call in calls.items()}
        for node, sight in seen.items():
            written = probe.with_name(f"{probe.name}.{node}").exists()
            if fault := wrong(sight, home, written=written, code=own_code()):
                raise _refused(address(), f"node {_name(node)} {fault}")
    kinds = Counter(sight.processor for sight in seen.values())
    if len(kinds) < 2:
        return []
    words = ", ".join(f"{count} with {kind}" for kind, count in sorted(kinds.items()))
    return [f"the nodes have different processors ({words}): the last bits of a result depend on where it was trained"]


@contextmanager
def probing(home: Path) -> Iterator[Path]:
    """A locked file in the work folder; it goes, with what nodes left beside it."""
    for left in home.glob(".nodes-*"):
        if dead("-".join(left.name.split("-")[1:3])):
            remove(left)
    probe = home / f".nodes-{owner()}-{uuid.uuid4().hex}"
    try:
        with FileLock(probe):
            yield probe
    except OSError as error:
        raise StoreError(f"{home}: cannot be written to: {error.strerror or error}") from error
    finally:
        for file in home.glob(f"{probe.name}*"):
            file.unlink(missing_ok=True)


def _answer(node: str, call: Any) -> Sight:
    try:
        sight: Sight = ray.get(call, timeout=ANSWER)
    except GetTimeoutError as error:
        raise _refused(address(), f"node {_name(node)} does not answer within {ANSWER:.0f} s") from error
    except (RayError, ImportError) as error:
        cause = getattr(error, "cause", None) or error
        raise _refused(address(), f"node {_name(node)} cannot train: {one_line(cause)}") from error
    return sight


def wrong(sight: Sight, home: Path, *, written: bool, code: str) -> str:
    """The reason why a node with this sight cannot take part; empty if it can."""
    if not sight.sees:
        return f"does not see {home}: the work folder (RHMC_HOME) has to lie on a file system that all nodes share"
    if not written:
        return f"cannot write to {home}, or the driver does not see what it writes there"
    if not sight.locks:
        return f"takes a lock in {home} that the driver holds: mount it with locks that reach every node"
    if sight.code != code:
        return _other_code(sight.code, code)
    return ""


def _name(node: str) -> str:
    there = alive().get(node)
    return str(Place(node, there["NodeManagerHostname"] if there else "gone"))


# Deaths


@dataclass
class Deaths:
    """The workers that died in a row on one training which got no further meanwhile.

    Those that died with their node do not count. That a node is dead, Ray knows seconds after its workers are gone, so
    it is asked whenever it matters.
    """

    seen: list[tuple[str, str]] = field(default_factory=list)  # node, empty if not known; what Ray said

    def add(self, node: str, text: str) -> None:
        """Another one died."""
        self.seen.append((node, text))

    @property
    def left(self) -> int:
        """The number that may still die; none if 0 or less."""
        living = alive()
        return DEATHS - sum(not (NODE_DIED in text or (node and node not in living)) for node, text in self.seen)
