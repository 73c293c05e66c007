"""Experience kept until an update is due: a replay buffer for off-policy methods, rollouts for on-policy ones."""

from collections.abc import Callable, Iterator

import torch
from torch import Generator, Tensor

from rhmc.learning.learner import Replay, pack_step, unpack
from rhmc.learning.settings import Replayed
from rhmc.types import Batch, Obs, State, Transition


class Experience:
    """A replay buffer and its pace: after `learning_starts`, one update for every `train_freq` environment steps.

    Args:
        cfg: size and pace.
        batch_size: rows of an update.
        rng: generator for sampling; its device holds the rows.
    """

    def __init__(self, cfg: Replayed, batch_size: int, rng: Generator) -> None:
        self.cfg, self.batch_size = cfg, batch_size
        self.replay = Replay(cfg.buffer_size, rng)
        self.steps = self.updates = 0

    def add(self, rows: Batch, steps: int) -> None:
        """Keep rows; `steps` environment steps were taken for them."""
        self.replay.add(rows)
        self.steps += steps

    def due(self) -> Iterator[Batch]:
        """A batch for every update that is due."""
        while self.replay.size and self.updates < (self.steps - self.cfg.learning_starts) // self.cfg.train_freq:
            self.updates += 1
            yield self.replay.sample(self.batch_size)

    def state_dict(self) -> State:
        """Rows and counters; the generator belongs to its owner."""
        return {"replay": self.replay.state_dict(), "steps": self.steps, "updates": self.updates}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        self.replay.load_state_dict(state["replay"])
        self.steps, self.updates = state["steps"], state["updates"]


class Rollout:
    """The latest steps of all environments, in order, until there are `length` of them."""

    def __init__(self, length: int, device: torch.device) -> None:
        self.length, self.device = length, device
        self.rows: list[Batch] = []

    def add(self, t: Transition, **more: Tensor) -> None:
        """Keep one step of B environments, and what else is needed of it, (B, ...) each."""
        self.rows.append(pack_step(t) | {"done": t.terminated | t.truncated} | more)

    def take(self) -> Batch | None:
        """All rows as (T, B, ...) once there are T = `length` of them; the next rollout then starts."""
        if len(self.rows) < self.length:
            return None
        rows, self.rows = self.rows, []
        return {key: torch.stack([row[key] for row in rows]) for key in rows[0]}

    def state_dict(self) -> State:
        """The rows kept so far."""
        return {"rows": list(self.rows)}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        self.rows = [{key: value.to(self.device) for key, value in row.items()} for row in state["rows"]]


def flat(rows: Batch) -> Batch:
    """(T, B, ...) -> (T B, ...)."""
    return {key: value.flatten(0, 1) for key, value in rows.items()}


def minibatches(rows: Batch, epochs: int, parts: int, rng: Generator) -> Iterator[Batch]:
    """In every epoch all rows (K, ...) once, in a drawn order, as `parts` batches."""
    count = len(next(iter(rows.values())))
    for _ in range(epochs):
        for index in torch.randperm(count, generator=rng, device=rng.device).chunk(parts):
            yield {key: value[index] for key, value in rows.items()}


def ends(rows: Batch) -> tuple[Tensor, Obs]:
    """Steps whose true successor is not the next row, (T, B) bool, and these successors, leading K.

    Such steps end an episode or stand in the last row.
    """
    last = rows["done"].clone()
    last[-1] = True
    after = {key: rows[key][last] for key in ("next_agents", "next_pairs", "next_peers")}
    return last, unpack(after, "next_")


def values(network: Callable[[Obs], Tensor], rows: Batch) -> tuple[Tensor, Tensor]:
    """Values (B, ...) of every step's observation and of its true successor: (T, B, ...) both.

    The successor of a step is the next row, but where an episode or the rollout ends: there, and only there, the
    network is asked about `next_` observations.
    """
    value = network(unpack(flat(rows))).unflatten(0, rows["reward"].shape)
    last, after = ends(rows)
    next_values = torch.cat((value[1:], value[-1:]))
    next_values[last] = network(after)
    return value, next_values
