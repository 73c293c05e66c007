"""The two levels of RHMC: their losses against values worked out by hand, and what each may see."""

from collections.abc import Iterator
from itertools import pairwise, product
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor, nn

from pipelines.conformance.blocks import nested
from pipelines.conformance.checks import seeded
from rhmc.algorithms import ALGORITHMS
from rhmc.algorithms.rhmc import RHMC, Config
from rhmc.envs import coverage, make_env, navigation
from rhmc.envs.base import Env
from rhmc.hierarchy.coordinator import Coordinator, assignment_value, differences
from rhmc.hierarchy.executor import Executor
from rhmc.hierarchy.regulation import REGULATORS, Charges
from rhmc.learning.learner import Learner, unpack
from rhmc.learning.normalisation import KEPT
from rhmc.networks.nets import ENCODERS, PairNet, Sizes, append
from rhmc.types import Batch, Obs, Spec, Transition, assigned_reward
from tests.oracles import regulation as oracle
from tests.support import constant, observation, observed

pytestmark = pytest.mark.usefixtures("short_episodes")
SPEC = Spec(2, 3, agent_features=1, pair_features=4, peer_features=0, actions=3, continuous=False, episode=9)
N, M = SPEC.agents, SPEC.targets


def config(**changes: Any) -> Config:
    few = {"hidden_dim": 16, "executor.batch_size": 8, "coordinator.batch_size": 8}
    return Config(**nested(few | {"executor.gamma": 0.5, "coordinator.gamma": 0.25} | changes))


def rows(batch: int = 1, terminated: bool = False, **changes: Tensor) -> Batch:
    """The columns that both levels may be given; rewards are added by the test."""
    held = (torch.rand(batch, N, M) < 0.5).float()
    some = observed(SPEC, batch)
    whole = {"terminated": torch.full((batch,), terminated), "share": torch.ones(batch)}
    return some | {"assignment": held} | whole | changes


def outputs(net: nn.Module, call: Any) -> list[Tensor]:
    """The outputs of a network during a call."""
    seen: list[Tensor] = []
    handle = net.register_forward_hook(lambda module, inputs, out: seen.append(out.detach().clone()))
    call()
    handle.remove()
    assert seen
    return seen


# Step sizes


@pytest.mark.parametrize(("kind", "method"), [("rhmc", "gumbel"), ("rhmc", "qmix"), ("hitmac", "expected")])
def test_a_level_may_have_a_step_size_of_its_own(kind: str, method: str) -> None:
    sizes: list[dict[str, Any]] = [{}, {"executor.lr": 2e-3}, {"coordinator.lr": 3e-3}]
    for own in [*sizes, sizes[1] | sizes[2]]:
        cfg = ALGORITHMS[kind].config(**nested({"lr": 1e-3, "executor.method": method} | own))
        algo: Any = ALGORITHMS[kind].build(cfg, SPEC, 4, seeded())
        for name in ("executor", "coordinator"):
            learners = getattr(algo, name).learners()
            steps = {group["lr"] for learner in learners for group in learner.optimiser.param_groups}
            assert steps == {learner.lr for learner in learners} == {own.get(f"{name}.lr", 1e-3)}


# Executor


@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
@pytest.mark.parametrize("terminated", [False, True])
def test_executor_target_by_hand(encoder: str, terminated: bool) -> None:
    """The slow actor chooses action 1, the slow critic values it at 20."""
    low = Executor(config(encoder=encoder), SPEC, seeded())
    constant(low.critic.net, [1.0, 2.0, 4.0])
    constant(low.critic.target_net, [10.0, 20.0, 40.0])
    constant(low.actor.target_net, [0.0, 3.0, 1.0])
    constant(low.actor.net, [9.0, 0.0, 0.0])
    logs = low.update(rows(terminated=terminated, reward=torch.tensor([[0.5, -1.0]]), action=torch.tensor([[2, 0]])))
    later = 0.0 if terminated else 0.5 * 20
    wrong = 4 - (0.5 + later), 1 - (-1.0 + later)
    assert logs["low_td"].item() == pytest.approx((wrong[0] ** 2 + wrong[1] ** 2) / 2)


@pytest.mark.parametrize("gradient", ["gumbel", "expected"])
@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
def test_executor_goes_up_a_critic_that_prefers_one_action(gradient: str, encoder: str) -> None:
    low = Executor(
        config(encoder=encoder, executor__method=gradient, lr=0.01, executor__logit_penalty=0.0), SPEC, seeded()
    )
    constant(low.critic.net, [0.0, 0.0, 3.0])
    low.critic = Learner(low.critic.net, lr=0.0)
    data = rows(64, reward=torch.zeros(64, N), action=torch.zeros(64, N, dtype=torch.int64))

    def chance() -> float:
        (logits,) = outputs(low.actor.net, lambda: low.update(data))
        return logits.softmax(-1)[..., 2].mean().item()

    first = chance()
    for _ in range(60):
        last = chance()
    assert first < 0.6
    assert last > 0.95


def test_executor_explores_by_a_share_of_random_actions() -> None:
    low = Executor(config(executor__epsilon=0.3), SPEC, seeded())
    constant(low.actor.net, [20.0, 0.0, 0.0])
    drawn = low.act(observation(SPEC, 10_000), torch.zeros(10_000, N, M), seeded(), explore=True)
    share = drawn.flatten().bincount(minlength=3) / drawn.numel()
    assert share.tolist() == pytest.approx([0.8, 0.1, 0.1], abs=0.02)
    assert (low.act(observation(SPEC, 9), torch.zeros(9, N, M), seeded(), explore=False) == 0).all()


def test_executor_rows_hold_the_reward_under_the_assignment() -> None:
    low, env = Executor(config(), SPEC, seeded()), make_env(coverage.Config(agents=N, targets=M), 5, seeded(1))
    obs, options = env.reset(), env.options()
    action, held = torch.ones(5, N, dtype=torch.int64), (torch.rand(5, N, M) < 0.4).float()
    s = env.step(action, held)
    t = Transition(obs, action, s.reward, s.local, s.completed, s.terminated, s.truncated, s.final_obs, options, {})
    kept = low.rows(t, held)
    assert torch.equal(kept["assignment"], held)
    for b, i in product(range(5), range(N)):
        scores = [float(s.local.pairs[b, i, j]) for j in range(M) if held[b, i, j]]
        expected = sum(scores) / max(len(scores), 1) - 0.01
        assert kept["reward"][b, i].item() == pytest.approx(expected, abs=1e-6)
    assert torch.equal(kept["next_pairs"], s.final_obs.pairs)
    assert torch.equal(kept["pairs"], obs.pairs)


@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
@pytest.mark.parametrize("mode", ["on", "off"])
def test_what_an_executor_sees_of_unassigned_targets(encoder: str, mode: str) -> None:
    """With the filter, nothing: neither acting nor in any pass of its actor while learning."""
    low = Executor(config(encoder=encoder, filter=mode, tau=0.0, lr=1e-9), SPEC, seeded())
    data = rows(40, reward=torch.zeros(40, N), action=torch.zeros(40, N, dtype=torch.int64))
    held = data["assignment"]
    hidden = held.unsqueeze(-1) == 0
    other = data | {key: torch.where(hidden, data[key] + 2, data[key]) for key in ("pairs", "next_pairs")}
    shown = data | {key: torch.where(hidden, data[key], data[key] + 2) for key in ("pairs", "next_pairs")}

    def scores(data: Batch) -> list[Tensor]:
        obs = Obs(data["agents"], data["pairs"], data["peers"], torch.zeros(40, dtype=torch.bool))
        acting = outputs(low.actor.net, lambda: low.act(obs, held, seeded(), explore=True))
        with torch.no_grad():
            kept = [p.clone() for p in low.actor.params]
        learning = outputs(low.actor.net, lambda: outputs(low.actor.target_net, lambda: low.update(data)))
        with torch.no_grad():
            for p, value in zip(low.actor.params, kept, strict=True):
                p.copy_(value)
        return acting + learning + outputs(low.actor.target_net, lambda: low.update(data))

    base, changed, visible = scores(data), scores(other), scores(shown)
    assert len(base) >= 3
    for a, b, c in zip(base, changed, visible, strict=True):
        assert torch.allclose(a, b, atol=1e-5) == (mode == "on")
        assert not torch.allclose(a, c, atol=1e-3)


@pytest.mark.parametrize("mode", ["on", "off"])
def test_an_executor_knows_which_targets_are_its_own(mode: str) -> None:
    low, obs = Executor(config(filter=mode, encoder="pairwise"), SPEC, seeded()), observation(SPEC, 3)
    obs = obs._replace(pairs=torch.zeros_like(obs.pairs))
    one, all_ = (torch.zeros(3, N, M), torch.ones(3, N, M))
    (a,), (b,) = (outputs(low.actor.net, lambda g=g: low.act(obs, g, seeded(), explore=False)) for g in (one, all_))
    assert not torch.allclose(a, b)


@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
@pytest.mark.parametrize("mode", ["on", "off"])
def test_without_the_filter_an_executor_may_be_told_nothing(encoder: str, mode: str) -> None:
    """Acting and in both passes of its actor while learning; where the filter is on that changes nothing."""
    data = rows(40, reward=torch.zeros(40, N), action=torch.zeros(40, N, dtype=torch.int64))

    def seen(held: Tensor, **changes: Any) -> list[Tensor]:
        torch.manual_seed(0)
        low = Executor(config(encoder=encoder, filter=mode, lr=1e-9, tau=0.0, **changes), SPEC, seeded())
        given = data | {"assignment": held}
        acting = outputs(low.actor.net, lambda: low.act(unpack(given), held, seeded(), explore=False))
        learning = [outputs(net, lambda: low.update(given)) for net in (low.actor.net, low.actor.target_net)]
        return acting + [out for found in learning for out in found]

    held, nothing = data["assignment"], torch.zeros(40, N, M)
    told, untold = seen(held), seen(held, executor__told="filtered")
    assert len(told) == len(untold) == 3
    for a, b, c in zip(told, untold, seen(nothing), strict=True):
        assert torch.equal(b, a if mode == "on" else c)
        assert not torch.allclose(a, c, atol=1e-3)


@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
def test_what_the_critic_is_told_of_the_assignment(encoder: str) -> None:
    """All of it, now and in the bootstrap; with `none` neither, as if it were always nothing."""
    data = rows(40, reward=torch.zeros(40, N), action=torch.zeros(40, N, dtype=torch.int64))

    def judged(held: Tensor, net: str, **changes: Any) -> Tensor:
        torch.manual_seed(0)
        low = Executor(config(encoder=encoder, **changes), SPEC, seeded())
        constant(low.actor.target_net, [0.0, 3.0, 1.0])
        (found,) = outputs(getattr(low.critic, net), lambda: low.update(data | {"assignment": held}))
        return found

    every, nothing = torch.ones(40, N, M), torch.zeros(40, N, M)
    for net in ("net", "target_net"):
        assert not torch.allclose(judged(every, net), judged(nothing, net), atol=1e-3)
        assert torch.equal(judged(every, net, executor__critic_sees="none"), judged(nothing, net))


@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
def test_the_slow_copies_and_the_other_network_of_a_level_are_left_alone(encoder: str) -> None:
    """Each optimiser moves its own network only: with a step of zero for one, only the other moves."""
    low, high = Executor(config(encoder=encoder), SPEC, seeded()), Coordinator(config(encoder=encoder), SPEC, seeded())
    data = rows(8, action=torch.zeros(8, N, dtype=torch.int64))
    rewards = {"low": torch.ones(8, N), "high": torch.ones(8)}
    for name, level in (("low", low), ("high", high)):
        for still in ("actor", "critic"):
            moving = {"actor": "critic", "critic": "actor"}[still]
            setattr(level, still, Learner(getattr(level, still).net, lr=0.0, tau=0.0))
            setattr(level, moving, Learner(getattr(level, moving).net, lr=0.01, tau=0.0))
            before = {key: _values(getattr(level, key)) for key in ("actor", "critic")}
            level.update(data | {"reward": rewards[name], "earned": torch.ones(8)})
            after = {key: _values(getattr(level, key)) for key in ("actor", "critic")}
            assert all(torch.equal(a, b) for a, b in zip(before[still], after[still], strict=True))
            half = len(before[moving]) // 2
            assert any(not torch.equal(a, b) for a, b in zip(before[moving][:half], after[moving][:half], strict=True))
            assert all(torch.equal(a, b) for a, b in zip(before[moving][half:], after[moving][half:], strict=True))


def _values(learner: Learner) -> list[Tensor]:
    return [p.detach().clone() for net in (learner.net, learner.target_net) for p in net.parameters()]


# Coordinator


@pytest.mark.parametrize("gradient", ["ddpg", "counterfactual"])
@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
@pytest.mark.parametrize("terminated", [False, True])
@pytest.mark.parametrize(("share", "discount"), [(1.0, 0.25), (0.5, 0.5)])
def test_coordinator_target_by_hand(
    gradient: str, encoder: str, terminated: bool, share: float, discount: float
) -> None:
    """The critic is a sum over the six pairs: 6 x 0.5 now, 6 x 2 later. Half a period has the root of the discount."""
    high = Coordinator(config(encoder=encoder, coordinator__gradient=gradient), SPEC, seeded())
    constant(high.critic.net, [0.5])
    constant(high.critic.target_net, [2.0])
    pay = {"reward": torch.tensor([0.75]), "earned": torch.tensor([0.0])}
    logs = high.update(rows(terminated=terminated, share=torch.tensor([share]), **pay))
    target = 0.75 if terminated else 0.75 + discount * N * M * 2
    assert logs["high_td"].item() == pytest.approx((N * M * 0.5 - target) ** 2)


def test_a_whole_period_has_the_discount_to_the_last_bit() -> None:
    """So that nothing depends on the power where periods divide an episode."""
    gammas = torch.linspace(0, 1, 5001, dtype=torch.float64).tolist()
    assert all((gamma ** torch.ones(9) == torch.tensor(gamma)).all() for gamma in gammas)


def test_coordinator_standardises_rewards_or_returns_by_those_seen() -> None:
    """Rewards of mean 2 and deviation 1; returns of mean 6 and deviation 2, the next one put out as 12 of them."""
    for scale, target in (("reward", (0.75 - 2) + 0.25 * 12), ("return", (0.75 + 0.25 * (12 * 2 + 6) - 6) / 2)):
        high = Coordinator(config(encoder="mlp", coordinator__standardise=scale), SPEC, seeded())
        constant(high.critic.net, [0.5])
        constant(high.critic.target_net, [2.0])
        high.standardiser.update_rewards(torch.tensor([1.0, 3.0]))
        high.standardiser.update_returns(torch.tensor([4.0, 8.0]))
        high.standardiser.update_returns = lambda value: None  # type: ignore[method-assign]
        logs = high.update(rows(reward=torch.tensor([0.75]), earned=torch.tensor([0.0])))
        assert logs["high_td"].item() == pytest.approx((N * M * 0.5 - target) ** 2, rel=1e-4), scale


def test_executor_standardises_rewards_or_returns_by_those_seen() -> None:
    """As above; the slow critic puts out 20 for the action that the slow actor chooses."""
    for scale, target in (("reward", (0.5 - 2) + 0.5 * 20), ("return", (0.5 + 0.5 * (20 * 2 + 6) - 6) / 2)):
        low = Executor(config(encoder="mlp", executor__standardise=scale), SPEC, seeded())
        constant(low.critic.net, [1.0, 2.0, 4.0])
        constant(low.critic.target_net, [10.0, 20.0, 40.0])
        constant(low.actor.target_net, [0.0, 3.0, 1.0])
        low.standardiser.update_rewards(torch.tensor([1.0, 3.0]))
        low.standardiser.update_returns(torch.tensor([4.0, 8.0]))
        low.standardiser.update_returns = lambda value: None  # type: ignore[method-assign]
        pay, action = torch.full((1, N), 0.5), torch.full((1, N), 2)
        assert low.update(rows(reward=pay, action=action))["low_td"].item() == pytest.approx(
            (4 - target) ** 2, rel=1e-4
        )


def test_each_level_counts_its_own_rewards() -> None:
    """The coordinator what it is paid for ended periods, the executors theirs at every step."""
    cfg = config(
        executor__standardise="reward",
        coordinator__standardise="reward",
        assignment_period=2,
        regulator="none",
        learning_starts=10**6,
    )
    env = make_env(coverage.Config(agents=N, targets=M), 5, seeded(1))
    algo = RHMC(cfg, env.spec, 5, seeded())
    obs, carry = env.reset(), algo.carry(5)
    for _ in range(4):
        action, carry, extra = algo.act(obs, carry, seeded(2), explore=True)
        options, s = env.options(), env.step(action, extra["assignment"])
        t = Transition(
            obs, action, s.reward, s.local, s.completed, s.terminated, s.truncated, s.final_obs, options, extra
        )
        algo.observe(t)
        obs = s.obs
    assert algo.high.size == 2 * 5
    for name, level, kept in (("low", algo.executor, algo.low.replay), ("high", algo.coordinator, algo.high)):
        weight, total, _ = level.standardiser.sums
        found = kept.rows["reward"][: kept.size].mean().item()
        assert (total / weight).item() == pytest.approx(found, abs=2e-3), name
        assert weight.item() == pytest.approx(1 - KEPT ** (4 if name == "low" else 2), rel=1e-3)


class Taught(PairNet):
    """A known critic, Q(s, g) = sum of weight x g - crowd x (sum of g - 1)^2, in the shape of one over pairs."""

    def __init__(self, weight: Tensor, crowd: float = 0.0) -> None:
        super().__init__()
        self.weight, self.crowd = nn.Parameter(weight), crowd

    def forward(self, obs: Obs) -> Tensor:
        g = obs.pairs[..., -1]
        pairs = self.weight * g - self.crowd * (g.sum((1, 2), keepdim=True) - 1).square() / (N * M)
        return pairs.unsqueeze(-1)

    def flips(self, obs: Obs) -> Tensor:
        return flipped(self, obs)


def flipped(critic: nn.Module, obs: Obs) -> Tensor:
    """The value of a critic after each pair's last feature in turn is made the other: (B, N, M)."""
    out = torch.empty(obs.pairs.shape[:3])
    for i, j in product(range(out.shape[1]), range(out.shape[2])):
        pairs = obs.pairs.clone()
        pairs[:, i, j, -1] = 1 - pairs[:, i, j, -1]
        out[:, i, j] = critic(obs._replace(pairs=pairs)).sum((1, 2, 3))
    return out


WEIGHT = torch.tensor([[1.0, -1.0, 0.5], [-2.0, 0.8, -0.5]])


def taught(critic: Taught, gradient: str, updates: int) -> tuple[Tensor, Tensor]:
    """Logits (N, M) in one state, before and after next_values a known critic."""
    high = Coordinator(config(coordinator__gradient=gradient, lr=3e-3, coordinator__ent_coef=0.0), SPEC, seeded())
    high.critic = Learner(critic, lr=0.0)
    data = rows(1, reward=torch.zeros(1), earned=torch.zeros(1))
    data = {key: value.repeat_interleave(64, 0) for key, value in data.items()}
    seen = [outputs(high.actor.net, lambda: high.update(data))[0][0, :, :, 0] for _ in range(updates)]
    return seen[0], seen[-1]


@pytest.mark.parametrize("gradient", ["ddpg", "counterfactual"])
def test_coordinator_raises_the_pairs_that_a_known_critic_likes_and_lowers_the_others(gradient: str) -> None:
    first, last = taught(Taught(WEIGHT.clone()), gradient, 60)
    assert torch.equal(last > 0, WEIGHT > 0)
    assert torch.equal(last > first, WEIGHT > 0)


def test_counterfactual_leaves_out_what_is_one_too_many() -> None:
    """With a price on the number of pairs, one pair is worth its place, and of the three that pay it is the best."""
    first, last = taught(Taught(WEIGHT.clone(), crowd=3.0), "counterfactual", 200)
    assert (first > -1).all()
    assert (last > 0).nonzero().tolist() == [[0, 0]]


@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
@pytest.mark.parametrize(("agents", "targets"), [(1, 1), (1, 4), (3, 1), (2, 3), (3, 3), (4, 5)])
@pytest.mark.parametrize(("own", "peer"), [(0, 0), (2, 3)])
def test_differences_are_those_of_assigning_and_not_assigning_each_pair(
    encoder: str, agents: int, targets: int, own: int, peer: int
) -> None:
    sizes = Sizes(agents, targets, agent=own, pair=4, peer=peer)
    critic = ENCODERS[encoder].pairs(sizes._replace(pair=5), 16, 1)
    peers = torch.randn(7, agents, agents, peer)
    obs = Obs(torch.randn(7, agents, own), torch.randn(7, agents, targets, 4), peers, torch.zeros(7, dtype=torch.bool))
    held = (torch.rand(7, agents, targets) < 0.5).float()
    before = [x.clone() for x in (*obs, held)]
    with torch.no_grad():
        found = differences(critic, obs, held)
        assert all(torch.equal(a, b) for a, b in zip(before, (*obs, held), strict=True))
        assert found.shape == (7, agents, targets)
        for i, j in product(range(agents), range(targets)):
            both = []
            for value in (1, 0):
                one = held.clone()
                one[:, i, j] = value
                both.append(assignment_value(critic, obs, one))
            assert torch.allclose(found[:, i, j], both[0] - both[1], atol=1e-5)
    assert found.abs().max() > 1e-3


@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
def test_flips_are_the_critics_values_with_one_pair_changed(encoder: str) -> None:
    critic = ENCODERS[encoder].pairs(Sizes.of(SPEC, pair=1), 16, 1)
    obs = append(observation(SPEC, 7), pair=(torch.rand(7, N, M, 1) < 0.5).float())
    with torch.no_grad():
        assert torch.allclose(critic.flips(obs), flipped(critic, obs), atol=1e-5)


def test_worth_of_a_known_critic() -> None:
    obs, held = observation(SPEC, 2), torch.stack((torch.ones(N, M), torch.zeros(N, M)))
    value = assignment_value(Taught(WEIGHT.clone(), crowd=2.0), obs, held)
    assert value.tolist() == pytest.approx([WEIGHT.sum().item() - 2 * 25, -2])


def test_coordinator_assigns_by_its_logits_and_flips_a_share() -> None:
    high = Coordinator(config(coordinator__assignment_epsilon=0.2), SPEC, seeded())
    obs = observation(SPEC, 5000)
    for logit, chance in ((30.0, 0.9), (-30.0, 0.1), (0.0, 0.5)):
        constant(high.actor.net, [logit])
        drawn = high.assign(obs, seeded(), explore=True)
        assert set(drawn.unique().tolist()) == {0.0, 1.0}
        assert drawn.mean().item() == pytest.approx(chance, abs=0.01)
        assert (high.assign(obs, seeded(), explore=False) == float(logit > 0)).all()


# What the loop of Algorithm 2 stores

WORLDS: dict[str, Any] = {
    "coverage": coverage.Config(agents=2, targets=3),
    "navigation": navigation.Config(agents=2, episode=7),
}


class Played(NamedTuple):
    """A step of the loop: what the method was handed, and what it then logged."""

    given: Transition
    table: Tensor  # options at horizon 2
    logs: Batch


def play(algo: RHMC, env: Env, steps: int) -> Iterator[Played]:
    """Alg. 2 without a trainer."""
    obs, carry, rng = env.reset(), algo.carry(env.batch), seeded(6)
    for _ in range(steps):
        action, carry, extra = algo.act(obs, carry, rng, explore=True)
        assert torch.equal(carry["assignment"], extra["assignment"])
        options = env.options()
        table = options(2)
        s = env.step(action, extra["assignment"])
        t = Transition(
            obs, action, s.reward, s.local, s.completed, s.terminated, s.truncated, s.final_obs, options, extra
        )
        algo.observe(t)
        yield Played(t, table, algo.update())
        obs = s.obs


def begin(world: str, batch: int, **changes: Any) -> tuple[RHMC, Env]:
    env = make_env(WORLDS[world], batch, seeded(4))
    return RHMC(config(**{"buffer_size": 200, "horizon": 2} | changes), env.spec, batch, seeded(5)), env


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("regulator", REGULATORS)
@pytest.mark.parametrize("period", [1, 3])
@pytest.mark.parametrize("unassigned", ["free", "charged"])
def test_high_rows_are_those_of_the_periods_worked_out_one_by_one(
    world: str, regulator: str, period: int, unassigned: Any
) -> None:
    """Each period: from the observation it was drawn in, max(mean of Eq. 6 earned, bound when drawn), to its last one.

    An episode of 7 steps cuts a period of 3 short: 3 + 3 + 1.
    """
    charges = Charges(0.3, unassigned)
    changes = {"regulator": regulator, "assignment_period": period, **charges._asdict()}
    algo, env = begin(world, 24, buffer_size=900, **changes)
    expected: list[dict[str, Any]] = []
    periods: list[dict[str, Any]] = [{} for _ in range(24)]
    for step, (t, table, _) in enumerate(play(algo, env, 17)):
        held, at = t.extra["assignment"], step % 7 % period
        for k in range(24):
            if at == 0:
                bound = _bound(regulator, table[k], held[k], charges)
                periods[k] = {"pairs": t.obs.pairs[k], "held": held[k], "earned": [], "bound": bound}
            assert torch.equal(held[k], periods[k]["held"])
            done = (t.completed[k] & held[k].bool()).any(0).tolist()
            periods[k]["earned"].append(oracle.reward(done, held[k].int().tolist(), *charges))
            if at == period - 1 or step % 7 == 6:
                expected.append(periods[k] | {"next": t.next_obs.pairs[k]})
    stored = algo.state_dict()["high"]["rows"]
    assert len(stored["reward"]) == len(expected) > 10
    for k, period_ in enumerate(expected):
        earned = sum(period_["earned"]) / len(period_["earned"])
        assert stored["earned"][k].item() == pytest.approx(earned, abs=1e-6)
        assert stored["reward"][k].item() == pytest.approx(max(earned, period_["bound"]), abs=1e-6)
        assert stored["share"][k].item() == pytest.approx(len(period_["earned"]) / period)
        assert torch.equal(stored["assignment"][k], period_["held"])
        assert torch.equal(stored["pairs"][k], period_["pairs"])
        assert torch.equal(stored["next_pairs"][k], period_["next"])
        assert not stored["terminated"][k]
    if regulator != "none":
        assert (stored["reward"] >= stored["earned"]).all()
        assert (stored["reward"] > stored["earned"]).any()


def _bound(regulator: str, options: Tensor, held: Tensor, charges: Charges) -> float:
    """By the slow oracles: every joint option, or Algorithm 1 line by line."""
    if regulator == "none":
        return -float("inf")
    slow = {"paper": oracle.algorithm1, "exact": oracle.optimum}[regulator]
    masked = (options & held.bool().unsqueeze(1)).tolist()
    return slow(masked, held.int().tolist(), *charges)


def test_low_rows_are_every_step_under_the_assignment_held() -> None:
    algo, env = begin("navigation", 3, assignment_period=3)
    given = [played.given for played in play(algo, env, 9)]
    stored = algo.state_dict()["low"]["replay"]["rows"]
    assert torch.equal(stored["action"], torch.cat([t.action for t in given]))
    assert torch.equal(stored["reward"], torch.cat([assigned_reward(t.local, t.extra["assignment"]) for t in given]))
    assert torch.equal(stored["next_pairs"], torch.cat([t.next_obs.pairs for t in given]))
    assert not stored["terminated"].any()


@pytest.mark.parametrize("period", [1, 3])
def test_an_assignment_is_held_for_its_period_and_drawn_anew_when_an_episode_starts(period: int) -> None:
    algo, env = begin("coverage", 20, assignment_period=period)
    held = [played.given.extra["assignment"] for played in play(algo, env, 16)]
    kept = [torch.equal(a, b) for a, b in pairwise(held)]
    assert kept == [k % 7 % period != 0 for k in range(1, 16)]


def test_the_first_update_is_due_after_the_warm_up_and_then_at_the_set_rate() -> None:
    algo, env = begin("coverage", 4, learning_starts=10, train_freq=8)
    counts, before = [], 0
    for played in play(algo, env, 10):
        counts.append(algo.state_dict()["low"]["updates"])
        assert bool(played.logs) == (counts[-1] > before)
        before = counts[-1]
    assert counts == [max(0, (4 * k - 10) // 8) for k in range(1, 11)]
