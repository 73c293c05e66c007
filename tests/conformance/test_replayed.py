"""The rows that updates use per environment step: what the report says of a configuration, against a training.

Every method is trained for some steps while every row that leaves a replay, or a pass over a rollout, is counted.
"""

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from torch import Generator

from pipelines.conformance.blocks import fitted, nested
from pipelines.specs.study import RunSpec, Study
from reports.analyses.settings import replayed
from rhmc.algorithms import ALGORITHMS, coma, ppo
from rhmc.envs import coverage
from rhmc.hierarchy import attention
from rhmc.learning.experience import minibatches
from rhmc.learning.learner import Replay
from rhmc.training.trainer import Config, Trainer
from rhmc.types import Batch
from tests.depth import covering

ROOT = Path(__file__).parents[2]
STEPS = 1600  # of 8 copies: two episodes each; half of them HiT-MAC's executors practise
RUN = Config(steps=STEPS, num_envs=8, evaluations=1, eval_episodes=1, final_episodes=1)
SMALL = {
    "hidden_dim": 4,
    "learning_starts": 0,
    "buffer_size": 400,
    "train_freq": 16,
    "pretrain": STEPS // 2,
    "n_steps": 5,
    "minibatches": 2,
    "actor_minibatches": 5,
    "coordinator.update_every": 2,
    "assignment_period": 10,
}
# Every setting that counts has another value in the second
VARIANTS: list[dict[str, Any]] = [
    {"executor.batch_size": 24, "coordinator.batch_size": 8, "batch_size": 24, "epochs": 3},
    {
        "executor.batch_size": 16,
        "coordinator.batch_size": 12,
        "batch_size": 16,
        "epochs": 2,
        "train_freq": 20,
        "coordinator.update_every": 5,
        "pretrain": STEPS // 4,
        "coordinator.epochs": 4,
    },
]
LEVELS = {"rhmc": {"low": "executors", "high": "coordinator"}, "hitmac": {"low": "executors", "passes": "coordinator"}}
LEVELS |= {"coma": {"passes": "critic", "actor passes": "actor"}}


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Rows by where they came from: replays in the order of their first use, passes over rollouts."""
    rows: Counter[str] = Counter()
    replays: list[Replay] = []
    sample = Replay.sample

    def sampled(self: Replay, count: int) -> Batch:
        if not any(one is self for one in replays):
            replays.append(self)
        found = sample(self, count)
        rows["low" if self is replays[0] else "high"] += len(next(iter(found.values())))
        return found

    def passed(data: Batch, epochs: int, parts: int, rng: Generator) -> Iterator[Batch]:
        for part in minibatches(data, epochs, parts, rng):
            rows["actor passes" if parts == SMALL["actor_minibatches"] else "passes"] += len(next(iter(part.values())))
            yield part

    monkeypatch.setattr(Replay, "sample", sampled)
    for module in (attention, coma, ppo):
        monkeypatch.setattr(module, "minibatches", passed)
    return rows


@pytest.mark.parametrize(("kind", "change"), [(kind, VARIANTS[place]) for kind, place in covering(ALGORITHMS, (0, 1))])
def test_the_rows_that_a_training_uses_are_those_that_its_settings_say(
    kind: str, change: dict[str, Any], counted: Counter[str]
) -> None:
    config = ALGORITHMS[kind].config
    algo = config(**nested(fitted(config, SMALL | change)))
    spec = RunSpec(env=coverage.Config(agents=2, targets=2), algo=algo, trainer=RUN, seed=0)
    for _ in Trainer(spec.env, spec.algo, spec.trainer, 0):
        pass
    names = LEVELS.get(kind, dict.fromkeys(counted, ""))
    found = {names[place]: rows / STEPS for place, rows in counted.items()}
    assert found == pytest.approx(replayed(json.loads(spec.canonical())))


def test_the_tuned_settings_of_the_paper_profile() -> None:
    runs = {run.arm: run.spec for run in Study.load(ROOT / "studies/coverage.yaml", "paper").runs()}
    rates = {arm: replayed(json.loads(spec.canonical())) for arm, spec in runs.items()}
    whole = {"MADDPG": 8, "MAPPO": 5, "IPPO": 5, "QMIX": 4, "VDN": 4, "IQL": 4}
    assert {arm: rates[arm] for arm in whole} == {arm: {"": rate} for arm, rate in whole.items()}
    assert rates["COMA"] == {"critic": 2, "actor": 1}
    assert rates["RHMC"] == rates["RHMC qmix"] == {"executors": 2, "coordinator": 0.5}
    assert rates["HiT-MAC"] == pytest.approx({"executors": 0.6, "coordinator": 0.42})
