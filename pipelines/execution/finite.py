"""True if a training still holds finite numbers only: its metrics, and everything that it learns with.

A network that holds one value that is not finite gives nothing else from then on, and its greedy policy still earns a
return, so that the run would look like any other.
"""

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from rhmc.types import Metrics, State

UNDEFINED = ("train/explained",)  # a share of a variance, and a rollout's targets may all be the same
UNBOUNDED = ("bound",)  # of an assignment: minus infinity where no regulator bounds it


class DivergedError(Exception):
    """A value of a training is not finite; str() is the whole message, one line."""


def defined(point: Metrics) -> Metrics:
    """A point without the metrics that have no value in it."""
    return {name: value for name, value in point.items() if name not in UNDEFINED or math.isfinite(value)}


def check(point: Metrics, state: State) -> None:
    """See that a point of the grid and the state that led to it are finite.

    Args:
        point: metrics with their `step`.
        state: of a training or of parts of it, without what was kept to learn from: that shows in the metrics.

    Raises:
        DivergedError: the first value that is not, metrics before weights.
    """
    for name, value in point.items():
        if not math.isfinite(value):
            raise _diverged(name, value, point)
    for name, tensor in astray(state):
        raise _diverged(name, float(tensor[~torch.isfinite(tensor)][0]), point)


def astray(state: Any) -> Iterator[tuple[str, Tensor]]:
    """The tensors of a state that hold a value that is not finite and may not, by dotted path."""
    for name, tensor in _tensors(state):
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            yield name, tensor


def _diverged(name: str, value: float, point: Metrics) -> DivergedError:
    return DivergedError(
        f"diverged: {name} is {value} at step {int(point['step']):,}; every value must be finite, so try a smaller lr "
        "or max_grad_norm"
    )


def _tensors(state: Any, path: str = "") -> Iterator[tuple[str, Tensor]]:
    """Every tensor of a state by its dotted path, but for those that may hold infinity."""
    if isinstance(state, Tensor):
        yield path, state
    inner = state.items() if isinstance(state, dict) else enumerate(state) if isinstance(state, list | tuple) else ()
    for key, child in inner:
        if key not in UNBOUNDED:
            yield from _tensors(child, f"{path}.{key}" if path else str(key))
