"""What the trainer expects of an algorithm."""

from typing import ClassVar, Protocol

from torch import Generator, Tensor

from rhmc.types import Batch, Obs, State, Transition

Carry = Batch  # what an acting policy remembers between steps, tensors with leading B


class Algorithm(Protocol):
    """A learner that acts. Built as `Algorithm(cfg, spec, num_envs, rng)`; `rng` samples while learning.

    `continuous` tells whether it can act in a task of continuous actions (the trainer asks).

    Network weights are drawn from torch's global generator, which the trainer seeds around the construction.
    """

    continuous: ClassVar[bool]

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

    def state_dict(self) -> State:
        """Everything that learning and acting depend on, `rng` included."""
        ...

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`, bit for bit."""
        ...
