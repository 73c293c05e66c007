"""The interface of an algorithm to the trainer, and the table of algorithms."""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol

from torch import Generator, Tensor

from rhmc.learning.learner import Learners
from rhmc.registry import register
from rhmc.types import Batch, Carry, Obs, State, Transition


class About(NamedTuple):
    """A row of Table 1, beside what is counted from the built networks."""

    name: str
    source: str
    family: Literal["value-based", "policy gradient", "actor-critic", "hierarchical"]
    training: Literal["centralised", "decentralised"]
    execution: Literal["decentralised", "central assignment, decentralised action"]
    critic: str
    coordination: str
    actions: tuple[Literal["discrete", "continuous"], ...] = ("discrete",)


class Method(NamedTuple):
    """An entry of the table: `build(cfg, spec, num_envs, rng)` makes an `Algorithm`."""

    config: type[Any]
    build: Callable[..., "Algorithm"]
    about: About
    acts_on: Callable[[State], State] | None = None  # the part of a state that acting needs; None: all but replays


ALGORITHMS: dict[str, Method] = {}  # by kind; everything that lists methods reads this table


def register_method(kind: str, method: Method) -> None:
    """Make a method known under the kind that studies write; its page calls this once, at its end.

    Raises:
        ValueError: another method has the kind.
    """
    register(ALGORITHMS, kind, method)


class Algorithm(Protocol):
    """A learner that acts. Built as `build(cfg, spec, num_envs, rng)`; `rng` samples while learning.

    Network weights are drawn from torch's global generator, which the trainer seeds around the construction.
    """

    def carry(self, batch: int) -> Carry:
        """Memory at the start of `batch` episodes."""
        ...

    def act(self, obs: Obs, carry: Carry, rng: Generator, *, explore: bool) -> tuple[Tensor, Carry, Batch]:
        """Joint action (B, N[, A]), the memory after it, and what the environment or `observe` should get beside it.

        `explore=False` is the evaluation rule: greedy for every method.
        """
        ...

    def observe(self, transition: Transition) -> None:
        """Take in one step of all training environments."""
        ...

    def update(self) -> Batch:
        """Learn what is due after the last `observe`: scalar tensors to log, or nothing."""
        ...

    def learners(self) -> Learners:
        """Every network that learns, with its optimiser: the trainer anneals their step sizes."""
        ...

    def state_dict(self) -> State:
        """Everything that learning and acting depend on, `rng` included."""
        ...

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`, bit for bit."""
        ...
