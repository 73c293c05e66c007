"""Errors that a user can mend, and the display of foreign text. Imports nothing heavy: every verb needs it."""

import errno
import os
import unicodedata

MOST = 50  # lines of a message
FULL = os.strerror(errno.EMFILE)
REMEDY = "raise the limit with `ulimit -n 4096`"
LONGEST = 2_000  # characters of a line


class InputError(Exception):
    """The input cannot be used. Each argument is a line of the message, meant for a person. Exit code 2.

    A line may hold names, paths and values as they were typed: `str` shows them by `visible`, so that nobody's file
    name moves the cursor, hides what follows, or adds a line of its own. Where the system has no room for another open
    file, it says what to do.
    """

    def __str__(self) -> str:
        more = [f"and {len(self.args) - MOST:,} more"] if len(self.args) > MOST else []
        text = "\n".join([*(_cut(visible(str(line))) for line in self.args[:MOST]), *more])
        return f"{text}: {REMEDY}" if FULL in text and REMEDY not in text else text


def visible(text: str) -> str:
    """The text with everything escaped that a terminal acts on or that cannot be seen.

    These are control characters (C0, DEL, C1), changes of direction, characters of no width, separators of lines and
    halves of surrogate pairs: all that Unicode does not call printable, but for blanks.
    """
    if text.isprintable():
        return text
    return "".join(c if seen(c) else c.encode("unicode_escape").decode() for c in text)


def visible_lines(text: str) -> str:
    """`visible`, but that lines stay lines."""
    return "\n".join(map(visible, text.split("\n")))


def seen(character: str) -> bool:
    """True if a character shows as itself."""
    return character.isprintable() or unicodedata.category(character) == "Zs"


def _cut(line: str) -> str:
    """The line without its middle, where it is long: place and reason stand at its ends."""
    half = LONGEST // 2
    return line if len(line) <= LONGEST else f"{line[:half]} … {line[-half:]}"
