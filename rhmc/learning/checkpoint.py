"""The state of a method from the states of its parts."""

from typing import Any, Protocol

from torch import Generator

from rhmc.types import State


class Part(Protocol):
    """Anything with a state: a learner, a replay, a rollout, statistics."""

    def state_dict(self) -> State: ...
    def load_state_dict(self, state: Any) -> object: ...


Parts = dict[str, Part]


def save(rng: Generator, parts: Parts) -> State:
    """The parts by name, and the generator `rng` that they share."""
    return save_parts(parts) | {"rng": rng.get_state()}


def load(state: State, rng: Generator, parts: Parts) -> None:
    """Continue from `save`."""
    load_parts(state, parts)
    rng.set_state(state["rng"].cpu())


def save_parts(parts: Parts) -> State:
    """The parts by name, of something whose generator belongs to its owner."""
    return {name: part.state_dict() for name, part in parts.items()}


def load_parts(state: State, parts: Parts) -> None:
    """Continue from `save_parts`."""
    for name, part in parts.items():
        part.load_state_dict(state[name])
