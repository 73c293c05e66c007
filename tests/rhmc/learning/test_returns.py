"""Returns and advantages against their forward view: sums over what lies ahead, written out for every row."""

from collections.abc import Callable
from typing import NamedTuple

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from rhmc.learning.returns import gae, n_step, td_lambda

GOING, CUT, OVER = range(3)  # what comes after a row: the next one, another episode, nothing


class Rows(NamedTuple):
    """Time-major rows (T, B)."""

    reward: Tensor
    value: Tensor
    next_values: Tensor
    terminated: Tensor
    done: Tensor

    def each(self, per_row: "Callable[[Rows, int, int], float]") -> Tensor:
        """(T, B) from one number at a time."""
        length, batch = self.reward.shape
        return torch.tensor([[per_row(self, t, b) for b in range(batch)] for t in range(length)], dtype=torch.float64)

    def reach(self, t: int, b: int) -> int:
        """Rows from t to the end of the episode or of the sequence, t included."""
        rest = self.done[t:, b].tolist()
        return rest.index(True) + 1 if True in rest else len(rest)


def rows_of(codes: list[list[int]], seed: int = 0) -> Rows:
    """Random numbers around a pattern (T, B) of `GOING`, `CUT` and `OVER`."""
    code, rng = torch.tensor(codes), torch.Generator().manual_seed(seed)
    reward, value, next_values = torch.randn(3, *code.shape, generator=rng, dtype=torch.float64)
    return Rows(reward, value, next_values, code == OVER, code != GOING)


def one(reward: list[float], value: list[float], next_values: list[float], codes: list[int]) -> Rows:
    """A single sequence."""
    code = torch.tensor(codes).view(-1, 1)
    numbers = (torch.tensor(x, dtype=torch.float64).view(-1, 1) for x in (reward, value, next_values))
    return Rows(next(numbers), next(numbers), next(numbers), code == OVER, code != GOING)


patterns = st.tuples(st.integers(1, 7), st.integers(1, 3)).flatmap(
    lambda shape: st.lists(
        st.lists(st.sampled_from([GOING, GOING, CUT, OVER]), min_size=shape[1], max_size=shape[1]),
        min_size=shape[0],
        max_size=shape[0],
    )
)
shares = st.sampled_from([0.0, 0.3, 0.8, 1.0])
everything = settings(deadline=None, max_examples=60)


# What is to be computed: Sutton and Barto, eq. 12.1 and 12.3; Schulman et al. 2016, eq. 16


def some_steps(rows: Rows, t: int, b: int, steps: int, gamma: float) -> float:
    """`steps` rewards, then the value of what follows the last of them unless nothing does."""
    rewards = sum(gamma**k * float(rows.reward[t + k, b]) for k in range(steps))
    last = t + steps - 1
    return rewards + (0.0 if rows.terminated[last, b] else gamma**steps * float(rows.next_values[last, b]))


def lambda_return(rows: Rows, t: int, b: int, gamma: float, lam: float) -> float:
    reach = rows.reach(t, b)
    shorter = sum(lam ** (n - 1) * some_steps(rows, t, b, n, gamma) for n in range(1, reach))
    return (1 - lam) * shorter + lam ** (reach - 1) * some_steps(rows, t, b, reach, gamma)


def advantage(rows: Rows, t: int, b: int, gamma: float, lam: float) -> float:
    errors = [some_steps(rows, k, b, 1, gamma) - float(rows.value[k, b]) for k in range(t, t + rows.reach(t, b))]
    return sum((gamma * lam) ** k * error for k, error in enumerate(errors))


@everything
@given(patterns, st.integers(0, 99), shares, shares)
def test_td_lambda_is_the_weighted_sum_of_all_returns_ahead(
    codes: list[list[int]], seed: int, gamma: float, lam: float
) -> None:
    rows = rows_of(codes, seed)
    got = td_lambda(rows.reward, rows.next_values, rows.terminated, rows.done, gamma, lam)
    assert torch.allclose(
        got, rows.each(lambda rows, t, b: lambda_return(rows, t, b, gamma, lam)), rtol=1e-12, atol=1e-12
    )


@everything
@given(patterns, st.integers(0, 99), shares, st.integers(1, 9))
def test_n_step_counts_rewards_up_to_the_end(codes: list[list[int]], seed: int, gamma: float, n: int) -> None:
    rows = rows_of(codes, seed)
    got = n_step(rows.reward, rows.next_values, rows.terminated, rows.done, gamma, n)
    want = rows.each(lambda rows, t, b: some_steps(rows, t, b, min(n, rows.reach(t, b)), gamma))
    assert torch.allclose(got, want, rtol=1e-12, atol=1e-12)


@everything
@given(patterns, st.integers(0, 99), shares, shares)
def test_gae_is_the_discounted_sum_of_errors_up_to_the_end(
    codes: list[list[int]], seed: int, gamma: float, lam: float
) -> None:
    rows = rows_of(codes, seed)
    got = gae(*rows, gamma, lam)
    assert torch.allclose(got, rows.each(lambda rows, t, b: advantage(rows, t, b, gamma, lam)), rtol=1e-12, atol=1e-12)


@everything
@given(patterns, st.integers(0, 99), shares, shares)
def test_gae_and_the_lambda_return_say_the_same_where_values_agree(
    codes: list[list[int]], seed: int, gamma: float, lam: float
) -> None:
    """Their difference is the value, once the value of a row is what the row before it expects."""
    rows = rows_of(codes, seed)
    value = rows.value.clone()
    value[1:] = torch.where(rows.done[:-1], value[1:], rows.next_values[:-1])
    target = td_lambda(rows.reward, rows.next_values, rows.terminated, rows.done, gamma, lam)
    assert torch.allclose(gae(*rows._replace(value=value), gamma, lam) + value, target, rtol=1e-12, atol=1e-12)


@everything
@given(patterns, st.integers(0, 99))
def test_what_follows_a_terminal_row_does_not_count(codes: list[list[int]], seed: int) -> None:
    rows = rows_of(codes, seed)
    changed = rows._replace(next_values=torch.where(rows.terminated, 1e6, rows.next_values))
    assert torch.equal(gae(*changed, 0.9, 0.8), gae(*rows, 0.9, 0.8))
    others: list[Callable[[Rows], Tensor]] = [
        lambda x: td_lambda(x.reward, x.next_values, x.terminated, x.done, 0.9, 0.8),
        lambda x: n_step(x.reward, x.next_values, x.terminated, x.done, 0.9, 3),
    ]
    assert all(torch.equal(returns(changed), returns(rows)) for returns in others)


# By hand, every number a sum of powers of two


@pytest.mark.parametrize(
    ("middle", "want"),
    [  # rewards 1, 2, 4, worth 2, 4, 8 afterwards; gamma = lambda = 1/2
        (GOING, [2.75, 5.0, 8.0]),  # 4 + 8/2; 2 + (4 + 8)/4; 1 + (2 + 5)/4
        (CUT, [2.5, 4.0, 8.0]),  # 2 + 4/2; 1 + (2 + 4)/4
        (OVER, [2.0, 2.0, 8.0]),  # 2; 1 + (2 + 2)/4
    ],
)
def test_td_lambda_by_hand(middle: int, want: list[float]) -> None:
    rows = one([1.0, 2.0, 4.0], [0.0] * 3, [2.0, 4.0, 8.0], [GOING, middle, GOING])
    got = td_lambda(rows.reward, rows.next_values, rows.terminated, rows.done, 0.5, 0.5)
    assert got.flatten().tolist() == want


@pytest.mark.parametrize(
    ("middle", "n", "want"),
    [
        (GOING, 1, [2.0, 4.0, 8.0]),  # reward + next_values/2
        (GOING, 2, [3.0, 6.0, 8.0]),  # 1 + 2/2 + 4/4; 2 + 4/2 + 8/4; no second reward
        (GOING, 3, [4.0, 6.0, 8.0]),  # 1 + 2/2 + 4/4 + 8/8
        (CUT, 3, [3.0, 4.0, 8.0]),
        (OVER, 3, [2.0, 2.0, 8.0]),
    ],
)
def test_n_step_by_hand(middle: int, n: int, want: list[float]) -> None:
    rows = one([1.0, 2.0, 4.0], [0.0] * 3, [2.0, 4.0, 8.0], [GOING, middle, GOING])
    got = n_step(rows.reward, rows.next_values, rows.terminated, rows.done, 0.5, n)
    assert got.flatten().tolist() == want


@pytest.mark.parametrize(
    ("middle", "want"),
    [  # errors 1 + 2/2 - 0 = 2, 2 + 4/2 - 2 = 2 (0 where it is over), 4 + 8/2 - 4 = 4
        (GOING, [2.75, 3.0, 4.0]),
        (CUT, [2.5, 2.0, 4.0]),
        (OVER, [2.0, 0.0, 4.0]),
    ],
)
def test_gae_by_hand(middle: int, want: list[float]) -> None:
    rows = one([1.0, 2.0, 4.0], [0.0, 2.0, 4.0], [2.0, 4.0, 8.0], [GOING, middle, GOING])
    assert gae(*rows, 0.5, 0.5).flatten().tolist() == want


# Shapes


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_of_every_agent_share_the_rewards_and_the_ends(dtype: torch.dtype) -> None:
    """(T, B, N) values beside (T, B, 1) rewards are N sequences of their own; nothing given is written to."""
    rows = rows_of([[GOING, OVER], [CUT, GOING], [GOING, GOING]])
    reward = rows.reward.to(dtype).unsqueeze(-1)
    value, next_values = torch.randn(2, 3, 2, 4, dtype=dtype)
    terminated, done = rows.terminated.unsqueeze(-1), rows.done.unsqueeze(-1)
    given = [x.clone() for x in (reward, value, next_values, terminated, done)]
    calls: list[Callable[..., Tensor]] = [
        lambda r, v, f, t, e: gae(r, v, f, t, e, 0.9, 0.8),
        lambda r, v, f, t, e: td_lambda(r, f, t, e, 0.9, 0.8),
        lambda r, v, f, t, e: n_step(r, f, t, e, 0.9, 2),
    ]
    for call in calls:
        whole = call(reward, value, next_values, terminated, done)
        assert whole.shape == (3, 2, 4)
        assert whole.dtype == dtype
        for i in range(4):
            alone = call(reward[..., 0], value[..., i], next_values[..., i], terminated[..., 0], done[..., 0])
            assert torch.equal(whole[..., i], alone)
    assert all(torch.equal(a, b) for a, b in zip(given, (reward, value, next_values, terminated, done), strict=True))
