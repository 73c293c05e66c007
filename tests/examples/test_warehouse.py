"""The task of `examples/warehouse`: its rules against an oracle, what it offers, and its study."""

from itertools import product
from types import ModuleType
from typing import Any

import pytest
import torch

from pipelines.conformance.checks import seeded
from pipelines.policies.render import episode_gif
from pipelines.specs.study import Study
from pipelines.tracking.policy import Saved
from pipelines.workspace.own_packages import bring
from rhmc.algorithms import ALGORITHMS
from rhmc.hierarchy.regulation import Charges, exact
from rhmc.training.trainer import Trainer
from rhmc.yardsticks.scores import play_yardsticks
from tests.examples.conftest import EXAMPLES, SHORT
from tests.oracles import warehouse as oracle
from tests.pipelines.support import run_rhmc

EXAMPLE = "warehouse"
SIZES = [(3, 4, 5), (1, 1, 2), (4, 2, 3)]  # robots, orders, cells along a side: walls, ties and orders on one cell


@pytest.fixture
def task(_there: None) -> ModuleType:
    import sys

    bring("warehouse.task", [EXAMPLES / EXAMPLE])
    return sys.modules["warehouse.task"]


def world(state: Any, b: int) -> oracle.World:
    robots, orders = ([(x, y) for x, y in cells[b].tolist()] for cells in (state.robots, state.orders))
    return oracle.World(robots, orders, state.age[b].tolist())


@pytest.mark.parametrize(("agents", "targets", "size"), SIZES)
def test_steps_scores_and_observations_are_the_oracles(task: ModuleType, agents: int, targets: int, size: int) -> None:
    cfg = task.Config(agents=agents, targets=targets, size=size)
    rng, batch, fetches = seeded(1), 6, 0
    state = task.initial(cfg, batch, rng)
    for _ in range(12):
        actions = torch.randint(5, (batch, agents), generator=rng)
        fresh = torch.randint(size, (batch, targets, 2), generator=torch.Generator().set_state(rng.get_state()))
        after = task.transition(cfg, state, actions, rng)
        out, obs = task.outcome(cfg, after, actions, None), task.observe(cfg, after)
        for b in range(batch):
            before = world(state, b)
            cells = [(x, y) for x, y in fresh[b].tolist()]
            wanted, fetched = oracle.step(before, actions[b].tolist(), cells, size)
            assert world(after, b) == wanted
            assert out.completed[b].tolist() == fetched
            count = sum(any(column) for column in zip(*fetched, strict=True))
            fetches += count
            assert (out.reward[b], out.info["fetched"][b]) == (count, count)
            assert out.info["age"][b] == pytest.approx(sum(wanted.age) / targets)
            assert torch.allclose(out.local.pairs[b], torch.tensor(oracle.scores(before, wanted)))
            seen = [[oracle.pair(wanted, i, j, size) for j in range(targets)] for i in range(agents)]
            assert torch.allclose(obs.pairs[b], torch.tensor(seen))
            assert torch.allclose(obs.agents[b] * size, after.robots[b].float())
        state = after
    assert fetches > 5


@pytest.mark.parametrize(("agents", "targets", "size"), SIZES)
def test_options_are_the_pairs_of_orders_on_one_way_and_bound_every_way(
    task: ModuleType, agents: int, targets: int, size: int
) -> None:
    cfg = task.Config(agents=agents, targets=targets, size=size)
    state = task.initial(cfg, 3, seeded(2))
    for horizon, b, i in product((1, 2, 3), range(3), range(agents)):
        table = task.options(cfg, state, horizon)[b, i]
        ways = oracle.visits(world(state, b), i, horizon, size)
        pairs = {(seen[t], j) for seen in ways for t in range(len(seen)) for j in seen[: t + 1]}
        assert {(d, j) for d, j in table.nonzero().tolist()} == pairs
        options = [set(row.nonzero().flatten().tolist()) for row in table]
        assert all(any({*seen} <= option for option in options) for seen in ways if seen)


def test_a_robot_may_be_told_no_more_than_it_could_fetch(task: ModuleType) -> None:
    """The regulator over the task's options: one robot in a corner of the grid, orders beside it and far away."""
    state = task.initial(task.Config(agents=1, targets=2), 1, seeded())
    state = state._replace(robots=torch.tensor([[[0, 0]]]), orders=torch.tensor([[[0, 2], [8, 8]]]))
    held, charges = torch.ones(1, 1, 2), Charges(0.5)
    bounds = [float(exact(task.options(None, state, h), held, charges)) for h in (1, 2, 15, 16)]
    assert bounds == [-1, 0.5, 0.5, 2]


def test_policies_without_learning_are_ranked_and_drawn(task: ModuleType) -> None:
    scores = play_yardsticks(task.Config(), episodes=50)
    means = [scores[name]["return"] for name in ("wait", "random", "nearest", "matching")]
    assert means == sorted(means)
    assert means[-1] > 1.2 * means[-2] > 10 * means[-3]
    spec = Study.load("studies/warehouse.yaml", "quick", SHORT).runs()[0].spec
    saved = Saved(spec, Trainer(spec.env, spec.algo, spec.trainer, 0).state_dict()["algorithm"])
    assert episode_gif(saved, beside="matching", frames=2).startswith(b"GIF89a")


def test_it_conforms_and_every_method_trains_in_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_rhmc("conformance", "warehouse.task", "--set", "episode=10") == 0
    said = capsys.readouterr().out
    assert f"{8 + len(ALGORITHMS)} checks hold, 0 do not, 0 left out" in said


def test_its_study_has_no_fault_and_every_arm_trains() -> None:
    assert run_rhmc("study", "check", "studies/warehouse.yaml") == 0
    study = Study.load("studies/warehouse.yaml", "quick", SHORT)
    assert study.remarks == () or all("learn" in one for one in study.remarks)
    specs = [run.spec for run in study.runs() if run.spec.seed == 0]
    assert {spec.imports for spec in specs} == {("warehouse.task",)}
    for spec in specs:
        assert "final/return" in list(Trainer(spec.env, spec.algo, spec.trainer, 0))[-1]


def test_the_paper_s_preset_leaves_what_the_task_does_not_have() -> None:
    study = Study.load("studies/warehouse.yaml", "quick", ["preset=paper"])
    assert {arm.env.observation for arm in study.arms.values()} == {"shared"}
