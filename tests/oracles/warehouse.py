"""The task of `examples/warehouse`, one world at a time in plain Python: slow, to be read beside the rules."""

from dataclasses import dataclass
from itertools import product

Cell = tuple[int, int]
MOVE = {0: (0, 0), 1: (1, 0), 2: (-1, 0), 3: (0, 1), 4: (0, -1)}


@dataclass(frozen=True)
class World:
    """The cells of robots and orders, and for how many steps each order has been open."""

    robots: list[Cell]
    orders: list[Cell]
    age: list[int]


def away(a: Cell, b: Cell) -> int:
    """Steps from one cell to another."""
    return abs(a[0] - b[0]) + abs(a[1] - b[1])


def moved(cell: Cell, action: int, size: int) -> Cell:
    """The cell after a step; walls stop it."""
    x, y = cell[0] + MOVE[action][0], cell[1] + MOVE[action][1]
    return min(max(x, 0), size - 1), min(max(y, 0), size - 1)


def step(world: World, actions: list[int], fresh: list[Cell], size: int) -> tuple[World, list[list[bool]]]:
    """The world after a step, and which robot fetched which order; a fetched order goes where `fresh` has it."""
    robots = [moved(cell, action, size) for cell, action in zip(world.robots, actions, strict=True)]
    fetched = [[robot == order for order in world.orders] for robot in robots]
    orders, age = [], []
    for j, order in enumerate(world.orders):
        gone = any(row[j] for row in fetched)
        orders.append(fresh[j] if gone else order)
        age.append(0 if gone else world.age[j] + 1)
    return World(robots, orders, age), fetched


def scores(before: World, after: World) -> list[list[float]]:
    """The local score of each robot on each order that was open: a tenth for each cell nearer, 1 where it is there."""
    rows = []
    for old, new in zip(before.robots, after.robots, strict=True):
        rows.append([0.1 * (away(old, order) - away(new, order)) + (new == order) for order in before.orders])
    return rows


def pair(world: World, i: int, j: int, size: int) -> list[float]:
    """The observation of robot i about order j."""
    (x, y), order = world.robots[i], world.orders[j]
    others = [away(cell, order) for k, cell in enumerate(world.robots) if k != i]
    numbers = [order[0] - x, order[1] - y, away((x, y), order), min(others, default=2 * size)]
    return [number / size for number in numbers]


def visits(world: World, i: int, horizon: int, size: int) -> list[list[int]]:
    """For every sequence of moves of robot i: the orders that it comes to stand on, in the order of time.

    Orders on one cell come in both directions.
    """
    found = []
    for actions in product(MOVE, repeat=horizon):
        cell, seen = world.robots[i], []
        for action in actions:
            cell = moved(cell, action, size)
            here = [j for j, order in enumerate(world.orders) if order == cell]
            seen += [*here, *reversed(here)]
        found.append(seen)
    return found
