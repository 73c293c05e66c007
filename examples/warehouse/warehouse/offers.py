"""What the task offers to be shown: its headlines, policies without learning, and a painter."""

from typing import Any

import torch
from torch import Generator, Tensor

from rhmc.yardsticks import Offers
from rhmc.yardsticks.joint import best_choice

OPEN, ROBOT, LINE = (200, 52, 44), (31, 119, 180), (205, 210, 216)  # colours


def random(cfg: Any, state: Any, rng: Generator) -> Tensor:
    """Every move alike."""
    return torch.randint(5, state.robots.shape[:2], generator=rng, device=rng.device)


def wait(cfg: Any, state: Any, rng: Generator) -> Tensor:
    """No move: only orders that appear under a robot are fetched."""
    return torch.zeros(state.robots.shape[:2], dtype=torch.int64, device=rng.device)


def nearest(cfg: Any, state: Any, rng: Generator) -> Tensor:
    """Each robot goes for its nearest order, also where another one is nearer to it."""
    return _go(state, _steps(state).argmin(-1))


def matching(cfg: Any, state: Any, rng: Generator) -> Tensor:
    """No two robots go for one order, as far as there are enough, and the sum of their ways is least; made anew at each
    step.
    """
    steps = _steps(state).float()
    single = torch.eye(steps.shape[-1], dtype=torch.bool, device=steps.device)
    return _go(state, best_choice(single.expand(*steps.shape, -1), steps))


def _steps(state: Any) -> Tensor:
    """Of each robot to each order: (B, N, M) int64."""
    return (state.orders.unsqueeze(1) - state.robots.unsqueeze(2)).abs().sum(-1)


def _go(state: Any, order: Tensor) -> Tensor:
    """The move towards an order, along the longer side of the way first. order: (B, N) int64 -> actions."""
    x, y = (state.orders.gather(1, order.unsqueeze(-1).expand(-1, -1, 2)) - state.robots).unbind(-1)
    along_x, along_y = torch.where(x > 0, 1, 2), torch.where(y > 0, 3, 4)
    return torch.where((x == 0) & (y == 0), 0, torch.where(x.abs() >= y.abs(), along_x, along_y))


def paint(brush: Any, scene: Any) -> None:
    """The grid's edge, orders as rings, robots as discs, and a line to each order that a robot is assigned to."""
    size = 1 + max(8, int(scene.state.robots.max()), int(scene.state.orders.max()))
    edge = [(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]
    brush.line(edge, LINE)
    robots, orders = (_places(cells[0], size) for cells in (scene.state.robots, scene.state.orders))
    for x, y in orders:
        brush.ring(x, y, 0.7 / size, OPEN)
    for i, j in scene.assignment.bool().nonzero().tolist() if scene.assignment is not None else ():
        brush.line([robots[i], orders[j]], ROBOT)
    for x, y in robots:
        brush.disc(x, y, 0.5 / size, ROBOT)


def _places(cells: Tensor, size: int) -> list[tuple[float, float]]:
    """Middles of cells in a square from -1 to 1."""
    return [(x, y) for x, y in ((2 * cells + 1) / size - 1).tolist()]


OFFERS = Offers(
    measures=("return", "age"),
    unit="orders fetched in an episode",
    policies={"random": random, "wait": wait, "nearest": nearest, "matching": matching},
    painter=paint,
    half_width=1.1,
)
