"""Executors that learn through a mixture: their loss by hand, what they may see, what they learn."""

from itertools import product
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from pipelines.conformance.blocks import nested
from pipelines.conformance.checks import seeded
from rhmc.algorithms.rhmc import Config
from rhmc.envs import coverage, make_env
from rhmc.hierarchy.mixing_executor import QMIXExecutor
from rhmc.types import Batch, Obs, Spec, Transition
from tests.doubles import Known
from tests.support import observed

SPEC = Spec(2, 3, agent_features=1, pair_features=4, peer_features=0, actions=3, continuous=False, episode=9)
N, M = SPEC.agents, SPEC.targets
NET, SLOW = [[1.0, 5.0, 2.0], [3.0, 0.0, 4.0]], [[10.0, 20.0, 50.0], [7.0, 30.0, 9.0]]


def executor(**changes: Any) -> QMIXExecutor:
    settings = {"executor.method": "qmix", "hidden_dim": 16, "executor.gamma": 0.5} | changes
    return QMIXExecutor(Config(**nested(settings)), SPEC, seeded())


def rows(batch: int = 1, **changes: Tensor) -> Batch:
    some = observed(SPEC, batch) | {"terminated": torch.zeros(batch, dtype=torch.bool)}
    held = (torch.rand(batch, N, M) < 0.5).float()
    return some | {"assignment": held, "action": torch.zeros(batch, N, dtype=torch.int64)} | changes


class Doubling(nn.Module):
    """2 a + b + 1 of two agents' values a and b."""

    def forward(self, obs: Obs, values: Tensor) -> Tensor:
        return (values * torch.tensor([2.0, 1.0])).sum(-1, keepdim=True) + 1


def known(**changes: Any) -> QMIXExecutor:
    low = executor(lr=1e-9, **changes)
    for net, values in ((low.q.net, NET), (low.q.target_net, SLOW)):
        net.own, net.mixer = Known(values), Doubling()
    low.q.params = list(low.q.net.parameters())
    low.q.target_params = list(low.q.target_net.parameters())
    return low


@pytest.mark.parametrize("terminated", [False, True])
def test_target_by_hand(terminated: bool) -> None:
    """The network chooses actions 1 and 2, the target network values them at 20 and 9; executors earn 0.5 and -1."""
    reward, done = torch.tensor([[0.5, -1.0]]), torch.tensor([terminated])
    logs = known().update(rows(reward=reward, action=torch.tensor([[2, 0]]), terminated=done))
    target = -0.25 + (0 if terminated else 0.5 * (2 * 20 + 9 + 1))
    assert logs["low_td"].item() == pytest.approx((2 * 2 + 3 + 1 - target) ** 2, rel=1e-5)


def test_rewards_are_standardised_before_they_are_averaged() -> None:
    low = known(executor__standardise="reward")
    low.standardiser.update_rewards(torch.tensor([1.0, 3.0]))  # mean 2, deviation 1
    data = rows(reward=torch.tensor([[4.0, 3.0]]), action=torch.tensor([[2, 0]]))
    target = (2 + 1) / 2 + 0.5 * 50
    assert low.update(data)["low_td"].item() == pytest.approx((8 - target) ** 2, rel=1e-4)


def test_returns_are_standardised_by_those_seen() -> None:
    low = known(executor__standardise="return")
    low.standardiser.update_returns(torch.tensor([4.0, 8.0]))  # mean 6, deviation 2
    low.standardiser.update_returns = lambda value: None  # type: ignore[method-assign]
    target = 0.5 + 0.5 * (50 * 2 + 6)
    data = rows(reward=torch.full((1, N), 0.5), action=torch.tensor([[2, 0]]))
    assert low.update(data)["low_td"].item() == pytest.approx((8 - (target - 6) / 2) ** 2, rel=1e-4)


@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
@pytest.mark.parametrize("mode", ["on", "off"])
def test_own_values_do_not_see_unassigned_targets_but_the_mixture_does(encoder: str, mode: str) -> None:
    low, data = executor(encoder=encoder, filter=mode), rows(40)
    held = data["assignment"]
    more = torch.where(held.unsqueeze(-1) == 0, data["pairs"] + 2, data["pairs"])
    obs, other = (Obs(data["agents"], pairs, data["peers"], None) for pairs in (data["pairs"], more))
    assert torch.allclose(low.q.net(obs, held), low.q.net(other, held), atol=1e-5) == (mode == "on")
    mixtures = [low.q.net.mixed(o, held, data["action"]) for o in (obs, other)]
    assert not torch.allclose(*mixtures, atol=1e-4)


def test_own_values_and_the_mixture_know_the_assignment() -> None:
    low, data = executor(encoder="pairwise", filter="off"), rows(5)
    obs = Obs(data["agents"], data["pairs"], data["peers"], None)
    none, all_ = torch.zeros(5, N, M), torch.ones(5, N, M)
    assert not torch.allclose(low.q.net(obs, none), low.q.net(obs, all_))
    low.q.net.own = Known(NET)
    assert not torch.allclose(*(low.q.net.mixed(obs, g, data["action"]) for g in (none, all_)))


@pytest.mark.parametrize("mode", ["on", "off"])
def test_own_values_may_know_nothing_of_the_assignment_without_the_filter(mode: str) -> None:
    low, data = executor(encoder="pairwise", filter=mode, executor__told="filtered"), rows(5)
    obs = Obs(data["agents"], data["pairs"], data["peers"], None)
    none, all_ = torch.zeros(5, N, M), torch.ones(5, N, M)
    assert torch.equal(low.q.net(obs, none), low.q.net(obs, all_)) == (mode == "off")
    low.q.net.own = Known(NET)
    assert not torch.allclose(*(low.q.net.mixed(obs, g, data["action"]) for g in (none, all_)))


@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
def test_the_mixture_may_know_nothing_of_the_assignment(encoder: str) -> None:
    low, data = executor(encoder=encoder, executor__critic_sees="none"), rows(5)
    obs = Obs(data["agents"], data["pairs"], data["peers"], None)
    none, all_ = torch.zeros(5, N, M), torch.ones(5, N, M)
    assert not torch.allclose(low.q.net(obs, none), low.q.net(obs, all_))
    low.q.net.own = Known(NET)
    assert torch.equal(*(low.q.net.mixed(obs, g, data["action"]) for g in (none, all_)))


def test_explores_by_a_share_of_random_actions() -> None:
    low = known(executor__epsilon=0.3)
    obs = Obs(torch.zeros(9000, N, 1), torch.zeros(9000, N, M, 4), torch.zeros(9000, N, N, 0), None)
    held = torch.zeros(9000, N, M)
    drawn = low.act(obs, held, seeded(), explore=True)
    assert torch.equal(low.act(obs, held, seeded(), explore=False), torch.tensor([[1, 2]]).expand(9000, -1))
    for i, best in enumerate((1, 2)):
        share = drawn[:, i].bincount(minlength=3) / 9000
        assert share.tolist() == pytest.approx([0.8 if a == best else 0.1 for a in range(3)], abs=0.02)


@pytest.mark.parametrize(("reward", "scale"), list(product(("local", "team"), ("none", "reward"))))
def test_rows_hold_what_is_paid_and_count_it_once(reward: str, scale: str) -> None:
    low, env = (
        executor(executor__reward=reward, executor__standardise=scale),
        make_env(coverage.Config(agents=N, targets=M), 5, seeded(1)),
    )
    obs, options = env.reset(), env.options()
    action, held = torch.ones(5, N, dtype=torch.int64), (torch.rand(5, N, M) < 0.4).float()
    s = env.step(action, held)
    t = Transition(obs, action, s.reward, s.local, s.completed, s.terminated, s.truncated, s.final_obs, options, {})
    kept = low.rows(t, held)
    if reward == "team":
        assert torch.equal(kept["reward"], s.reward.unsqueeze(-1).expand(5, N))
    else:
        assert not torch.allclose(kept["reward"][:, 0], kept["reward"][:, 1])
    weight, total, _ = low.standardiser.sums
    assert (total / weight if scale == "reward" else total).item() == pytest.approx(
        kept["reward"].mean().item() if scale == "reward" else 0.0, rel=1e-4
    )


def test_it_learns_which_joint_action_pays() -> None:
    """Rewards 1 for actions (2, 1), else 0, on states that say nothing."""
    low = executor(encoder="pairwise", executor__gamma=0.0, lr=0.01, filter="off", share=False)
    generator = seeded(3)
    for _ in range(150):
        action = torch.randint(3, (64, N), generator=generator)
        pay = ((action[:, 0] == 2).float() + (action[:, 1] == 1).float()) / 2
        low.update(rows(64, action=action, reward=pay.unsqueeze(-1).expand(64, N)))
    data = rows(200)
    obs = Obs(data["agents"], data["pairs"], data["peers"], None)
    best = low.act(obs, data["assignment"], seeded(), explore=False)
    assert (best == torch.tensor([2, 1])).float().mean() > 0.95
