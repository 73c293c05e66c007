"""Types that environments and algorithms share.

Shape letters: B environments, N agents, M targets, D options of an agent (regulator), F features.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict
from torch import Tensor

Metrics = dict[str, float]
Batch = dict[str, Tensor]
Carry = Batch  # what an acting policy remembers between steps, tensors with leading B
State = dict[str, Any]  # a checkpoint: only dicts, lists, tensors, numbers and strings


class Frozen(BaseModel):
    """A configuration: immutable, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Spec(NamedTuple):
    """Sizes of a task, all that a network needs to be built.

    `actions` counts the discrete actions of an agent, or the dimensions of a continuous one in [-1, 1].
    """

    agents: int
    targets: int
    agent_features: int
    pair_features: int
    peer_features: int
    actions: int
    continuous: bool
    episode: int  # steps


class Obs(NamedTuple):
    """Observations of all agents. Row i of each tensor is all that agent i may use when it acts alone."""

    agents: Tensor  # (B, N, Fa) own features
    pairs: Tensor  # (B, N, M, Fp) agent i about target j
    peers: Tensor  # (B, N, N, Fo) agent i about agent k; zeros where i = k; Fo may be 0
    first: Tensor  # (B,) bool, the first observation of an episode


class Local(NamedTuple):
    """Local reward in parts, so that it can be formed for any assignment (`assigned_reward`)."""

    pairs: Tensor  # (B, N, M) score of agent i on target j
    agents: Tensor  # (B, N) what agent i gets whatever its assignment (rotation cost, collisions)


class Step(NamedTuple):
    """Outcome of one step of B environments. `obs` is already reset where an episode ended."""

    obs: Obs
    final_obs: Obs  # the true successor observation: differs from `obs` exactly where an episode ended
    reward: Tensor  # (B,) team reward
    local: Local
    completed: Tensor  # (B, N, M) bool, agent i completes target j now (sees it, stands on it)
    terminated: Tensor  # (B,) bool, the task ended: no bootstrap
    truncated: Tensor  # (B,) bool, the time limit ended the episode: bootstrap
    info: dict[str, Tensor]  # (B,) each, logged per step


class Transition(NamedTuple):
    """One acted step as an algorithm gets it. `next_obs` is the true successor (`Step.final_obs`).

    `options(horizon)` is the (B, N, D, M) table of what each agent could complete from the state before the step;
    it is computed when called.
    """

    obs: Obs
    action: Tensor  # (B, N) int64, or (B, N, A) float
    reward: Tensor
    local: Local
    completed: Tensor
    terminated: Tensor
    truncated: Tensor
    next_obs: Obs
    options: Callable[[int], Tensor]
    extra: Batch  # what `act` handed out beside the action (an assignment, a log-probability), (B, ...)


def assigned_reward(local: Local, assignment: Tensor) -> Tensor:
    """Local reward of each agent under an assignment: mean over its assigned targets, 0 with none, plus its own part.

    Args:
        local: scores (B, N, M) and own part (B, N).
        assignment: (B, N, M), 0 or 1.

    Returns:
        (B, N).
    """
    chosen = assignment.to(local.pairs.dtype)
    return (local.pairs * chosen).sum(-1) / chosen.sum(-1).clamp(min=1) + local.agents
