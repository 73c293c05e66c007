"""Checks of a method: on a small run in each task that it fits, and that it learns a tiny task with a known optimum."""

from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from itertools import islice
from typing import Any, NamedTuple

import torch

from pipelines.conformance import toy
from pipelines.conformance.blocks import fitted, nested
from pipelines.conformance.checks import (
    RUN,
    SMALL,
    Outcome,
    Unfit,
    at_random,
    finite,
    need,
    need_difference,
    outcomes,
    reordered,
    seeded,
    through_a_file,
)
from pipelines.conformance.same import assert_same
from pipelines.specs import limits
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS, Task, coverage, make_env, navigation
from rhmc.training.evaluation import evaluate
from rhmc.training.trainer import Config, Trainer
from rhmc.types import Obs

SMALL_TASKS = (coverage.Config(agents=2, targets=3), navigation.Config(agents=2, episode=7))
LEARNED = 0.85  # of the tiny task's optimum; acting at random earns about a third of it
BUDGET = Config(steps=12_000, num_envs=32, evaluations=12, eval_episodes=300, final_episodes=1)
ORDER = [2, 0, 3, 1]  # of four agents
LEARNING = {  # of methods that have such a setting: they suit the tiny task, whose episodes have six steps
    "lr": 5e-3,
    "hidden_dim": 32,
    "tau": 0.05,
    "gamma": 0.8,
    "coordinator.gamma": 0.0,
    "batch_size": 64,
    "learning_starts": 300,
    "train_freq": 32,
    "epsilon_steps": 4000,
    "assignment_period": 1,
}


class Case(NamedTuple):
    """A method with its settings in a task."""

    algo: Any
    env: Any


def check_method(kind: str, changes: dict[str, Any], steps: int, coordinator: str = "") -> Iterator[Outcome]:
    """Every check of a method.

    Args:
        kind: a registered method.
        changes: settings of the run that is to learn, by dotted name.
        steps: budget of that run.
        coordinator: that assigns in all runs, if it is not the method's own; a registered name.

    Raises:
        pydantic.ValidationError: a change that the method does not have.
    """
    config, chosen = ALGORITHMS[kind].config, {"coordinator.method": coordinator} if coordinator else {}
    learner = config.model_validate(nested(fitted(config, LEARNING) | chosen | changes))
    small = config.model_validate(nested(fitted(config, SMALL) | chosen))
    subject = f"{kind} with {coordinator}" if coordinator else kind
    for env in SMALL_TASKS:
        if fault := limits.misfit(env, small):
            yield Outcome(subject, f"acts in {env.kind}", left_out=fault)
            continue
        yield from outcomes(f"{subject} in {env.kind}", Case(small, env), CHECKS)
    yield from outcomes(subject, Case(small, None), [agents_in_another_order_do_the_same])
    yield from outcomes(subject, (learner, steps), [learns_the_tiny_task])


def _trainer(case: Case, seed: int = 0, **changes: Any) -> Trainer:
    return Trainer(case.env, case.algo, RUN.model_copy(update=changes), seed)


def _built(case: Case, batch: int) -> tuple[Any, Obs]:
    env = make_env(case.env, batch, seeded(0))
    obs = env.reset()
    for _ in range(3):  # away from the start
        obs = env.step(at_random(env, seeded(1))).obs
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        algo = ALGORITHMS[case.algo.kind].build(case.algo, env.spec, batch, seeded(2))
    return algo, obs._replace(first=torch.ones(batch, dtype=torch.bool))


def continues_from_any_point_bit_for_bit(case: Case) -> None:
    """In a fresh trainer of another seed, so that nothing can come from anywhere but the checkpoint."""
    run, metrics, states = _trainer(case), [], []
    for item in run:
        metrics.append(item)
        states.append(through_a_file(run.state_dict()))
    for point, state in enumerate(states[:-1]):
        other = _trainer(case, seed=99)
        other.load_state_dict(deepcopy(state))
        assert_same(other.state_dict(), state, f"loaded at point {point}")
        need(
            list(islice(other, 1)) == metrics[point + 1 : point + 2],
            f"point {point + 1} has other values after a resume",
        )
        assert_same(other.state_dict(), states[point + 1], f"point {point + 1} after a resume")


def repeats_with_the_same_seed_alone(case: Case) -> None:
    """Two runs of one seed are the same; one of another seed is not."""
    first, second, other = _trainer(case), _trainer(case), _trainer(case, seed=7)
    need(list(first) == list(second), "two runs of one seed have other values")
    assert_same(first.state_dict(), second.state_dict(), "the second run of one seed")
    list(other)
    learned = first.state_dict()["algorithm"], other.state_dict()["algorithm"]
    need_difference(*learned, "a run of another seed learns the same: does it use its generators?")


def evaluation_leaves_no_trace(case: Case) -> None:
    """More of them, and of more episodes, change nothing that was learned; nor does one after the run."""
    usual, more = _trainer(case), _trainer(case, evaluations=11, eval_episodes=5)
    list(usual)
    list(more)
    assert_same(usual.state_dict()["algorithm"], more.state_dict()["algorithm"], "after more evaluations: algorithm")
    before = deepcopy(more.state_dict()["algorithm"])
    evaluate(more.algorithm, case.env, 3, 5)
    assert_same(more.state_dict()["algorithm"], before, "after one evaluation more: algorithm")


def acts_within_the_task(case: Case) -> None:
    """Actions of the right shape and range; greedy acting draws nothing; what is given stays as it was."""
    algo, obs = _built(case, 6)
    spec = ENVS[case.env.kind].physics.spec(case.env)
    for explore in (False, True):
        carry, rng = algo.carry(6), seeded(0)
        given = deepcopy({"obs": obs._asdict(), "carry": carry, "algorithm": algo.state_dict()})
        action, after, extra = algo.act(obs, carry, rng, explore=explore)
        assert_same({"obs": obs._asdict(), "carry": carry, "algorithm": algo.state_dict()}, given, "changed by acting")
        need(explore or torch.equal(rng.get_state(), seeded(0).get_state()), "greedy acting draws from the generator")
        shape = (6, spec.agents, spec.actions) if spec.continuous else (6, spec.agents)
        need(tuple(action.shape) == shape, f"the joint action has the shape {tuple(action.shape)}, not {shape}")
        least, most = (-1, 1) if spec.continuous else (0, spec.actions - 1)
        need(least <= action.min() <= action.max() <= most, f"an action is outside {least} to {most}")
        need(after.keys() == carry.keys(), "the memory after acting has other parts than before")
        need(
            all(len(v) == 6 and not v.requires_grad for v in (*after.values(), *extra.values())),
            "memory and what is handed out lead with B and carry no gradient",
        )


def exploring_is_decided_by_the_generator(case: Case) -> None:
    """One generator state, one action; another state, another action."""
    algo, obs = _built(case, 64)
    drawn = [algo.act(obs, algo.carry(64), seeded(seed), explore=True)[0] for seed in (0, 0, 1)]
    need(torch.equal(drawn[0], drawn[1]), "the same generator gives other actions")
    need(not torch.equal(drawn[0], drawn[2]), "another generator gives the same actions: nothing explores")


def values_stay_finite_at_cut_and_ended_episodes(case: Case) -> None:
    """The time limit as a truncation, and as a termination."""
    for flag in (True, False):
        for item in _trainer(case, bootstrap_on_truncation=flag):
            finite({name: torch.tensor(value) for name, value in item.items()})


def every_learner_is_named(case: Case) -> None:
    """Learners change over a run, and nothing but what `learners()` names has an optimiser."""
    run = _trainer(case)
    before = deepcopy([one.state_dict() for one in run.algorithm.learners()])
    list(run)
    after = [one.state_dict() for one in run.algorithm.learners()]
    need(len(before) == len(after), "`learners()` names another number of networks after a run")
    for number, (old, new) in enumerate(zip(before, after, strict=True)):
        need_difference(old, new, f"learner {number} has learned nothing in the whole run")


def agents_in_another_order_do_the_same(case: Case) -> None:
    """Of a method with the encoder `pairwise`: reordering agents reorders what they do."""
    config = type(case.algo)
    if "encoder" not in config.model_fields:
        raise Unfit("it has no setting `encoder`")
    env = navigation.Config(agents=4, observation="extended", episode=7)
    _fit(env, case.algo)
    algo, obs = _built(Case(case.algo.model_copy(update={"encoder": "pairwise"}), env), 30)
    seen = obs, reordered(obs, ORDER)
    here, there = (algo.act(one, algo.carry(30), seeded(0), explore=False)[0] for one in seen)
    need(torch.equal(there, here[:, ORDER]), "agents in another order do something else")


def learns_the_tiny_task(given: tuple[Any, int]) -> None:
    """Two agents and two targets on a ring: 85 % of what they earn that go for a target each."""
    algo, steps = given
    best = toy.own_target()
    run = BUDGET.model_copy(update={"steps": steps})
    with _toy():
        _fit(toy.Config(), algo)
        found = max(item["eval/return"] for item in Trainer(toy.Config(), algo, run, 0))
    asked = f"{found:.2f} at best within {steps:,} steps, and {LEARNED * best:.2f} are asked for"
    need(found > LEARNED * best, f"{asked}; give --steps, or settings that suit it with --set")


def _fit(env: Any, algo: Any) -> None:
    if fault := limits.misfit(env, algo):
        raise Unfit(fault)


@contextmanager
def _toy() -> Iterator[None]:
    """The tiny task is registered for a check alone."""
    ENVS["toy"] = Task(toy.Config, toy)
    try:
        yield
    finally:
        del ENVS["toy"]


CHECKS = (
    continues_from_any_point_bit_for_bit,
    repeats_with_the_same_seed_alone,
    evaluation_leaves_no_trace,
    acts_within_the_task,
    exploring_is_decided_by_the_generator,
    values_stay_finite_at_cut_and_ended_episodes,
    every_learner_is_named,
)
