"""Segments: some steps of one environment in order, with the state of a recurrent network before the first of them.

Gradients flow through a segment and no further (truncated backpropagation). The state at its start is the one that
acted then (the stored state of R2D2, Kapturowski et al. 2019). Rows of a segment hold `first`, where an episode begins
and the state starts anew; `state` and other names in `STATES` belong to the whole segment.
"""

from collections.abc import Iterator

import torch
from torch import Generator, Tensor, nn

from rhmc.learning.experience import Experience, Rollout, ends, flat
from rhmc.learning.learner import unpack
from rhmc.learning.settings import Replayed
from rhmc.networks.recurrent import unrolled
from rhmc.types import Batch, State, Transition

STATES = ("state", "critic_state")  # (K, N, H) of K segments


class Segments(Experience):
    """A replay of segments; size, batch and pace count environment steps as of any replay.

    Args:
        cfg: size and pace.
        batch_size: steps of an update, a multiple of `length`.
        length: steps of a segment.
        rng: generator for sampling; its device holds the rows.
    """

    def __init__(self, cfg: Replayed, batch_size: int, length: int, rng: Generator) -> None:
        whole = cfg.model_copy(update={"buffer_size": cfg.buffer_size // length})
        super().__init__(whole, batch_size // length, rng)
        self.begun = Rollout(length, rng.device)

    def add_step(self, t: Transition, state: Tensor) -> None:
        """Keep one step of B environments, and the state (B, N, H) before it."""
        self.steps += len(t.reward)
        self.begun.add(t, first=t.obs.first, state=state)
        if rows := self.begun.take():
            self.add(cut(rows, len(rows["first"])), 0)

    def due(self) -> Iterator[Batch]:
        """A batch (T, K, ...) of K segments for every update that is due."""
        for segments in super().due():
            yield in_time(segments)

    def state_dict(self) -> State:
        """Segments, the steps of those begun, and counters."""
        return super().state_dict() | {"begun": self.begun.state_dict()}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        super().load_state_dict(state)
        self.begun.load_state_dict(state["begun"])


def cut(rows: Batch, length: int) -> Batch:
    """Steps (T, B, ...), T a multiple of `length`, as T B / `length` segments (K, length, ...), states (K, ...)."""
    parts = {key: value.unflatten(0, (-1, length)).transpose(1, 2).flatten(0, 1) for key, value in rows.items()}
    return {key: value[:, 0] if key in STATES else value for key, value in parts.items()}


def in_time(segments: Batch) -> Batch:
    """Segments (K, T, ...) as steps (T, K, ...); states stay (K, ...)."""
    return {key: v if key in STATES else v.transpose(0, 1).contiguous() for key, v in segments.items()}


def along(net: nn.Module, rows: Batch, state: Tensor) -> tuple[Tensor, Tensor]:
    """Output of every step and state after it, (T, B, N, out) and (T, B, N, H), from the state before the first."""
    seen = {key: rows[key] for key in ("agents", "pairs", "peers")}
    return unrolled(net, unpack(flat(seen)), state, rows["first"])


@torch.no_grad()
def following(net: nn.Module, rows: Batch, output: Tensor, states: Tensor) -> Tensor:
    """Output for the true successor of every step (T, B, N, out), without a gradient; `output`, `states` by `along`.

    It is that of the next row, but where an episode or the rows end: there the network goes on to what came after.
    """
    last, after = ends(rows)
    found = torch.cat((output[1:], output[-1:]))
    goes_on = torch.zeros(1, len(after.first), dtype=torch.bool, device=last.device)
    found[last] = unrolled(net, after, states[last], goes_on)[0][0]
    return found
