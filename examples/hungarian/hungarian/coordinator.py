"""Hungarian: RHMC's coordinator is replaced by the assignment with the least sum of distances; executors learn as ever.

Every target is assigned to one agent, and no agent has more than the M / N targets, rounded up, that this takes.
Where agents are more than targets some have none. The distances are those that the agents observe (`COSTS`), so the
coordinator knows no more than a learned one.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Generator, Tensor

from rhmc.envs import coverage
from rhmc.hierarchy.coordinator import Coordination, register_coordinator
from rhmc.learning.learner import Learners
from rhmc.types import Batch, Obs, Spec, State


def fourth(pairs: Tensor) -> Tensor:
    """Coverage, all its observations: the distance of sensor and target, in 2000 m. (B, N, M, F) -> (B, N, M)."""
    return pairs[..., 3]


def length(pairs: Tensor) -> Tensor:
    """Navigation, both its observations: the length of the way (x, y) to the landmark. (B, N, M, F) -> (B, N, M)."""
    return torch.hypot(pairs[..., 0], pairs[..., 1])


Sizes = tuple[int, int, int]  # features of an agent, of a pair, of a peer: they tell the observations apart
COSTS: dict[Sizes, Callable[[Tensor], Tensor]] = {
    **{(0, features, 0): fourth for features in coverage.FEATURES.values()},
    (4, 2, 2): length,
    (4, 5, 5): length,
}


class Hungarian:
    """See the module; the interface is `rhmc.hierarchy.coordinator.HighLevel`."""

    def __init__(self, cfg: Any, spec: Spec, rng: Generator) -> None:
        self.cost = COSTS[sizes(spec)]

    def assign(self, obs: Obs, rng: Generator, *, explore: bool) -> Tensor:
        """The cheapest assignment (B, N, M), whether exploring or not."""
        return cheapest(self.cost(obs.pairs))

    def observe(self, rows: Batch) -> None:
        """Nothing is learned."""

    def update(self, rows: Batch) -> Batch:
        """Nothing is learned."""
        return {}

    def learners(self) -> Learners:
        """None."""
        return []

    def state_dict(self) -> State:
        """Nothing is remembered."""
        return {}

    def load_state_dict(self, state: State) -> None:
        """Nothing is remembered."""


def cheapest(cost: Tensor) -> Tensor:
    """Of the assignments of every target to one agent, with loads as even as the module says, the cheapest.

    Args:
        cost: (B, N, M), finite.

    Returns:
        (B, N, M) float, 0 or 1.
    """
    batch, agents, targets = cost.shape
    rows = cost.repeat(1, -(-targets // agents), 1).cpu().numpy()  # an agent stands for each target that it may have
    row, target = torch.from_numpy(np.array([linear_sum_assignment(table) for table in rows])).unbind(1)
    assignment = torch.zeros(batch, agents, targets)
    assignment[torch.arange(batch).unsqueeze(-1), row % agents, target] = 1
    return assignment.to(cost.device)


def sizes(spec: Spec) -> Sizes:
    """The key of `COSTS`."""
    return spec.agent_features, spec.pair_features, spec.peer_features


def misfit(spec: Spec) -> str:
    """Reason that the distances of a task are not known here; empty if they are."""
    if sizes(spec) in COSTS:
        return ""
    return (
        "observation: 'hungarian' knows the distances in coverage and navigation alone (`hungarian.coordinator.COSTS`)"
    )


register_coordinator("hungarian", Coordination(Hungarian, misfit))
