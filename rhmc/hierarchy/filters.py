"""The target-conditioned filter (Eq. 10): an executor does not see the targets that it is not assigned to."""

from collections.abc import Callable

from torch import Tensor

Filter = Callable[[Tensor, Tensor], Tensor]


def on(pairs: Tensor, assignment: Tensor) -> Tensor:
    """Features of unassigned targets set to zero.

    Args:
        pairs: (B, N, M, F), what agent i knows about target j (`Obs.pairs`).
        assignment: (B, N, M), 0 or 1 in any dtype.

    Returns:
        (B, N, M, F).
    """
    return pairs.masked_fill((assignment <= 0.5).unsqueeze(-1), 0)


def off(pairs: Tensor, assignment: Tensor) -> Tensor:
    """No filter: every target is seen."""
    return pairs


FILTERS: dict[str, Filter] = {"on": on, "off": off}
