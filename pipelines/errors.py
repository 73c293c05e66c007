"""What a user can mend. Imports nothing heavy, so that the command line can catch it before anything is loaded."""

import errno
import os

FULL = os.strerror(errno.EMFILE)
REMEDY = "raise the limit with `ulimit -n 4096`"


class InputError(Exception):
    """What was given cannot be used; the text is the whole message, meant for a person. Exit code 2."""

    def __str__(self) -> str:
        """The message; where the system has no room for another open file, with what to do."""
        text = super().__str__()
        return f"{text}: {REMEDY}" if FULL in text and REMEDY not in text else text
