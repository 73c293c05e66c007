"""Offers of a task beside its physics: its headlines, its policies without learning, and how it is drawn.

None of it decides a run. What a task leaves out is left out where it would be shown.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from torch import Generator, Tensor

Policy = Callable[[Any, Any, Generator], Tensor]  # configuration, state, generator -> actions


class Offers(NamedTuple):
    """An entry of the table. `painter(brush, scene)` draws with the `Brush` of `pipelines.policies.animation`."""

    measures: tuple[str, ...] = ("return",)  # of its `summary`, those that come first, in this order
    unit: str = "as the task defines it"  # of its return, in words
    score: str = "return"  # the measure whose standard error is stated of a yardstick
    policies: Mapping[str, Policy] = {}  # by name
    painter: Callable[[Any, Any], None] | None = None
    half_width: float = 1.0  # of what a painter shows, in the task's coordinates


OFFERS: dict[str, Offers] = {  # by kind; the policies of these two are in the table of the package
    "coverage": Offers(("return", "coverage"), "100 × mean reward per step", "coverage"),
    "navigation": Offers(("return", "landmarks_covered", "collisions"), "sum over an episode"),
}


def offered(kind: str) -> Offers:
    """Offers of a task; of one that says nothing, its return."""
    return OFFERS.get(kind, Offers())
