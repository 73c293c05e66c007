"""Output that is only looked at: a description, a picture, a line on the board. A failure never ends a launch."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from pipelines.workspace.work_folder import one_line

EPISODE, WHY_NOT = "episode.gif", "episode.txt"  # what a run keeps: an animation, or why there is none


@contextmanager
def decoration(what: str, say: Callable[[str], None]) -> Iterator[None]:
    """Go on where `what` fails, and say so in one line; if that cannot be said either, go on all the same."""
    try:
        yield
    except Exception as error:
        with suppress(Exception):
            say(f"{what}: left out ({type(error).__name__}: {one_line(error)})")
