"""Multi-sensor multi-target coverage: fixed directional sensors turn to keep moving targets in view.

Lengths in metres of the published task, angles in degrees counter-clockwise from +x, time in steps.
"""

import sys
from typing import Literal, NamedTuple, Self

import torch
from pydantic import Field, model_validator
from torch import Generator, Tensor

from rhmc.envs.base import EnvConfig, Outcome, Task, register_task, where
from rhmc.types import Local, Obs, Spec, assigned_reward

HALF_AREA = 1250.0  # targets stay in [-1250, 1250]^2
RANGE = 800.0
HALF_VIEW = 45.0
TURN = 5.0
TURNS = (0.0, TURN, -TURN)  # by action
GOAL_RADIUS, STUCK, PATIENCE = 5.0, 10.0, 100  # when a target redraws its goal
FIRST_MOVE = 30.0  # distance that counts as moved before the first move
REDRAWS = 50  # cap on moves that are decided again
FEATURES = {"paper": 4, "extended": 10, "extended_own": 8}  # of a pair, by observation
BOXES = (  # x0, x1, y0, y1 of each sensor's start
    (250, 750, 250, 750),
    (250, 750, -750, -250),
    (-1250, -750, -250, 250),
    (-750, -250, 250, 750),
    (750, 1250, -250, 250),
    (-750, -250, -750, -250),
)


class Dynamics(NamedTuple):
    """Settings that a preset fixes."""

    dt: float
    extra_move_every: int  # targets move twice at every such step; 0 = never
    start: int  # half-width of the square in which targets start
    aimed: bool  # sensor i starts turned to target i
    reward: Literal["global", "local"]
    own_only: bool  # the penalty looks at a sensor's assigned targets only
    episode: int


PRESETS = {
    "flat": Dynamics(0.3, 0, 800, False, "global", False, 100),
    "executor": Dynamics(0.3, 0, 400, True, "local", True, 100),
    "coordinator": Dynamics(0.13, 10, 1000, False, "global", True, 1000),
}


class Config(EnvConfig):
    """The task; `preset` chooses among the three published variants (`PRESETS`)."""

    kind: Literal["coverage"] = "coverage"
    preset: Literal["flat", "executor", "coordinator"] = Field(
        "flat", description="published variant: how targets start and move, length of an episode, who is rewarded"
    )
    agents: int = Field(4, ge=1, description="N sensors")
    targets: int = Field(5, ge=1, description="M targets")
    observation: Literal["paper", "extended", "extended_own"] = Field(
        "paper",
        description="features of a pair: the paper's four, or ten with what other sensors do; extended_own: without "
        "the last two",
    )
    penalty: float = Field(0.1, ge=0, description="minus this is the reward when nothing is captured")
    boxes: tuple[tuple[int, int, int, int], ...] = Field(
        BOXES, description="x0, x1, y0, y1 of the box in which each sensor starts, in metres"
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.agents > len(self.boxes):
            raise ValueError(f"agents: {self.agents} sensors need as many boxes, and there are {len(self.boxes)}")
        if PRESETS[self.preset].aimed and self.agents > self.targets:
            raise ValueError(
                f"agents: preset 'executor' aims sensor i at target i, so agents <= targets = {self.targets}"
            )
        return self


class State(NamedTuple):
    """A batch of worlds; frozen, a step makes a new one."""

    sensors: Tensor  # (B, N, 2)
    heading: Tensor  # (B, N) in [-180, 180)
    targets: Tensor  # (B, M, 2)
    goal: Tensor  # (B, M, 2)
    speed: Tensor  # (B, M)
    trip: Tensor  # (B, M) moves towards the present goal
    last: Tensor  # (B, M, 2) position before the last move
    before_last: Tensor  # (B, M, 2)
    moved: Tensor  # (B, M) bool, has moved since the reset
    steps: Tensor  # (B,) int64


def spec(cfg: Config) -> Spec:
    """Sizes for the networks."""
    features = FEATURES[cfg.observation]
    return Spec(cfg.agents, cfg.targets, 0, features, 0, len(TURNS), False, PRESETS[cfg.preset].episode)


def initial(cfg: Config, batch: int, rng: Generator) -> State:
    """Draw `batch` starts: sensors in shuffled boxes, targets in the preset's square."""
    dyn, n, m, dev = PRESETS[cfg.preset], cfg.agents, cfg.targets, rng.device
    boxes = torch.tensor(cfg.boxes[:n], device=dev, dtype=torch.float32)
    boxes = boxes[torch.rand(batch, n, generator=rng, device=dev).argsort(-1)]
    low, high = boxes[..., 0::2], boxes[..., 1::2]
    sensors = low + torch.floor(torch.rand(batch, n, 2, generator=rng, device=dev) * (high - low))
    draw = torch.rand(batch, m, 5, generator=rng, device=dev)
    targets = torch.floor(draw[..., 3:5] * (2 * dyn.start)) - dyn.start
    goal, speed = _goal_speed(draw)
    heading = torch.rand(batch, n, generator=rng, device=dev) * 360 - 180
    if dyn.aimed:
        away = targets[:, :n] - sensors
        heading = wrap(torch.rad2deg(torch.atan2(away[..., 1], away[..., 0])))
    zero = torch.zeros(batch, m, device=dev)
    steps = torch.zeros(batch, dtype=torch.int64, device=dev)
    return State(sensors, heading, targets, goal, speed, zero, targets, targets, zero.bool(), steps)


def transition(cfg: Config, state: State, action: Tensor, rng: Generator) -> State:
    """Move the targets, then turn the sensors. action: (B, N) in {0 stay, 1 left, 2 right}."""
    dyn = PRESETS[cfg.preset]
    if dyn.extra_move_every:
        twice = state.steps % dyn.extra_move_every == 0
        state = where(twice, move_targets(dyn.dt, state, rng), state)
    state = move_targets(dyn.dt, state, rng)
    turn = torch.tensor(TURNS, device=action.device)[action]
    return state._replace(heading=wrap(state.heading + turn), steps=state.steps + 1)


def move_targets(dt: float, state: State, rng: Generator) -> State:
    """One move of every target towards its goal; a move out of the area is decided again with a new goal."""
    shape, dev = state.speed.shape, state.speed.device
    draw = torch.rand(*shape, 4, generator=rng, device=dev)
    gap = torch.minimum(_norm(state.targets - state.last), _norm(state.targets - state.before_last))
    gap = torch.where(state.moved, gap, FIRST_MOVE)
    trip = state.trip + 1
    redraw = (_norm(state.goal - state.targets) < GOAL_RADIUS) | (gap < STUCK) | (trip > PATIENCE)
    new_goal, new_speed = _goal_speed(draw)
    goal = torch.where(redraw.unsqueeze(-1), new_goal, state.goal)
    speed = torch.where(redraw, new_speed, state.speed)
    trip = torch.where(redraw, 0.0, trip)
    targets = state.targets + _displacement(state.targets, goal, speed, draw[..., 3], dt)
    before_last = state.last
    for _ in range(REDRAWS):  # few rows: work on them alone
        rows = (targets.abs() > HALF_AREA).any(-1).nonzero(as_tuple=True)
        if not len(rows[0]):
            break
        draw = torch.rand(len(rows[0]), 4, generator=rng, device=dev)
        goal[rows], speed[rows] = _goal_speed(draw)
        trip[rows] = 0
        stay = state.targets[rows]
        targets[rows] = stay + _displacement(stay, goal[rows], speed[rows], draw[..., 3], dt)
        before_last = before_last.index_put(rows, stay)
    else:
        targets = targets.clamp(-HALF_AREA, HALF_AREA)
    return state._replace(
        targets=targets,
        goal=goal,
        speed=speed,
        trip=trip,
        last=state.targets,
        before_last=before_last,
        moved=torch.ones_like(state.moved),
    )


def relation(state: State) -> tuple[Tensor, Tensor]:
    """Bearing of each target from each sensor relative to its heading, in [-180, 180), and distance: (B, N, M) each."""
    away = state.targets.unsqueeze(1) - state.sensors.unsqueeze(2)
    bearing = torch.rad2deg(torch.atan2(away[..., 1], away[..., 0])) - state.heading.unsqueeze(-1)
    return wrap(bearing), _norm(away)


def visible(bearing: Tensor, distance: Tensor) -> Tensor:
    """True where a target at this relative bearing and distance is seen: strict in angle, inclusive in range."""
    return (bearing.abs() < HALF_VIEW) & (distance <= RANGE)


def outcome(cfg: Config, state: State, action: Tensor, assignment: Tensor | None) -> Outcome:
    """Rewards in `state`, reached by `action`. assignment: (B, N, M) or None for all pairs."""
    dyn = PRESETS[cfg.preset]
    bearing, distance = relation(state)
    seen = visible(bearing, distance)
    coverage = seen.any(1).float().mean(-1)
    local = Local(torch.where(seen, 1 - bearing.abs() / HALF_VIEW, -1.0), -0.01 * (action != 0).float())
    held = torch.ones_like(seen) if assignment is None else assignment.bool()
    captured = seen & held if dyn.own_only else seen
    reward = coverage
    if cfg.penalty:
        reward = torch.where(captured.flatten(1).any(-1), coverage, -cfg.penalty)
    if dyn.reward == "local":
        reward = assigned_reward(local, held).mean(-1)
    return Outcome(reward, local, seen, {"coverage": coverage})


def observe(cfg: Config, state: State) -> Obs:
    """Per sensor and target; all targets are seen, in range or not.

    `paper`: (i/n, j/m, bearing/180, distance/2000). `extended`: sine and cosine of the bearing, its size, distance,
    radial and tangential part of the target's last move, visible to me, in my range, visible to another sensor, and how
    closely another sensor that has it in range is turned to it. `extended_own`: without the last two, which tell
    what other sensors do.
    """
    bearing, distance = relation(state)
    b, n, m = bearing.shape
    if cfg.observation == "paper":
        i = (torch.arange(n, device=bearing.device) / n).view(1, n, 1).expand(b, n, m)
        j = (torch.arange(m, device=bearing.device) / m).view(1, 1, m).expand(b, n, m)
        pairs = torch.stack((i, j, bearing / 180, distance / 2000), -1)
    else:
        pairs = _extended(state, bearing, distance, others=cfg.observation == "extended")
    empty = bearing.new_zeros(b, n, 0)
    return Obs(empty, pairs, bearing.new_zeros(b, n, n, 0), state.steps == 0)


def options(cfg: Config, state: State, horizon: int) -> Tensor:
    """Targets each sensor would see after `horizon` steps, under each heading that it can reach by then.

    Targets are taken to go on as in their last move; where they will turn is not known.

    Returns:
        (B, N, D, M) bool with D = 2 horizon + 1; the middle option is the present heading.
    """
    ahead = state.targets + horizon * (state.targets - state.last)
    bearing, distance = relation(state._replace(targets=ahead.clamp(-HALF_AREA, HALF_AREA)))
    turns = TURN * torch.arange(-horizon, horizon + 1, device=bearing.device)
    turned = wrap(bearing.unsqueeze(2) - turns.view(1, 1, -1, 1))
    return visible(turned, distance.unsqueeze(2))


def summary(cfg: Config, reward: Tensor, info: dict[str, Tensor]) -> dict[str, Tensor]:
    """An episode in percent: 100 x mean reward per step, 100 x mean coverage. (T, B) each -> (B,) each."""
    return {"return": 100 * reward.mean(0), "coverage": 100 * info["coverage"].mean(0)}


def wrap(degrees: Tensor) -> Tensor:
    """To [-180, 180)."""
    return torch.remainder(degrees + 180, 360) - 180


def _extended(state: State, bearing: Tensor, distance: Tensor, *, others: bool) -> Tensor:
    seen, near = visible(bearing, distance), distance <= RANGE
    absolute = torch.deg2rad(bearing + state.heading.unsqueeze(-1))
    ray = torch.stack((absolute.cos(), absolute.sin()), -1)
    move = (state.targets - state.last).unsqueeze(1) / 30
    radial = (move * ray).sum(-1)
    tangential = move[..., 1] * ray[..., 0] - move[..., 0] * ray[..., 1]
    angle = torch.deg2rad(bearing)
    parts = [angle.sin(), angle.cos(), bearing.abs() / 180, distance / 2000, radial, tangential]
    parts += [seen.float(), near.float()]
    if others:
        shared = seen.sum(1, keepdim=True) - seen.int() > 0
        parts += [shared.float(), _best_other(torch.where(near, 1 - bearing.abs() / 180, 0.0))]
    return torch.stack(parts, -1)


def _best_other(value: Tensor) -> Tensor:
    """For each agent the largest value among the other agents, 0 with none. (B, N, M) -> the same."""
    zero = torch.zeros_like(value[:, :1])
    below = torch.cat((zero, value[:, :-1]), 1).cummax(1).values
    above = torch.cat((value[:, 1:], zero), 1).flip(1).cummax(1).values.flip(1)
    return torch.maximum(below, above)


def _goal_speed(draw: Tensor) -> tuple[Tensor, Tensor]:
    goal = torch.floor(draw[..., :2] * (2 * HALF_AREA)) - HALF_AREA
    return goal, torch.floor(draw[..., 2] * 50) + 50


def _displacement(targets: Tensor, goal: Tensor, speed: Tensor, u: Tensor, dt: float) -> Tensor:
    away = goal - targets
    length = speed * (1 + 0.2 * u) * dt / _norm(away).clamp(min=1e-6)
    return away * length.unsqueeze(-1)


def _norm(v: Tensor) -> Tensor:
    return torch.linalg.vector_norm(v, dim=-1)


register_task("coverage", Task(Config, sys.modules[__name__]))
