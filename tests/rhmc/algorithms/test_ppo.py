"""The common part of MAPPO and IPPO: its objectives, targets and first weights against values worked out by hand."""

from itertools import product
from math import log
from typing import Any, Literal

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from pipelines.conformance.checks import seeded
from rhmc.algorithms import ALGORITHMS, ppo
from rhmc.algorithms.ppo import PPO, Clip, Config, Penalty
from rhmc.networks.nets import ENCODERS, Sizes, Unshared
from rhmc.types import Local, Obs, Spec, Transition
from tests.support import constant, observation

SPEC = Spec(2, 3, agent_features=1, pair_features=2, peer_features=1, actions=3, continuous=False, episode=9)
N, M, A = SPEC.agents, SPEC.targets, SPEC.actions
CPU = torch.device("cpu")


def config(**changes: Any) -> Config:
    return Config(**{"hidden_dim": 16, "n_steps": 2, "epochs": 1, "minibatches": 1} | changes)


def method(sees: Literal["local", "central"] = "central", **changes: Any) -> PPO:
    return PPO(config(**changes), SPEC, seeded(), sees)


def acted(algo: PPO, reward: Tensor, obs: Obs | None = None, **changes: Any) -> Transition:
    """One acted step of as many environments as there are rewards."""
    batch = len(reward)
    obs = observation(SPEC, batch) if obs is None else obs
    with torch.no_grad():
        action, _, extra = algo.act(obs, {}, seeded(), explore=True)
    local, no = Local(torch.zeros(batch, N, M), torch.zeros(batch, N)), torch.zeros(batch, dtype=torch.bool)
    completed = torch.zeros(batch, N, M, dtype=torch.bool)
    after = observation(SPEC, batch)
    t = Transition(obs, action, reward, local, completed, no, no, after, lambda _: no, extra)
    return t._replace(**changes)


def policies(*chances: list[float]) -> Tensor:
    """Log-policies (1, 1, actions) of a single agent."""
    return torch.tensor(chances).log().unsqueeze(0).requires_grad_()


# Objectives


@pytest.mark.parametrize(
    ("new", "advantage", "loss", "moves"),
    [
        (0.45, 2.0, -1.8, True),  # ratio 0.9 and 1.1: inside
        (0.55, 2.0, -2.2, True),
        (0.45, -2.0, 1.8, True),
        (0.55, -2.0, 2.2, True),
        (0.75, 2.0, -2.4, False),  # ratio 1.5, paid as 1.2
        (0.25, 2.0, -1.0, True),  # ratio 0.5 of a good action: the way back is open
        (0.25, -2.0, 1.6, False),  # ratio 0.5, paid as 0.8
        (0.75, -2.0, 3.0, True),  # ratio 1.5 of a bad action: the way back is open
    ],
)
def test_the_clipped_objective_by_hand(new: float, advantage: float, loss: float, moves: bool) -> None:
    now, old = policies([1 - new, new]), policies([0.5, 0.5]).detach()
    found = Clip(config(clip_range=0.2), CPU)(now, old, torch.tensor([[1]]), torch.tensor([[advantage]]))
    assert found.shape == (1, 1)
    assert found.item() == pytest.approx(loss)
    (grad,) = torch.autograd.grad(found.sum(), now)
    assert bool(grad.any()) == moves
    assert grad[0, 0, 0] == 0  # only the chosen action's probability counts


@pytest.mark.parametrize(("clip", "loss"), [(0.1, -1.1), (0.3, -1.3), (0.6, -1.5)])
def test_the_clip_is_where_it_is_set(clip: float, loss: float) -> None:
    now, old = policies([0.25, 0.75]), policies([0.5, 0.5])
    found = Clip(config(clip_range=clip), CPU)(now, old, torch.tensor([[1]]), torch.ones(1, 1))
    assert found.item() == pytest.approx(loss)


def test_the_penalised_objective_by_hand() -> None:
    """Ratio 1.6 for the action taken; divergence of (0.8, 0.2) from (0.5, 0.5) is ln(1.25) = 0.2231 nats."""
    penalty = Penalty(config(), CPU)
    penalty.beta = torch.tensor(3.0)
    now, old = policies([0.8, 0.2]), policies([0.5, 0.5])
    for advantage in (2.0, -2.0):
        found = penalty(now, old, torch.tensor([[0]]), torch.tensor([[advantage]]))
        assert found.item() == pytest.approx(3 * log(1.25) - 1.6 * advantage, rel=1e-5)


def test_the_divergence_weighs_by_the_old_policy() -> None:
    one, other = policies([0.5, 0.5]), policies([0.9, 0.1])
    assert ppo.kl(one, other).item() == pytest.approx(0.5 * log(0.5 / 0.9) + 0.5 * log(0.5 / 0.1), rel=1e-5)
    assert ppo.kl(other, one).item() == pytest.approx(0.9 * log(0.9 / 0.5) + 0.1 * log(0.1 / 0.5), rel=1e-5)


@pytest.mark.parametrize(
    ("divergence", "factor"),
    [(0.0, 0.5), (0.0199, 0.5), (0.0201, 1.0), (0.03, 1.0), (0.0449, 1.0), (0.0451, 2.0), (9.0, 2.0)],
)
def test_the_price_follows_the_divergence(divergence: float, factor: float) -> None:
    penalty = Penalty(config(kl_target=0.03), CPU)
    for k in range(3):
        assert penalty.beta.item() == factor**k
        penalty.adapt(torch.tensor(divergence))


@pytest.mark.parametrize(("target", "factor"), [(1e-9, 2.0), (1e3, 0.5)])
def test_the_price_is_set_after_every_rollout_and_kept_in_a_checkpoint(target: float, factor: float) -> None:
    algo = method(objective="kl_adaptive", kl_target=target, n_steps=1, epochs=3)
    for _ in range(2):
        algo.observe(acted(algo, torch.rand(5)))
        algo.update()
    other = method(objective="kl_adaptive")
    other.load_state_dict(algo.state_dict())
    assert isinstance(other.objective, Penalty)
    assert other.objective.beta.item() == factor**2


def test_the_divergence_told_is_that_of_the_whole_rollouts_updates() -> None:
    algo = method(n_steps=1, epochs=4, minibatches=3, lr=0.05)
    obs = observation(SPEC, 10)
    with torch.no_grad():
        before = algo._policy(obs)
    algo.observe(acted(algo, torch.rand(10), obs))
    logs = algo.update()
    with torch.no_grad():
        after = algo._policy(obs)
    assert logs["kl"].item() == pytest.approx((before.exp() * (before - after)).sum(-1).mean().item(), rel=1e-4)
    assert logs["kl"] > 1e-4


# Acting


def test_actions_are_drawn_from_the_policy_that_is_handed_out() -> None:
    algo = method()
    constant(algo.actor.net, [log(0.6) + 5, log(0.3) + 5, log(0.1) + 5])
    obs = observation(SPEC, 5000)
    action, _, extra = algo.act(obs, {}, seeded(), explore=True)
    shares = action.flatten().bincount(minlength=A) / action.numel()
    assert torch.allclose(shares, torch.tensor([0.6, 0.3, 0.1]), atol=0.02)
    assert torch.allclose(extra["policy"].exp(), torch.tensor([0.6, 0.3, 0.1]).expand(5000, N, A))
    assert (algo.act(obs, {}, seeded(), explore=False)[0] == 0).all()


# Learning


def test_nothing_is_learned_before_a_rollout_is_full() -> None:
    algo = method(n_steps=3)
    done = []
    for _ in range(7):
        algo.observe(acted(algo, torch.rand(4)))
        done.append(bool(algo.update()))
    assert done == [False, False, True, False, False, True, False]


def judged(monkeypatch: pytest.MonkeyPatch, algo: PPO) -> tuple[Tensor, Tensor, Tensor]:
    """Values that an update hands to the objective as advantages, and to the critic's loss as values and targets."""
    seen: list[Tensor] = []
    loss, objective = ppo.huber_loss, algo.objective

    def watch(value: Tensor, target: Tensor, **kwargs: Any) -> Tensor:
        seen.extend((value.detach(), target))
        return loss(value, target, **kwargs)

    class Watched(Clip):
        def __call__(self, new: Tensor, old: Tensor, action: Tensor, advantage: Tensor) -> Tensor:
            seen.append(advantage)
            return objective(new, old, action, advantage)

    algo.objective = Watched(algo.cfg, CPU)
    monkeypatch.setattr(ppo, "huber_loss", watch)
    algo.update()
    advantage, value, target = seen
    return advantage, value, target


@pytest.mark.parametrize(
    ("standardise", "target"),
    [("none", [2.25, 3.0]), ("return", [-1.0, 1.0])],  # mean 2.625, deviation 0.375
)
@pytest.mark.parametrize("sees", ["local", "central"])
def test_targets_and_advantages_by_hand(
    monkeypatch: pytest.MonkeyPatch, sees: Any, standardise: str, target: list[float]
) -> None:
    """Value 2, rewards 1 and then 3, which is the last: errors 0 and 1, advantages 0.25 and 1, to every agent."""
    algo = method(sees, gamma=0.5, gae_lambda=0.5, standardise=standardise)
    constant(algo.critic.net, [2.0])
    algo.observe(acted(algo, torch.tensor([1.0])))
    algo.observe(acted(algo, torch.tensor([3.0]), terminated=torch.tensor([True])))
    advantage, value, found = judged(monkeypatch, algo)
    assert torch.equal(value, torch.full((2, N), 2.0))
    assert torch.allclose(found, torch.tensor(target).unsqueeze(1).expand(2, N), atol=1e-4)
    assert torch.allclose(advantage, torch.tensor([[-1.0], [1.0]]).expand(2, N), atol=1e-4)


def test_a_critic_that_says_the_same_everywhere_explains_nothing() -> None:
    """Advantages 0.25 and 1 beside targets 2.25 and 3: all of the targets' spread is left."""
    algo = method(gamma=0.5, gae_lambda=0.5, standardise="none")
    constant(algo.critic.net, [2.0])
    algo.observe(acted(algo, torch.tensor([1.0])))
    algo.observe(acted(algo, torch.tensor([3.0]), terminated=torch.tensor([True])))
    logs = algo.update()
    assert float(logs["value"]) == 2.0
    assert float(logs["explained"]) == pytest.approx(0.0, abs=1e-5)


def test_rewards_are_standardised_before_the_returns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Mean 2 and deviation 1; value 0.5 everywhere, gamma 0.5."""
    algo = method(gamma=0.5, standardise="reward", n_steps=1)
    constant(algo.critic.net, [0.5])
    algo.observe(acted(algo, torch.tensor([1.0, 3.0])))
    _, _, target = judged(monkeypatch, algo)
    assert torch.allclose(target, torch.tensor([[-0.75], [1.25]]).expand(2, N), atol=1e-4)


def test_values_are_taken_back_to_the_scale_of_returns(monkeypatch: pytest.MonkeyPatch) -> None:
    """The critic says 1, which is 10 + 4 x 1; reward 7: 7 + 0.5 x 14 is what is to be learned."""
    algo = method(gamma=0.5, n_steps=1)
    algo.standardiser.sums = torch.tensor([1.0, 10.0, 116.0])
    constant(algo.critic.net, [1.0])
    algo.observe(acted(algo, torch.tensor([7.0])))
    _, _, target = judged(monkeypatch, algo)
    assert torch.allclose(algo.standardiser.value(target), torch.full((1, N), 14.0), atol=1e-3)


@given(st.lists(st.integers(-100, 100), min_size=2, max_size=30))
@settings(deadline=None)
def test_advantages_have_mean_0_and_deviation_1(values: list[int]) -> None:
    x = torch.tensor(values, dtype=torch.float64)
    found = ppo.normalised(x)
    assert found.mean().item() == pytest.approx(0, abs=1e-6)
    if x.std() > 0:
        assert found.square().mean().item() == pytest.approx(1, rel=1e-4)
        assert ((found[:, None] > found) == (x[:, None] > x)).all()


def test_a_value_far_off_is_learned_from_linearly() -> None:
    """Error 3, linear from 1 on: 1 x (3 - 0.5)."""
    algo = method(n_steps=1, standardise="none", huber=1.0)
    constant(algo.critic.net, [0.0])
    algo.observe(acted(algo, torch.tensor([3.0]), terminated=torch.tensor([True])))
    assert algo.update()["value_loss"].item() == pytest.approx(2.5)


@given(count=st.integers(1, 40), epochs=st.integers(1, 3), minibatches=st.integers(1, 6))
@settings(deadline=None, max_examples=30)
def test_every_epoch_takes_every_row_once(count: int, epochs: int, minibatches: int) -> None:
    algo = method(epochs=epochs, minibatches=minibatches)
    rows = torch.arange(count)
    parts = list(algo._minibatches({"action": rows, "twice": 2 * rows}))
    per_epoch, rest = divmod(len(parts), epochs)
    assert rest == 0
    assert per_epoch <= minibatches
    for k in range(epochs):
        epoch = parts[k * per_epoch : (k + 1) * per_epoch]
        assert sorted(torch.cat([part["action"] for part in epoch]).tolist()) == rows.tolist()
    assert all(len(part["action"]) and torch.equal(part["twice"], 2 * part["action"]) for part in parts)


def test_every_epoch_is_shuffled_anew_and_a_pass_of_one_update_is_not() -> None:
    rows = {"action": torch.arange(30)}
    orders = [part["action"] for part in method(epochs=2, minibatches=2)._minibatches(rows)]
    assert not torch.equal(torch.cat(orders[:2]), torch.cat(orders[2:]))
    assert not torch.equal(torch.cat(orders[:2]), rows["action"])
    algo = method(epochs=2)
    before = algo.rng.get_state()
    assert all(torch.equal(part["action"], rows["action"]) for part in algo._minibatches(rows))
    assert torch.equal(algo.rng.get_state(), before)


@pytest.mark.parametrize("objective", ["clip", "kl_adaptive"])
def test_the_first_update_starts_from_the_policy_that_acted(objective: str) -> None:
    """Every ratio is 1, the divergence 0: the loss is minus the mean of the normalised advantages."""
    algo = method(objective=objective, minibatches=1)
    for _ in range(2):
        algo.observe(acted(algo, torch.randn(6)))
    logs = algo.update()
    assert logs["policy_loss"].item() == pytest.approx(0, abs=1e-5)
    assert logs["grad_norm"] > 0


@pytest.mark.parametrize("entropy", [0.0, 0.1])
def test_entropy_alone_makes_a_policy_uniform(entropy: float) -> None:
    """The loss where no action is better than another, and only then with a weight."""
    algo = method(ent_coef=entropy, n_steps=1, epochs=20, lr=0.01)
    constant(algo.actor.net, [1.0, 0.0, 0.0])
    constant(algo.critic.net, [0.0])
    before = algo._policy(observation(SPEC)).exp().max()
    algo.observe(acted(algo, torch.ones(4), terminated=torch.ones(4, dtype=torch.bool)))
    algo.update()
    after = algo._policy(observation(SPEC)).exp().max()
    assert after < before - 0.05 if entropy else torch.equal(after, before)


def test_the_critic_of_mappo_sees_the_others_and_that_of_ippo_does_not() -> None:
    obs = observation(SPEC)
    other = obs._replace(agents=obs.agents + torch.tensor([[[0.0], [1.0]]]))  # the second agent's
    for encoder, share in product(ENCODERS, (True, False)):
        mappo, ippo = (
            ALGORITHMS[kind].build(ALGORITHMS[kind].config(encoder=encoder, share=share), SPEC, 1, seeded())
            for kind in ("mappo", "ippo")
        )
        for algo, sees in ((mappo, True), (ippo, False)):
            assert isinstance(algo, PPO)
            here, there = algo._value(obs), algo._value(other)
            assert here.shape == (1, N)
            assert (here[0, 0] != there[0, 0]) == sees
            assert here[0, 1] != there[0, 1]
            assert torch.equal(algo._policy(obs)[0, 0], algo._policy(other)[0, 0])


@pytest.mark.parametrize("objective", ["clip", "kl_adaptive"])
def test_a_bandit_is_learned(objective: str) -> None:
    """The team is paid for each agent whose action is 1 where its feature is positive, and 2 elsewhere."""
    algo = method(objective=objective, n_steps=4, epochs=5, minibatches=2, lr=5e-3, kl_target=0.05)
    yes = torch.ones(32, dtype=torch.bool)
    for k in range(4 * 40):
        obs = observation(SPEC, 32)
        action, _, extra = algo.act(obs, {}, seeded(k), explore=True)
        reward = (action == torch.where(obs.agents.squeeze(-1) > 0, 1, 2)).float().mean(-1)
        algo.observe(acted(algo, reward, obs, action=action, extra=extra, terminated=yes))
        algo.update()
    obs = observation(SPEC, 500)
    best = torch.where(obs.agents.squeeze(-1) > 0, 1, 2)
    assert (algo.act(obs, {}, seeded(), explore=False)[0] == best).float().mean() > 0.95


# First weights


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize("encoder", ENCODERS)
def test_first_weights_are_orthogonal(encoder: Any, share: bool) -> None:
    algo = method(encoder=encoder, share=share)
    for net, last in ((algo.actor.net, 0.01), (algo.critic.net, 1.0)):
        nets = list(net.nets) if isinstance(net, Unshared) else [net]
        assert len(nets) == (1 if share else N)
        for each in nets:
            *inner, head = [layer for layer in each.modules() if isinstance(layer, nn.Linear)]
            assert inner
            assert head.out_features == (A if net is algo.actor.net else 1)
            for layer, gain in (*((layer, 2**0.5) for layer in inner), (head, last)):
                weight = layer.weight if len(layer.weight) <= layer.weight.shape[1] else layer.weight.T
                assert torch.allclose(weight @ weight.T, gain**2 * torch.eye(len(weight)), atol=1e-5)
                assert layer.bias is None or not layer.bias.any()


@pytest.mark.parametrize("encoder", ENCODERS)
def test_the_first_policy_is_nearly_uniform(encoder: Any) -> None:
    chance = method(encoder=encoder)._policy(observation(SPEC, 100)).exp()
    assert (chance - 1 / A).abs().max() < 0.03
    assert (chance - 1 / A).abs().max() > 0


def test_the_last_layer_is_the_one_that_puts_out() -> None:
    """The layer that `orthogonal` takes for the last is the last in every network that it is given."""
    sizes = Sizes.of(SPEC)
    for encoder in ENCODERS.values():
        for make in (encoder.local, encoder.central):
            net = ppo.orthogonal(make(sizes, 16, 3), 1e-6)
            assert net(observation(SPEC, 10)).abs().max() < 1e-4
