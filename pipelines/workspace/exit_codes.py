"""The exit codes of the command `rhmc`, all of them: docs/cli.md lists what each verb means by them."""

from enum import IntEnum


class Exit(IntEnum):
    """The answer of a verb to a script."""

    DONE = 0  # all of it
    BROKEN = 1  # a fault of the program, which shows its traceback; or of the server it started, or of its output
    BAD = 2  # bad input or environment error: a line on stderr for each fault, nothing was started
    UNFINISHED = 3  # half of it: a run failed or is missing, a figure could not be drawn; what is done is kept
    NO = 4  # it is done, and the answer is no: results differ, an older run is refused, an installation has a fault
    INTERRUPTED = 130  # 128 + SIGINT; the same command continues
    TERMINATED = 143  # 128 + SIGTERM; the same command continues
