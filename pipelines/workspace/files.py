"""Files that a person names: what can be read to its end is a regular file, anything else may wait or never end."""

import os
import stat
from pathlib import Path

from pipelines.workspace.errors import InputError

ABSENT = "no such file"
KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def regular(path: Path, what: str = "", *, absent: bool = False) -> Path:
    """The path, if it is a file that can be read.

    Args:
        path: as it was given; links are followed.
        what: of which option or key, for the message.
        absent: there may be none.

    Raises:
        InputError: it is not, with the reason.
    """
    fault = fault_of(path)
    if fault and not (absent and fault == ABSENT):
        raise InputError(f"{what}: {path}: {fault}" if what else f"{path}: {fault}")
    return path


def fault_of(path: Path) -> str:
    """The reason why a path is no readable file; nothing if it is one. Opens nothing: that may wait for ever."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return ABSENT
    except (OSError, ValueError) as error:  # a loop of links, a name that is too long or holds a zero byte
        return getattr(error, "strerror", None) or str(error)
    if not stat.S_ISREG(mode):
        return f"{KINDS.get(stat.S_IFMT(mode), 'something else')}, and a regular file is needed"
    return "" if os.access(path, os.R_OK) else "not readable: change its rights"
