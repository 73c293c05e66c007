"""The fixed evaluation episodes."""

from typing import Any

import pytest
import torch
from torch import Generator, Tensor

from pipelines.conformance import toy
from pipelines.conformance.blocks import fitted, nested
from pipelines.conformance.same import assert_same
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS, Task, coverage, make_env, navigation
from rhmc.training.evaluation import CHUNK, Episodes, evaluate
from rhmc.training.trainer import Config, Trainer
from rhmc.types import Obs, Transition

SHORT = navigation.Config(episode=4, agents=2)


@pytest.fixture(autouse=True)
def _toy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ENVS, "toy", Task(toy.Config, toy))


class Fixed:
    """Always the same action and assignment; keeps what it sees. `draws` numbers are taken from the generator given."""

    def __init__(self, action: int = 0, assigned: float | None = None, draws: int = 0) -> None:
        self.action, self.assigned, self.draws = action, assigned, draws
        self.seen: list[Obs] = []
        self.explored: list[bool] = []

    def carry(self, batch: int) -> dict[str, Tensor]:
        return {"steps": torch.zeros(batch)}

    def act(self, obs: Obs, carry: dict[str, Tensor], rng: Generator, *, explore: bool) -> Any:
        torch.rand(self.draws, generator=rng)
        self.seen.append(obs)
        self.explored.append(explore)
        b, n, m, _ = obs.pairs.shape
        extra = {} if self.assigned is None else {"assignment": torch.full((b, n, m), self.assigned)}
        assert carry["steps"].tolist() == [len(self.seen) - 1.0] * b
        return torch.full((b, n), self.action), {"steps": carry["steps"] + 1}, extra

    def observe(self, transition: Transition) -> None:
        raise AssertionError("evaluation does not teach")

    def update(self) -> dict[str, Tensor]:
        raise AssertionError("evaluation does not teach")

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


def same(a: Episodes, b: Episodes) -> bool:
    return list(a.values) == list(b.values) and all(torch.equal(a.values[k], b.values[k]) for k in a.values)


class Many(Fixed):
    """Without the check of one episode: several chunks."""

    def act(self, obs: Obs, carry: dict[str, Tensor], rng: Generator, *, explore: bool) -> Any:
        return torch.full(obs.pairs.shape[:2], self.action), carry, {}


def test_evaluation_episodes_are_made_of_chunks() -> None:
    whole = evaluate(Many(1), SHORT, CHUNK + 1, seed=7)
    first, last = evaluate(Many(1), SHORT, CHUNK, seed=7), evaluate(Many(1), SHORT, 1, seed=7 + CHUNK)
    assert whole.values["return"].shape == (CHUNK + 1,)
    for key, value in whole.values.items():
        assert torch.equal(value, torch.cat((first.values[key], last.values[key])))
    assert same(first, evaluate(Many(1), SHORT, CHUNK, seed=7))
    assert not same(first, evaluate(Many(1), SHORT, CHUNK, seed=8))


@pytest.mark.parametrize("cfg", [SHORT, coverage.Config(agents=2, targets=3)], ids=["navigation", "coverage"])
def test_every_method_meets_the_same_episodes(cfg: Any) -> None:
    """Starts, and what moves by itself, whatever a method does or draws."""
    policies = Fixed(0), Fixed(1, draws=3), Fixed(2, assigned=1.0)
    for policy in policies:
        evaluate(policy, cfg, 5, seed=11)
    first, *others = policies
    assert first.seen[0].first.all()
    for other in others:
        assert torch.equal(first.seen[0].pairs, other.seen[0].pairs)
        assert not torch.equal(first.seen[-1].pairs, other.seen[-1].pairs)
        if cfg.kind == "coverage":  # the targets' ways: distance does not depend on headings
            ways = [[obs.pairs[..., 3] for obs in policy.seen] for policy in (first, other)]
            assert all(torch.equal(a, b) for a, b in zip(*ways, strict=True))


def test_one_episode_each_and_greedy() -> None:
    policy = Fixed()
    evaluate(policy, SHORT, 3, seed=0)
    assert len(policy.seen) == SHORT.episode
    assert [bool(obs.first.any()) for obs in policy.seen] == [True, False, False, False]
    assert policy.explored == [False] * SHORT.episode


@pytest.mark.parametrize("cfg", [SHORT, coverage.Config(agents=2, targets=3), toy.Config()], ids=lambda c: c.kind)
def test_results_are_those_of_the_environment_in_the_units_of_its_summary(cfg: Any) -> None:
    env = make_env(cfg, 6, torch.Generator().manual_seed(5))
    env.reset()
    steps = [env.step(torch.full((6, 2), 1)) for _ in range(env.spec.episode)]
    rewards = torch.stack([s.reward for s in steps])
    values = evaluate(Fixed(1), cfg, 6, seed=5).values
    unit = {"navigation": rewards.sum(0), "coverage": 100 * rewards.mean(0), "toy": rewards.mean(0)}
    assert torch.allclose(values["return"], unit[cfg.kind])
    assert len(values["return"].unique()) > 1
    if cfg.kind == "coverage":
        seen = torch.stack([s.info["coverage"] for s in steps])
        assert torch.allclose(values["coverage"], 100 * seen.mean(0))
        assert values["coverage"].max() > 1  # percent
    if cfg.kind == "navigation":
        assert torch.allclose(values["collisions"], torch.stack([s.info["collisions"] for s in steps]).sum(0))
        assert torch.equal(values["landmarks_covered"], steps[-1].info["landmarks_covered"])


def test_the_assignment_reaches_the_environment() -> None:
    """In the preset whose reward depends on it."""
    cfg = coverage.Config(preset="executor", agents=2, targets=3)
    everything, nothing, untold = (evaluate(Fixed(0, g), cfg, 4, seed=1) for g in (1.0, 0.0, None))
    assert same(everything, untold)
    assert not same(everything, nothing)
    assert (nothing.values["return"] == 0).all()  # no target, no score, and holding costs nothing


def test_means_and_the_standard_error() -> None:
    episodes = Episodes({"return": torch.tensor([1.0, 2.0, 6.0]), "coverage": torch.tensor([0.0, 1.0, 0.5])})
    means = episodes.means("eval")
    assert means["eval/return"] == pytest.approx(3)
    assert means["eval/coverage"] == pytest.approx(0.5)
    assert means["eval/return_sem"] == pytest.approx((14 / 2 / 3) ** 0.5)  # squares 4 + 1 + 9, over n - 1, over n
    assert Episodes({"return": torch.tensor([4.0])}).means("final") == {"final/return": 4.0, "final/return_sem": 0.0}


@pytest.mark.parametrize("kind", ALGORITHMS)
def test_evaluating_leaves_the_run_and_the_global_generator_untouched_and_repeats_itself(kind: str) -> None:
    config = ALGORITHMS[kind].config
    small = {"hidden_dim": 8, "buffer_size": 30, "batch_size": 8, "learning_starts": 8, "train_freq": 4}
    algo = config(**nested(fitted(config, small)))
    cfg = Config(steps=40, num_envs=4, evaluations=2, eval_episodes=2, final_episodes=2)
    run = Trainer(SHORT, algo, cfg, seed=0)
    next(run)
    next(run)
    twin = Trainer(SHORT, algo, cfg, seed=0)
    next(twin)
    next(twin)
    before = torch.get_rng_state()
    first = evaluate(run.algorithm, SHORT, 6, seed=2)
    assert same(first, evaluate(run.algorithm, SHORT, 6, seed=2))
    assert torch.equal(torch.get_rng_state(), before)
    assert assert_same(run.state_dict(), twin.state_dict()) > 50
    assert not first.values["return"].requires_grad
