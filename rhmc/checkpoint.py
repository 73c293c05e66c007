"""The state of a method from the states of its parts."""

from typing import Any, Protocol

from torch import Generator

from rhmc.types import State


class Part(Protocol):
    """What has a state: a learner, a replay, a rollout, statistics."""

    def state_dict(self) -> State: ...
    def load_state_dict(self, state: Any) -> object: ...


def save(rng: Generator, parts: dict[str, Part]) -> State:
    """The parts by name, and the generator `rng` that they share."""
    return {name: part.state_dict() for name, part in parts.items()} | {"rng": rng.get_state()}


def load(state: State, rng: Generator, parts: dict[str, Part]) -> None:
    """Continue from `save`."""
    for name, part in parts.items():
        part.load_state_dict(state[name])
    rng.set_state(state["rng"].cpu())
