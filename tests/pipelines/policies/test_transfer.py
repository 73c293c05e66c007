"""Policies with other numbers than they were trained with: what is played, and what the table holds."""

import pickle
from pathlib import Path

import pandas as pd
import pytest

from pipelines.policies.evaluation import EvaluationEpisodes, Policy, score
from pipelines.policies.transfer import Size, export_transfer, sizes, transfer
from pipelines.tracking.policy import Saved
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import without_replay
from reports.data.schema import TRANSFER
from tests.pipelines.policies.test_evaluation import of_kind, trained
from tests.pipelines.support import jobs_of, run_rhmc


def policy(encoder: str = "pairwise", kind: str = "iql") -> Policy:
    one = of_kind(kind, encoder)
    trainer, _ = trained(one)
    return Policy(kind.upper(), Saved(one, without_replay(trainer.state_dict())["algorithm"]))


def test_one_number_is_changed_at_a_time_and_the_trained_ones_are_played_too() -> None:
    assert sizes(policy(), [3, 2], [4]) == [Size(2, 2), Size(2, 4), Size(3, 2)]


def test_the_table_holds_what_evaluation_says(tmp_path: Path) -> None:
    one = policy()
    rows = list(transfer("tiny", [one], [3], [], 8))
    table = pd.read_parquet(export_transfer(rows, tmp_path / "out"))
    assert list(table.columns) == TRANSFER.names
    assert table[["agents", "targets", "trained_agents", "trained_targets"]].to_numpy().tolist() == [
        [2, 2, 2, 2],
        [3, 2, 2, 2],
    ]
    for row in table.itertuples():
        played = score(one, EvaluationEpisodes(episodes=8, agents=int(str(row.agents))))._asdict()["values"]
        assert (row.value, row.sem) == (played["return"], played["return_sem"])
    assert set(table["run"]) == {one.saved.spec.id}


def test_several_policies_at_a_time_give_the_same_bytes(tmp_path: Path) -> None:
    policies = [policy(kind=kind) for kind in ("iql", "qmix", "mappo")]
    files = []
    for jobs in (1, 2):
        rows = list(transfer("tiny", iter(policies), [3], [3], 8, jobs))
        assert [row[1] for row in rows] == ["IQL"] * 3 + ["QMIX"] * 3 + ["MAPPO"] * 3
        files.append(export_transfer(rows, tmp_path / str(jobs)).read_bytes())
    assert files[0] == files[1]


def test_a_policy_under_way_goes_to_another_process_without_its_replay(monkeypatch: pytest.MonkeyPatch) -> None:
    one = of_kind("iql", "pairwise")
    trainer, _ = trained(one)
    given: list[Policy] = []
    monkeypatch.setattr(
        "pipelines.policies.transfer.side_by_side", lambda function, items, jobs: given.extend(items) or ()
    )
    whole = trainer.state_dict()["algorithm"]
    assert list(transfer("tiny", [Policy("IQL", Saved(one, whole))], [3], [], 8)) == []
    sizes = [len(pickle.dumps(state)) for state in (given[0].saved.algorithm, without_replay(whole), whole)]
    assert sizes[0] == sizes[1] < sizes[2]


def test_a_policy_that_cannot_act_with_them_is_said() -> None:
    with pytest.raises(InputError, match="'pairwise' acts with any"):
        list(transfer("tiny", [policy("mlp")], [3], [], 8))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "--agents or --targets: at least one number, such as --agents 2,3,6"),
        (["--agents", "2,x"], "--agents: '2,x': whole numbers with commas between, such as 2,3,6"),
        (["--targets", "0"], "--targets: '0': numbers from 1 to 100"),
    ],
)
def test_bad_numbers_are_one_line(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_rhmc("transfer", "studies/coverage.yaml", "--out", str(tmp_path), *words) == 2
    assert capsys.readouterr().err == f"{said}\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_what_another_process_cannot_play_is_one_line(
    jobs: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    policies, seen = [policy(), policy("mlp")], jobs_of("pipelines.policies.transfer", monkeypatch)
    monkeypatch.setattr("pipelines.policies.evaluation.of_study", lambda *given: iter(policies))
    words = ["studies/coverage.yaml", "--agents", "3", "--episodes", "4", "--out", str(tmp_path), "--jobs", jobs]
    assert run_rhmc("transfer", *words) == 2
    sizes = "--agents or --targets: iql with encoder 'mlp'"
    said = f"{sizes} acts only with the numbers that it was trained with; 'pairwise' acts with any\n"
    assert capfd.readouterr() == ("", said)
    assert seen == [int(jobs)]
    assert list(tmp_path.iterdir()) == []
