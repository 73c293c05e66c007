"""Parts that tests of several rooms build from: generators, observations, and networks with known outputs."""

from collections.abc import Callable
from copy import copy
from typing import Any

import torch
from torch import Tensor, nn

from rhmc.learning.learner import pack
from rhmc.types import Batch, Obs, Spec


def observation(spec: Spec, batch: int = 1, *, first: bool = False) -> Obs:
    """A random observation of a task with the sizes of `spec`."""
    n, m = spec.agents, spec.targets
    pairs, agents = torch.randn(batch, n, m, spec.pair_features), torch.randn(batch, n, spec.agent_features)
    return Obs(agents, pairs, torch.randn(batch, n, n, spec.peer_features), torch.full((batch,), first))


def observed(spec: Spec, batch: int) -> Batch:
    """Columns of random observations and of those after them, as replay holds them."""
    return pack(observation(spec, batch)) | pack(observation(spec, batch), "next_")


def constant(net: nn.Module, out: list[float]) -> Tensor:
    """Make a network return `out`, on its last axis, for every input; returns the weights that hold it."""
    weights = list(net.parameters())
    with torch.no_grad():
        for p in weights:
            p.zero_()
        weights[-1].copy_(torch.tensor(out).expand_as(weights[-1].view(-1, len(out))).reshape(weights[-1].shape))
    return weights[-1]


def copied(state: Any) -> Any:
    """The same content in new dicts, lists and tensors of the same kinds, in less time than `copy.deepcopy` takes."""
    if isinstance(state, dict):
        fresh = copy(state)
        fresh.update({key: copied(value) for key, value in state.items()})
        return fresh
    if isinstance(state, list | tuple):
        return type(state)(map(copied, state))
    return state.clone() if isinstance(state, Tensor) else state


def changing(text: str) -> Callable[[str, str], str]:
    """A function that replaces a part of `text` which is there once."""

    def changed(old: str, new: str) -> str:
        assert text.count(old) == 1
        return text.replace(old, new)

    return changed
