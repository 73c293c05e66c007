"""Warehouse: robots on a grid fetch orders; an order that is fetched is replaced by a new one at a cell drawn anew.

An order is fetched by a robot that stands on its cell after a step; several that do fetch it once. Robots do not block
each other. Lengths in cells, along the grid's lines (|dx| + |dy|), time in steps. Pure functions of a configuration and
a frozen state (`rhmc.envs.base.Physics`). Shape letters: B copies, N robots, M orders.
"""

import sys
from typing import Literal, NamedTuple

import torch
from pydantic import Field
from torch import Generator, Tensor
from torch.nn.functional import embedding

from rhmc.envs import EnvConfig, Task, register_task
from rhmc.envs.base import Outcome
from rhmc.types import Local, Obs, Spec
from rhmc.yardsticks import register_offers
from warehouse.offers import OFFERS

MOVES = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))  # by action
CLOSER = 0.1  # local score of one cell nearer to an order, where fetching it scores 1


class Config(EnvConfig):
    """Settings."""

    kind: Literal["warehouse"] = "warehouse"
    agents: int = Field(3, ge=1, description="robots")
    targets: int = Field(4, ge=1, description="open orders")
    size: int = Field(9, ge=2, le=100, description="cells along a side")
    episode: int = Field(40, ge=1)
    observation: Literal["shared"] = "shared"


class State(NamedTuple):
    """A batch of grids; a step makes a new one."""

    robots: Tensor  # (B, N, 2) int64, cells from 0
    orders: Tensor  # (B, M, 2) int64, those that are open
    fetched: Tensor  # (B, N, M) bool: robot i fetched in the last step what was order j then
    closer: Tensor  # (B, N, M) int64, cells that robot i came nearer to it in that step
    age: Tensor  # (B, M) int64, steps that an order has been open
    steps: Tensor  # (B,) int64


def spec(cfg: Config) -> Spec:
    """Sizes for the networks."""
    sizes = {"agent_features": 2, "pair_features": 4, "peer_features": 2}
    return Spec(cfg.agents, cfg.targets, **sizes, actions=len(MOVES), continuous=False, episode=cfg.episode)


def initial(cfg: Config, batch: int, rng: Generator) -> State:
    """Draw `batch` starts: every robot and every order at any cell alike."""
    n, m, dev = cfg.agents, cfg.targets, rng.device
    cells = torch.randint(cfg.size, (batch, n + m, 2), generator=rng, device=dev)
    none = torch.zeros(batch, n, m, dtype=torch.int64, device=dev)
    age, steps = none[:, 0], torch.zeros(batch, dtype=torch.int64, device=dev)
    return State(cells[:, :n], cells[:, n:], none > 0, none, age, steps)


def transition(cfg: Config, state: State, action: Tensor, rng: Generator) -> State:
    """Move all robots at once, stopped by the walls; then replace the orders that were fetched.

    action: (B, N) int64 by `MOVES`. Every order draws a cell at every step, so that draws do not depend on actions.
    """
    moves = torch.tensor(MOVES, device=action.device)
    robots = (state.robots + embedding(action, moves)).clamp(0, cfg.size - 1)
    distance = distances(robots, state.orders)
    fetched = distance == 0
    gone = fetched.any(1)
    fresh = torch.randint(cfg.size, state.orders.shape, generator=rng, device=rng.device)
    orders = torch.where(gone.unsqueeze(-1), fresh, state.orders)
    closer = distances(state.robots, state.orders) - distance
    return State(robots, orders, fetched, closer, torch.where(gone, 0, state.age + 1), state.steps + 1)


def outcome(cfg: Config, state: State, action: Tensor, assignment: Tensor | None) -> Outcome:
    """The team's reward: orders fetched. A pair's score: 1 where fetched, and `CLOSER` for each cell nearer."""
    pairs = state.fetched.float() + CLOSER * state.closer
    fetched = state.fetched.any(1).float().sum(-1)
    info = {"fetched": fetched, "age": state.age.float().mean(-1)}
    return Outcome(fetched, Local(pairs, torch.zeros(action.shape, device=action.device)), state.fetched, info)


def observe(cfg: Config, state: State) -> Obs:
    """All lengths over the grid's side.

    Own: the cell. Of an order: where it is from here (x, y), its distance, and that of the nearest other robot to it
    (2, as far as there is, with none). Of another robot: where it is from here.
    """
    distance = distances(state.robots, state.orders)
    parts = [_from(state.robots, state.orders), distance.unsqueeze(-1), _nearest_other(cfg, distance).unsqueeze(-1)]
    peers = _from(state.robots, state.robots)
    own, pairs = state.robots / cfg.size, torch.cat(parts, -1) / cfg.size
    return Obs(own, pairs, peers / cfg.size, state.steps == 0)


def options(cfg: Config, state: State, horizon: int) -> Tensor:
    """Orders that each robot could fetch within `horizon` steps on its way to each order.

    Option d completes order j if the way to j and from there to d takes at most `horizon` steps: an upper bound where
    three orders do not lie on one way. Orders stand still; where new ones will appear is not known. An order under a
    robot takes a step as well, of waiting.

    Returns:
        (B, N, D, M) bool with D = M.
    """
    first = distances(state.robots, state.orders).clamp(min=1)
    then = distances(state.orders, state.orders)
    return first.unsqueeze(2) + then.unsqueeze(1) <= horizon


def summary(cfg: Config, reward: Tensor, info: dict[str, Tensor]) -> dict[str, Tensor]:
    """Of each episode: orders fetched, and the mean age in steps of the open orders. (T, B) each -> (B,) each."""
    return {"return": reward.sum(0), "age": info["age"].mean(0)}


def distances(origin: Tensor, cells: Tensor) -> Tensor:
    """Steps from each origin to each cell: (B, N, 2), (B, M, 2) int64 -> (B, N, M) int64."""
    return _from(origin, cells).abs().sum(-1)


def _from(origin: Tensor, cells: Tensor) -> Tensor:
    return cells.unsqueeze(1) - origin.unsqueeze(2)


def _nearest_other(cfg: Config, distance: Tensor) -> Tensor:
    """Steps of the nearest other robot to each order, 2 `size` with none. (B, N, M) -> the same."""
    if cfg.agents == 1:
        return torch.full_like(distance, 2 * cfg.size)
    first, second = distance.topk(2, 1, largest=False).values.split(1, 1)
    return torch.where(distance == first, second, first)


register_task("warehouse", Task(Config, sys.modules[__name__]))
register_offers("warehouse", OFFERS)
