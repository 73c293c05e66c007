"""COMA's advantage, targets and gradients against values worked out by hand."""

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from pipelines.conformance.checks import seeded
from pipelines.conformance.same import assert_same
from rhmc.algorithms.coma import COMA, Config, draw, expected
from rhmc.learning.experience import flat
from rhmc.learning.learner import taken
from rhmc.types import Batch, Local, Spec, Transition
from tests.support import constant, observation

SPEC = Spec(2, 3, agent_features=1, pair_features=4, peer_features=0, actions=3, continuous=False, episode=9)
N, M, ACTIONS = SPEC.agents, SPEC.targets, SPEC.actions


def method(**changes: Any) -> COMA:
    """Without exploration beyond the policy, standardised rewards or scaled advantages, unless asked for."""
    plain = {
        "advantage_estimator": "critic",
        "hidden_dim": 8,
        "standardise": "none",
        "scale": False,
        "epsilon": 0.0,
    }
    return COMA(Config(**plain | {"gamma": 0.5, "td_lambda": 0.5, "ent_coef": 0.0} | changes), SPEC, 2, seeded())


def others_action(net: nn.Module, times: float) -> None:
    """Makes a central critic of the `mlp` encoder answer `times` the others' action's number for every own action."""
    weights = list(net.parameters())
    with torch.no_grad():
        for p in weights:
            p.zero_()
        weights[0][0, -N * ACTIONS :] = torch.arange(ACTIONS).repeat(N).float()
        weights[2][0, 0] = 1.0
        weights[4][:, 0] = times


def transition(
    algo: COMA, action: list[list[int]], reward: float = 0.0, after: str = "going", **changes: Any
) -> Transition:
    """One step of as many environments as there are joint actions."""
    b = len(action)
    flag = torch.ones(b, dtype=torch.bool)
    obs = observation(SPEC, b)
    _, _, extra = algo.act(obs, {}, seeded(), explore=True)
    t = Transition(
        obs,
        torch.tensor(action),
        torch.full((b,), reward),
        Local(torch.zeros(b, N, M), torch.zeros(b, N)),
        torch.zeros(b, N, M, dtype=torch.bool),
        flag & (after == "over"),
        flag & (after == "cut"),
        observation(SPEC, b),
        lambda horizon: torch.zeros(0),
        extra,
    )
    return t._replace(**changes)


def whole(algo: COMA, *steps: Transition) -> Batch:
    for t in steps:
        algo.observe(t)
    rollout = algo.rollout.take()
    assert rollout is not None
    return rollout


# The advantage


def test_the_baseline_by_hand() -> None:
    """q 1, 2, 4 under chances 1/2, 1/4, 1/4: worth 2 on average."""
    q, chance = torch.tensor([1.0, 2.0, 4.0]).expand(1, 3, 3), torch.tensor([0.5, 0.25, 0.25]).expand(1, 3, 3)
    assert expected(q, chance).tolist() == [[2.0, 2.0, 2.0]]
    assert taken(q, torch.tensor([[0, 1, 2]])).tolist() == [[1.0, 2.0, 4.0]]


@settings(deadline=None)
@given(st.integers(0, 999), st.floats(-100, 100))
def test_the_advantage_is_0_on_average_and_blind_to_what_all_actions_share(seed: int, shared: float) -> None:
    torch.manual_seed(seed)
    q, chance = torch.randn(5, N, ACTIONS, dtype=torch.float64), torch.rand(5, N, ACTIONS, dtype=torch.float64)
    chance = chance / chance.sum(-1, keepdim=True)

    def advantage(q: Tensor, a: int) -> Tensor:
        return taken(q, torch.full((5, N), a)) - expected(q, chance)

    each = torch.stack([advantage(q, a) for a in range(ACTIONS)], -1)
    assert torch.allclose(expected(each, chance), torch.zeros(5, N, dtype=torch.float64), atol=1e-12)
    assert torch.allclose(advantage(q + shared, 1), each[..., 1], atol=1e-9)


def judged(algo: COMA, policy: list[float], q: list[float], *steps: Transition) -> tuple[Tensor, Tensor]:
    """Returns and advantages of a rollout acted by one policy and judged by one critic, whatever is seen."""
    constant(algo.actor.net, [0.0, 0.0, 0.0])  # what the policy has become since does not count along the rollout
    constant(algo.critic.net, [77.0, 33.0, 11.0])  # nor does the critic that learns
    constant(algo.critic.target_net, q)
    chance = torch.tensor(policy).expand(len(steps[0].reward), N, ACTIONS)
    return algo._judged(whole(algo, *(t._replace(extra={"chance": chance}) for t in steps)))


@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
def test_the_critics_advantage_by_hand(encoder: str) -> None:
    algo = method(encoder=encoder, n_steps=1)
    _, advantage = judged(algo, [0.5, 0.25, 0.25], [1.0, 2.0, 4.0], transition(algo, [[0, 1], [2, 2]]))
    assert advantage.tolist() == [[[-1.0, 0.0], [2.0, 2.0]]]


def test_the_returns_advantage_by_hand() -> None:
    """The last reward is 4, then the present policy, uniform, is worth 20/3; the one that acted was worth 5."""
    algo = method(n_steps=2, advantage_estimator="return")
    steps = (transition(algo, [[0, 1]], 2.0), transition(algo, [[1, 1]], 4.0))
    target, advantage = judged(algo, [0.5, 0.25, 0.25], [0.0, 8.0, 12.0], *steps)
    last = 4 + (8 + 12) / 3 / 2
    first = 2 + (5 + last) / 4
    assert target.flatten().tolist() == pytest.approx([first, first, last, last])
    assert torch.allclose(advantage, target - 5)


@pytest.mark.parametrize("worth", ["critic", "return"])
def test_scaled_advantages_have_mean_0_and_deviation_1_and_keep_their_order(worth: str) -> None:
    algo = method(n_steps=1, advantage_estimator=worth, scale=True)
    steps = transition(algo, [[0, 1], [1, 1], [2, 0]], reward=1.0)
    _, advantage = judged(
        algo, [0.5, 0.25, 0.25], [1.0, 2.0, 6.0], steps._replace(reward=torch.tensor([1.0, 2.0, 4.0]))
    )
    assert advantage.mean().item() == pytest.approx(0.0, abs=1e-6)
    assert advantage.std(correction=0).item() == pytest.approx(1.0)
    best, worst = {"critic": ([0, 2, 0], [0, 0, 0]), "return": ([0, 2, 1], [0, 0, 1])}[worth]
    assert advantage[tuple(best)] == advantage.max()
    assert advantage[tuple(worst)] == advantage.min()
    alike = method(n_steps=1, advantage_estimator=worth, scale=True)
    _, advantage = judged(alike, [0.5, 0.25, 0.25], [1.0, 1.0, 1.0], transition(alike, [[0, 1], [1, 1]]))
    assert torch.isfinite(advantage).all()


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
def test_an_agents_action_values_see_the_others_actions_and_not_its_own(encoder: str, share: bool) -> None:
    algo, obs = method(encoder=encoder, share=share), observation(SPEC, 6)
    action = torch.randint(ACTIONS, (6, N), generator=seeded())
    q = algo.critic.net(obs, joint=algo._joint(action))
    assert q.shape == (6, N, ACTIONS)
    for i in range(N):
        other = action.clone()
        other[:, i] = (other[:, i] + 1) % ACTIONS
        moved = algo.critic.net(obs, joint=algo._joint(other))
        assert torch.allclose(moved[:, i], q[:, i], atol=1e-6)
        assert not torch.allclose(moved[:, 1 - i], q[:, 1 - i], atol=1e-4)


# The critic's targets


@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
@pytest.mark.parametrize(
    ("middle", "want"),
    [  # rewards 1, 2, 4; a policy worth 6 everywhere; gamma = lambda = 1/2
        ("going", [3.8125, 5.25, 7.0]),  # 4 + 6/2; 2 + (6 + 7)/4; 1 + (6 + 5.25)/4
        ("cut", [3.75, 5.0, 7.0]),  # 2 + 6/2; 1 + (6 + 5)/4
        ("over", [3.0, 2.0, 7.0]),  # 2; 1 + (6 + 2)/4
    ],
)
def test_targets_by_hand(encoder: str, middle: str, want: list[float]) -> None:
    algo = method(encoder=encoder, n_steps=3)
    constant(algo.actor.net, [0.0, 0.0, -1e9])
    constant(algo.critic.target_net, [4.0, 8.0, 500.0])
    constant(algo.critic.net, [77.0, 77.0, 77.0])
    steps = [transition(algo, [[0, 1]], r, after) for r, after in ((1.0, "going"), (2.0, middle), (4.0, "going"))]
    assert algo._judged(whole(algo, *steps))[0][:, 0].tolist() == [[x, x] for x in want]


@pytest.mark.parametrize(
    ("first", "want"),
    [
        ("going", [[0.0, 0.5], [1.0, 1.0]]),  # the others did 0 and 1 next
        ("cut", [[1.0, 1.0], [1.0, 1.0]]),  # the policy always does 2
        ("over", [[0.0, 0.0], [1.0, 1.0]]),
    ],
)
def test_others_next_actions_are_those_taken_but_the_policys_where_nothing_was_taken(
    first: str, want: list[list[float]]
) -> None:
    algo = method(n_steps=2, td_lambda=0.0)
    constant(algo.actor.net, [-1e9, -1e9, 0.0])
    others_action(algo.critic.target_net, 1.0)
    steps = (transition(algo, [[2, 2]], after=first), transition(algo, [[1, 0]]))
    assert algo._judged(whole(algo, *steps))[0][:, 0].tolist() == want


def test_standardised_rewards_make_the_scale_of_the_task_irrelevant() -> None:
    targets = []
    for scale, shift in ((1.0, 0.0), (10.0, 40.0)):
        torch.manual_seed(1)
        algo = method(n_steps=3, standardise="reward")
        targets.append(
            algo._judged(whole(algo, *(transition(algo, [[0, 1]], scale * r + shift) for r in (1, 2, 4))))[0]
        )
    assert torch.allclose(targets[0], targets[1], atol=1e-3)


def test_standardised_returns_give_the_critics_outputs_their_scale() -> None:
    algo = method(n_steps=1, standardise="return")
    algo.standardiser.sums = torch.tensor([1.0, 10.0, 104.0])  # mean 10, deviation 2
    constant(algo.critic.target_net, [6.0, 6.0, 6.0])
    target, _ = algo._judged(whole(algo, transition(algo, [[0, 1]], 4.0)))
    assert target.flatten().tolist() == pytest.approx([15.0, 15.0])  # 4 + (6 * 2 + 10)/2
    assert algo.standardiser.target(target).flatten().tolist() == pytest.approx([2.5, 2.5])


def test_what_the_critic_learns_is_standardised_by_the_returns_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """These count as seen before they are a target: the first rollout's have mean 0 and deviation 1 themselves."""
    algo, seen = method(n_steps=2, standardise="return", minibatches=1, epochs=1), []
    real = algo._critic_loss

    def spy(rows: Batch) -> Any:
        seen.append(rows["target"])
        return real(rows)

    monkeypatch.setattr(algo, "_critic_loss", spy)
    for reward in (30.0, 50.0):
        algo.observe(transition(algo, [[0, 1], [1, 2]], reward, after="over"))
    algo.update()
    assert seen[0].shape == (4, N)
    assert sorted(seen[0].flatten().tolist()) == pytest.approx([-1.0] * 4 + [1.0] * 4, abs=1e-3)


@pytest.mark.parametrize("standardise", ["reward", "return"])
def test_a_checkpoint_holds_what_was_seen_and_the_half_of_a_rollout(standardise: str) -> None:
    first, other = (method(n_steps=2, standardise=standardise) for _ in range(2))
    steps = [transition(first, [[0, 1], [1, 2]], reward) for reward in (5.0, 1.0, 7.0, 3.0, 9.0)]
    for t in steps[:3]:
        first.observe(t)
        first.update()
    torch.manual_seed(7)
    other.load_state_dict(deepcopy(first.state_dict()))
    for algo in (first, other):
        for t in steps[3:]:
            algo.observe(t)
            algo.update()
    assert_same(first.state_dict(), other.state_dict())


def test_the_critic_learns_the_value_of_the_action_taken() -> None:
    algo = method(n_steps=1)
    bias = constant(algo.critic.net, [1.0, 2.0, 4.0])
    rows = flat(whole(algo, transition(algo, [[0, 2]]))) | {"target": torch.tensor([[3.0, 3.0]])}
    loss, _ = algo._critic_loss(rows)
    assert loss.item() == pytest.approx((2**2 + 1**2) / 2)
    (slope,) = torch.autograd.grad(loss, [bias])
    assert slope.tolist() == pytest.approx([-2.0, 0.0, 1.0])


# The policy's gradient


@pytest.mark.parametrize("epsilon", [0.0, 0.5])
def test_the_policy_gradient_by_hand(epsilon: float) -> None:
    """A uniform policy: every logit moves by advantage x (1 if taken - 1/3), the softmax's share of it with a floor."""
    algo = method(n_steps=1, epsilon=epsilon)
    bias = constant(algo.actor.net, [0.0, 0.0, 0.0])
    rows = flat(whole(algo, transition(algo, [[0, 2]]))) | {"advantage": torch.tensor([[6.0, -12.0]])}
    loss, _ = algo._actor_loss(rows)
    (slope,) = torch.autograd.grad(loss, [bias])
    want = [(6 * 2 / 3 - 12 * -1 / 3) / 2, (6 * -1 / 3 - 12 * -1 / 3) / 2, (6 * -1 / 3 - 12 * 2 / 3) / 2]
    assert slope.tolist() == pytest.approx([-(1 - epsilon) * x for x in want], abs=1e-5)


def test_the_entropy_bonus_draws_towards_the_uniform_policy() -> None:
    algo = method(n_steps=1, ent_coef=2.0)
    bias = constant(algo.actor.net, [1.0, 0.0, 0.0])
    rows = flat(whole(algo, transition(algo, [[0, 2]]))) | {"advantage": torch.zeros(1, N)}
    loss, logs = algo._actor_loss(rows)
    chance = torch.tensor([1.0, 0.0, 0.0]).softmax(-1)
    entropy = -(chance * chance.log()).sum().item()
    assert logs["entropy"].item() == pytest.approx(entropy)
    assert loss.item() == pytest.approx(-2 * entropy)
    (slope,) = torch.autograd.grad(loss, [bias])
    assert slope[0] > 0 > slope[1]
    constant(algo.actor.net, [0.0, 0.0, 0.0])
    assert algo._actor_loss(rows)[1]["entropy"].item() == pytest.approx(torch.tensor(3.0).log().item())


def test_a_certain_policy_has_finite_gradients() -> None:
    algo = method(n_steps=1, ent_coef=1.0)
    bias = constant(algo.actor.net, [500.0, 0.0, 0.0])
    rows = flat(whole(algo, transition(algo, [[1, 2]]))) | {"advantage": torch.ones(1, N)}
    (slope,) = torch.autograd.grad(algo._actor_loss(rows)[0], [bias])
    assert torch.isfinite(slope).all()


# Exploring


@pytest.mark.parametrize(("epsilon", "floor"), [(0.6, 0.2), (0.3, 0.1), (0.0, 0.0)])
def test_no_action_is_less_likely_than_its_share_of_epsilon(epsilon: float, floor: float) -> None:
    algo, obs = method(epsilon=epsilon), observation(SPEC)
    constant(algo.actor.net, [0.0, 500.0, 0.0])
    _, _, extra = algo.act(obs, {}, seeded(), explore=True)
    assert extra["chance"][0, 0].tolist() == pytest.approx([floor, 1 - 2 * floor, floor])
    assert algo.act(obs, {}, seeded(), explore=False)[0].tolist() == [[1, 1]]


def test_actions_are_those_whose_chances_are_told() -> None:
    algo, obs = method(epsilon=0.6), observation(SPEC, 4000)
    constant(algo.actor.net, [0.0, 500.0, 0.0])
    action, _, _ = algo.act(obs, {}, seeded(), explore=True)
    assert (action.flatten().bincount() / 8000).tolist() == pytest.approx([0.2, 0.6, 0.2], abs=0.03)


def test_actions_are_drawn_with_their_chances() -> None:
    chance = torch.tensor([[0.5, 0.25, 0.25], [0.0, 0.1, 0.9]]).expand(20_000, 2, 3)
    action = draw(chance, seeded())
    counts = torch.stack([action[:, i].bincount(minlength=3) for i in range(2)])
    expected = 20_000 * chance[0]
    assert ((counts - expected).abs() <= 4.5 * (expected * (1 - chance[0])).sqrt()).all()
    together = (action[:, 0] == 0) & (action[:, 1] == 2)  # independent of each other
    assert together.float().mean().item() == pytest.approx(0.45, abs=0.02)


# Pace


def test_an_update_waits_for_the_rollout_and_shows_every_row_as_often_as_it_says(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    algo = method(n_steps=5, epochs=3, minibatches=2, actor_minibatches=5)
    shown: dict[str, list[list[float]]] = {"_critic_loss": [], "_actor_loss": []}

    def spied(name: str) -> Callable[[Batch], Any]:
        real = getattr(algo, name)

        def spy(rows: Batch) -> Any:
            shown[name].append(rows["reward"].tolist())
            return real(rows)

        return spy

    for name in shown:
        monkeypatch.setattr(algo, name, spied(name))
    for t in range(5):
        assert algo.update() == {}
        algo.observe(transition(algo, [[0, 1], [1, 2]], reward=float(t)))
    before = [p.clone() for learner in (algo.actor, algo.critic) for p in learner.params]
    logs = algo.update()
    after = [p for learner in (algo.actor, algo.critic) for p in learner.params]
    assert all(torch.isfinite(x) for x in logs.values())
    assert not any(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    once = sorted([0.0, 1, 2, 3, 4] * 2)
    critic = shown["_critic_loss"]
    assert [len(part) for part in critic] == [5] * 6
    assert [sorted(critic[k] + critic[k + 1]) for k in (0, 2, 4)] == [once] * 3
    assert critic[0] != critic[2]
    assert [len(part) for part in shown["_actor_loss"]] == [2] * 5
    assert sorted(x for part in shown["_actor_loss"] for x in part) == once
    assert algo.update() == {}
