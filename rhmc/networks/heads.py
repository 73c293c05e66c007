"""Output heads of actors and the form of their actions for a critic: a draw among choices, or a point of a cube."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Generator, Tensor, nn
from torch.nn.functional import one_hot

from rhmc.networks.sampling import gumbel, mix, straight_through
from rhmc.types import Obs


class Head(Protocol):
    """The meaning of an actor's output (B, N, A). An action is (B, N) int64 or (B, N, A) float."""

    def critic(self, central: Callable[..., nn.Module]) -> nn.Module:
        """A network of (obs, own, joint) -> (B, N, 1) from `central(out, own=)`."""
        ...

    def greedy(self, output: Tensor) -> Tensor:
        """The best action."""
        ...

    def explore(self, output: Tensor, rng: Generator) -> Tensor:
        """An action to learn from."""
        ...

    def policy(self, output: Tensor, rng: Generator) -> Tensor:
        """An action as the critic takes it, (B, N, A), with a gradient."""
        ...

    def encode(self, action: Tensor) -> Tensor:
        """A taken action as the critic takes it, (B, N, A)."""
        ...


class Choices(nn.Module):
    """A value linear in the own action, so that its slope there is the difference that another choice makes."""

    def __init__(self, values: nn.Module) -> None:
        super().__init__()
        self.values = values

    def forward(self, obs: Obs, own: Tensor, joint: Tensor) -> Tensor:
        return (self.values(obs, joint=joint) * own).sum(-1, keepdim=True)


class Discrete(NamedTuple):
    """Logits of `actions` choices."""

    actions: int
    epsilon: float

    def critic(self, central: Callable[..., nn.Module]) -> nn.Module:
        return Choices(central(self.actions))

    def greedy(self, output: Tensor) -> Tensor:
        return output.argmax(-1)

    def explore(self, output: Tensor, rng: Generator) -> Tensor:
        logits = mix(output.softmax(-1), 1 / self.actions, self.epsilon).log()
        return (logits + gumbel(logits.shape, rng)).argmax(-1)

    def policy(self, output: Tensor, rng: Generator) -> Tensor:
        return straight_through(output, rng)

    def encode(self, action: Tensor) -> Tensor:
        return one_hot(action, self.actions).float()


class Continuous(NamedTuple):
    """A point in [-1, 1]^A before its tanh."""

    size: int
    noise: float

    def critic(self, central: Callable[..., nn.Module]) -> nn.Module:
        return central(1, own=self.size)

    def greedy(self, output: Tensor) -> Tensor:
        return output.tanh()

    def explore(self, output: Tensor, rng: Generator) -> Tensor:
        away = torch.randn(output.shape, generator=rng, device=rng.device)
        return (output.tanh() + self.noise * away).clamp(-1, 1)

    def policy(self, output: Tensor, rng: Generator) -> Tensor:
        return output.tanh()

    def encode(self, action: Tensor) -> Tensor:
        return action
