"""RHMC's two levels side by side: how often each learns."""

import pytest

from pipelines.conformance.blocks import nested
from rhmc.algorithms import rhmc
from rhmc.envs import coverage
from rhmc.training.trainer import Config, Trainer
from rhmc.types import Batch


@pytest.mark.parametrize("every", [1, 2, 3])
def test_the_coordinator_learns_after_each_so_many_updates_of_the_executors(
    every: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocks = {"coordinator.update_every": every, "coordinator.batch_size": 4, "executor.batch_size": 4}
    fields = {"hidden_dim": 4, "learning_starts": 8, "train_freq": 8, "assignment_period": 1}
    cfg = rhmc.Config.model_validate(nested(blocks | fields))
    budget = Config(steps=104, num_envs=4, evaluations=1, eval_episodes=1, final_episodes=1)
    trainer = Trainer(coverage.Config(agents=2, targets=2), cfg, budget, 0)
    learned: list[str] = []

    def note(level: str) -> None:
        part = getattr(trainer.algorithm, level)
        update = part.update

        def noted(rows: Batch) -> Batch:
            learned.append(level)
            return dict(update(rows))

        monkeypatch.setattr(part, "update", noted)

    note("executor")
    note("coordinator")
    for _ in trainer:
        pass
    turn = ["executor"] * every + ["coordinator"]
    assert learned.count("executor") == 12  # 96 steps after the first 8, an update each 8
    assert learned == (turn * 12)[: len(learned)]
    assert learned.count("coordinator") == 12 // every
