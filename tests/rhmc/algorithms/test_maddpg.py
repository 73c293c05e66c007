"""MADDPG: its losses against values worked out by hand, whose actions carry a gradient, both kinds of action."""

import io
from typing import Any

import pytest
import torch
from torch import Size, Tensor, nn

from pipelines.conformance.checks import seeded
from pipelines.conformance.same import assert_same
from rhmc.algorithms.maddpg import MADDPG, Config
from rhmc.envs import make_env, navigation
from rhmc.envs.base import Env
from rhmc.networks.heads import Choices, Continuous, Discrete
from rhmc.networks.sampling import gumbel, straight_through
from rhmc.training.trainer import Config as Run
from rhmc.training.trainer import Trainer
from rhmc.types import Batch, Obs, Spec
from tests.support import observation, observed

N, A = 3, 2
SPEC = Spec(N, 2, agent_features=1, pair_features=4, peer_features=2, actions=A, continuous=False, episode=9)
FORCE = navigation.Config(agents=3, continuous=True, episode=7)
SMALL: dict[str, Any] = {"hidden_dim": 8, "buffer_size": 40, "batch_size": 8, "learning_starts": 12, "train_freq": 4}
RUN = Run(steps=44, num_envs=4, evaluations=5, eval_episodes=2, final_episodes=2)
either = pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])
both = pytest.mark.parametrize("encoder", ["mlp", "pairwise"])


def method(continuous: bool = False, **changes: Any) -> MADDPG:
    return MADDPG(
        Config(**SMALL | {"standardise": "none"} | changes), SPEC._replace(continuous=continuous), 4, seeded()
    )


def rows(continuous: bool, batch: int = 5, terminated: bool = False) -> Batch:
    action = torch.rand(batch, N, A) * 2 - 1 if continuous else torch.randint(A, (batch, N))
    out = {"action": action, "reward": torch.randn(batch), "terminated": torch.full((batch,), terminated)}
    return out | observed(SPEC, batch)


class Actor(nn.Module):
    """The same outputs (N, A) whatever is observed."""

    def __init__(self, output: Tensor) -> None:
        super().__init__()
        self.output = nn.Parameter(output)

    def forward(self, obs: Obs) -> Tensor:
        return self.output.expand(len(obs.pairs), N, A)


class Critic(nn.Module):
    """Keeps what it is given; Q of agent i: 100 i + its own action times `slope` + 10 times all first parts."""

    def __init__(self) -> None:
        super().__init__()
        self.slope = nn.Parameter(torch.arange(1.0, 1 + N * A).view(N, A))
        self.given: list[tuple[Obs, Tensor, Tensor]] = []

    def forward(self, obs: Obs, own: Tensor, joint: Tensor) -> Tensor:
        self.given.append((obs, own, joint))
        first = 10 * joint[..., :1].sum(1, keepdim=True)
        return (100 * torch.arange(N).view(N, 1) + (self.slope * own).sum(-1, keepdim=True) + first).view(-1, N, 1)


# Straight-through draws


def test_straight_through_is_one_hot_with_the_gradient_of_the_soft_draw() -> None:
    logits = torch.randn(50, N, 4, requires_grad=True)
    weight = torch.randn(50, N, 4)
    hard = straight_through(logits, seeded(7))
    soft = (logits + gumbel(logits.shape, seeded(7))).softmax(-1)
    assert set(hard.detach().round(decimals=5).unique().tolist()) == {0.0, 1.0}
    assert torch.equal(hard.argmax(-1), soft.argmax(-1))
    assert torch.allclose(hard.sum(-1), torch.ones(50, N), atol=1e-5)
    found, expected = (torch.autograd.grad((x * weight).sum(), logits)[0] for x in (hard, soft))
    assert found.abs().sum() > 1
    assert torch.allclose(found, expected, atol=1e-6)


def test_straight_through_draws_from_the_softmax() -> None:
    logits = torch.tensor([0.0, 1.0, -1.0])
    share = straight_through(logits.expand(20_000, 3), seeded()).mean(0)
    assert torch.allclose(share, logits.softmax(-1), atol=0.02)


# Heads


def test_discrete_head() -> None:
    head, output = Discrete(3, 0.3), torch.tensor([[0.0, 30.0, 0.0]]).expand(20_000, 1, 3)
    assert head.greedy(output).unique().tolist() == [1]
    share = head.explore(output, seeded()).flatten().bincount()
    assert torch.allclose(share / 20_000, torch.tensor([0.1, 0.8, 0.1]), atol=0.02)
    assert head.encode(torch.tensor([[2, 0]])).tolist() == [[[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]]


def test_continuous_head() -> None:
    head, output = Continuous(2, 0.25), torch.full((20_000, 1, 2), 0.2)
    mean = torch.tensor(0.2).tanh()
    assert torch.equal(head.greedy(output), mean.expand_as(output))
    assert torch.equal(head.policy(output, seeded()), mean.expand_as(output))
    drawn = head.explore(output, seeded())
    assert drawn.mean().item() == pytest.approx(mean.item(), abs=0.01)
    assert drawn.std().item() == pytest.approx(0.25, abs=0.01)
    for extreme in (head.explore(100 * output, seeded()), head.explore(-100 * output, seeded())):
        assert extreme.abs().max() == 1
        assert extreme.unique().numel() > 100
    assert torch.equal(head.encode(drawn), drawn)


# Critics


class Table(nn.Module):
    """Values (B, N, A) of every own action, higher by the others' first parts."""

    def __init__(self) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.arange(1.0, 1 + N * A).view(N, A).square())

    def forward(self, obs: Obs, joint: Tensor) -> Tensor:
        return self.values + joint[..., :1].sum(1, keepdim=True)


def test_the_slope_in_a_discrete_action_is_the_difference_that_another_one_makes() -> None:
    critic, joint = Choices(Table()), torch.eye(A)[torch.randint(A, (6, N))]
    own = torch.eye(A)[torch.randint(A, (6, N))].requires_grad_()
    value = critic(observation(SPEC, 6), own=own, joint=joint)
    assert value.shape == (6, N, 1)
    slope = torch.autograd.grad(value.sum(), own)[0]
    for choice in range(A):
        other = critic(observation(SPEC, 6), own=torch.eye(A)[choice].expand(6, N, A), joint=joint)
        change = (slope * (torch.eye(A)[choice] - own)).sum(-1, keepdim=True)
        assert torch.allclose(other - value, change, atol=1e-4)


@both
@either
def test_a_critic_takes_the_own_action_and_the_others(encoder: str, continuous: bool) -> None:
    algo, obs = method(continuous, encoder=encoder), observation(SPEC, 5)
    own, joint = torch.rand(5, N, A), torch.rand(5, N, A)
    value = algo.critic.net(obs, own=own, joint=joint)
    assert value.shape == (5, N, 1)
    for i in range(N):
        mine, theirs = own.clone(), joint.clone()
        mine[:, i] += 1
        theirs[:, i] += 1
        moved = (algo.critic.net(obs, own=mine, joint=joint) - value).abs().amax((0, 2)) > 1e-6
        assert moved.tolist() == [k == i for k in range(N)]
        moved = (algo.critic.net(obs, own=own, joint=theirs) - value).abs().amax((0, 2)) > 1e-6
        assert moved.tolist() == [k != i for k in range(N)]


# Losses


@either
@pytest.mark.parametrize("terminated", [False, True])
def test_target_by_hand(continuous: bool, terminated: bool) -> None:
    """The slow actor's best actions, valued by the slow critic, all agents' together, in the next observation."""
    algo, batch = method(continuous, gamma=0.5), rows(continuous, terminated=terminated)
    critic = algo.critic.target_net = Critic()
    algo.actor.target_net = Actor(torch.tensor([[2.0, 1.0], [-1.0, 3.0], [0.5, -0.5]]))
    algo.actor.net = algo.critic.net = nn.Identity()  # not asked
    best = torch.tensor([[2.0, 1.0], [-1.0, 3.0], [0.5, -0.5]]).tanh()
    if not continuous:
        best = torch.tensor([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
    value = torch.tensor([0.0, 100.0, 200.0]) + (critic.slope * best).sum(-1) + 10 * best[:, 0].sum()
    expected = batch["reward"].unsqueeze(-1) + (0 if terminated else 0.5 * value)
    target = algo._target(batch)
    assert target.shape == (5, N)
    assert torch.allclose(target, expected.expand(5, N))
    assert not target.requires_grad
    ((obs, own, joint),) = critic.given
    assert torch.equal(obs.pairs, batch["next_pairs"])
    assert torch.equal(own, joint)


@either
def test_critic_loss_by_hand(continuous: bool) -> None:
    """The taken actions, each agent's own and all of them, in the observation that they were taken in."""
    algo, batch = method(continuous), rows(continuous, terminated=True)
    critic = algo.critic.net = Critic()
    loss, _ = algo._critic_loss(batch)
    ((obs, own, joint),) = critic.given
    taken = batch["action"] if continuous else torch.eye(A)[batch["action"]]
    assert torch.equal(obs.pairs, batch["pairs"])
    assert torch.equal(own, taken)
    assert torch.equal(joint, taken)
    q = torch.tensor([0.0, 100.0, 200.0]) + (critic.slope * taken).sum(-1) + 10 * taken[..., :1].sum(1)
    assert loss.item() == pytest.approx((q - batch["reward"].unsqueeze(-1)).square().mean().item(), rel=1e-5)


@pytest.mark.parametrize("mode", ["reward", "return"])
def test_standardised_targets_by_hand(mode: str) -> None:
    """With mean -4 and deviation 2: of the reward, or of what the networks put out."""
    algo, batch = method(gamma=0.5, standardise=mode), rows(False)
    algo.standardiser.sums = torch.tensor([1.0, -4.0, 20.0])
    algo.critic.target_net, algo.actor.target_net = Critic(), Actor(torch.zeros(N, A))
    value = torch.tensor([0.0, 100.0, 200.0]) + algo.critic.target_net.slope[:, 0] + 30
    reward = batch["reward"].unsqueeze(-1)
    expected = (reward + 4) / 2 + 0.5 * value if mode == "reward" else reward + 0.5 * (2 * value - 4)
    assert torch.allclose(algo._target(batch), expected, rtol=1e-5)


def test_what_the_critic_learns_is_standardised_after_it_was_counted_in() -> None:
    algo, batch = method(standardise="return"), rows(False, batch=400, terminated=True)
    critic = algo.critic.net = Critic()
    loss, _ = algo._critic_loss(batch)
    obs, own, joint = critic.given[0]
    reward = batch["reward"]
    target = (reward - reward.mean()) / reward.std(unbiased=False)
    away = critic(obs, own, joint).squeeze(-1) - target.unsqueeze(-1)
    assert loss.item() == pytest.approx(away.square().mean().item(), rel=1e-4)


@either
def test_an_actor_follows_the_slope_of_its_own_action_alone(continuous: bool) -> None:
    """The others' actions are those of the replay: Q's 10 times all first parts move nobody."""
    output = torch.tensor([[0.3, -0.2], [0.0, 0.4], [-0.6, 0.1]])
    algo, batch = method(continuous, penalty=3.0), rows(continuous, batch=4000)
    actor, critic = Actor(output), Critic()
    algo.actor.net, algo.critic.net = actor, critic
    loss, _ = algo._actor_loss(batch)
    ((obs, own, joint),) = critic.given
    assert own.requires_grad
    assert not joint.requires_grad
    assert torch.equal(obs.pairs, batch["pairs"])
    assert torch.equal(joint, batch["action"] if continuous else torch.eye(A)[batch["action"]])
    found = torch.autograd.grad(loss, actor.output)[0]
    slope = critic.slope.detach()
    if continuous:
        gain = slope * (1 - output.tanh().square())
    else:  # the mean over the noise of the soft draw's gradient
        soft = (output + gumbel(Size((100_000, N, A)), seeded(5))).softmax(-1)
        gain = (soft * (slope - (soft * slope).sum(-1, keepdim=True))).mean(0)
    assert torch.allclose(found, 3.0 * 2 * output / (N * A) - gain / N, atol=3e-3)


@both
@either
def test_no_others_action_reaches_an_agents_value_with_a_gradient(encoder: str, continuous: bool) -> None:
    """With the real networks: agent 0's share of the gain moves agent 0's outputs and nobody else's."""
    algo, batch = method(continuous, encoder=encoder, penalty=0.0), rows(continuous)
    outputs: list[Tensor] = []
    values: list[Tensor] = []
    algo.actor.net.register_forward_hook(lambda *x: outputs.append(x[-1]))
    algo.critic.net.register_forward_hook(lambda *x: values.append(x[-1]))
    algo._actor_loss(batch)
    for i in range(N):
        moved = torch.autograd.grad(values[0][:, i].sum(), outputs[0], retain_graph=True)[0].abs().sum((0, 2))
        assert (moved > 0).tolist() == [k == i for k in range(N)]


@both
@either
def test_an_update_moves_both_networks_each_by_its_own_loss(encoder: str, continuous: bool) -> None:
    algo = method(continuous, encoder=encoder, learning_starts=0, train_freq=1, tau=0.1)
    algo.experience.add(rows(continuous), 1)
    before = [p.detach().clone() for p in (*algo.actor.params, *algo.critic.params)]
    slow = [p.clone() for p in (*algo.actor.target_params, *algo.critic.target_params)]
    logs = algo.update()
    assert {"td_loss", "q", "output", "grad_norm", "actor_grad_norm"} <= set(logs)
    for old, new in zip(before, (*algo.actor.params, *algo.critic.params), strict=True):
        assert not torch.equal(old, new)
    after = (*algo.actor.target_params, *algo.critic.target_params)
    for old, copy, new in zip(slow, after, (*algo.actor.params, *algo.critic.params), strict=True):
        assert torch.allclose(copy, 0.9 * old + 0.1 * new, atol=1e-6)


# Parameters of their own


@both
@either
def test_unshared_networks_are_the_agents_own(encoder: str, continuous: bool) -> None:
    algo, batch = method(continuous, encoder=encoder, share=False), rows(continuous)
    shared = method(continuous, encoder=encoder)
    assert len(algo.actor.params) == N * len(shared.actor.params)
    assert len(algo.critic.params) == N * len(shared.critic.params)
    outputs: list[Tensor] = []
    algo.actor.net.register_forward_hook(lambda *x: outputs.append(x[-1]))
    algo._actor_loss(batch)
    per = len(shared.actor.params)
    for i in range(N):
        grads = torch.autograd.grad(outputs[0][:, i].sum(), algo.actor.params, retain_graph=True, allow_unused=True)
        moved = [k for k, g in enumerate(grads) if g is not None and bool(g.abs().sum() > 0)]
        assert {k // per for k in moved} == {i}


# Continuous actions in a task


def world(batch: int, seed: int = 0) -> tuple[Env, Obs]:
    env = make_env(FORCE, batch, seeded(seed))
    env.reset()
    for _ in range(2):
        obs = env.step(torch.randn(batch, FORCE.agents, 2).clamp(-1, 1)).obs
    return env, obs


def build(env: Env, **changes: Any) -> MADDPG:
    torch.manual_seed(1)
    return MADDPG(Config(**SMALL | changes), env.spec, env.batch, seeded(2))


@both
@pytest.mark.parametrize("explore", [False, True])
def test_continuous_actions_are_within_bounds(encoder: str, explore: bool) -> None:
    env, obs = world(60)
    algo = build(env, encoder=encoder, noise=0.5)
    with torch.no_grad():
        for p in algo.actor.params:
            p.mul_(3)
    action, carry, extra = algo.act(obs, {}, seeded(), explore=explore)
    assert (action.shape, action.dtype) == ((60, 3, 2), torch.float32)
    assert action.abs().max() <= 1
    assert action.std() > 0.1
    assert not action.requires_grad
    assert (carry, extra) == ({}, {})


@both
def test_greedy_continuous_acting_is_not_random_and_exploring_is_decided_by_the_generator(encoder: str) -> None:
    env, obs = world(60)
    algo = build(env, encoder=encoder)

    def act(seed: int, explore: bool) -> Tensor:
        return algo.act(obs, {}, seeded(seed), explore=explore)[0]

    assert torch.equal(act(0, False), act(1, False))
    assert torch.equal(act(0, True), act(0, True))
    assert not torch.equal(act(0, True), act(1, True))
    assert not torch.equal(act(0, True), act(0, False))


def test_reordering_agents_reorders_continuous_actions() -> None:
    env, obs = world(60)
    algo, order = build(env, encoder="pairwise"), [2, 0, 1]
    swapped = Obs(obs.agents[:, order], obs.pairs[:, order], obs.peers[:, order][:, :, order], obs.first)
    action, again = (algo.act(x, {}, seeded(), explore=False)[0] for x in (obs, swapped))
    assert torch.allclose(again, action[:, order], atol=1e-6)
    assert not torch.allclose(again, action, atol=1e-3)


@both
def test_a_continuous_run_continues_from_any_point_bit_for_bit(encoder: str) -> None:
    algo = Config(**SMALL | {"encoder": encoder})
    full, states, metrics = Trainer(FORCE, algo, RUN, 0), [], []
    for item in full:
        file = io.BytesIO()
        torch.save(full.state_dict(), file)
        states.append(file)
        metrics.append(item)
    assert full.algorithm.state_dict()["experience"]["updates"] == 8
    assert "train/td_loss" in metrics[-1]

    def read(file: io.BytesIO) -> Any:
        file.seek(0)
        return torch.load(file, weights_only=True)

    for point, file in enumerate(states[:-1]):
        run = Trainer(FORCE, algo, RUN, 99)
        run.load_state_dict(read(file))
        assert list(run) == metrics[point + 1 :]
        assert assert_same(run.state_dict(), read(states[-1])) > 60


def test_a_continuous_run_is_decided_by_its_seed() -> None:
    one, same, other = (list(Trainer(FORCE, Config(**SMALL), RUN, seed)) for seed in (0, 0, 1))
    assert one == same
    assert one != other
