"""Encoders with memory: the network of any encoder, a GRU cell behind it, and a linear head.

A state is (B, N, H), a row for each agent; it starts at zero, and again where an episode begins. The cell is that of
`torch.nn.GRU`, made of this project's layers: nobody says that torch's own has the same bytes on every processor.
"""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor, nn

from rhmc.networks.linear import Linear
from rhmc.networks.nets import ENCODERS, Encoder, Sizes
from rhmc.types import Obs

AnyEncoderName = Literal["mlp", "pairwise", "mlp_gru", "pairwise_gru"]
GRU = "_gru"  # ends the name of an encoder with memory


class Cell(nn.Module):
    """Gated recurrent unit (Cho et al. 2014), its input's part apart, as that of all steps is one product."""

    def __init__(self, size: int, hidden: int) -> None:
        super().__init__()
        self.inputs, self.hidden = Linear(size, 3 * hidden), Linear(hidden, 3 * hidden)

    def forward(self, inputs: Tensor, state: Tensor) -> Tensor:
        """The next state (..., H) from `self.inputs` of what is seen, (..., 3 H), and the state (..., H)."""
        size = state.shape[-1]
        gates, new = inputs.split((2 * size, size), -1)
        by_state, by_new = self.hidden(state).split((2 * size, size), -1)
        reset, keep = (gates + by_state).sigmoid().chunk(2, -1)
        candidate = (new + reset * by_new).tanh()
        return candidate + keep * (state - candidate)


class Recurrent(nn.Module):
    """A network, a cell and a head over T steps of B environments in order -> (T B, N, out + H).

    The output of each step stands beside the state after it, so that `Unshared` and target networks work as with any
    network; `unrolled` takes them apart.
    """

    def __init__(self, body: nn.Module, hidden: int, out: int) -> None:
        super().__init__()
        self.body, self.cell, self.head = body, Cell(hidden, hidden), Linear(hidden, out)

    def forward(self, obs: Obs, state: Tensor, first: Tensor) -> Tensor:
        """Of observations (T B, ...), the state before them (B, N, H), and where an episode begins, (T, B) bool."""
        seen = self.cell.inputs(self.body(obs).relu()).unflatten(0, first.shape)
        states = []
        for inputs, begins in zip(seen, first, strict=True):
            state = self.cell(inputs, torch.where(begins.view(-1, 1, 1), 0.0, state))
            states.append(state)
        after = torch.cat(states)
        return torch.cat((self.head(after), after), -1)


def unrolled(net: nn.Module, obs: Obs, state: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
    """Output of every step and state after it, (T, B, N, out) and (T, B, N, H); arguments as of `Recurrent`."""
    both: Tensor = net(obs, state, first).unflatten(0, first.shape)
    size = state.shape[-1]
    output, states = both.split((both.shape[-1] - size, size), -1)
    return output, states


def stepped(net: nn.Module, obs: Obs, state: Tensor) -> tuple[Tensor, Tensor]:
    """The same of one step, without a gradient: (B, N, out) and (B, N, H)."""
    with torch.no_grad():
        output, states = unrolled(net, obs, state, obs.first.unsqueeze(0))
    return output[0], states[0]


def remembers(name: str) -> bool:
    """True if an encoder has memory."""
    return name.endswith(GRU)


def encoder(name: str) -> Encoder:
    """The shapes of any encoder; with memory `local` and `central` are `Recurrent`, and a mixer has none."""
    plain = ENCODERS[name.removesuffix(GRU)]
    if not remembers(name):
        return plain
    return plain._replace(local=_with_memory(plain.local), central=_with_memory(plain.central))


def _with_memory(make: Callable[..., nn.Module]) -> Callable[..., nn.Module]:
    def made(sizes: Sizes, hidden: int, out: int) -> Recurrent:
        return Recurrent(make(sizes, hidden, hidden), hidden, out)

    return made
