"""The replay ring, and a network with its target network and optimiser."""

from collections import deque
from copy import deepcopy
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Generator, Tensor, nn

from pipelines.conformance.same import assert_same
from rhmc.learning.learner import Learner, Replay, pack, unpack
from rhmc.types import Obs


def labelled(values: list[int]) -> dict[str, Tensor]:
    """Rows that say who they are, in two keys of different shape."""
    x = torch.tensor(values, dtype=torch.float32)
    return {"x": x, "y": torch.stack((x, -x), -1).view(-1, 1, 2)}


def replay(capacity: int, seed: int = 0) -> Replay:
    return Replay(capacity, Generator().manual_seed(seed))


@settings(deadline=None)
@given(capacity=st.integers(1, 9), counts=st.lists(st.integers(0, 9), max_size=8))
def test_the_ring_holds_the_newest_rows(capacity: int, counts: list[int]) -> None:
    ring, newest, told = replay(capacity), deque[int](maxlen=capacity), 0
    for count in counts:
        values = list(range(told, told + count))
        ring.add(labelled(values))
        newest.extend(values)
        told += count
        assert ring.size == len(newest)
        held = ring.state_dict()["rows"]
        assert sorted(held["x"].tolist()) == list(newest)
        assert torch.equal(held["y"][:, 0], torch.stack((held["x"], -held["x"]), -1))


def test_a_wrapped_ring_overwrites_its_oldest_rows_in_place() -> None:
    ring = replay(4)
    ring.add(labelled([0, 1, 2]))
    ring.add(labelled([3, 4, 5]))
    assert ring.rows["x"].tolist() == [4, 5, 2, 3]
    assert (ring.next, ring.size) == (2, 4)


def test_a_sample_is_uniform_over_the_filled_rows_and_keeps_rows_together() -> None:
    ring = replay(50)
    ring.add(labelled(list(range(20))))
    drawn = ring.sample(20_000)
    counts = drawn["x"].long().bincount(minlength=50)
    assert counts[20:].sum() == 0
    assert ((counts[:20] - 1000).abs() < 5 * 1000**0.5).all()
    assert torch.equal(drawn["y"][:, 0, 1], -drawn["x"])


def test_a_full_ring_is_sampled_to_its_last_row() -> None:
    ring = replay(3)
    ring.add(labelled([0, 1, 2, 3]))
    assert set(ring.sample(200)["x"].tolist()) == {1.0, 2.0, 3.0}


def test_samples_are_decided_by_the_generator_given() -> None:
    drawn = []
    for seed in (0, 0, 1):
        ring = replay(30, seed)
        ring.add(labelled(list(range(30))))
        torch.rand(1)
        drawn.append(ring.sample(50)["x"])
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])


def test_a_row_handed_out_is_not_the_row_kept() -> None:
    ring = replay(3)
    ring.add(labelled([1, 2, 3]))
    ring.sample(10)["x"].zero_()
    assert ring.rows["x"].tolist() == [1, 2, 3]


@pytest.mark.parametrize("added", [[], [0], [2], [5], [5, 4], [5, 5, 1]])
def test_a_ring_continues_from_its_state(added: list[int]) -> None:
    ring, other = replay(6), replay(6)
    for k, count in enumerate(added):
        ring.add(labelled(list(range(10 * k, 10 * k + count))))
    other.add(labelled([99] * 6))  # to be forgotten
    other.load_state_dict(ring.state_dict())
    assert_same(other.state_dict(), ring.state_dict())
    for each in (ring, other):
        each.add(labelled([70, 71, 72]))
    assert_same(other.state_dict(), ring.state_dict())
    assert_same(other.sample(40), ring.sample(40))


def test_pack_and_unpack_are_inverse() -> None:
    obs = Obs(torch.rand(2, 3, 4), torch.rand(2, 3, 5, 6), torch.rand(2, 3, 3, 1), torch.zeros(2, dtype=torch.bool))
    after = obs._replace(agents=obs.agents + 1, pairs=obs.pairs + 1, peers=obs.peers + 1)
    both = pack(obs) | pack(after, "next_")
    for prefix, shift in (("", 0), ("next_", 1)):
        again = unpack(both, prefix)
        assert all(torch.equal(x, y + shift) for x, y in zip(again[:3], obs[:3], strict=True))


def net(seed: int = 0) -> nn.Sequential:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 1))


INPUT = torch.linspace(-1, 1, 15).view(5, 3)


def params(module: nn.Module) -> list[Tensor]:
    return [p.detach().clone() for p in module.parameters()]


def test_the_slow_copy_follows_by_the_share_not_kept() -> None:
    learner = Learner(net(), lr=0.1, tau=0.25)
    assert all(torch.equal(a, b) for a, b in zip(params(learner.net), params(learner.target_net), strict=True))
    slow = params(learner.target_net)
    for _ in range(3):
        learner.update(learner.net(INPUT).square().mean())
        fast = params(learner.net)
        slow = [0.75 * s + 0.25 * f for s, f in zip(slow, fast, strict=True)]
        assert all(torch.allclose(a, b, atol=1e-7) for a, b in zip(params(learner.target_net), slow, strict=True))
        assert not any(torch.equal(a, b) for a, b in zip(fast, params(learner.target_net), strict=True))


class Transposed(torch.autograd.Function):
    """The identity, with a gradient that lies in memory by columns."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        return x.clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        return grad.t().contiguous().t()


def test_a_step_does_not_depend_on_how_gradients_lie_in_memory() -> None:
    """The fused optimiser takes the numbers of both in the order of memory."""
    mine, other = (Learner(net(), lr=0.1) for _ in range(2))
    for learner, through in ((mine, Transposed.apply), (other, Tensor.clone)):
        first = learner.net[0]
        hidden = nn.functional.linear(INPUT, through(first.weight), first.bias)
        learner.update(learner.net[2](hidden.tanh()).square().mean())
    assert all(torch.equal(a, b) for a, b in zip(params(mine.net), params(other.net), strict=True))


@pytest.mark.parametrize(("tau", "follows"), [(0.0, False), (1.0, True)])
def test_the_ends_of_the_share_moved(tau: float, follows: bool) -> None:
    learner = Learner(net(), lr=0.1, tau=tau)
    before = params(learner.target_net)
    learner.update(learner.net(INPUT).mean())
    expected = params(learner.net) if follows else before
    assert all(torch.allclose(a, b) for a, b in zip(params(learner.target_net), expected, strict=True))


def test_the_slow_copy_takes_no_gradient_even_when_the_loss_goes_through_it() -> None:
    learner = Learner(net(), lr=0.1, tau=0.0)
    before = params(learner.target_net)
    learner.update((learner.net(INPUT) - learner.target_net(INPUT + 1)).square().mean())
    assert not learner.target_net(INPUT).requires_grad
    assert all(p.grad is None and not p.requires_grad for p in learner.target_net.parameters())
    assert all(torch.equal(a, b) for a, b in zip(before, params(learner.target_net), strict=True))


def test_a_step_is_adams() -> None:
    learner, twin = Learner(net(), lr=0.01), net()
    adam = torch.optim.Adam(twin.parameters(), lr=0.01)
    for _ in range(3):
        learner.update((learner.net(INPUT) - 1).square().mean())
        adam.zero_grad()
        (twin(INPUT) - 1).square().mean().backward()
        adam.step()
        assert all(torch.allclose(a, b, atol=1e-6) for a, b in zip(params(learner.net), params(twin), strict=True))


def test_the_gradient_is_cut_to_the_largest_norm_and_its_own_norm_returned() -> None:
    learner = Learner(net(), lr=0.01, max_grad_norm=0.5)
    loss = 1000 * learner.net(INPUT).square().mean()
    raw = torch.cat([g.flatten() for g in torch.autograd.grad(loss, learner.params, retain_graph=True)])
    assert raw.norm() > 50
    assert learner.update(loss).item() == pytest.approx(raw.norm().item(), rel=1e-5)
    used = torch.cat([p.grad.flatten() for p in learner.net.parameters() if p.grad is not None])
    assert torch.allclose(used, raw * 0.5 / raw.norm(), rtol=1e-4)


def test_a_small_gradient_is_left_as_it_is() -> None:
    learner = Learner(net(), lr=0.01, max_grad_norm=1e6)
    loss = learner.net(INPUT).square().mean()
    raw = torch.autograd.grad(loss, learner.params, retain_graph=True)
    learner.update(loss)
    assert all(torch.allclose(p.grad, g) for p, g in zip(learner.params, raw, strict=True) if p.grad is not None)
    assert all(p.grad is not None for p in learner.params)


def test_gradients_do_not_add_up_over_updates() -> None:
    learner = Learner(net(), lr=0.0, max_grad_norm=1e6)
    norms = [learner.update(learner.net(INPUT).square().mean()).item() for _ in range(3)]
    assert norms == [norms[0]] * 3


def test_other_networks_in_the_loss_are_left_alone() -> None:
    learner, other = Learner(net(0), lr=0.1), Learner(net(1), lr=0.1)
    before = params(other.net) + params(other.target_net)
    learner.update((learner.net(INPUT) * other.net(INPUT)).mean())
    assert all(torch.equal(a, b) for a, b in zip(before, params(other.net) + params(other.target_net), strict=True))
    assert all(p.grad is None for p in other.net.parameters())


@pytest.mark.parametrize("updates", [0, 3])
def test_a_learner_continues_from_its_state(updates: int) -> None:
    def step(learner: Learner) -> None:
        learner.update((learner.net(INPUT) - learner.target_net(INPUT).cos()).square().mean())

    learner, other = Learner(net(0), lr=0.05, tau=0.1), Learner(net(1), lr=0.05, tau=0.1)
    step(other)
    for _ in range(updates):
        step(learner)
    other.load_state_dict(deepcopy(learner.state_dict()))  # a checkpoint is a copy, as torch.save makes one
    assert_same(other.state_dict(), learner.state_dict())
    for _ in range(2):
        step(learner)
        step(other)
    assert_same(other.state_dict(), learner.state_dict())
