"""Yardsticks of learned scores: policies without learning and bounds, by task and name; nothing learns here."""

from collections.abc import Callable
from typing import Any

from torch import Generator, Tensor

from rhmc.yardsticks import coverage, navigation

Policy = Callable[[Any, Any, Generator], Tensor]  # configuration, state, generator -> actions
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
