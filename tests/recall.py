"""A tiny task that only memory solves: each agent sees a cue in the first step, and is paid for it in the last.

A physics for `rhmc.envs.base.Env`. Whoever has forgotten the cue earns 1/2 on average, whatever it does.
"""

from typing import Literal, NamedTuple

import torch
from pydantic import Field
from torch import Generator, Tensor

from rhmc.envs.base import EnvConfig, Outcome
from rhmc.types import Local, Obs, Spec

EPISODE = 4


class Config(EnvConfig):
    kind: Literal["recall"] = "recall"
    agents: int = Field(2, ge=1)
    observation: Literal["paper"] = "paper"


class State(NamedTuple):
    cue: Tensor  # (B, N) int64, 0 or 1
    steps: Tensor  # (B,) int64


def spec(cfg: Config) -> Spec:
    return Spec(cfg.agents, 1, 0, 2, 0, 2, False, EPISODE)


def initial(cfg: Config, batch: int, rng: Generator) -> State:
    cue = torch.randint(2, (batch, cfg.agents), generator=rng)
    return State(cue, torch.zeros(batch, dtype=torch.int64))


def transition(cfg: Config, state: State, action: Tensor, rng: Generator) -> State:
    return State(state.cue, state.steps + 1)


def observe(cfg: Config, state: State) -> Obs:
    """The cue as 1 or -1 in the first step, else 0; and how far the episode is."""
    b, n = state.cue.shape
    first = state.steps == 0
    shown = (2.0 * state.cue - 1) * first.unsqueeze(-1)
    clock = (state.steps / EPISODE).unsqueeze(-1).expand(b, n)
    pairs = torch.stack((shown, clock), -1).unsqueeze(2)
    return Obs(torch.zeros(b, n, 0), pairs, torch.zeros(b, n, n, 0), first)


def outcome(cfg: Config, state: State, action: Tensor, assignment: Tensor | None) -> Outcome:
    """In the last step the share of agents that name their cue."""
    right = (action == state.cue) & (state.steps == EPISODE).unsqueeze(-1)
    share = right.float().mean(-1)
    return Outcome(share, Local(right.float().unsqueeze(-1), torch.zeros(action.shape)), right.unsqueeze(-1), {})


def options(cfg: Config, state: State, horizon: int) -> Tensor:
    return torch.ones(len(state.steps), cfg.agents, 1, 1, dtype=torch.bool)


def summary(cfg: Config, reward: Tensor, info: dict[str, Tensor]) -> dict[str, Tensor]:
    return {"return": reward.sum(0)}
