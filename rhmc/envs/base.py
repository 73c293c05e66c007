"""The one environment that remembers: a task's pure functions, a batch of states and a generator."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeVar

import torch
from torch import Generator, Tensor

from rhmc.registry import register
from rhmc.types import Frozen, Local, Obs, Spec, State, Step

S = TypeVar("S", bound=tuple[Tensor, ...])


class Outcome(NamedTuple):
    """Rewards of a step; shapes as in `Step`."""

    reward: Tensor
    local: Local
    completed: Tensor
    info: dict[str, Tensor]


class Physics(Protocol):
    """A task as pure functions of its configuration and a frozen state (a NamedTuple of tensors, leading B).

    A module with these functions is an implementation. The state has a field `steps` (B,) int64.
    """

    @property
    def spec(self) -> Callable[[Any], Spec]: ...
    @property
    def initial(self) -> Callable[[Any, int, Generator], Any]: ...
    @property
    def transition(self) -> Callable[[Any, Any, Tensor, Generator], Any]: ...
    @property
    def observe(self) -> Callable[[Any, Any], Obs]: ...
    @property
    def outcome(self) -> Callable[[Any, Any, Tensor, Tensor | None], Outcome]: ...
    @property
    def options(self) -> Callable[[Any, Any, int], Tensor]: ...
    @property
    def summary(self) -> Callable[[Any, Tensor, dict[str, Tensor]], dict[str, Tensor]]: ...


class EnvConfig(Frozen):
    """Fields that every task's configuration has; a task adds its own."""

    kind: str
    agents: int
    observation: str


class Task(NamedTuple):
    """An entry of the table of tasks."""

    config: type[Any]
    physics: Physics


ENVS: dict[str, Task] = {}  # by kind; everything that lists tasks reads this table


def register_task(kind: str, task: Task) -> None:
    """Make a task known under the kind that studies write; its page calls this once, at its end.

    Raises:
        ValueError: another task has the kind.
    """
    register(ENVS, kind, task)


class Env:
    """B copies of a task on the generator's device, reset automatically when their episode ends.

    Args:
        physics: the task's functions.
        cfg: the task's configuration.
        batch: B, the number of copies.
        rng: generator for starts and dynamics; its device is the environment's.
    """

    def __init__(self, physics: Physics, cfg: Any, batch: int, rng: Generator) -> None:
        self.physics, self.cfg, self.batch, self.rng = physics, cfg, batch, rng
        self.spec = physics.spec(cfg)
        self.state: Any = None

    def reset(self) -> Obs:
        """Start every copy anew."""
        self.state = self.physics.initial(self.cfg, self.batch, self.rng)
        return self.physics.observe(self.cfg, self.state)

    def step(self, action: Tensor, assignment: Tensor | None = None) -> Step:
        """Act in every copy.

        Args:
            action: (B, N) int64, or (B, N, A) float for continuous tasks.
            assignment: (B, N, M) 0 or 1; only tasks whose reward depends on it look at it. None means all.
        """
        state = self.physics.transition(self.cfg, self.state, action, self.rng)
        out = self.physics.outcome(self.cfg, state, action, assignment)
        final_obs = obs = self.physics.observe(self.cfg, state)
        truncated = state.steps >= self.spec.episode
        if bool(truncated.any()):
            state = where(truncated, self.physics.initial(self.cfg, self.batch, self.rng), state)
            obs = self.physics.observe(self.cfg, state)
        self.state = state
        terminated = torch.zeros_like(truncated)
        return Step(obs, final_obs, out.reward, out.local, out.completed, terminated, truncated, out.info)

    def options(self) -> Callable[[int], Tensor]:
        """The regulator's table from the present state, as a function of its horizon: (B, N, D, M) bool."""
        return partial(self.physics.options, self.cfg, self.state)

    def state_dict(self) -> State:
        """Everything that decides what comes next."""
        return {"rng": self.rng.get_state(), "state": self.state._asdict()}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        self.rng.set_state(state["rng"].cpu())
        blank = self.physics.initial(self.cfg, self.batch, torch.Generator(self.rng.device))
        self.state = type(blank)(**{k: v.to(self.rng.device) for k, v in state["state"].items()})


def where(mask: Tensor, new: S, old: S) -> S:
    """Row-wise choice between two states (NamedTuples of tensors, leading B) by mask (B,)."""
    pairs = zip(new, old, strict=True)
    return type(old)(*(torch.where(mask.view(-1, *[1] * (o.dim() - 1)), n, o) for n, o in pairs))


def make_env(cfg: EnvConfig, batch: int, rng: Generator) -> Env:
    """B copies of the configured task on the generator's device."""
    return Env(ENVS[cfg.kind].physics, cfg, batch, rng)
