"""Methods with memory: what they learn from against what acted, losses against a loop, and a task that needs memory."""

from itertools import product
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

from pipelines.conformance import checks
from pipelines.conformance.blocks import fitted, nested
from pipelines.conformance.checks import through_a_file
from pipelines.conformance.methods import CHECKS, Case
from pipelines.conformance.same import assert_same
from pipelines.specs.document import Node, Place, validate
from pipelines.specs.learning_start import starts
from pipelines.specs.study import RunSpec, Setting
from pipelines.tracking.policy import Actor, Saved, load, save
from rhmc.algorithms import ALGORITHMS
from rhmc.algorithms.qlearning import QLearning
from rhmc.algorithms.recurrent_ppo import RecurrentPPO
from rhmc.algorithms.recurrent_qlearning import RecurrentQLearning
from rhmc.envs import ENVS, Task, make_env, navigation
from rhmc.learning.learner import Learner, taken, unpack
from rhmc.learning.segments import along
from rhmc.networks.recurrent import stepped
from rhmc.training.trainer import Config, Trainer
from rhmc.types import Batch
from tests import recall

VALUES = ("iql", "vdn", "qmix")
EPISODE, LENGTH, BATCH = 7, 4, 3  # episodes begin and end within segments
ENV = navigation.Config(agents=2, observation="extended", episode=EPISODE)
RUN = Config(steps=10**6, num_envs=BATCH, evaluations=1)


def config(kind: str, **changes: Any) -> Any:
    """Segments of 4 steps; a method's first update is on steps 12 to 24 of each environment, or never."""
    own: dict[str, Any] = {"learning_starts": 10**9, "n_steps": 3 * LENGTH, "epochs": 1, "minibatches": 1}
    small = own | {"batch_size": 5 * LENGTH, "buffer_size": 100 * LENGTH, "hidden_dim": 8, "segment_length": LENGTH}
    cfg = ALGORITHMS[kind].config
    return cfg(**nested(fitted(cfg, small | {"encoder": "pairwise_gru"}) | changes))


def run_of(kind: str, steps: int, seed: int = 0, **changes: Any) -> Trainer:
    """After so many steps of each environment, with weights that remember."""
    run = Trainer(ENV, config(kind, **changes), RUN, seed)
    for _ in range(steps):
        run._act()
    return run


def grads(loss: Tensor, learner: Learner[Any]) -> list[Tensor]:
    return list(torch.autograd.grad(loss, learner.params, retain_graph=True))


# What is learned from is what acted


@pytest.mark.parametrize(("kind", "share"), [("iql", True), ("vdn", False), ("qmix", True)])
def test_values_of_a_segment_are_those_that_chose_its_actions(kind: str, share: bool) -> None:
    """Greedily: epsilon ends at 0 at once. All agents' memories differ from those of a fresh start."""
    run = run_of(kind, 6 * LENGTH, share=share, epsilon_steps=1, epsilon_end=0.0)
    algo = run.algorithm
    assert isinstance(algo, RecurrentQLearning)
    rows = algo.experience.replay.rows
    held = {key: value[: algo.experience.replay.size] for key, value in rows.items()}
    time = {key: value if key == "state" else value.transpose(0, 1) for key, value in held.items()}
    assert time["reward"].shape == (LENGTH, 6 * BATCH)
    values, _ = along(algo.q.net.agents, time, time["state"])
    steps_on = time["reward"].shape[1] - BATCH  # those of the first steps were explored
    assert torch.equal(values.argmax(-1)[:, -steps_on:], time["action"][:, -steps_on:])
    cold, _ = along(algo.q.net.agents, time, torch.zeros_like(time["state"]))
    goes_on = ~time["first"][0]
    assert goes_on.any()
    assert not torch.allclose(values[0, goes_on], cold[0, goes_on], atol=1e-5)


@pytest.mark.parametrize(("kind", "share"), [("mappo", True), ("ippo", False)])
def test_policies_of_a_segment_are_those_that_acted(kind: str, share: bool) -> None:
    """To 1e-6, in the second rollout, whose first steps go on in an episode."""
    run = run_of(kind, 3 * LENGTH, share=share)
    algo = run.algorithm
    assert isinstance(algo, RecurrentPPO)
    algo.update()
    for _ in range(3 * LENGTH):
        run._act()
    rows, _ = algo._judged(algo.rollout.take() or {})
    assert rows["policy"].shape == (3 * BATCH, LENGTH, 2, 5)
    assert_close(algo._policies(rows), rows["policy"], atol=1e-6, rtol=0)
    cold = algo._policies(rows | {"state": torch.zeros_like(rows["state"])})
    assert not torch.allclose(cold, rows["policy"], atol=1e-5)


def test_a_critic_goes_on_from_rollout_to_rollout() -> None:
    """Its values of each segment are those of one walk through both rollouts, step by step."""
    run = run_of("mappo", 3 * LENGTH, lr=1e-12)
    algo = run.algorithm
    assert isinstance(algo, RecurrentPPO)
    rollouts, predicted = [], []
    for _ in range(2):
        rows = algo.rollout.take() or {}
        rollouts.append(rows)
        predicted.append(algo._predicted(algo._judged(rows)[0]))
        for _ in range(3 * LENGTH):
            run._act()
    state = algo.carry(BATCH)["state"]
    for rows, found in zip(rollouts, predicted, strict=True):
        in_time = found.unflatten(0, (3, BATCH)).transpose(1, 2).flatten(0, 1)
        for t in range(3 * LENGTH):
            now = {key: value[t] for key, value in rows.items()}
            value, state = stepped(algo.critic.net, unpack(now)._replace(first=now["first"]), state)
            assert_close(in_time[t], value.squeeze(-1), atol=1e-6, rtol=0)


# Losses against a loop over steps


def oracle(algo: QLearning, rows: Batch) -> Tensor:
    """The loss of segments (T, K, ...), one environment and one step at a time."""
    cfg, net, target_net = algo.cfg, algo.q.net, algo.q.target_net
    errors = []
    for k in range(rows["reward"].shape[1]):
        state = target_state = rows["state"][k : k + 1]
        for t in range(len(rows["reward"])):
            now = {key: value[t, k : k + 1] for key, value in rows.items() if key != "state"}
            if now["first"]:
                state, target_state = torch.zeros_like(state), torch.zeros_like(state)
            q, state = _step(net.agents, now, "", state)
            _, target_state = _step(target_net.agents, now, "", target_state)
            later, _ = _step(net.agents, now, "next_", state)
            target_later, _ = _step(target_net.agents, now, "next_", target_state)
            best = (later if cfg.double_q else target_later).argmax(-1)
            chosen = net.mixer(unpack(now), taken(q, now["action"]))
            value = target_net.mixer(unpack(now, "next_"), taken(target_later, best))
            target = now["reward"] + (0 if now["terminated"] else cfg.gamma * value)
            errors.append((chosen - target.detach()).square())
    return torch.cat(errors).mean()


def _step(net: nn.Module, now: Batch, prefix: str, state: Tensor) -> tuple[Tensor, Tensor]:
    """With a gradient, and no begin of an episode: values (1, N, actions) and state (1, N, H)."""
    both = net(unpack(now, prefix), state, torch.zeros(1, 1, dtype=torch.bool))
    return both[..., :5], both[..., 5:]


@pytest.mark.parametrize(("kind", "double"), [*product(VALUES, [True, False])])
def test_the_loss_of_segments_is_that_of_a_loop_in_value_and_slope(kind: str, double: bool) -> None:
    run = run_of(kind, 5 * LENGTH, double_q=double, standardise="none", learning_starts=0, train_freq=5 * LENGTH)
    algo = run.algorithm
    assert isinstance(algo, RecurrentQLearning)
    with torch.no_grad():
        for p in algo.q.target_params:
            p.add_(0.1 * torch.randn(p.shape))
    rows = next(algo.experience.due())
    rows["terminated"] = rows["done"] & (torch.arange(rows["done"].shape[1]) % 2 == 0)
    assert 0 < rows["terminated"].sum() < rows["done"].sum()  # both kinds of end
    found, slow = algo._loss(rows)[0], oracle(algo, rows)
    assert_close(found, slow, atol=1e-6, rtol=1e-5)
    assert_close(grads(found, algo.q), grads(slow, algo.q), atol=1e-5, rtol=1e-4)


# Requirements on every method


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__.partition("_")[0])
@pytest.mark.parametrize(("kind", "encoder", "share"), [("qmix", "mlp_gru", False), ("mappo", "pairwise_gru", True)])
def test_methods_with_memory_do_what_every_method_has_to_do(kind: str, encoder: str, share: bool, check: Any) -> None:
    """Segments of 2 steps, which the runs' points cut; a rollout is two of them."""
    cfg = ALGORITHMS[kind].config
    wanted = checks.SMALL | {"segment_length": 2, "n_steps": 4, "encoder": encoder, "share": share}
    check(Case(cfg(**nested(fitted(cfg, wanted))), ENV))


@pytest.mark.parametrize("kind", ["iql", "ippo"])
def test_a_kept_policy_plays_on_with_its_memory(kind: str, tmp_path: Any) -> None:
    """What was kept to learn from is left out; the same actions through two episodes, and with other numbers."""
    run = run_of(kind, 3 * LENGTH)
    run.algorithm.update()
    spec = RunSpec(env=ENV, algo=run.algorithm.cfg, trainer=RUN, seed=0)
    save(tmp_path / "policy.pt", Saved(spec, run.algorithm.state_dict()))
    actor = Actor(load(tmp_path / "policy.pt"))
    env, rng = make_env(ENV, BATCH, checks.seeded()), checks.seeded()
    obs, carry = env.reset(), run.algorithm.carry(BATCH)
    for _ in range(2 * EPISODE):
        action, carry, _ = run.algorithm.act(obs, carry, rng, explore=False)
        assert torch.equal(actor.act(obs)[0], action)
        obs = env.step(action).obs
    assert_same(actor.carry, carry)
    more = ENV.model_copy(update={"agents": 4})
    played, _ = Actor(load(tmp_path / "policy.pt"), more).act(make_env(more, 5, checks.seeded()).reset())
    assert played.shape == (5, 4)


def test_a_checkpoint_between_rollouts_holds_the_critics_memory() -> None:
    run, other = run_of("mappo", 3 * LENGTH), run_of("mappo", 0, seed=9)
    run.algorithm.update()
    other.load_state_dict(through_a_file(run.state_dict()))
    for _ in range(3 * LENGTH):
        run._act()
        other._act()
    assert other.algorithm.update() == run.algorithm.update()


# Settings


@pytest.mark.parametrize("kind", ["coma", "maddpg", "hitmac", "rhmc"])
def test_methods_without_memory_refuse_it_in_one_line(kind: str) -> None:
    assert faults(kind, encoder="mlp_gru") == [
        "study.yaml: encoder: 'mlp_gru' is not allowed; allowed: mlp, pairwise; did you mean 'mlp'?"
    ]


@pytest.mark.parametrize(
    ("kind", "changes", "text"),
    [
        ("iql", {"batch_size": 100}, "batch_size: 100 is not allowed with encoder 'mlp_gru'; allowed: multiples of"),
        ("qmix", {"buffer_size": 7}, "buffer_size: must be at least segment_length, 8"),
        ("ippo", {"n_steps": 30}, "n_steps: 30 is not allowed with encoder 'mlp_gru'; allowed: multiples of"),
        ("mappo", {"segment_length": 0}, "segment_length: 0 is not allowed; must be greater than or equal to 1"),
    ],
)
def test_steps_that_are_no_whole_segments_are_refused_where_there_is_memory(
    kind: str, changes: dict[str, int], text: str
) -> None:
    (line,) = faults(kind, encoder="mlp_gru", **changes)
    assert text in line
    assert faults(kind, **changes) == [] or "segment_length" in changes


def faults(kind: str, **fields: Any) -> list[str]:
    def node(value: Any, path: str) -> Node:
        return Node(value, Place("study.yaml"), Place("study.yaml"), path)

    tree = node({key: node(value, key) for key, value in fields.items()}, "")
    return [str(fault) for fault in validate(ALGORITHMS[kind].config, tree)[1]]


@pytest.mark.parametrize(("length", "step"), [(2, 10 + 4), (8, 8 * 4)])
def test_values_are_learned_from_the_first_whole_segment_on(length: int, step: int) -> None:
    """At `learning_starts` + `train_freq`, or later: where a check says that it begins, it does."""
    changes = {"segment_length": length, "batch_size": 8, "learning_starts": 10, "train_freq": 4}
    algo, run = config("iql", **changes), Config(steps=99, num_envs=4)
    (start,) = starts(Setting(env=ENV, algo=algo, trainer=run))
    trainer, steps = Trainer(ENV, algo, run, 0), 0
    while trainer.algorithm.experience.updates == 0:  # type: ignore[attr-defined]
        trainer._act()
        trainer.algorithm.update()
        steps += 4
    assert start.step == steps == -(-step // 4) * 4


# Learning

RECALL: dict[str, dict[str, Any]] = {
    "iql": {
        "lr": 5e-3,
        "tau": 0.05,
        "gamma": 0.9,
        "batch_size": 64,
        "buffer_size": 4000,
        "learning_starts": 256,
        "train_freq": 32,
        "epsilon_steps": 2000,
        "segment_length": 8,
    },
    "ippo": {"lr": 1e-2, "gamma": 0.9, "n_steps": 8, "segment_length": 4, "epochs": 4, "minibatches": 2},
}


@pytest.mark.parametrize("kind", RECALL)
def test_memory_recalls_a_cue_and_no_other_network_does(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The task ends with the episode; what comes after its end is nothing to bootstrap with."""
    monkeypatch.setitem(ENVS, "recall", Task(recall.Config, recall))
    best = {}
    for encoder in ("mlp_gru", "mlp"):
        algo = ALGORITHMS[kind].config(encoder=encoder, hidden_dim=16, **RECALL[kind])
        run = Config(
            steps=5120,
            num_envs=32,
            evaluations=8,
            eval_episodes=300,
            final_episodes=1,
            bootstrap_on_truncation=False,
        )
        best[encoder] = 0.0
        for item in Trainer(recall.Config(), algo, run, 0):
            best[encoder] = max(best[encoder], item["eval/return"])
            if best[encoder] > 0.95:
                break
    assert best["mlp_gru"] > 0.95
    assert best["mlp"] < 0.6
