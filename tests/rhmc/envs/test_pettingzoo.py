"""Both tasks behind PettingZoo's interfaces: its own tests pass, and nothing about the task is another."""

import re
import warnings
from typing import Any

import pytest
import torch
from torch import Generator

from pipelines.specs.study import RunSpec
from pipelines.tracking.policy import Actor, Saved
from rhmc.envs import ENVS, make_env
from rhmc.envs.pettingzoo import ParallelTask, env, flattened, parallel_env, unflattened
from rhmc.training.evaluation import evaluate
from rhmc.training.trainer import Trainer

with warnings.catch_warnings():  # its module of tests makes an example in a way that it calls deprecated
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test

TASKS: list[dict[str, Any]] = [
    {"kind": "coverage", "agents": 4, "targets": 5, "preset": "flat", "observation": "extended"},
    {"kind": "coverage"},
    {"kind": "navigation"},
    {"kind": "navigation", "continuous": True, "observation": "extended", "agents": 1},
    {"kind": "navigation", "continuous": True, "agents": 4, "episode": 6},
]


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.filterwarnings("ignore:Agent's m:UserWarning")  # positions have no bounds
def test_its_own_tests_pass(task: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    parallel_api_test(parallel_env(**task), 120)
    parallel_seed_test(lambda: parallel_env(**task), 40)
    api_test(env(**task), 120)
    assert capsys.readouterr().out.count("Passed") == 2


@pytest.mark.parametrize("task", TASKS)
def test_a_step_is_a_step_of_the_task(task: dict[str, Any]) -> None:
    zoo = parallel_env(**task)
    ours = make_env(zoo.cfg, 1, Generator().manual_seed(3))
    seen, _ = zoo.reset(seed=3)
    obs = ours.reset()
    ended = []
    for _ in range(zoo.spec.episode):
        assert all((seen[f"agent_{i}"] == flattened(obs)[0, i].numpy()).all() for i in range(zoo.spec.agents))
        actions = {agent: zoo.action_space(agent).sample() for agent in zoo.agents}
        joint = torch.stack([torch.as_tensor(actions[agent]) for agent in zoo.agents]).unsqueeze(0)
        step = ours.step(joint)
        seen, rewards, terminations, truncations, infos = zoo.step(actions)
        assert set(rewards.values()) == {float(step.reward)}
        assert not any(terminations.values())
        assert infos["agent_0"] == {name: float(value) for name, value in step.info.items()}
        assert len(zoo.state()) == len(seen) * len(seen["agent_0"])
        ended.append(set(truncations.values()))
        obs = step.final_obs
    assert ended == [{False}] * (zoo.spec.episode - 1) + [{True}]
    assert zoo.agents == []
    assert (flattened(obs)[0].numpy() == list(seen.values())).all(), "the last observation is of the episode that ended"


def test_one_seed_decides_the_episodes_after_it_too() -> None:
    first, second = parallel_env("navigation"), parallel_env("navigation")
    starts = [[one.reset(seed=seed)[0]["agent_0"].tolist() for seed in (7, None, None)] for one in (first, second)]
    assert starts[0] == starts[1]
    assert starts[0][0] != starts[0][1] != starts[0][2]
    unseeded = [parallel_env("navigation").reset()[0]["agent_0"].tolist() for _ in range(2)]
    assert unseeded[0] != unseeded[1]


@pytest.mark.parametrize("task", TASKS)
def test_observations_come_back_from_their_vectors(task: dict[str, Any]) -> None:
    zoo = parallel_env(**task)
    obs = make_env(zoo.cfg, 3, Generator().manual_seed(0)).reset()
    again = unflattened(zoo.cfg, flattened(obs), first=True)
    assert all(torch.equal(a, b) for a, b in zip(obs, again, strict=True))
    assert flattened(obs).shape[-1:] == zoo.observation_space("agent_0").shape


@pytest.mark.parametrize("kind", ["rhmc", "iql", "mappo"])
def test_a_policy_of_ours_plays_as_it_is_evaluated(kind: str) -> None:
    task = {"kind": "coverage", "agents": 2, "targets": 3}
    trainer = {"steps": 40, "num_envs": 4, "evaluations": 1}
    algo = {"kind": kind, "hidden_dim": 8} | ({"assignment_period": 3} if kind == "rhmc" else {})
    one = RunSpec.model_validate({"env": task, "algo": algo, "trainer": trainer, "seed": 5})
    made = Trainer(one.env, one.algo, one.trainer, one.seed)
    saved = Saved(one, made.algorithm.state_dict())

    zoo, total = parallel_env(**task), 0.0
    actor = Actor(saved)
    zoo.reset(seed=11)
    while zoo.agents:
        _, rewards, _, _, _ = zoo.step(zoo.split(actor.act(zoo.observed())[0]))
        total += rewards["agent_0"]
    expected = evaluate(made.algorithm, one.env, 1, 11).values["return"]
    assert 100 * total / zoo.spec.episode == pytest.approx(float(expected), rel=1e-6)


def test_every_task_is_there() -> None:
    assert {parallel_env(kind).metadata["name"] for kind in ENVS} == {f"{kind}_v0" for kind in ENVS}


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ({"agent_0": 0}, "agent_1: action None is not allowed; allowed is Discrete(5)"),
        ({"agent_0": 0, "agent_1": 1, "agent_2": 5}, "agent_2: action 5 is not allowed; allowed is Discrete(5)"),
    ],
)
def test_a_bad_action_is_named(actions: dict[str, int], message: str) -> None:
    zoo = parallel_env("navigation")
    zoo.reset(seed=0)
    with pytest.raises(ValueError, match=re.escape(message)):
        zoo.step(actions)


def test_a_bad_task_is_named() -> None:
    with pytest.raises(ValueError, match="task 'chess' is not known; known are coverage, navigation"):
        parallel_env("chess")
    with pytest.raises(ValueError, match="agents"):
        parallel_env("coverage", agents=0)
    assert isinstance(parallel_env("coverage"), ParallelTask)
