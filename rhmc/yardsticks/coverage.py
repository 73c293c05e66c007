"""Coverage without learning: scripted policies, and bounds that no policy can beat.

A policy sees the whole state, never a target's goal or base speed: (cfg, state, generator) -> actions (B, N).
A bound is a function of the state alone: (cfg, state) -> (B,), the coverage that no headings in that state can exceed.
"""

import math

import torch
from torch import Generator, Tensor

from rhmc.envs.coverage import HALF_AREA, HALF_VIEW, RANGE, TURN, TURNS, Config, State, relation, visible, wrap
from rhmc.yardsticks.joint import best_choice, largest_union

HORIZON = 30  # steps the planner looks ahead
PASSES = 2  # rounds in which each sensor's plan is improved, the others' held fixed
IDLE = 0.01  # what the planner gives, in targets, for a step without a turn (the price of one in local rewards)
CENTRE = 0.001  # and for a sighting on the axis rather than far off it: a tie, where a target that turns is kept longer


def random(cfg: Config, state: State, rng: Generator) -> Tensor:
    """Every action alike."""
    return torch.randint(len(TURNS), state.heading.shape, generator=rng, device=rng.device)


def hold(cfg: Config, state: State, rng: Generator) -> Tensor:
    """Never turn."""
    return torch.zeros_like(state.heading, dtype=torch.int64)


def nearest(cfg: Config, state: State, rng: Generator) -> Tensor:
    """Each sensor turns to its nearest target."""
    bearing, distance = relation(state)
    return toward(_pick(bearing, distance.argmin(-1)))


def mean_all(cfg: Config, state: State, rng: Generator) -> Tensor:
    """Each sensor turns to the centroid of all targets."""
    return toward(relation(state._replace(targets=state.targets.mean(1, keepdim=True)))[0].squeeze(-1))


def best_window(cfg: Config, state: State, rng: Generator) -> Tensor:
    """Each sensor alone turns to its fullest window; of several to the one that takes the least turning."""
    bearing, distance = relation(state)
    member, turn = windows(bearing, distance <= RANGE)
    value = member.sum(-1) - turn.abs() / 360
    return toward(_pick(turn, value.argmax(-1)))


def joint_one_step(cfg: Config, state: State, rng: Generator) -> Tensor:
    """The joint action, of all 3^N, after which the most targets are seen where they are now.

    Most joint actions are equal in that; among equals each target draws the sensor nearest to it: least is the sum over
    targets of how far off the axis of its nearest sensor they are.
    """
    bearing, distance = relation(state)
    turns = torch.tensor(TURNS, device=bearing.device).view(1, 1, -1, 1)
    after = wrap(bearing.unsqueeze(2) - turns)
    own = distance == distance.amin(1, keepdim=True)
    return best_choice(visible(after, distance.unsqueeze(2)), (after.abs() * own.unsqueeze(2)).sum(-1))


def set_point(cfg: Config, state: State, rng: Generator) -> Tensor:
    """Find the joint headings that would see the most targets, of all headings, and turn toward them.

    Each sensor chooses a window or none (then it holds). Among equal unions one is drawn anew at every step.
    """
    bearing, distance = relation(state)
    member, turn = windows(bearing, distance <= RANGE)
    nothing = torch.zeros_like(member[:, :, :1])
    member = torch.cat((member, nothing), 2)
    turn = torch.cat((turn, torch.zeros_like(turn[..., :1])), -1)
    lot = torch.rand(turn.shape, generator=rng, device=rng.device)
    return toward(_pick(turn, best_choice(member, lot)))


def planner(cfg: Config, state: State, rng: Generator) -> Tensor:
    """The first action of a joint plan for `HORIZON` steps, made anew at every step.

    Targets are taken to repeat their last move. One sensor after the other gets the plan that adds the most sightings
    to those of the others' plans (exact, by dynamic programming over its heading), `PASSES` times round.
    """
    sight = _sight(state)
    batch, horizon, targets, _ = sight[0].shape
    plans = torch.zeros(batch, cfg.agents, horizon, targets, dtype=torch.bool, device=state.heading.device)
    action = torch.zeros_like(state.heading, dtype=torch.int64)
    for i in [*range(cfg.agents)] * PASSES:
        plans[:, i] = False
        unseen = (~plans.any(1)).float()
        gain = (unseen.unsqueeze(-2) @ sight[i]).squeeze(-2)
        offset = _best_path(gain)
        action[:, i] = toward(TURN * (offset[:, 0] - horizon))
        column = offset.view(batch, horizon, 1, 1).expand(-1, -1, targets, 1)
        plans[:, i] = sight[i].gather(-1, column).squeeze(-1) > 0
    return action


def free_heading_bound(cfg: Config, state: State) -> Tensor:
    """Coverage if every sensor could take any heading at once."""
    bearing, distance = relation(state)
    return largest_union(windows(bearing, distance <= RANGE)[0]) / cfg.targets


def range_bound(cfg: Config, state: State) -> Tensor:
    """Coverage if sensors saw all around: the share of targets in range of one."""
    return (relation(state)[1] <= RANGE).any(1).float().mean(-1)


def toward(turn: Tensor) -> Tensor:
    """The action that brings the heading nearest to `turn` degrees from now (to the left if positive)."""
    return torch.where(turn.abs() <= TURN / 2, 0, torch.where(turn > 0, 1, 2))


def windows(bearing: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    """Windows that a sensor can see: window j begins at target j and extends less than 90 degrees to the left.

    Every set of targets visible under some heading is part of one of these M sets, and each of them is visible under
    the heading in the middle of its targets.

    Args:
        bearing: (B, N, M) from the present heading.
        near: (B, N, M) bool, in range.

    Returns:
        The targets in each window (B, N, M, M) bool, none where target j is out of range; and the turn that brings the
        middle of them ahead (B, N, M), 0 where there are none.
    """
    left = torch.remainder(bearing.unsqueeze(-2) - bearing.unsqueeze(-1), 360)
    member = near.unsqueeze(-1) & near.unsqueeze(-2) & (left < 2 * HALF_VIEW)
    middle = wrap(bearing + torch.where(member, left, 0.0).amax(-1) / 2)
    return member, torch.where(near, middle, 0.0)


def _sight(state: State) -> list[Tensor]:
    """The view of a sensor 1 to T steps ahead, turned by -T to T actions: N times (B, T, M, 2T + 1).

    0 is out of sight, about 1 in sight: a little more near the axis, where a target that turns is not lost at once.
    """
    steps = torch.arange(1, HORIZON + 1, device=state.heading.device).view(1, -1, 1, 1)
    ahead = state.targets.unsqueeze(1) + steps * (state.targets - state.last).unsqueeze(1)
    later = state._replace(targets=ahead.clamp(-HALF_AREA, HALF_AREA).flatten(1, 2))
    bearing, distance = (x.unflatten(-1, ahead.shape[1:3]) for x in relation(later))
    turned = torch.deg2rad(TURN * torch.arange(-HORIZON, HORIZON + 1, device=state.heading.device))
    angle = torch.deg2rad(bearing)
    ray = torch.stack((angle.cos(), angle.sin()), -1) * (distance <= RANGE).unsqueeze(-1)
    axes, edge = torch.stack((turned.cos(), turned.sin())), math.cos(math.radians(HALF_VIEW))
    return [_worth(own @ axes, edge) for own in ray.unbind(1)]  # of the cosine of the angle off axis, 0 out of range


def _worth(cosine: Tensor, edge: float) -> Tensor:
    return torch.where(cosine > edge, 1 - CENTRE * (1 - cosine), 0.0)


def _best_path(gain: Tensor) -> Tensor:
    """The walk over headings with the largest total gain.

    Args:
        gain: (B, T, 2T + 1), of being at each heading at each time; it starts in the middle and moves by at most one.

    Returns:
        (B, T) int64, its heading at each time.
    """
    times = gain.shape[1]
    moves = torch.tensor([0, 1, -1], device=gain.device)
    to_come = torch.zeros_like(gain[:, 0])
    best = []
    for t in reversed(range(times)):
        value = torch.nn.functional.pad(to_come + gain[:, t], (1, 1), value=-torch.inf)
        to_come, move = torch.stack((value[:, 1:-1] + IDLE, value[:, 2:], value[:, :-2])).max(0)
        best.append(move)
    at = torch.full_like(best[0][:, :1], times)
    path = []
    for move in reversed(best):
        at = at + moves[move.gather(1, at)]
        path.append(at)
    return torch.cat(path, 1)


def _pick(values: Tensor, index: Tensor) -> Tensor:
    """One value of each agent: (B, N, K) at (B, N) -> (B, N)."""
    return values.gather(-1, index.unsqueeze(-1)).squeeze(-1)
