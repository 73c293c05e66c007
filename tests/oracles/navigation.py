"""Cooperative navigation, one world at a time in plain Python floats: slow, and meant to be read beside the rules."""

import math
from dataclasses import dataclass

Point = tuple[float, float]
PUSH = {0: (0.0, 0.0), 1: (-1.0, 0.0), 2: (1.0, 0.0), 3: (0.0, -1.0), 4: (0.0, 1.0)}


@dataclass(frozen=True)
class World:
    """Positions and velocities of the agents, positions of the landmarks."""

    position: list[Point]
    velocity: list[Point]
    landmarks: list[Point]


def step(world: World, pushes: list[Point], order: str) -> World:
    """One step of 0.1 with each agent pushing with force 5 times its push."""
    position, velocity = [], []
    for i, (x, y) in enumerate(world.position):
        bump_x, bump_y = contact(world, i)
        old_vx, old_vy = world.velocity[i]
        vx = 0.75 * old_vx + 0.1 * (5 * pushes[i][0] + bump_x)
        vy = 0.75 * old_vy + 0.1 * (5 * pushes[i][1] + bump_y)
        if order == "mpe2":
            position.append((x + 0.1 * old_vx, y + 0.1 * old_vy))
        else:
            position.append((x + 0.1 * vx, y + 0.1 * vy))
        velocity.append((vx, vy))
    return World(position, velocity, world.landmarks)


def contact(world: World, i: int) -> Point:
    """Sum of the forces of all other agents on agent i."""
    x, y = world.position[i]
    force_x = force_y = 0.0
    for k, (other_x, other_y) in enumerate(world.position):
        if k == i:
            continue
        distance = math.hypot(x - other_x, y - other_y)
        z = (0.3 - distance) / 0.001
        log_one_plus_exp = z + math.log1p(math.exp(-z)) if z > 0 else math.log1p(math.exp(z))
        force = 100 * 0.001 * log_one_plus_exp
        force_x += force * (x - other_x) / distance
        force_y += force * (y - other_y) / distance
    return force_x, force_y


def collisions(world: World, i: int) -> int:
    """Number of other agents whose centre is nearer than 0.3."""
    return sum(k != i and math.dist(world.position[i], p) < 0.3 for k, p in enumerate(world.position))


def rewards(world: World) -> dict[str, float]:
    """The three published team rewards of one state."""
    n = len(world.position)
    bumps = sum(collisions(world, i) for i in range(n))
    own_nearest = sum(min(math.dist(p, landmark) for landmark in world.landmarks) for p in world.position)
    spread = -sum(min(math.dist(p, landmark) for p in world.position) for landmark in world.landmarks)
    per_agent_mpe2 = [0.5 * spread - 0.5 * collisions(world, i) for i in range(n)]
    per_agent_mpe1 = [spread - collisions(world, i) - 1 for i in range(n)]  # the 1: its collision with itself
    return {"paper": -own_nearest - bumps, "mpe2": sum(per_agent_mpe2), "mpe1": sum(per_agent_mpe1)}


def completed(world: World) -> list[list[bool]]:
    """Per agent and landmark, whether they are nearer than 0.1."""
    return [[math.dist(p, landmark) < 0.1 for landmark in world.landmarks] for p in world.position]


def extended_pair(world: World, i: int, j: int) -> list[float]:
    """The observation by agent i of landmark j in the extended observation."""
    own = math.dist(world.position[i], world.landmarks[j])
    others = [math.dist(p, world.landmarks[j]) for k, p in enumerate(world.position) if k != i]
    dx, dy = (world.landmarks[j][a] - world.position[i][a] for a in range(2))
    return [dx, dy, own, min(others), float(all(own <= other for other in others))]


def extended_peer(world: World, i: int, k: int) -> list[float]:
    """The observation by agent i of agent k in the extended observation."""
    away = [world.position[k][a] - world.position[i][a] for a in range(2)]
    drift = [world.velocity[k][a] - world.velocity[i][a] for a in range(2)]
    return [*away, math.dist(world.position[i], world.position[k]), *drift]
