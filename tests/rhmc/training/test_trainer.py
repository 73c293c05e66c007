"""The iterator of metrics: its grid, what it hands to a method, and that evaluation does not touch training."""

from functools import cache
from itertools import pairwise
from typing import Any, Literal

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Generator, Tensor, nn

from pipelines.conformance import toy
from pipelines.conformance.blocks import fitted, nested
from pipelines.conformance.same import assert_same
from rhmc.algorithms import ALGORITHMS
from rhmc.algorithms import rhmc as rhmc_page
from rhmc.algorithms.base import Method
from rhmc.envs import ENVS, Task
from rhmc.learning.learner import Learner, Learners
from rhmc.training.trainer import Config, Means, Trainer, grid_step
from rhmc.types import Frozen, Metrics, Obs, Spec, Transition
from tests.depth import covering

ENVIRONMENTS = 4


class RecorderConfig(Frozen):
    kind: Literal["recorder"] = "recorder"


class Recorder:
    """A method that acts at random, remembers everything it is handed and learns nothing."""

    def __init__(self, cfg: Any, spec: Spec, num_envs: int, rng: Generator) -> None:
        self.spec, self.num_envs, self.rng = spec, num_envs, rng
        self.weight = torch.rand(3)
        self.learner = Learner(nn.Linear(1, 1), lr=0.5)
        self.seen: list[Transition] = []
        self.options: list[Tensor] = []
        self.acted: list[tuple[Obs, bool]] = []

    def carry(self, batch: int) -> dict[str, Tensor]:
        return {"count": torch.zeros(batch)}

    def act(
        self, obs: Obs, carry: dict[str, Tensor], rng: Generator, *, explore: bool
    ) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        self.acted.append((obs, explore))
        b, n, m, _ = obs.pairs.shape
        action = torch.randint(self.spec.actions, (b, n), generator=rng)
        return action, {"count": carry["count"] + 1}, {"assignment": torch.ones(b, n, m), "count": carry["count"]}

    def observe(self, transition: Transition) -> None:
        self.seen.append(transition)
        self.options.append(transition.options(1))

    def update(self) -> dict[str, Tensor]:
        return {"seen": torch.tensor(float(len(self.seen)))} if len(self.seen) % 2 else {}

    def learners(self) -> Learners:
        return [self.learner]

    def state_dict(self) -> dict[str, Any]:
        return {"rng": self.rng.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.rng.set_state(state["rng"])


@pytest.fixture(autouse=True)
def _tables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ENVS, "toy", Task(toy.Config, toy))
    monkeypatch.setitem(ALGORITHMS, "recorder", Method(RecorderConfig, Recorder, rhmc_page.ABOUT))


def settle(**changes: Any) -> Config:
    defaults = {"steps": 60, "num_envs": ENVIRONMENTS, "evaluations": 3, "eval_episodes": 3, "final_episodes": 5}
    return Config.model_validate(defaults | changes)


def trainer(algo: Any = None, seed: int = 0, **changes: Any) -> Trainer:
    env: Any = toy.Config(targets=3)
    return Trainer(env, algo or RecorderConfig(), settle(**changes), seed)


@settings(deadline=None)
@given(steps=st.integers(1, 10**7), envs=st.integers(1, 3000), evaluations=st.integers(1, 300))
def test_the_grid(steps: int, envs: int, evaluations: int) -> None:
    cfg = Config(steps=steps, num_envs=envs, evaluations=evaluations)
    grid = [grid_step(cfg, point) for point in range(evaluations + 1)]
    assert grid[0] == 0
    assert steps <= grid[-1] < steps + envs
    assert all(step % envs == 0 for step in grid)
    assert all(a <= b for a, b in pairwise(grid))
    assert all(0 <= step - steps * point / evaluations < envs + 1 for point, step in enumerate(grid))


def test_a_grid_by_hand() -> None:
    cfg = Config(steps=100, num_envs=8, evaluations=3)
    assert [grid_step(cfg, point) for point in range(4)] == [0, 40, 72, 104]


def test_the_items_of_a_run() -> None:
    run = trainer()
    assert iter(run) is run
    items = list(run)
    assert [item["step"] for item in items] == [0, 20, 40, 60]
    assert "train/reward" not in items[0]
    assert all("train/reward" in item for item in items[1:])
    assert all({"eval/return", "eval/return_sem", "eval/faced"} <= set(item) for item in items)
    assert ["final/return" in item for item in items] == [False, False, False, True]
    assert run.done
    with pytest.raises(StopIteration):
        next(run)


def test_metrics_are_means_between_two_points() -> None:
    run = trainer()
    items = list(run)
    rewards = torch.stack([t.reward for t in run.algorithm.seen])
    assert len(rewards) == 15  # nothing of the evaluations is observed
    for k, item in enumerate(items[1:]):
        assert item["train/reward"] == pytest.approx(rewards[5 * k : 5 * k + 5].mean().item(), abs=1e-6)
    assert [item["train/seen"] for item in items[1:]] == [3, 8, 13]  # of 1 3 5, 7 9 and 11 13 15


def test_what_a_method_is_handed() -> None:
    """The true successor, also at an episode's end; the next observation is a start exactly there."""
    run = trainer()
    list(run)
    seen = run.algorithm.seen
    assert all(t.truncated.tolist() == [k % toy.EPISODE == toy.EPISODE - 1] * ENVIRONMENTS for k, t in enumerate(seen))
    starts = 0
    for k, (t, after) in enumerate(pairwise(seen)):
        turned = torch.tensor(toy.TURNS)[t.action].unsqueeze(-1)
        bearing = (angles(t.obs) - turned) % toy.HEADINGS
        assert torch.equal(angles(t.next_obs), bearing)
        assert torch.equal(t.completed, bearing == 0)
        assert torch.equal(t.reward, (bearing == 0).any(1).float().mean(-1))
        assert not t.next_obs.first.any()
        assert torch.equal(after.obs.first, t.truncated)
        if t.truncated.any():
            starts += 1
            assert not torch.equal(after.obs.pairs, t.next_obs.pairs)
        else:
            assert torch.equal(after.obs.pairs, t.next_obs.pairs)
        assert torch.equal(t.extra["count"], torch.full((ENVIRONMENTS,), float(k)))
        possible = (angles(t.obs).unsqueeze(2) - torch.tensor([-1, 0, 1]).view(1, 1, -1, 1)) % toy.HEADINGS == 0
        assert torch.equal(run.algorithm.options[k], possible)
    assert starts == 2


def angles(obs: Obs) -> Tensor:
    turns = torch.atan2(obs.pairs[..., 0], obs.pairs[..., 1]) * toy.HEADINGS / (2 * torch.pi)
    return turns.round().long() % toy.HEADINGS


def test_the_assignment_reaches_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    handed, outcome = [], toy.outcome

    def listen(cfg: Any, state: Any, action: Tensor, assignment: Tensor | None) -> Any:
        handed.append(assignment)
        return outcome(cfg, state, action, assignment)

    monkeypatch.setattr(toy, "outcome", listen)
    next(trainer())
    assert handed
    assert all(g is not None and g.shape[1:] == (2, 3) for g in handed)


def test_exploring_while_training_and_greedy_while_evaluating() -> None:
    run = trainer(eval_episodes=3, final_episodes=5)
    list(run)
    assert [explore for obs, explore in run.algorithm.acted if len(obs.first) == ENVIRONMENTS] == [True] * 15
    evaluated = [explore for obs, explore in run.algorithm.acted if len(obs.first) != ENVIRONMENTS]
    assert evaluated == [False] * (5 * toy.EPISODE)


SMALL = {"hidden_dim": 8, "buffer_size": 30, "batch_size": 8, "learning_starts": 8, "train_freq": 4}
SMALL |= {"n_steps": 3, "epochs": 2, "minibatches": 2, "pretrain": 20, "assignment_period": 1}


def method(kind: str) -> Any:
    config = ALGORITHMS[kind].config
    return config(**nested(fitted(config, SMALL)))


METHODS = [kind for kind in ALGORITHMS if kind != "recorder"]


def outcome_of(run: Trainer) -> tuple[list[Metrics], dict[str, Any]]:
    items = list(run)
    state = run.state_dict()
    del state["point"]
    return items, state


@cache
def trained(kind: str) -> dict[str, Any]:
    """The end of a run with nothing changed. Not to be changed either."""
    return outcome_of(trainer(method(kind)))[1]


OTHERWISE = [("eval_episodes", 50), ("evaluations", 1), ("evaluations", 12), ("final_episodes", 2), ("eval_seed", 3)]


@pytest.mark.parametrize(("kind", "name", "value"), [(kind, *change) for kind, change in covering(METHODS, OTHERWISE)])
def test_evaluating_otherwise_does_not_change_training(kind: str, name: str, value: int) -> None:
    usual = trained(kind)
    _, other = outcome_of(trainer(method(kind), **{name: value}))
    assert assert_same(usual, other) > 50


@pytest.mark.parametrize("kind", METHODS)
def test_the_seed_decides_everything(kind: str) -> None:
    first, again = outcome_of(trainer(method(kind), seed=3)), outcome_of(trainer(method(kind), seed=3))
    assert first[0] == again[0]
    assert_same(first[1], again[1])
    other, _ = outcome_of(trainer(method(kind), seed=4))
    assert all(a["train/reward"] != b["train/reward"] for a, b in zip(first[0][1:], other[1:], strict=True))


def test_the_seed_decides_starts_actions_weights_and_samples_each_for_itself() -> None:
    """Four streams, none of which repeats another, nor one of the next seed."""
    draws = []
    for seed in (0, 1):
        run = trainer(seed=seed)
        draws += [run.algorithm.weight]
        draws += [torch.rand(3, generator=rng.clone_state()) for rng in (run.env.rng, run.act_rng, run.algorithm.rng)]
    assert len({tuple(draw.tolist()) for draw in draws}) == len(draws)


@pytest.mark.parametrize("kind", METHODS)
def test_a_run_neither_needs_nor_moves_the_global_generator(kind: str) -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first = list(trainer(method(kind)))
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    assert list(trainer(method(kind))) == first


def test_means() -> None:
    means = Means()
    weight = torch.tensor(2.0, requires_grad=True)
    for k in range(4):
        means.add({"x": torch.tensor(float(k))} | ({"y": weight * k} if k > 1 else {}))
    assert means.result() == {"x": 1.5, "y": 5.0}
    assert not means.sums["y"].requires_grad
    assert Means().result() == {}


@pytest.mark.parametrize("left", [1.0, 0.2, 0.0])
def test_step_sizes_fall_in_a_line_to_what_is_left_of_them(left: float) -> None:
    """Budget of 60 in steps of 4: the update after k steps has 1 - (1 - left) k / 60 of the size."""
    run = trainer(final_lr_fraction=left)
    sizes: list[float] = []
    learner, update = run.algorithm.learners()[0], run.algorithm.update

    def recorded() -> dict[str, Tensor]:
        sizes.append(learner.optimiser.param_groups[0]["lr"])
        return update()

    run.algorithm.update = recorded  # type: ignore[method-assign]
    list(run)
    assert sizes == pytest.approx([0.5 * (1 - (1 - left) * step / 60) for step in range(0, 60, ENVIRONMENTS)])
