"""One setting trained with several seeds, a point of the grid at a time: what a trial of a search is."""

from collections.abc import Sequence
from typing import Self

from pipelines.execution.finite import defined
from pipelines.specs.study import Setting
from rhmc.training.trainer import Trainer
from rhmc.types import Metrics, State


class Seeds:
    """An iterator of metrics like `Trainer`. A point holds the mean of each metric over the seeds.

    At the last point `seeds/<seed>` is the final return of each. Side by side rather than one after the other, so that
    a decision to give up sees all of them at the same step.
    """

    def __init__(self, setting: Setting, seeds: Sequence[int]) -> None:
        parts = (setting.env, setting.algo, setting.trainer)
        self.trainers = {seed: Trainer(*parts, seed) for seed in seeds}

    @property
    def first(self) -> Trainer:
        """One of the trainers: all are at the same point."""
        return next(iter(self.trainers.values()))

    @property
    def step(self) -> int:
        """Environment steps of each seed."""
        return self.first.step

    @property
    def done(self) -> bool:
        """True if the budget is spent and evaluated."""
        return self.first.done

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Metrics:
        points = {seed: defined(next(trainer)) for seed, trainer in self.trainers.items()}
        names = {name: None for point in points.values() for name in point}
        means = {}
        for name in names:
            values = [point[name] for point in points.values() if name in point]
            means[name] = sum(values) / len(values)
        finals = {f"seeds/{seed}": point["final/return"] for seed, point in points.items() if "final/return" in point}
        return means | finals

    def start_from(self, policy: State) -> None:
        """Let every seed start from a policy."""
        for trainer in self.trainers.values():
            trainer.start_from(policy)

    def state_dict(self) -> State:
        """All seeds between two points of the grid."""
        return {"seeds": [trainer.state_dict() for trainer in self.trainers.values()]}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`, bit for bit."""
        for trainer, one in zip(self.trainers.values(), state["seeds"], strict=True):
            trainer.load_state_dict(one)
