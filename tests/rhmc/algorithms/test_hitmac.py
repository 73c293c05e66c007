"""HiT-MAC: the critic's sum and the policy's probabilities by hand, what a decision earns, and the two phases."""

from itertools import pairwise, product
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Generator, Tensor, nn

from pipelines.conformance.blocks import nested
from pipelines.conformance.checks import seeded, through_a_file
from pipelines.conformance.same import DifferentError, assert_same
from rhmc.algorithms.hitmac import PRACTISED, Config, HiTMAC, practice
from rhmc.envs import coverage, make_env
from rhmc.envs.base import Env
from rhmc.hierarchy.attention import Assigner, Contributions, Settings, likelihood, orders
from rhmc.hierarchy.decisions import Decisions
from rhmc.learning.learner import pack
from rhmc.networks.nets import Sizes
from rhmc.training.trainer import Config as Budget
from rhmc.training.trainer import Trainer
from rhmc.types import Batch, Local, Obs, Spec, Transition
from tests.support import observation

pytestmark = pytest.mark.usefixtures("short_episodes")
SPEC = Spec(2, 3, agent_features=0, pair_features=4, peer_features=0, actions=3, continuous=False, episode=7)
N, M = SPEC.agents, SPEC.targets


OWN = {name: f"coordinator.{name}" for name in Settings.model_fields}


def config(**changes: Any) -> Config:
    """Changes without a block are of the coordinator where it has such a field."""
    settings = {"hidden_dim": 8, "executor.batch_size": 8, "buffer_size": 64, "learning_starts": 8, "train_freq": 4}
    settings |= {"pretrain": 0, "assignment_period": 3}
    own = {"n_steps": 2, "epochs": 1, "minibatches": 1, "gamma": 0.5, "standardise": "none"} | changes
    return Config(**nested(settings | {OWN.get(name, name): value for name, value in own.items()}))


# The critic: a sum of marginal contributions


class Product(nn.Module):
    """The contribution of a pair, made easy: its own number times the mean of those before it, plus its own number."""

    def forward(self, both: Tensor) -> Tensor:
        before, own = both.chunk(2, -1)
        return before * own + own


def easy() -> Contributions:
    critic = Contributions("pairwise", Sizes.of(SPEC), 1)
    critic.head = nn.Sequential(Product())
    return critic


def test_contributions_by_hand() -> None:
    pairs = torch.tensor([[[1.0], [2.0], [4.0]], [[1.0], [2.0], [4.0]]])
    order = torch.tensor([[2, 0, 1], [0, 1, 2]])
    added = easy().each(pairs, order)
    assert added.tolist() == [[4.0, 4 * 1 + 1, 2.5 * 2 + 2], [1.0, 1 * 2 + 2, 1.5 * 4 + 4]]
    assert added.sum(1).tolist() == [16.0, 15.0]


@given(st.permutations(range(6)), st.permutations(range(6)), st.integers(0, 99))
@settings(deadline=None, max_examples=50)
def test_renumbering_the_pairs_and_their_order_alike_changes_nothing(
    names: list[int], order: list[int], seed: int
) -> None:
    critic = Contributions("pairwise", Sizes.of(SPEC), 5)
    pairs = torch.randn(1, 6, 5, generator=seeded(seed))
    renamed = [names.index(k) for k in order]  # pair k is now at place names.index(k)
    before, after = (critic.each(x, torch.tensor([o])) for x, o in ((pairs, order), (pairs[:, names], renamed)))
    assert torch.allclose(before, after, atol=1e-6)


def test_another_order_is_another_sum() -> None:
    critic, obs = Contributions("mlp", Sizes.of(SPEC), 8), observation(SPEC, 1)
    sums = {round(critic(obs, orders(1, 6, seeded(k))).item(), 6) for k in range(20)}
    assert len(sums) > 10


@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
def test_the_value_is_the_sum_of_the_contributions_of_all_pairs(encoder: Any) -> None:
    critic, obs, order = Contributions(encoder, Sizes.of(SPEC), 8), observation(SPEC, 7), orders(7, 6, seeded())
    each = critic.each(critic.body(obs), order)
    assert each.shape == (7, 6)
    assert torch.allclose(critic(obs, order), each.sum(1))


def test_orders_are_drawn_for_each_state_and_every_pair_is_first_as_often() -> None:
    drawn = orders(6000, 4, seeded())
    assert torch.equal(drawn.sort(1).values, torch.arange(4).expand(6000, 4))
    assert drawn[:, 0].bincount().tolist() == pytest.approx([1500] * 4, abs=150)
    assert drawn[:, 3].bincount().tolist() == pytest.approx([1500] * 4, abs=150)


def test_the_first_pairs_context_is_nothing() -> None:
    critic, pairs = easy(), torch.randn(5, 6, 1)
    order = orders(5, 6, seeded())
    assert torch.equal(critic.each(pairs, order)[:, 0], pairs.squeeze(-1).gather(1, order[:, :1]).squeeze(1))


# The actor


def test_every_pair_attends_to_every_other() -> None:
    actor, obs = Assigner("pairwise", Sizes.of(SPEC), 8), observation(SPEC, 1)
    # The encoder pools over rows and columns: (0, 0) and (1, 1) share neither.
    changed = obs.pairs.clone()
    changed[0, 1, 1] += 1
    logits, after = actor(obs), actor(obs._replace(pairs=changed))
    assert logits.shape == (1, N, M)
    assert (logits != after).all()


def test_reordering_agents_and_targets_reorders_the_logits() -> None:
    actor, obs = Assigner("pairwise", Sizes.of(SPEC), 8), observation(SPEC, 9)
    moved = obs._replace(agents=obs.agents[:, [1, 0]], pairs=obs.pairs[:, [1, 0]][:, :, [2, 0, 1]])
    assert torch.allclose(actor(moved), actor(obs)[:, [1, 0]][:, :, [2, 0, 1]], atol=1e-6)


def test_weights_fit_other_numbers_of_agents_and_targets() -> None:
    small, large = (Assigner("pairwise", Sizes.of(SPEC._replace(agents=n, targets=n)), 8) for n in (2, 4))
    large.load_state_dict(small.state_dict())
    obs = Obs(torch.zeros(3, 2, 0), torch.randn(3, 2, 2, 4), torch.zeros(3, 2, 2, 0), torch.ones(3).bool())
    twice = obs._replace(agents=obs.agents.repeat(1, 2, 1), pairs=obs.pairs.repeat(1, 2, 2, 1))
    assert torch.allclose(large(twice), small(obs).repeat(1, 2, 2), atol=1e-6)


def test_likelihood_of_an_assignment_by_hand() -> None:
    """Chances 3/4, 1/2 and 1/4."""
    logits = torch.tensor([[[3.0, 1.0, 1 / 3]]]).log()
    each = likelihood(logits, torch.tensor([[[1.0, 0.0, 0.0]]]))
    assert each.exp().flatten().tolist() == pytest.approx([0.75, 0.5, 0.75])
    assert each.sum().exp().item() == pytest.approx(9 / 32)


@given(st.lists(st.floats(-5, 5), min_size=4, max_size=4))
@settings(deadline=None, max_examples=30)
def test_the_likelihoods_of_all_assignments_add_up_to_one(logits: list[float]) -> None:
    every = torch.tensor(list(product([0.0, 1.0], repeat=4))).view(16, 2, 2)
    chances = likelihood(torch.tensor(logits).view(1, 2, 2).expand(16, 2, 2), every).sum((1, 2)).exp()
    assert chances.sum().item() == pytest.approx(1, abs=1e-5)


def test_assignments_are_drawn_with_the_chances_that_are_said() -> None:
    algo, obs = HiTMAC(config(), SPEC, 4, seeded()), observation(SPEC, 1, first=True)
    many = Obs(*(x.expand(5000, *x.shape[1:]) for x in obs))
    _, _, extra = algo.act(many, algo.carry(5000), seeded(), explore=True)
    chance = torch.where(extra["assignment"] > 0, extra["chance"], 0.0).exp()
    assert torch.allclose(extra["assignment"].mean(0), algo.coordinator.actor.net(obs)[0].sigmoid(), atol=0.03)
    assert torch.allclose(chance.amin(0), algo.coordinator.actor.net(obs)[0].sigmoid(), atol=1e-5)


# Decisions


def step(
    obs: Obs, extra: Batch, reward: float, after: Obs, *, terminated: bool = False, truncated: bool = False
) -> Any:
    """A transition of all environments alike."""
    b = len(obs.pairs)
    local = Local(torch.zeros(b, N, M), torch.zeros(b, N))
    flags = torch.full((b,), terminated), torch.full((b,), truncated)
    done, action = torch.zeros(b, N, M).bool(), torch.zeros(b, N, dtype=torch.int64)

    def options(horizon: int) -> Tensor:
        raise AssertionError

    return Transition(obs, action, torch.full((b,), reward), local, done, *flags, after, options, extra)


def play(algo: HiTMAC, rewards: list[float], batch: int = 1, **last: bool) -> list[Obs]:
    """One episode of all environments; returns what was seen before each step and after the last."""
    seen, carry = [observation(SPEC, batch, first=True)], algo.carry(batch)
    for k, reward in enumerate(rewards):
        _, carry, extra = algo.act(seen[-1], carry, seeded(k), explore=True)
        seen.append(observation(SPEC, batch))
        flags = last if k == len(rewards) - 1 else {}
        algo.observe(step(seen[-2], extra, reward, seen[-1], **flags))
    return seen


def flat_value(algo: HiTMAC, value: float) -> None:
    """Makes the critic put out `value` for every state."""
    with torch.no_grad():
        for p in algo.coordinator.critic.net.parameters():
            p.zero_()
        list(algo.coordinator.critic.net.parameters())[-1].fill_(value / (N * M))


def test_a_decision_is_paid_the_mean_of_its_steps_and_a_cut_one_for_those_it_had() -> None:
    algo = HiTMAC(config(), SPEC, 2, seeded())
    seen = play(algo, [1.0, 2.0, 3.0, 4.0, 5.0], batch=2, truncated=True)
    rows = algo.decisions.take()
    assert rows is not None
    assert rows["reward"].tolist() == [[pytest.approx(2.0)] * 2, [pytest.approx(3.0)] * 2]
    assert rows["length"].tolist() == [[3.0, 3.0], [2.0, 2.0]]
    assert rows["done"].tolist() == [[False, False], [True, True]]
    assert not rows["terminated"].any()
    for key, (first, second) in {"": (seen[0], seen[3]), "next_": (seen[3], seen[5])}.items():
        assert torch.equal(rows[f"{key}pairs"], torch.stack((first.pairs, second.pairs)))


@pytest.mark.parametrize("terminated", [False, True])
def test_returns_of_decisions_by_hand(terminated: bool) -> None:
    """Lambda 1: the second decision had 2 of 3 steps, so what follows it is discounted by 0.5 ** (2 / 3)."""
    algo = HiTMAC(config(), SPEC, 1, seeded())
    flat_value(algo, 8.0)
    play(algo, [1.0, 2.0, 3.0, 4.0, 5.0], terminated=terminated, truncated=not terminated)
    rows = algo.decisions.take()
    assert rows is not None
    data = algo.coordinator.judge(rows)
    second = (4 + 5) / 3 + (0 if terminated else 0.5 ** (2 / 3) * 8)
    first = (1 + 2 + 3) / 3 + 0.5 * second
    assert data["target"].tolist() == pytest.approx([first, second], abs=1e-4)
    assert data["advantage"].sign().tolist() == ([1, -1] if first > second else [-1, 1])


def test_without_a_discount_a_cut_period_counts_its_reward_alone() -> None:
    algo = HiTMAC(config(gamma=0.0), SPEC, 1, seeded())
    flat_value(algo, 8.0)
    play(algo, [1.0, 2.0, 3.0, 4.0, 5.0], truncated=True)
    rows = algo.decisions.take()
    assert rows is not None
    assert algo.coordinator.judge(rows)["target"].tolist() == pytest.approx([(1 + 2 + 3) / 3, (4 + 5) / 3])


def test_half_a_lambda_mixes_in_the_critics_word() -> None:
    algo = HiTMAC(config(gae_lambda=0.5), SPEC, 1, seeded())
    flat_value(algo, 8.0)
    play(algo, [1.0] * 6, truncated=True)
    rows = algo.decisions.take()
    assert rows is not None
    second = 1 + 0.5 * 8
    assert algo.coordinator.judge(rows)["target"].tolist() == pytest.approx(
        [1 + 0.5 * (8 + second) / 2, second], abs=1e-4
    )


def test_environments_that_are_out_of_step_keep_their_own_decisions() -> None:
    """Environment 1 has made one decision when environment 0 has made two; a place never filled is never learned."""
    decisions = Decisions(2, torch.device("cpu"))

    def add(value: float, done: list[bool]) -> None:
        rows = {"x": torch.tensor([value, 10 * value]), "done": torch.zeros(2, dtype=torch.bool)}
        decisions.add(rows, torch.tensor(done))

    add(1.0, [True, False])
    add(2.0, [False, True])
    assert decisions.take() is None
    add(3.0, [True, False])
    rows = decisions.take()
    assert rows is not None
    assert rows["x"].tolist() == [[1.0, 20.0], [3.0, 0.0]]
    assert rows["filled"].tolist() == [[True, True], [True, False]]
    assert rows["done"].tolist() == [[False, True], [True, True]]
    assert decisions.take() is None


def test_out_of_step_decisions_bootstrap_from_their_own_successors() -> None:
    algo = HiTMAC(config(n_steps=2), SPEC, 2, seeded())
    seen, after = observation(SPEC, 2), observation(SPEC, 2)
    common = {"assignment": torch.zeros(2, N, M), "chance": torch.zeros(2, N, M), "length": torch.full((2,), 3.0)}
    flags = {"terminated": torch.zeros(2).bool(), "done": torch.zeros(2).bool(), "reward": torch.zeros(2)}
    rows = common | flags | pack(seen) | pack(after, "next_")
    for done in ([True, True], [True, False]):
        algo.decisions.add(rows, torch.tensor(done))
    asked: list[Tensor] = []
    algo.coordinator._output = lambda obs: asked.append(obs.pairs) or obs.pairs.sum((1, 2, 3))  # type: ignore[method-assign,func-returns-value]
    taken = algo.decisions.take()
    assert taken is not None
    target = algo.coordinator.judge(taken)["target"]
    first, second = 0.5 * after.pairs.sum((1, 2, 3))
    assert target.tolist() == pytest.approx([0.5 * first.item(), second.item(), first.item()], abs=1e-4)


def test_an_assignment_is_held_for_its_period_and_never_across_episodes() -> None:
    env, algo = small_env(64), HiTMAC(config(), SPEC, 64, seeded())
    obs, carry, rng, changed, fresh = env.reset(), algo.carry(64), seeded(), [], []
    held = carry["assignment"]
    for _ in range(16):
        action, carry, extra = algo.act(obs, carry, rng, explore=True)
        changed.append(bool((extra["assignment"] != held).any()))
        fresh.append(bool(extra["new"].all()))
        held = extra["assignment"]
        obs = env.step(action, held).obs
    new = [0, 3, 6, 7, 10, 13, 14]  # episodes of 7 steps
    assert [k for k, x in enumerate(changed) if x] == new
    assert [k for k, x in enumerate(fresh) if x] == new


def test_evaluation_is_the_threshold_at_one_half() -> None:
    algo, obs = HiTMAC(config(), SPEC, 50, seeded()), observation(SPEC, 50, first=True)
    algo.coordinator.actor.net.head.bias.data -= algo.coordinator.actor.net(obs).median()
    _, _, extra = algo.act(obs, algo.carry(50), seeded(), explore=False)
    assert torch.equal(extra["assignment"], (algo.coordinator.actor.net(obs).sigmoid() > 0.5).float())
    assert 0 < extra["assignment"].mean() < 1


def decided(algo: HiTMAC, advantage: float) -> Batch:
    """Rows as `improve` gets them, of decisions by the policy as it is."""
    obs = observation(SPEC, 32, first=True)
    _, _, extra = algo.act(obs, algo.carry(32), seeded(), explore=True)
    wanted = {"advantage": torch.full((32,), advantage), "target": torch.zeros(32)}
    return pack(obs) | {key: extra[key] for key in ("assignment", "chance")} | wanted


@pytest.mark.parametrize("advantage", [1.0, -1.0])
def test_the_policy_goes_where_the_advantage_points_as_far_as_the_clip(advantage: float) -> None:
    algo = HiTMAC(config(lr=1e-2, ent_coef=0.0), SPEC, 4, seeded())
    rows, ratios = decided(algo, advantage), []
    for _ in range(80):
        logs = algo.coordinator.improve(rows)
        ratios.append(advantage * logs["policy_gain"].item())
    assert ratios[0] == pytest.approx(1, abs=1e-4)
    assert ratios[-1] == pytest.approx(1 + 0.2 * advantage, abs=0.06)
    assert logs["grad_norm"].item() < 1  # most rows are at their clip
    logits = algo.coordinator.actor.net(Obs(rows["agents"], rows["pairs"], rows["peers"], torch.zeros(32).bool()))
    change = likelihood(logits, rows["assignment"]) - rows["chance"]
    assert (change.sign() == advantage).float().mean() > 0.9


def test_the_critic_goes_to_its_target() -> None:
    algo = HiTMAC(config(lr=1e-2), SPEC, 4, seeded())
    rows = decided(algo, 0.0) | {"target": torch.linspace(-1, 1, 32)}
    errors = [algo.coordinator.improve(rows)["value_loss"].item() for _ in range(200)]
    assert errors[0] > 0.3
    assert errors[-1] < 0.1


# The two phases


def small_env(batch: int) -> Env:
    return make_env(coverage_task(), batch, seeded(1))


def coverage_task() -> coverage.Config:
    return coverage.Config(agents=N, targets=M)


def test_practice_covers_every_number_of_targets_alike() -> None:
    drawn = practice(torch.ones(8000).bool(), torch.zeros(8000, N, M), seeded())
    assert set(drawn.unique().tolist()) == {0.0, 1.0}
    assert drawn.sum(-1).flatten().int().bincount().tolist() == pytest.approx([2 * 8000 / (M + 1)] * (M + 1), rel=0.06)
    assert drawn.mean((0, 1)).tolist() == pytest.approx([0.5] * M, abs=0.02)
    assert torch.corrcoef(drawn.sum(-1).T)[0, 1].abs() < 0.05  # of two agents


def test_practice_assignments_last_ten_steps_on_average() -> None:
    algo, batch = HiTMAC(config(pretrain=10**9), SPEC, 4, seeded()), 500
    obs, carry, rng, changes = observation(SPEC, batch), algo.carry(batch), seeded(), 0
    for _ in range(40):
        before = carry["assignment"]
        _, carry, _ = algo.act(obs, carry, rng, explore=True)
        changes += int((carry["assignment"] != before).flatten(1).any(1).sum())
    twice_the_same = (1 / 20 + 2 * (1 / 4 * 1 / 4)) / 2  # seldom, some of it by chance
    assert changes == pytest.approx(40 * batch / PRACTISED * (1 - twice_the_same), rel=0.15)


def trainer(seed: int = 0, **changes: Any) -> Trainer:
    budget = Budget(steps=160, num_envs=4, evaluations=40, eval_episodes=2, final_episodes=2)
    return Trainer(coverage_task(), config(**{"pretrain": 92} | changes), budget, seed)


def test_executors_learn_first_and_are_frozen_then() -> None:
    run, states = trainer(), []
    for _ in run:
        states.append(through_a_file(run.state_dict()["algorithm"]))
    turn = 92 // 4
    for earlier, later in pairwise(states[4 : turn + 1]):
        with pytest.raises(DifferentError):
            assert_same(earlier["executor"], later["executor"])
    for state in states[turn + 1 :]:
        assert_same(states[turn]["executor"], state["executor"])
    for level in ("actor", "critic"):
        assert_same(states[0]["coordinator"][level], states[turn]["coordinator"][level])
        with pytest.raises(DifferentError):
            assert_same(states[turn]["coordinator"][level], states[-1]["coordinator"][level])
    assert states[turn - 1]["practised"]["replay"]["size"] == 64
    assert all(state["practised"]["replay"]["size"] == 0 for state in states[turn:])
    assert all(state["practised"]["steps"] == 92 for state in states[turn:])
    assert states[-1]["practised"]["updates"] == (92 - 8) // 4


@pytest.mark.parametrize("final", [None, 0.2])
def test_the_executors_step_size_may_fall_within_their_own_phase(final: float | None) -> None:
    """Their last update is at step 92 of 160; without a schedule of their own they leave the trainer's there."""
    run = trainer(**{"executor.final_lr_fraction": final})
    run.cfg = run.cfg.model_copy(update={"final_lr_fraction": 0.5})
    sizes, update = [], run.algorithm.executor.update

    def spy(rows: Batch) -> Batch:
        groups = [learner.optimiser.param_groups[0]["lr"] for learner in run.algorithm.learners()]
        sizes.append((run.step, *(size / run.algorithm.cfg.lr for size in groups)))
        return update(rows)

    run.algorithm.executor.update = spy
    list(run)
    for step, coordinator, _, actor, critic in sizes:
        assert coordinator == pytest.approx(1 - 0.5 * step / 160)
        assert actor == critic == pytest.approx(coordinator if final is None else 1 - 0.8 * (step + 4) / 92)
    assert sizes[-1][0] + 4 == 92


def test_frozen_executors_act_greedily_for_the_coordinator() -> None:
    algo, obs = HiTMAC(config(), SPEC, 4, seeded()), observation(SPEC, 200, first=True)
    action, _, extra = algo.act(obs, algo.carry(200), seeded(), explore=True)
    assert torch.equal(action, algo.executor.act(obs, extra["assignment"], seeded(5), explore=False))


def test_the_coordinator_takes_over_everywhere_at_once() -> None:
    run, news = trainer(), []
    act = run.algorithm.act

    def spy(obs: Obs, carry: Any, rng: Generator, *, explore: bool) -> Any:
        out = act(obs, carry, rng, explore=explore)
        if explore and "new" in out[2]:
            news.append(out[2]["new"].tolist())
        return out

    run.algorithm.act = spy  # type: ignore[method-assign]
    list(run)
    assert len(news) == (160 - 92) // 4
    assert news[0] == [True] * 4
    assert news[1] == [False] * 4


def test_a_run_continues_from_any_step_of_both_phases_bit_for_bit() -> None:
    again = {"epochs": 2, "minibatches": 2, "n_steps": 3}
    run, states, items = trainer(**again), [], []
    for item in run:
        items.append(item)
        states.append(through_a_file(run.state_dict()))
    algos = [state["algorithm"] for state in states]
    assert {float(x) for a in algos if a["pending"] for x in a["pending"]["length"]} == {1.0, 2.0, 3.0}
    assert {int(x) for a in algos for x in a["decisions"]["count"]} == {1, 2}
    for point in (11, 22, 23, 24, 34):  # the executors are frozen at point 23, within an episode
        other = trainer(seed=7, **again)
        other.load_state_dict(through_a_file(states[point]))
        assert_same(other.state_dict(), states[point])
        assert list(other) == items[point + 1 :]
        assert_same(other.state_dict(), states[-1])


def test_one_pass_in_one_batch_is_the_plain_actor_critic() -> None:
    """The ratio is 1 then, and the gradient that of the advantage times the log-likelihood, per pair."""
    algo = HiTMAC(config(ent_coef=0.0), SPEC, 4, seeded())
    rows = decided(algo, 1.0) | {"advantage": torch.randn(32)}
    obs = Obs(rows["agents"], rows["pairs"], rows["peers"], torch.zeros(32).bool())
    chance = likelihood(algo.coordinator.actor.net(obs), rows["assignment"]).sum((1, 2))
    plain = torch.autograd.grad(-(chance * rows["advantage"]).mean() / (N * M), algo.coordinator.actor.params)
    algo.coordinator.improve(rows)
    for p, grad in zip(algo.coordinator.actor.params, plain, strict=True):
        assert p.grad is not None
        assert torch.allclose(p.grad, grad, atol=1e-6)
