"""Eq. 10."""

import pytest
import torch
from torch import Tensor

from rhmc.hierarchy.filters import FILTERS


@pytest.fixture
def pairs() -> Tensor:
    return torch.arange(1.0, 1 + 2 * 3 * 4 * 5).view(2, 3, 4, 5)  # nothing is zero before the filter


@pytest.fixture
def assignment() -> Tensor:
    held = torch.zeros(2, 3, 4)
    held[0, 1, 2] = held[1, 2, 0] = held[1, 2, 3] = 1
    return held


@pytest.mark.parametrize("dtype", [torch.bool, torch.int64, torch.float32])
def test_on_keeps_assigned_targets_and_zeroes_the_others(pairs: Tensor, assignment: Tensor, dtype: torch.dtype) -> None:
    kept = FILTERS["on"](pairs, assignment.to(dtype))
    for b, i, j in torch.cartesian_prod(torch.arange(2), torch.arange(3), torch.arange(4)).tolist():
        expected = pairs[b, i, j] if assignment[b, i, j] else torch.zeros(5)
        assert torch.equal(kept[b, i, j], expected)


def test_on_does_not_let_an_unassigned_feature_through_in_any_form(pairs: Tensor, assignment: Tensor) -> None:
    """Neither its value, not even an infinite one, nor its gradient."""
    pairs[0, 0, 0] = torch.inf
    pairs.requires_grad_()
    kept = FILTERS["on"](pairs, assignment)
    assert kept.isfinite().all()
    kept.sum().backward()
    assert pairs.grad is not None
    assert torch.equal(pairs.grad, assignment.unsqueeze(-1).expand(2, 3, 4, 5))


def test_on_changes_nothing_in_place(pairs: Tensor, assignment: Tensor) -> None:
    before = pairs.clone()
    FILTERS["on"](pairs, assignment)
    assert torch.equal(pairs, before)


def test_off_shows_everything(pairs: Tensor, assignment: Tensor) -> None:
    assert torch.equal(FILTERS["off"](pairs, assignment), pairs)
