"""A rollout of assignments, whose periods end at other steps in other environments."""

import torch
from torch import Tensor

from rhmc.types import Batch, State


class Decisions:
    """The latest assignments of every environment with what came of them, until one has made `length` of them."""

    def __init__(self, length: int, device: torch.device) -> None:
        self.length, self.device = length, device
        self.rows: Batch = {}  # (length, B, ...)
        self.count = torch.zeros(0, dtype=torch.int64)  # (B,) assignments kept

    def add(self, rows: Batch, over: Tensor) -> None:
        """Keep the rows (B, ...) of the environments whose period is `over`, (B,) bool."""
        if not bool(over.any()):
            return
        if not self.rows:
            self.rows = {key: value.new_zeros(self.length, *value.shape) for key, value in rows.items()}
            self.count = torch.zeros(len(over), dtype=torch.int64, device=self.device)
        where = over.nonzero().squeeze(1)
        for key, value in rows.items():
            self.rows[key][self.count[where], where] = value[where]
        self.count = self.count + over

    def take(self) -> Batch | None:
        """All rows once an environment has `length`: those `filled` (length, B), the last of each marked `done`."""
        if not len(self.count) or int(self.count.max()) < self.length:
            return None
        place = torch.arange(self.length, device=self.device).unsqueeze(1)
        rows = self.rows | {"filled": place < self.count, "done": self.rows["done"] | (place >= self.count - 1)}
        self.rows, self.count = {}, self.count[:0]
        return rows

    def state_dict(self) -> State:
        """The rows kept so far."""
        return {"rows": self.rows, "count": self.count}

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`."""
        self.rows = {key: value.to(self.device, copy=True) for key, value in state["rows"].items()}
        self.count = state["count"].to(self.device)
