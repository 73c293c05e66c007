"""Cooperative navigation (simple_spread): agents with inertia spread over as many landmarks without bumping.

Lengths in units of the half-side of the start square, time in steps of 0.1, mass 1. The plane is unbounded, there is
no speed limit and no noise; landmarks neither move nor collide.
"""

import sys
from functools import cache
from typing import Literal, NamedTuple

import torch
from pydantic import Field
from torch import Generator, Tensor
from torch.nn.functional import embedding, softplus

from rhmc.envs.base import EnvConfig, Outcome, Task, register_task
from rhmc.types import Local, Obs, Spec

DT = 0.1
KEPT = 0.75  # share of the velocity that a step keeps
FORCE = 5.0  # of a full action
DIRECTIONS = ((0.0, 0.0), (-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0))  # by action
CONTACT = 0.3  # centres nearer than this: two agents of radius 0.15 collide
STIFFNESS, SOFTNESS = 100.0, 0.001  # of the contact force
NEAR = 0.1  # an agent nearer than this covers a landmark
FAR = 8**0.5  # diagonal of the start square: how far "the nearest other" is where there is no other

Order = Literal["mpe2", "mpe1"]


class Config(EnvConfig):
    """The task. `reward` and `order` both name a published version and are independent of each other."""

    kind: Literal["navigation"] = "navigation"
    agents: int = Field(default=3, ge=1, description="N agents, and as many landmarks")
    reward: Literal["paper", "mpe2", "mpe1"] = Field(
        "paper",
        description="minus distances and collisions: each agent's to its nearest landmark (Eq. 18), or each landmark's "
        "to its nearest agent, weighted as in either version of the particle environments",
    )
    order: Order = Field(default="mpe2", description="integration: mpe2 moves first, mpe1 changes velocity first")
    continuous: bool = Field(default=False, description="act by a force in [-1, 1]^2 instead of five directions")
    observation: Literal["paper", "extended"] = Field(
        "paper", description="as in mpe2; extended: also distances, who is nearest to a landmark, relative velocities"
    )
    episode: int = Field(default=25, ge=1, description="steps of an episode")


class State(NamedTuple):
    """A batch of worlds; frozen, a step makes a new one."""

    position: Tensor  # (B, N, 2)
    velocity: Tensor  # (B, N, 2)
    landmarks: Tensor  # (B, M, 2), M = N
    steps: Tensor  # (B,) int64


def spec(cfg: Config) -> Spec:
    """Sizes for the networks."""
    features = 2 if cfg.observation == "paper" else 5
    actions = 2 if cfg.continuous else len(DIRECTIONS)
    return Spec(cfg.agents, cfg.agents, 4, features, features, actions, cfg.continuous, cfg.episode)


def initial(cfg: Config, batch: int, rng: Generator) -> State:
    """Draw `batch` starts: agents, at rest, and landmarks uniform in [-1, 1]^2."""
    draw = torch.rand(batch, 2 * cfg.agents, 2, generator=rng, device=rng.device) * 2 - 1
    position, landmarks = draw[:, : cfg.agents], draw[:, cfg.agents :]
    steps = torch.zeros(batch, dtype=torch.int64, device=rng.device)
    return State(position, torch.zeros_like(position), landmarks, steps)


def transition(cfg: Config, state: State, action: Tensor, rng: Generator) -> State:
    """Move the agents. action: (B, N) int64 by `DIRECTIONS`, or (B, N, 2), cut to [-1, 1]. Draws nothing from `rng`."""
    position, velocity = state.position, state.velocity
    push = action.clamp(-1, 1) if cfg.continuous else embedding(action, _directions(position.dtype, position.device))
    faster = velocity * KEPT + (push * FORCE + contact(position)) * DT
    moved = position + DT * (velocity if cfg.order == "mpe2" else faster)
    return State(moved, faster, state.landmarks, state.steps + 1)


def contact(position: Tensor) -> Tensor:
    """Force on each agent from all others, in a form that cannot overflow. (B, N, 2) -> the same.

    Two agents on exactly one point have no line of centres: they do not push each other (`mpe2` divides zero by zero).
    """
    away = -_relative(position, position)
    distance = _length(away)
    size = STIFFNESS * SOFTNESS * softplus((CONTACT - distance) / SOFTNESS)
    return (away * (size / distance.clamp(min=1e-12)).unsqueeze(-1)).sum(2)


def outcome(cfg: Config, state: State, action: Tensor, assignment: Tensor | None) -> Outcome:
    """Rewards in `state`, all three of them logged. The action and the assignment do not matter here."""
    distance = _length(_relative(state.position, state.landmarks))
    touching = _length(_relative(state.position, state.position)) < CONTACT
    bumps = touching.sum(-1).to(distance.dtype) - 1  # all but the agent itself
    collisions = bumps.sum(-1)  # ordered pairs
    nearest_agent = distance.amin(1)
    spread = -nearest_agent.sum(-1)
    n = cfg.agents
    rewards = {
        "paper": -distance.amin(2).sum(-1) - collisions,
        "mpe2": (n * spread - collisions) / 2,
        "mpe1": n * spread - collisions - n,  # the last n: every agent once collided with itself
    }
    info = {f"reward_{name}": value for name, value in rewards.items()}
    info["landmarks_covered"] = (nearest_agent < NEAR).to(distance.dtype).mean(-1)
    info["collisions"] = collisions
    return Outcome(rewards[cfg.reward], Local(-distance, -bumps), distance < NEAR, info)


def observe(cfg: Config, state: State) -> Obs:
    """Per agent its velocity and position, the landmarks and the other agents relative to it.

    `paper`: what `mpe2` shows, as it stands, but for its 2 (N - 1) communication channels: they are always silent, so
    their zeros are left out. `extended`: per landmark also the distance, that of the nearest other agent to it, and
    whether this agent is its nearest (1 or 0); per other agent also the distance and the relative velocity.
    """
    own = torch.cat((state.velocity, state.position), -1)
    pairs = _relative(state.position, state.landmarks)
    peers = _relative(state.position, state.position)
    if cfg.observation == "extended":
        distance = _length(pairs)
        other = _nearest_other(distance)
        pairs = torch.cat((pairs, torch.stack((distance, other, (distance <= other).to(distance.dtype)), -1)), -1)
        peers = torch.cat((peers, _length(peers).unsqueeze(-1), _relative(state.velocity, state.velocity)), -1)
    return Obs(own, pairs, peers, state.steps == 0)


def options(cfg: Config, state: State, horizon: int) -> Tensor:
    """Landmarks that each agent could complete by heading for each landmark, and by staying.

    Option d < M completes landmark d if some sequence of 1 to `horizon` forces ends within 0.1 of it (`reachable`),
    and along with it every reachable landmark whose disc overlaps that of d, since one agent can cover both. The last
    option, staying, completes the landmarks that the agent covers now. So whatever an agent covers at one moment, some
    option contains: an upper bound, as long as no contact helps it along.

    Returns:
        (B, N, D, M) bool with D = M + 1.
    """
    reach = reachable(cfg, state, horizon)
    overlap = _length(_relative(state.landmarks, state.landmarks)) < 2 * NEAR
    heading = overlap.unsqueeze(1) & reach.unsqueeze(2) & reach.unsqueeze(3)
    staying = _length(_relative(state.position, state.landmarks)) < NEAR
    return torch.cat((heading, staying.unsqueeze(2)), 2)


def summary(cfg: Config, reward: Tensor, info: dict[str, Tensor]) -> dict[str, Tensor]:
    """An episode: sums of the reward, of all three and of colliding pairs; share of landmarks covered at its end.

    (T, B) each -> (B,) each.
    """
    sums = {f"return_{name}": info[f"reward_{name}"].sum(0) for name in ("paper", "mpe2", "mpe1")}
    collisions = info["collisions"].sum(0)
    return {
        "return": reward.sum(0),
        **sums,
        "landmarks_covered": info["landmarks_covered"][-1],
        "collisions": collisions,
    }


def reachable(cfg: Config, state: State, horizon: int) -> Tensor:
    """True where an agent can be within 0.1 of each landmark after some number of steps from 1 to `horizon`.

    Motion is linear in the forces: after k steps the agent is at drift + reach * f, where f is a weighted mean of its k
    actions. Continuous actions fill the square `|f_x|, |f_y| <= 1`: exact, contacts aside. Discrete ones push along one
    axis at a time and fill the diamond `|f_x| + |f_y| <= 1`, up to the grain of single pushes: an upper bound.

    Returns:
        (B, N, M) bool.
    """
    drift, reach = _free_motion(cfg.order, horizon, state.position)
    ahead = state.position.unsqueeze(1) + drift.view(1, -1, 1, 1) * state.velocity.unsqueeze(1)  # (B, K, N, 2)
    gap = (state.landmarks.unsqueeze(1).unsqueeze(2) - ahead.unsqueeze(3)).abs()  # (B, K, N, M, 2)
    x, y = gap.unbind(-1)
    r = reach.view(1, -1, 1, 1)
    if cfg.continuous:
        on_x, on_y = torch.minimum(x, r), torch.minimum(y, r)
    else:  # the nearest point of the diamond's edge, unless the landmark is inside
        on_x = torch.minimum(((x - y + r) / 2).clamp(min=0), r)
        on_y = r - on_x
        inside = x + y <= r
        on_x, on_y = torch.where(inside, x, on_x), torch.where(inside, y, on_y)
    return (_length(torch.stack((x - on_x, y - on_y), -1)) < NEAR).any(1)


def _free_motion(order: Order, horizon: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """After k = 1 to `horizon` free steps: how far unit velocity carries, and full force along an axis: (K,) each."""
    k = torch.arange(1, horizon + 1, dtype=like.dtype, device=like.device)
    later = 0 if order == "mpe2" else 1  # a force moves the agent in its own step only if velocity changes first
    kept = KEPT ** (k - 1 + later)  # of the first velocity, in the move of step k
    speed = FORCE * DT * (1 - kept) / (1 - KEPT)  # under full force, in the move of step k
    return DT * kept.cumsum(0), DT * speed.cumsum(0)


def _relative(origin: Tensor, points: Tensor) -> Tensor:
    """Each point as seen from each origin: (B, N, 2), (B, M, 2) -> (B, N, M, 2)."""
    return points.unsqueeze(1) - origin.unsqueeze(2)


def _length(v: Tensor) -> Tensor:
    """Norm over the last dimension, of size 2 (several times faster than a reduction over two numbers)."""
    x, y = v.unbind(-1)
    return torch.hypot(x, y)  # MKL's `sqrt` differs between processors


def _nearest_other(distance: Tensor) -> Tensor:
    """Distance of the nearest other agent to each landmark, `FAR` with none. (B, N, M) -> the same."""
    if distance.shape[1] == 1:
        return torch.full_like(distance, FAR)
    first, second = distance.topk(2, 1, largest=False).values.split(1, 1)
    return torch.where(distance == first, second, first)


@cache
def _directions(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(DIRECTIONS, dtype=dtype, device=device)


register_task("navigation", Task(Config, sys.modules[__name__]))
