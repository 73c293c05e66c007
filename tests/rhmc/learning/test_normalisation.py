"""The scale of rewards and values against numpy, over what a moving average has seen."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pipelines.conformance.same import assert_same
from rhmc.learning.normalisation import KEPT, LEAST, Standardiser

CPU = torch.device("cpu")
batches = st.lists(
    st.lists(st.floats(-50, 50, allow_nan=False, width=32), min_size=1, max_size=5), min_size=1, max_size=6
)


def moments(seen: list[list[float]]) -> tuple[float, float]:
    """Mean and deviation, every batch one voice, an older one quieter by `KEPT` per batch seen since."""
    voices = np.concatenate(
        [np.full(len(x), KEPT ** (len(seen) - 1 - k) / len(x), dtype=np.float64) for k, x in enumerate(seen)]
    )
    values = np.concatenate(seen).astype(np.float64)
    mean = float(np.average(values, weights=voices))
    return mean, max(float(np.sqrt(np.average((values - mean) ** 2, weights=voices))), LEAST)


def updated(standard: Standardiser, batches: list[list[float]], *, returns: bool = False) -> Standardiser:
    for batch in batches:
        (standard.update_returns if returns else standard.update_rewards)(torch.tensor(batch))
    return standard


@settings(deadline=None, max_examples=100)
@given(batches, st.floats(-50, 50))
def test_rewards_get_mean_0_and_deviation_1_of_what_was_seen(batches: list[list[float]], reward: float) -> None:
    mean, deviation = moments(batches)
    paid = updated(Standardiser("reward", CPU), batches).reward(torch.tensor(reward, dtype=torch.float32))
    # A variance far below the values' squares is the small difference of large numbers: to the float's digits only.
    slack = 1e-3 + 5e-7 * (max(abs(x) for batch in batches for x in batch) / deviation) ** 2
    assert float(paid) * deviation == pytest.approx(reward - mean, rel=slack, abs=slack)


@settings(deadline=None, max_examples=100)
@given(batches, st.floats(-50, 50))
def test_a_network_predicts_returns_of_mean_0_and_deviation_1(batches: list[list[float]], output: float) -> None:
    mean, deviation = moments(batches)
    standard = updated(Standardiser("return", CPU), batches, returns=True)
    x = torch.tensor(output, dtype=torch.float32)
    assert torch.allclose(standard.target(standard.value(x)), x, atol=1e-2)
    slack = 1e-2 + 1e-4 * max(abs(x) for batch in batches for x in batch) / deviation
    assert float(standard.value(x)) == pytest.approx(output * deviation + mean, rel=slack, abs=50 * slack)


def test_the_first_batch_counts_in_full() -> None:
    """The start of the average at zero is corrected for: without it, the mean would be a thousandth of 3."""
    standard = updated(Standardiser("reward", CPU), [[1.0, 5.0]])
    assert standard.reward(torch.tensor([1.0, 3.0, 5.0])).tolist() == pytest.approx([-1.0, 0.0, 1.0], abs=1e-3)


def test_old_batches_are_forgotten() -> None:
    standard = updated(Standardiser("reward", CPU), [[0.0, 2.0]] * 50 + [[10.0, 14.0]] * 8000)
    assert standard.reward(torch.tensor([12.0, 14.0])).tolist() == pytest.approx([0.0, 1.0], abs=0.02)


@pytest.mark.parametrize("mode", ["none", "reward", "return"])
def test_before_anything_is_seen_everything_stays_as_it_is(mode: str) -> None:
    standard, x = Standardiser(mode, CPU), torch.tensor([-3.0, 0.5])  # type: ignore[arg-type]
    for there in (standard.reward, standard.value, standard.target):
        assert torch.equal(there(x), x)


@pytest.mark.parametrize("mode", ["reward", "return"])
def test_nothing_seen_changes_nothing(mode: str) -> None:
    standard = Standardiser(mode, CPU)  # type: ignore[arg-type]
    for values in ([], [2.0, 4.0], []):
        standard.update_rewards(torch.tensor(values))
        standard.update_returns(torch.tensor(values))
    there = standard.reward if mode == "reward" else standard.target
    assert there(torch.tensor([2.0, 4.0])).tolist() == pytest.approx([-1.0, 1.0], abs=1e-3)


@pytest.mark.parametrize("mode", ["none", "reward", "return"])
def test_a_mode_touches_its_own_numbers_only(mode: str) -> None:
    """`reward` scales rewards by the rewards seen, `return` values by the returns seen, `none` nothing."""
    x = torch.tensor([6.0, 10.0])
    standard = Standardiser(mode, CPU)  # type: ignore[arg-type]
    standard.update_rewards(torch.tensor([7.0, 9.0]))
    standard.update_returns(torch.tensor([0.0, 4.0]))

    def close(got: Tensor, want: list[float]) -> None:
        assert got.tolist() == pytest.approx(want, abs=5e-3)

    close(standard.reward(x), [-2.0, 2.0] if mode == "reward" else [6.0, 10.0])
    close(standard.value(x), [14.0, 22.0] if mode == "return" else [6.0, 10.0])
    close(standard.target(x), [2.0, 4.0] if mode == "return" else [6.0, 10.0])


def test_the_deviation_has_a_floor() -> None:
    standard = updated(Standardiser("reward", CPU), [[5.0, 5.0]])
    assert standard.reward(torch.tensor(5.0 + LEAST)).item() == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("mode", ["none", "reward", "return"])
def test_a_checkpoint_continues_bit_for_bit(mode: str) -> None:
    first, other = (Standardiser(mode, CPU) for _ in range(2))  # type: ignore[arg-type]
    for standard in (first, other):
        standard.update_rewards(torch.tensor([1.0, 2.0, 4.0]))
        standard.update_returns(torch.tensor([8.0, 16.0]))
    fresh = Standardiser(mode, CPU)  # type: ignore[arg-type]
    fresh.load_state_dict(first.state_dict())
    for standard in (fresh, other):
        standard.update_rewards(torch.tensor([3.0, 9.0]))
        standard.update_returns(torch.tensor([-3.0, 9.0]))
    assert_same(fresh.state_dict(), other.state_dict())
    x = torch.tensor([0.1, 20.0])
    for name in ("reward", "value", "target"):
        assert torch.equal(getattr(fresh, name)(x), getattr(other, name)(x))
