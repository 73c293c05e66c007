"""One switch for the scale of rewards and values.

`reward`: a learner is paid (reward - mean) / deviation. `return`: networks predict (return - mean) / deviation (the
value normalisation of Yu et al. 2022, EPyMARL's standardised returns). `none`: as they come. Statistics are moving
averages with their start corrected for.
"""

from typing import Literal

import torch
from torch import Tensor

from rhmc.types import State

Scale = Literal["none", "reward", "return"]
KEPT = 0.999  # share of the statistics kept per batch seen
LEAST = 1e-2  # smallest deviation


class Standard:
    """Mean and deviation of the rewards or returns met so far; 0 and 1 until the first.

    Args:
        mode: what is standardised.
        device: where the statistics live.
    """

    def __init__(self, mode: Scale, device: torch.device) -> None:
        self.mode = mode
        self.sums = torch.zeros(3, device=device)  # of weights, values and squares

    def see_rewards(self, reward: Tensor) -> None:
        """Count in rewards as they come, any shape."""
        if self.mode == "reward":
            self._see(reward)

    def see_returns(self, value: Tensor) -> None:
        """Count in returns that are about to be a target, any shape."""
        if self.mode == "return":
            self._see(value)

    def reward(self, reward: Tensor) -> Tensor:
        """What the learner is paid."""
        return self._down(reward) if self.mode == "reward" else reward

    def value(self, output: Tensor) -> Tensor:
        """A network's output as a return."""
        if self.mode != "return":
            return output
        mean, deviation = self._moments()
        return output * deviation + mean

    def target(self, value: Tensor) -> Tensor:
        """A return as what a network should put out."""
        return self._down(value) if self.mode == "return" else value

    def _down(self, x: Tensor) -> Tensor:
        mean, deviation = self._moments()
        return (x - mean) / deviation

    def _see(self, x: Tensor) -> None:
        if not x.numel():
            return
        new = torch.stack((torch.ones_like(self.sums[0]), x.mean(), x.square().mean()))
        self.sums = torch.lerp(new, self.sums, KEPT)

    def _moments(self) -> tuple[Tensor, Tensor]:
        weight, mean, square = self.sums
        seen = weight > 0
        weight = weight.clamp(min=1e-12)
        mean = mean / weight
        deviation = (square / weight - mean.square()).clamp(min=LEAST**2).rsqrt().reciprocal()  # MKL's `sqrt` differs
        return torch.where(seen, mean, 0.0), torch.where(seen, deviation, 1.0)

    def state_dict(self) -> State:
        """The statistics."""
        return {"sums": self.sums}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        self.sums = state["sums"].to(self.sums.device)
