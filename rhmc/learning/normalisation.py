"""Standardisation of rewards and values, with one switch.

`reward`: a method learns from (reward - mean) / deviation. `return`: networks predict (return - mean) / deviation (the
value normalisation of Yu et al. 2022, EPyMARL's standardised returns). `none`: neither.
"""

from typing import Literal

import torch
from torch import Tensor

from rhmc.types import State

Scale = Literal["none", "reward", "return"]
KEPT = 0.999  # share of the statistics kept per update
LEAST = 1e-2  # smallest deviation


class RunningMeanStd:
    """Moving averages of mean and deviation, corrected for their start; 0 and 1 before the first update.

    Args:
        device: where the statistics live.
    """

    def __init__(self, device: torch.device) -> None:
        self.sums = torch.zeros(3, device=device)  # of weights, values and squares

    def update(self, values: Tensor) -> None:
        """Count in values of any shape."""
        if not values.numel():
            return
        new = torch.stack((torch.ones_like(self.sums[0]), values.mean(), values.square().mean()))
        self.sums = torch.lerp(new, self.sums, KEPT)

    def normalise(self, values: Tensor) -> Tensor:
        """(values - mean) / deviation."""
        mean, deviation = self.moments()
        return (values - mean) / deviation

    def denormalise(self, values: Tensor) -> Tensor:
        """The inverse of `normalise`."""
        mean, deviation = self.moments()
        return values * deviation + mean

    def moments(self) -> tuple[Tensor, Tensor]:
        """Mean and deviation, () each."""
        weight, mean, square = self.sums
        updated = weight > 0
        weight = weight.clamp(min=1e-12)
        mean = mean / weight
        deviation = (square / weight - mean.square()).clamp(min=LEAST**2).rsqrt().reciprocal()  # MKL's `sqrt` differs
        return torch.where(updated, mean, 0.0), torch.where(updated, deviation, 1.0)

    def state_dict(self) -> State:
        """The statistics."""
        return {"sums": self.sums}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        self.sums = state["sums"].to(self.sums.device)


class Standardiser(RunningMeanStd):
    """Rewards, network outputs and targets on the scale of one mode; the statistics are of rewards or of returns.

    Args:
        mode: quantity that is standardised.
        device: where the statistics live.
    """

    def __init__(self, mode: Scale, device: torch.device) -> None:
        super().__init__(device)
        self.mode = mode

    def update_rewards(self, reward: Tensor) -> None:
        """Count in raw rewards, any shape, where rewards are standardised."""
        if self.mode == "reward":
            self.update(reward)

    def update_returns(self, returns: Tensor) -> None:
        """Count in returns that become targets, any shape, where returns are standardised."""
        if self.mode == "return":
            self.update(returns)

    def reward(self, reward: Tensor) -> Tensor:
        """A raw reward as the method learns from it."""
        return self.normalise(reward) if self.mode == "reward" else reward

    def value(self, output: Tensor) -> Tensor:
        """A network's output as a return."""
        return self.denormalise(output) if self.mode == "return" else output

    def target(self, value: Tensor) -> Tensor:
        """A return as the target of a network's output."""
        return self.normalise(value) if self.mode == "return" else value
