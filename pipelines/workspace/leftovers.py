"""Files that are not finished carry their writer in their names, so that those of a killed process are swept.

A part lies beside what it will be (`runs.parquet.<host>-<pid>.part`), a scratch folder in the system's temporary folder
(`rhmc-<host>-<pid>-...`). Whoever writes the same thing again takes the parts of the dead away, and whoever needs
scratch the scratch. A writer on another machine cannot be asked and counts as living.
"""

import errno
import hashlib
import os
import shutil
import socket
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

PART = ".part"
ENDS = ("", "-journal")  # of a part, and of SQLite's beside it
SCRATCH = "rhmc-"
OWNER = ".owner"  # a file inside a folder whose name says nothing


HOST = hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]  # a name may be too long for a socket's path


def owner() -> str:
    """This process, in a name."""
    return f"{HOST}-{os.getpid()}"


def dead(writer: str) -> bool:
    """True if a process of this machine is gone; this one's own number means a former one, as in a new container."""
    host, _, number = writer.rpartition("-")
    if host != HOST or not number.isascii() or not number.isdigit():
        return False
    try:
        os.kill(int(number), 0)
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:  # somebody else's
        return False
    return int(number) == os.getpid()


def part_of(path: Path) -> Path:
    """The place where this process writes what is to become `path`; parts that dead processes left are removed.

    Raises:
        FileExistsError: a device, a pipe or a socket is there, which a rename would put an end to for all who use it.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise FileExistsError(errno.EEXIST, "a device, a named pipe or a socket is there", str(path))
    with suppress(OSError):  # no such folder, or a closed one
        for name in os.listdir(path.parent):
            writer, found, end = name.removeprefix(f"{path.name}.").partition(PART)
            if name.startswith(f"{path.name}.") and found and end in ENDS and dead(writer):
                remove(path.with_name(name))
    return path.with_name(f"{path.name}.{owner()}{PART}")


def remove(path: Path) -> None:
    """Remove a file or a folder, as far as possible."""
    with suppress(OSError):
        if stat.S_ISDIR(path.lstat().st_mode):
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink()


@contextmanager
def scratch() -> Iterator[Path]:
    """A folder for the length of a block, in which libraries make their temporary files as well."""
    sweep_scratch()
    before = tempfile.tempdir
    with tempfile.TemporaryDirectory(prefix=f"{SCRATCH}{owner()}-", ignore_cleanup_errors=True) as folder:
        tempfile.tempdir = folder
        try:
            yield Path(folder)
        finally:
            tempfile.tempdir = before


@cache  # once in a process: none of its own can be dead
def sweep_scratch() -> None:
    """Remove the scratch folders of processes that are gone."""
    for folder in _own(Path(tempfile.gettempdir()), f"{SCRATCH}*-*-*"):
        if dead(folder.name.removeprefix(SCRATCH).rpartition("-")[0]):
            remove(folder)


def claim(folder: Path) -> None:
    """Say in a folder whose it is, for `sweep_claimed`."""
    (folder / OWNER).write_text(owner(), encoding="utf-8")


def sweep_claimed(parent: Path, pattern: str) -> None:
    """Remove the folders of a pattern that a process has claimed which is gone."""
    for folder in _own(parent, pattern):
        with suppress(OSError, UnicodeDecodeError):
            if dead((folder / OWNER).read_text(encoding="utf-8")):
                remove(folder)


def _own(parent: Path, pattern: str) -> Iterator[Path]:
    """This user's folders: others may write to a shared place as well, under whatever names."""
    for folder in parent.glob(pattern):
        with suppress(OSError):
            found = folder.lstat()
            if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid():
                yield folder
