"""Watching a coordinator: what is counted, and that nothing changes by it."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch

from pipelines.conformance.blocks import fitted, nested
from pipelines.policies import assignments
from pipelines.policies.assignments import Watch, counts, export_assignments, rows_of, watched
from pipelines.specs.study import Study
from pipelines.workspace.errors import InputError
from rhmc.algorithms import ALGORITHMS
from rhmc.hierarchy.theorem import smallest_counterexample
from rhmc.training.trainer import Trainer
from rhmc.types import Local, Obs, Transition
from tests.pipelines.support import jobs_of, run_rhmc, setting, tiny


def rhmc_study() -> Study:
    """RHMC, HiT-MAC and IQL, one seed, a second of training."""
    algo: dict[str, Any] = {
        "learning_starts": 64,
        "batch_size": 32,
        "train_freq": 16,
        "hidden_dim": 8,
        "buffer_size": 400,
    }
    base = setting()
    arms = {
        name: type(base).model_validate(
            base.model_dump() | {"algo": {"kind": name} | nested(fitted(ALGORITHMS[name].config, own))}
        )
        for name, own in (("rhmc", algo), ("hitmac", {"hidden_dim": 8, "pretrain": 200}), ("iql", algo))
    }
    return tiny(arms=arms)


def transition(held: torch.Tensor, options: torch.Tensor) -> Transition:
    """A transition of which only the assignment (B, N, M) and the options (B, N, D, M) count."""
    none = torch.zeros(len(held))
    obs = Obs(none, none, none, none.bool())
    local = Local(none, none)
    extra = {"assignment": held.float()}
    flags = none.bool()
    return Transition(obs, none, none, local, flags, flags, flags, obs, lambda horizon: options, extra)


def test_counts_by_hand() -> None:
    held = torch.tensor([[[1, 1, 0], [1, 0, 0]], [[0, 0, 0], [1, 1, 1]]]).bool()
    found = counts(transition(held, torch.zeros(2, 2, 1, 3, dtype=torch.bool)))
    assert {name: x.tolist() for name, x in found.items() if not name.endswith(("1", "6"))} == {
        "pairs": [3, 3],
        "conflicts": [1, 0],  # the first target of the first state
        "free": [1, 0],
        "idle": [0, 1],
    }
    assert found["lost_h1"].tolist() == [0, 0]


def test_algorithm_1_is_found_short_where_it_is() -> None:
    case = smallest_counterexample(alpha=assignments.ALPHA)
    held, options = case.assignment.unsqueeze(0).repeat(3, 1, 1), case.options.unsqueeze(0).repeat(3, 1, 1, 1)
    options[1] = True  # whatever is chosen, all is completed: nothing to lose
    found = counts(transition(held, options))
    assert found["lost_h6"].tolist() == [1, 0, 1]
    assert found["gap_h6"].tolist() == pytest.approx([case.exact - case.paper, 0, case.exact - case.paper])


def test_means_are_over_the_states_since_the_last_look() -> None:
    passed: list[Transition] = []
    watch = Watch(passed.append)
    assert watch.take() == {}
    case = smallest_counterexample(alpha=assignments.ALPHA)
    one = transition(case.assignment.unsqueeze(0), case.options.unsqueeze(0))
    none = transition(torch.zeros_like(one.extra["assignment"]), case.options.unsqueeze(0))
    for step in range(2 * assignments.EVERY):
        watch(one if step < assignments.EVERY else none)
    assert len(passed) == 2 * assignments.EVERY  # every one, though two are looked at
    found = watch.take()
    assert found["assign/states"] == 2
    assert found["assign/pairs"] == float(case.assignment.sum()) / 2
    assert found["assign/lost_h1"] == 0.5
    assert found["assign/gap_h1"] == pytest.approx(case.exact - case.paper)  # where lost, not on average
    assert watch.take() == {}


def test_watching_changes_no_training() -> None:
    study = rhmc_study()
    (run,) = watched(study, ["rhmc"])
    spec = run.item.spec
    plain = Trainer(spec.env, spec.algo, spec.trainer, spec.seed)
    before = list(plain)
    other = Trainer(spec.env, spec.algo, spec.trainer, spec.seed)
    other.algorithm.observe = Watch(other.algorithm.observe)  # type: ignore[method-assign]
    assert list(other) == before
    assert [step for step, _ in run.points] == [int(x["step"]) for x in before[1:]]  # nothing is trained at step 0


def test_several_runs_at_a_time_give_the_same_bytes(tmp_path: Path) -> None:
    study = rhmc_study()
    alone, files = list(watched(study)), []
    for jobs in (1, 2):
        runs = list(watched(study, jobs=jobs))
        assert runs == alone
        for run in runs:
            file = export_assignments(study, rows_of(run), tmp_path / str(jobs))
        files.append(file.read_bytes())
    assert files[0] == files[1]


def test_only_what_assigns_is_trained(tmp_path: Path) -> None:
    study = rhmc_study()
    runs = list(watched(study))
    assert [run.item.card.arm for run in runs] == ["rhmc", "hitmac"]
    with pytest.raises(InputError, match="no such run assigns targets; rhmc and hitmac do"):
        list(watched(study, ["iql"]))
    with pytest.raises(InputError, match=r"--arm: 'rmhc' is not allowed; .*did you mean 'rhmc'"):
        list(watched(study, ["rmhc"]))
    file = export_assignments(study, rows_of(runs[0]), tmp_path)
    export_assignments(study, rows_of(runs[1]), tmp_path)
    table = pd.read_parquet(file)
    assert set(table["arm"]) == {"rhmc", "hitmac"}  # the first run's rows have stayed
    bytes_before = file.read_bytes()
    export_assignments(study, rows_of(runs[0]), tmp_path)
    assert file.read_bytes() == bytes_before
    file.write_text("text")
    with pytest.raises(InputError, match="not a readable table; move it away"):
        export_assignments(study, rows_of(runs[0]), tmp_path)


@pytest.mark.parametrize(("jobs", "asked"), [([], 2), (["--jobs", "1"], 1)])
def test_the_command_writes_the_table(
    jobs: list[str], asked: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["studies/ablation.yaml", "--arm", "full", "--seed", "0", "--out", str(tmp_path / "out"), *jobs]
    seen = jobs_of("pipelines.policies.assignments", monkeypatch)
    small = ("steps=512", "trainer.evaluations=1", "trainer.eval_episodes=2", "trainer.final_episodes=2")
    words += [word for one in small for word in ("--set", one)]
    assert run_rhmc("assignments", *words) == 0
    assert capsys.readouterr().err == f"wrote {tmp_path / 'out' / 'ablation.assignments.parquet'}\n"
    table = pd.read_parquet(tmp_path / "out" / "ablation.assignments.parquet")
    assert table["metric"].str.startswith("assign/").all()
    assert seen == [asked]
