"""A tiny task with a known optimum: agents turn on a ring of headings, a target is completed by who faces it.

A physics for `rhmc.envs.base.Env`. Targets stand still for an episode, so that an agent does best to turn to a target
by the shortest way and stay; `own_target` is what they earn when agent i does so with target i.
"""

from math import pi
from typing import Literal, NamedTuple

import torch
from pydantic import Field
from torch import Generator, Tensor

from rhmc.envs.base import EnvConfig, Outcome
from rhmc.types import Local, Obs, Spec

HEADINGS = 6
TURNS = (0, 1, -1)  # by action
EPISODE = 6


class Config(EnvConfig):
    """Sizes of the task."""

    kind: Literal["toy"] = "toy"
    agents: int = Field(2, ge=1)
    targets: int = Field(2, ge=1)
    observation: Literal["paper"] = "paper"


class State(NamedTuple):
    """A batch of rings."""

    bearing: Tensor  # (B, N, M) int64, turns to the left that agent i is away from facing target j
    steps: Tensor  # (B,) int64


def own_target() -> float:
    """Mean reward when agent i goes for target i by the shortest way and stays: first to face it at step max(d, 1)."""
    away = [min(d, HEADINGS - d) for d in range(HEADINGS)]
    return sum(EPISODE + 1 - max(d, 1) for d in away) / (HEADINGS * EPISODE)


def spec(cfg: Config) -> Spec:
    """Sizes for the networks."""
    return Spec(cfg.agents, cfg.targets, 0, 4, 0, len(TURNS), False, EPISODE)


def initial(cfg: Config, batch: int, rng: Generator) -> State:
    """Draw `batch` starts."""
    bearing = torch.randint(HEADINGS, (batch, cfg.agents, cfg.targets), generator=rng)
    return State(bearing, torch.zeros(batch, dtype=torch.int64))


def transition(cfg: Config, state: State, action: Tensor, rng: Generator) -> State:
    """Turn. action: (B, N) in {0 stay, 1 left, 2 right}."""
    turned = state.bearing - torch.tensor(TURNS)[action].unsqueeze(-1)
    return State(turned % HEADINGS, state.steps + 1)


def outcome(cfg: Config, state: State, action: Tensor, assignment: Tensor | None) -> Outcome:
    """Share of targets that somebody faces; the local score is 1 for each target faced."""
    faced = state.bearing == 0
    share = faced.any(1).float().mean(-1)
    return Outcome(share, Local(faced.float(), torch.zeros(action.shape)), faced, {"faced": share})


def observe(cfg: Config, state: State) -> Obs:
    """Bearing as sine and cosine, and the place of the agent and the target in their order."""
    angle = state.bearing * (2 * pi / HEADINGS)
    b, n, m = angle.shape
    i = (torch.arange(n) / n).view(1, n, 1).expand(b, n, m)
    j = (torch.arange(m) / m).view(1, 1, m).expand(b, n, m)
    pairs = torch.stack((angle.sin(), angle.cos(), i, j), -1)
    return Obs(torch.zeros(b, n, 0), pairs, torch.zeros(b, n, n, 0), state.steps == 0)


def options(cfg: Config, state: State, horizon: int) -> Tensor:
    """The targets that each agent would face after each turn of up to `horizon`: (B, N, 2 horizon + 1, M) bool."""
    turns = torch.arange(-horizon, horizon + 1).view(1, 1, -1, 1)
    return (state.bearing.unsqueeze(2) - turns) % HEADINGS == 0


def summary(cfg: Config, reward: Tensor, info: dict[str, Tensor]) -> dict[str, Tensor]:
    """Mean reward per step of each episode."""
    return {"return": reward.mean(0), "faced": info["faced"].mean(0)}
