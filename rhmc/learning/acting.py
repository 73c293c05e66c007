"""The part of a method's state that acting needs, where a method says so.

No run depends on it, so it stands apart from the method's entry, which is part of what names a run.
"""

from collections.abc import Callable

from rhmc.types import State

ActsOn = Callable[[State], State]

ACTS_ON: dict[
    str, ActsOn
] = {}  # by kind; a method that is not here keeps a replay or a rollout of `rhmc.learning`, or none


def register_acting(kind: str, acts_on: ActsOn) -> None:
    """Say what is left of a method's state for a policy; its page calls this once.

    Raises:
        ValueError: another function has the kind.
    """
    if ACTS_ON.setdefault(kind, acts_on) != acts_on:
        raise ValueError(f"'{kind}' says already what it acts on")
