"""Policies with other numbers than they were trained with: what is played, and what the table holds."""

from pathlib import Path

import pandas as pd
import pytest

from pipelines import cli
from pipelines.errors import InputError
from pipelines.evaluation import Bank, Policy, score
from pipelines.policy import Saved
from pipelines.store import without_replay
from pipelines.transfer import TRANSFER, Size, export_transfer, sizes, transfer
from tests.pipelines.test_evaluation import of_kind, trained


def policy(encoder: str = "pairwise") -> Policy:
    one = of_kind("iql", encoder)
    trainer, _ = trained(one)
    return Policy("IQL", Saved(one, without_replay(trainer.state_dict())["algorithm"]))


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
        *_, values = score(one, Bank(episodes=8, agents=int(str(row.agents))))
        assert (row.value, row.sem) == (values["return"], values["return_sem"])
    assert set(table["run"]) == {one.spec.id}


def test_a_policy_that_cannot_act_with_them_is_said() -> None:
    with pytest.raises(InputError, match="'pairwise' acts with any"):
        list(transfer("tiny", [policy("mlp")], [3], [], 8))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "--agents or --targets: at least one number, such as --agents 2,3,6"),
        (["--agents", "2,x"], "--agents: '2,x': whole numbers with commas between, such as 2,3,6"),
        (["--targets", "0"], "--targets: '0': numbers from 1 on"),
    ],
)
def test_bad_numbers_are_one_line(
    words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["rhmc", "transfer", "studies/coverage.yaml", "--out", str(tmp_path), *words])
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == 2
    assert capsys.readouterr().err == f"{said}\n"
    assert list(tmp_path.iterdir()) == []
