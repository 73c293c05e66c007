"""Sensor coverage, one world at a time in plain Python floats: slow, and meant to be read beside the rules.

Chance comes in from outside as uniform numbers in [0, 1), four for each decision of a target.
"""

import math
from dataclasses import dataclass, field

Point = tuple[float, float]
Draws = list[float]  # goal x, goal y, base speed, jitter
TURN_OF = {0: 0.0, 1: 5.0, 2: -5.0}


@dataclass
class Target:
    """A target that walks to a goal."""

    position: Point
    goal: Point
    speed: float
    counter: int = 0
    visited: list[Point] = field(default_factory=list)  # where it stood at its decisions, latest last

    def decide(self, draws: Draws, dt: float) -> Point:
        """The point where it wants to go now. Asked again at the same place it has not moved, and chooses another."""
        self.counter += 1
        moved = min((math.dist(self.position, p) for p in self.visited[-2:]), default=30.0)
        self.visited.append(self.position)
        if math.dist(self.position, self.goal) < 5 or moved < 10 or self.counter > 100:
            self.goal = (math.floor(2500 * draws[0]) - 1250.0, math.floor(2500 * draws[1]) - 1250.0)
            self.speed = 50.0 + math.floor(50 * draws[2])
            self.counter = 0
        length = self.speed * (1 + 0.2 * draws[3]) * dt
        far = max(math.dist(self.position, self.goal), 1e-6)
        x, y = self.position
        return x + (self.goal[0] - x) / far * length, y + (self.goal[1] - y) / far * length


@dataclass
class World:
    """Fixed sensors with headings in degrees, and targets."""

    sensors: list[Point]
    headings: list[float]
    targets: list[Target]

    def bearing(self, i: int, j: int) -> float:
        """Of target j from sensor i, relative to its heading, in [-180, 180)."""
        (x, y), (tx, ty) = self.sensors[i], self.targets[j].position
        return wrapped(math.degrees(math.atan2(ty - y, tx - x)) - self.headings[i])

    def distance(self, i: int, j: int) -> float:
        """From sensor i to target j."""
        return math.dist(self.sensors[i], self.targets[j].position)

    def sees(self, i: int, j: int) -> bool:
        """True if target j is in the field of view of sensor i."""
        return -45 < self.bearing(i, j) < 45 and self.distance(i, j) <= 800

    def turn(self, actions: list[int]) -> None:
        """Turn every sensor: 0 stays, 1 turns left, 2 turns right."""
        self.headings = [wrapped(h + TURN_OF[a]) for h, a in zip(self.headings, actions, strict=True)]


def wrapped(degrees: float) -> float:
    """The same direction in [-180, 180)."""
    while degrees >= 180:
        degrees -= 360
    while degrees < -180:
        degrees += 360
    return degrees


def inside(point: Point) -> bool:
    """True if a target may be here."""
    return max(abs(point[0]), abs(point[1])) <= 1250


def coverage(world: World) -> float:
    """Share of targets that a sensor sees."""
    n, m = len(world.sensors), len(world.targets)
    return sum(any(world.sees(i, j) for i in range(n)) for j in range(m)) / m


def global_reward(world: World, penalty: float, own: list[list[bool]]) -> float:
    """Coverage, or minus the penalty if no sensor sees a target j with own[i][j]."""
    if any(mine and world.sees(i, j) for i, row in enumerate(own) for j, mine in enumerate(row)):
        return coverage(world)
    return -penalty if penalty else coverage(world)


def local_reward(world: World, i: int, action: int, own: list[bool]) -> float:
    """Sensor i's mean score on its own targets, less the price of a turn."""
    scores = []
    for j, mine in enumerate(own):
        if mine:
            scores.append(1 - abs(world.bearing(i, j)) / 45 if world.sees(i, j) else -1.0)
    mean = sum(scores) / len(scores) if scores else 0.0
    return mean - (0.01 if action else 0.0)


def paper_features(world: World, i: int, j: int) -> list[float]:
    """The observation of sensor i in the paper about target j."""
    n, m = len(world.sensors), len(world.targets)
    return [i / n, j / m, world.bearing(i, j) / 180, world.distance(i, j) / 2000]


def extended_features(world: World, i: int, j: int) -> list[float]:
    """The richer description, by vectors instead of angles where that is possible."""
    (x, y), (tx, ty) = world.sensors[i], world.targets[j].position
    far = world.distance(i, j)
    ray = ((tx - x) / far, (ty - y) / far)
    axis = (math.cos(math.radians(world.headings[i])), math.sin(math.radians(world.headings[i])))
    before = world.targets[j].visited[-1] if world.targets[j].visited else (tx, ty)
    move = ((tx - before[0]) / 30, (ty - before[1]) / 30)
    others = [k for k in range(len(world.sensors)) if k != i]
    return [
        axis[0] * ray[1] - axis[1] * ray[0],
        axis[0] * ray[0] + axis[1] * ray[1],
        abs(world.bearing(i, j)) / 180,
        far / 2000,
        move[0] * ray[0] + move[1] * ray[1],
        ray[0] * move[1] - ray[1] * move[0],
        float(world.sees(i, j)),
        float(far <= 800),
        float(any(world.sees(k, j) for k in others)),
        max((1 - abs(world.bearing(k, j)) / 180 for k in others if world.distance(k, j) <= 800), default=0.0),
    ]


def extended_own_features(world: World, i: int, j: int) -> list[float]:
    """The richer description as a sensor without any word of the others has it."""
    return extended_features(World([world.sensors[i]], [world.headings[i]], world.targets), 0, j)[:8]
