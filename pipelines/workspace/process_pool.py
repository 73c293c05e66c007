"""A function over items in several processes of this machine, where nothing has to survive an interruption."""

import os
import pickle
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from threading import Thread
from typing import TypeVar

import torch

from pipelines.workspace.own_packages import load_taken, named, take
from pipelines.workspace.work_folder import StoreError

Given = TypeVar("Given")
Made = TypeVar("Made")
KILLED = "a process that worked on this was killed, perhaps for want of memory; fewer at a time (--jobs 1) need less"


def side_by_side(function: Callable[[Given], Made], items: Iterable[Given], jobs: int) -> Iterator[Made]:
    """Results of a function, in the order of the items, each made with one torch thread unless it sets more.

    However the iteration ends, no process is left; whoever stops before its end does not wait for what is under way.

    Args:
        function: can be pickled, as can what it is given, returns and raises.
        items: what it is called with.
        jobs: processes; 1 stands for this one, where an item is taken when its turn comes.

    Raises:
        StoreError: a process was killed.
    """
    if jobs == 1:
        torch.set_num_threads(1)
        yield from map(function, items)
        return
    context = get_context("spawn")  # torch's threads do not survive a fork
    theirs, ours = context.Pipe(duplex=False)
    # On the way out `ours` is closed first, which ends the workers: the pool then has nothing to wait for.
    with theirs, ProcessPoolExecutor(jobs, context, _begin, (theirs, named())) as pool, ours:
        try:
            waiting = [_submit(pool, pickle.dumps((function, item))) for item in items]
            for future in waiting:
                yield pickle.loads(future.result())
        except BrokenProcessPool as error:
            raise StoreError(KILLED) from error


def _submit(pool: ProcessPoolExecutor, call: bytes) -> "Future[bytes]":
    """Hand a call to the pool, which may start a worker for it. Bytes, as torch would put tensors in shared memory."""
    # A worker keeps the mask that it is started under: Ctrl-C, which reaches all of them, is this process's matter.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.submit(_call, call)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(lifeline: Connection, imports: Mapping[str, str]) -> None:
    """Make a worker ready. What it is given may be of packages that the user has named."""
    torch.set_num_threads(1)
    take(imports)
    load_taken()
    Thread(target=_end_with, args=(lifeline,), daemon=True).start()


def _end_with(lifeline: Connection) -> None:
    """End this process at once when the other end of a pipe is closed: by its owner, or by the owner's death."""
    with suppress(EOFError, OSError):
        lifeline.recv_bytes()
    os._exit(1)


def _call(call: bytes) -> bytes:
    function, item = pickle.loads(call)
    return pickle.dumps(function(item))
