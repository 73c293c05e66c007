"""Networks with known outputs, to put in the place of learned ones."""

import torch
from torch import Tensor, nn

from rhmc.types import Obs


class Known(nn.Module):
    """Action values (B, N, actions), the same everywhere, so that what is learned from them can be worked out."""

    def __init__(self, values: list[list[float]]) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.tensor(values))

    def forward(self, obs: Obs) -> Tensor:
        return self.values.expand(len(obs.pairs), -1, -1)
