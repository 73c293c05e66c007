"""Parts of every learner: a replay buffer of rows, and a network with its target network and optimiser."""

from copy import deepcopy
from typing import Any, Generic, TypeVar

import torch
from torch import Generator, Tensor, nn

from rhmc.types import Batch, Obs, State, Transition

Net = TypeVar("Net", bound=nn.Module)


class Replay:
    """A ring of the newest `capacity` rows, kept on one device.

    Args:
        capacity: rows kept.
        rng: generator for sampling; its device holds the rows.
    """

    def __init__(self, capacity: int, rng: Generator) -> None:
        self.capacity, self.rng = capacity, rng
        self.rows: Batch = {}
        self.next = self.size = 0

    def add(self, rows: Batch) -> None:
        """Append rows: tensors with one leading dimension, the same keys and shapes at every call."""
        count = len(next(iter(rows.values())))
        if not self.rows:
            self.rows = {k: v.new_zeros(self.capacity, *v.shape[1:]) for k, v in rows.items()}
        index = torch.arange(self.next, self.next + count, device=self.rng.device) % self.capacity
        for key, value in rows.items():
            self.rows[key][index] = value
        self.next = (self.next + count) % self.capacity
        self.size = min(self.size + count, self.capacity)

    def sample(self, count: int) -> Batch:
        """`count` rows, uniformly and with replacement."""
        index = torch.randint(self.size, (count,), generator=self.rng, device=self.rng.device)
        return {key: value[index] for key, value in self.rows.items()}

    def state_dict(self) -> State:
        """The filled rows and the ring's position; the generator belongs to its owner."""
        return {"rows": {k: v[: self.size].clone() for k, v in self.rows.items()}, "next": self.next, "size": self.size}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        self.next, self.size = state["next"], state["size"]
        self.rows = {}
        for key, value in state["rows"].items():
            self.rows[key] = value.new_zeros(self.capacity, *value.shape[1:], device=self.rng.device)
            self.rows[key][: self.size] = value.to(self.rng.device)


class Learner(Generic[Net]):
    """A network, its target network and its optimiser. The loss is handed in at each update.

    Args:
        net: the network that learns.
        lr: Adam's step size.
        tau: share of the way that the target network moves per update (1 - rho of Eq. 8 and 12); 0 leaves it as it is.
        max_grad_norm: largest norm of the gradient.
    """

    def __init__(self, net: Net, *, lr: float, tau: float = 0.005, max_grad_norm: float = 10.0) -> None:
        self.net, self.target_net = net, deepcopy(net).requires_grad_(False)
        self.tau, self.max_grad_norm = tau, max_grad_norm
        self.params: list[Tensor] = list(net.parameters())
        self.target_params: list[Tensor] = list(self.target_net.parameters())
        self.lr = lr
        self.optimiser = torch.optim.Adam(self.params, lr=lr, fused=True)

    def anneal(self, left: float) -> None:
        """Set the step size to `left` times the one given at the start."""
        for group in self.optimiser.param_groups:
            group["lr"] = self.lr * left

    def update(self, loss: Tensor) -> Tensor:
        """One step down `loss`; returns the norm of the gradient. Other networks in the loss are left alone.

        Gradients are laid in memory as their weights are: the fused optimiser reads both in the order of memory.
        """
        grads = torch.autograd.grad(loss, self.params)
        for param, grad in zip(self.params, grads, strict=True):
            param.grad = grad if grad.stride() == param.stride() else torch.empty_like(param).copy_(grad)
        norm = nn.utils.clip_grad_norm_(self.params, self.max_grad_norm, foreach=True)
        self.optimiser.step()
        if self.tau > 0:
            with torch.no_grad():
                torch._foreach_lerp_(self.target_params, self.params, self.tau)
        return norm

    def state_dict(self) -> State:
        """Network, target network and optimiser, live: write them out before the next update."""
        return {
            "net": self.net.state_dict(),
            "target_net": self.target_net.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        self.net.load_state_dict(state["net"])
        self.target_net.load_state_dict(state["target_net"])
        self.optimiser.load_state_dict(state["optimiser"])


Learners = list[Learner[Any]]


def pack(obs: Obs, prefix: str = "") -> Batch:
    """An observation as rows of a replay (`first` is left out: networks do not see it)."""
    return {f"{prefix}agents": obs.agents, f"{prefix}pairs": obs.pairs, f"{prefix}peers": obs.peers}


def unpack(rows: Batch, prefix: str = "") -> Obs:
    """The inverse of `pack`."""
    pairs = rows[f"{prefix}pairs"]
    first = torch.zeros(len(pairs), dtype=torch.bool, device=pairs.device)
    return Obs(rows[f"{prefix}agents"], pairs, rows[f"{prefix}peers"], first)


def pack_step(t: Transition) -> Batch:
    """One acted step as rows, (B, ...) each: observations before and after, action, reward, terminated."""
    rows = {"action": t.action, "reward": t.reward, "terminated": t.terminated}
    return pack(t.obs) | pack(t.next_obs, "next_") | rows


def taken(values: Tensor, action: Tensor) -> Tensor:
    """The values (B, N, actions) of the actions taken (B, N)."""
    return values.gather(-1, action.unsqueeze(-1)).squeeze(-1)


def choose(mask: Tensor, new: Batch, old: Batch) -> Batch:
    """Rows of `new` where `mask` (B,), else of `old`."""
    return {k: torch.where(mask.view(-1, *[1] * (v.dim() - 1)), v, old[k]) for k, v in new.items()}
