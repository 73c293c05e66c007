"""Yardsticks of learned scores, and what else a task offers to be shown, by task and name; nothing learns here."""

from collections.abc import Callable
from typing import Any

from torch import Tensor

from rhmc.registry import register
from rhmc.yardsticks import coverage, navigation
from rhmc.yardsticks.offers import OFFERS, Offers, Policy, offered

Bound = Callable[[Any, Any], Tensor]  # configuration, state -> (B,) score of the present step

POLICIES: dict[str, dict[str, Policy]] = {
    "coverage": {
        "random": coverage.random,
        "hold": coverage.hold,
        "nearest": coverage.nearest,
        "mean_all": coverage.mean_all,
        "best_window": coverage.best_window,
        "joint_one_step": coverage.joint_one_step,
        "set_point": coverage.set_point,
        "planner": coverage.planner,
    },
    "navigation": {
        "random": navigation.random,
        "hold": navigation.hold,
        "nearest": navigation.nearest,
        "matching": navigation.matching,
    },
}
BOUNDS: dict[str, dict[str, Bound]] = {
    "coverage": {"free_heading_bound": coverage.free_heading_bound, "range_bound": coverage.range_bound},
    "navigation": {},
}


def register_offers(kind: str, offers: Offers) -> None:
    """Say what a task offers beside its physics; its page calls this once.

    Raises:
        ValueError: another entry has the kind.
    """
    register(OFFERS, kind, offers)
    POLICIES[kind], BOUNDS[kind] = dict(offers.policies), {}
