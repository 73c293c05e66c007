"""Text in and out, the same on every machine: UTF-8 whatever the locale, and a reader that leaves ends nothing."""

import io
import locale
import os
import sys
from typing import IO, Any

UTF8 = ("utf-8", "utf8")


def settle() -> None:
    """Once, before anything is read or printed.

    File names, the text of subprocesses and of libraries follow the interpreter's own encoding, which cannot be changed
    once it runs: where the locale is not UTF-8 the program starts anew in Python's UTF-8 mode, as its workers then do.
    """
    if not sys.flags.utf8_mode and not _speaks_utf8():
        os.environ["PYTHONUTF8"] = "1"
        os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])
    sys.stdout, sys.stderr = patient(sys.stdout, 1), patient(sys.stderr, 2)


def _speaks_utf8() -> bool:
    """True if names of files and the content of texts are UTF-8 unless somebody says otherwise."""
    return sys.getfilesystemencoding().lower() in UTF8 and locale.getencoding().lower() in UTF8


def patient(stream: IO[str] | None, number: int) -> IO[str]:
    """A standard stream that takes everything: letters that it cannot say are escaped, a reader that left is no error.

    Args:
        stream: as Python made it; None where it was closed from the start. One of somebody else's stays.
        number: of its descriptor.
    """
    if not isinstance(stream, io.TextIOWrapper) or not _is(stream, number):
        return stream or open(os.devnull, "w", encoding="utf-8")
    stream.flush()
    raw = Abandoned(number, "wb", closefd=False)
    lines = stream.line_buffering
    return io.TextIOWrapper(io.BufferedWriter(raw), stream.encoding, "backslashreplace", line_buffering=lines)


def _is(stream: IO[str], number: int) -> bool:
    """True if a stream is that of a descriptor, and not what somebody has put in its place."""
    try:
        return stream.fileno() == number
    except (OSError, ValueError):
        return False


class Abandoned(io.FileIO):
    """A descriptor that may be lost: its reader goes, as in `rhmc study list | head -1`, or its disk is full.

    What comes afterwards is dropped, and the program goes on to its own end and exit code: a launch does not lose its
    results to a pager.
    """

    lost = ""  # why, where it is a fault

    def write(self, data: Any, /) -> int:
        """As of a file, but that nothing has to take it."""
        try:
            return super().write(data)
        except BlockingIOError:
            raise
        except OSError as error:
            self.lost = "" if isinstance(error, BrokenPipeError) else error.strerror or str(error)
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())  # for processes that are started later as well
            os.close(nowhere)
            return memoryview(data).nbytes


def lost() -> str:
    """The reason why the output on stdout is not complete; nothing if it is, or if nobody wanted more of it."""
    sys.stderr.flush()
    sys.stdout.flush()
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    return raw.lost if isinstance(raw, Abandoned) else ""
