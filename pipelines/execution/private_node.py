"""A Ray node for one launch, closed to everybody else.

Left to itself, Ray listens on every network of the machine, and gives its folder to all users of it. Here it listens on
loopback alone, answers only who knows a token that is made for the session, and keeps its files in a folder that nobody
else can enter.
"""

import os
import resource
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ray._private import ray_constants
from ray._raylet import AuthenticationTokenLoader, Config  # type: ignore[attr-defined]

from pipelines.workspace.leftovers import claim, sweep_claimed
from pipelines.workspace.work_folder import StoreError

AUTH = ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")
LONGEST = 107  # bytes in the name of a socket
FILES, FILES_EACH = 128, 4  # that Ray's busiest process holds open: without a worker, and for each (found: 53, 2.5)
INSIDE = "ray/session_2000-01-01_00-00-00_000000_4194304/sockets/plasma_store"  # the longest name that Ray adds


def read_again() -> None:
    """Make Ray, which remembers them, read mode and token from the environment again."""
    Config.initialize("")
    AuthenticationTokenLoader.instance().reset_cache()


@contextmanager
def closed() -> Iterator[None]:
    """Inside, what Ray starts listens on loopback alone and asks for a token that is made here.

    Mode and token that a person has set are meant for a cluster: they neither open this node nor come into it, and are
    back afterwards. The token is in the environment of this process and its children, which other users cannot read.
    """
    before = {name: os.environ.pop(name) for name in AUTH if name in os.environ}
    several, ray_constants.ENABLE_RAY_CLUSTER = ray_constants.ENABLE_RAY_CLUSTER, False
    os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    read_again()
    try:
        yield
    finally:
        for name in AUTH:
            os.environ.pop(name, None)
        os.environ |= before
        ray_constants.ENABLE_RAY_CLUSTER = several
        Config.initialize("")  # not the token: a thread of Ray that still ends would miss it, and abort the process


@contextmanager
def private_folder(name: str) -> Iterator[Path]:
    """A folder for Ray's sockets and logs that its owner alone can enter; Ray opens its own, inside, to everybody.

    The names of sockets have to be short, so it cannot lie in the work folder. A killed driver leaves it behind; the
    next one removes it.

    Args:
        name: tells it from those of other drivers that may run now.

    Raises:
        StoreError: it cannot be made, is somebody else's, or has too long a name.
    """
    above = Path(tempfile.gettempdir())
    folder = above / f"ray-{name}"
    _check_place(above, len(os.fsencode(folder / INSIDE)) - LONGEST)
    sweep_claimed(above, "ray-*")
    shutil.rmtree(folder, ignore_errors=True)  # does not follow links
    try:
        folder.mkdir(mode=0o700)  # fails on whatever is there still: a link, or what is not ours to remove
        claim(folder)
    except FileExistsError as error:
        owner = folder.lstat().st_uid
        raise StoreError(
            f"{folder}: Ray's folder cannot be made: user {owner} has put something there: remove it, or set TMPDIR"
        ) from error
    except OSError as error:
        raise StoreError(f"{folder}: Ray's folder cannot be made: {error.strerror}") from error
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def allow_files(workers: int) -> None:
    """See that Ray's processes may open as many files as they need; with fewer, a launch waits for ever.

    Raises:
        StoreError: the hard limit, which only root can raise, is too low.
    """
    needed = FILES + FILES_EACH * workers
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if resource.RLIM_INFINITY != hard < needed:
        raise StoreError(
            f"{needed} open files are needed for runs on {workers} processor{'s' * (workers != 1)}, "
            f"and {hard} are allowed (ulimit -Hn): raise that limit, or lower resources.concurrent"
        )
    if resource.RLIM_INFINITY != soft < needed:
        resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))


def _check_place(above: Path, excess: int) -> None:
    if excess > 0:
        raise StoreError(
            f"{above}: sockets of Ray in it would have names longer than {LONGEST} bytes: "
            f"set TMPDIR to a folder whose name is {excess} bytes shorter, such as /tmp"
        )
    mode = above.stat().st_mode
    if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
        raise StoreError(f"{above}: anybody may replace what lies there: chmod o-w it, or set TMPDIR to another folder")
