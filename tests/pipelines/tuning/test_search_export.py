"""From Optuna's trials to the table that the report reads: the whole budget, the same bytes, and what is left out."""

import json
import math
from contextlib import nullcontext
from pathlib import Path

import optuna
import pandas as pd
import pyarrow.parquet as pq
import pytest

from pipelines.specs.study import Setting
from pipelines.tuning import search_export
from pipelines.tuning.search_export import export_search
from pipelines.tuning.trials import opened
from pipelines.workspace.work_folder import Home
from reports.data.schema import TRIALS
from tests.pipelines.support import CODE, Said, run_rhmc
from tests.pipelines.tuning.test_search import GOOD, MEDIAN, World, changed, curve, load

NAME = "search_x.trials.parquet"


@pytest.fixture(autouse=True)
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty project as the current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("OPTUNA_STORAGE", raising=False)
    monkeypatch.setenv("RHMC_HOME", str(tmp_path / "work"))
    (tmp_path / "studies" / "best_params").mkdir(parents=True)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return tmp_path


def exported(world: World, folder: Path) -> tuple[int, pd.DataFrame]:
    """The exit code and the table."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search_export, "opened", lambda place, write: nullcontext(world.storage))
        code = export_search(world.search, folder, folder)
    return code, pd.read_parquet(folder / NAME)


def test_a_row_for_each_trial_of_the_budget(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = World(load(), tmp_path)
    world.launch()
    code, table = exported(world, tmp_path)
    assert (code, capsys.readouterr()) == (0, ("", ""))
    assert list(table) == TRIALS.names
    assert pq.read_schema(tmp_path / NAME).metadata[b"rhmc.tables"] == TRIALS.metadata[b"rhmc.tables"]
    assert list(zip(table["arm"], table["trial"], strict=True)) == [
        (arm, n) for arm in ("IQL", "VDN") for n in range(5)
    ]
    same = {
        "search": "search_x",
        "state": "complete",
        "steps": 600,
        "seeds": 2,
        "task": "navigation",
        "profile": "quick",
    }
    for column, value in (same | {"question": "Which?"}).items():
        assert set(table[column]) == {value}
    (iql, _) = world.arm_studies()
    for row, trial in zip(table.itertuples(), iql.latest().values(), strict=False):
        assert (row.algorithm, row.fingerprint, json.loads(str(row.params))) == ("iql", CODE, trial.params)
        assert row.value == pytest.approx(10.005 - abs(math.log10(trial.params["lr"]) + 3))
        assert Setting.model_validate_json(str(row.config)) == iql.search.arms["IQL"].at(trial.params)


def test_equal_trials_give_equal_bytes(tmp_path: Path) -> None:
    found = []
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        world = World(load(), tmp_path / name)
        world.launch()
        exported(world, tmp_path / name)
        found.append((tmp_path / name / NAME).read_bytes())
    assert found[0] == found[1]


def test_what_is_pruned_has_no_value_and_fewer_steps(tmp_path: Path) -> None:
    world = World(load(GOOD + MEDIAN, "quick", "trials=12"), tmp_path)
    world.launch()
    code, table = exported(world, tmp_path)
    pruned = table[table["state"] == "pruned"]
    assert code == 0
    assert len(pruned) > 0
    assert pruned["value"].isna().all()
    assert set(pruned["steps"]) <= {200, 400}
    assert table[table["state"] == "complete"]["value"].notna().all()


def test_the_plan_is_kept_where_trials_failed_or_are_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def raises(one: Setting, seed: int) -> list[float]:
        if one.algo.kind == "iql":
            raise ValueError("no such thing")
        return curve(one, seed)

    few = World(load(GOOD, "quick", "trials=3"), tmp_path)
    few.launch(raises)
    world = World(load(), tmp_path, few.storage)
    world.arm_studies()[1].ask()
    code, table = exported(world, tmp_path)
    assert code == 3
    assert table["state"].tolist() == ["failed"] * 3 + ["missing"] * 2 + ["complete"] * 3 + ["partial", "missing"]
    open_ = table[~table["state"].isin(["complete"])]
    assert open_["value"].isna().all()
    assert set(open_["steps"]) == {0}
    gone = table[table["state"] == "missing"]
    assert set(gone["params"]) == {"{}"}
    assert json.loads(gone["config"].iloc[0])["algo"]["lr"] == world.search.arms["IQL"].setting.algo.lr
    assert capsys.readouterr().err == "search_x (quick): 7 of 10 trials are neither complete nor pruned\n"


def test_a_smaller_budget_has_its_own_trials_alone(tmp_path: Path) -> None:
    world = World(load(), tmp_path)
    world.launch()
    _, table = exported(World(load(GOOD, "quick", "trials=2"), tmp_path, world.storage), tmp_path)
    assert table["trial"].tolist() == [0, 1, 0, 1]


def test_trials_of_other_code_are_left_out_and_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = World(load(), tmp_path)
    world.launch()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipelines.specs.search.code_id", lambda *place: "0ther")
        code, table = exported(world, tmp_path)
    assert (code, set(table["state"])) == (3, {"missing"})
    said = capsys.readouterr().err.splitlines()
    assert said[:2] == [f"search_x (quick), {a}: 5 trials of other settings or code left out" for a in ("IQL", "VDN")]


# The command


def rhmc(capfd: pytest.CaptureFixture[str], *words: str) -> Said:
    return Said(run_rhmc("search", "export", *words), *capfd.readouterr())


def test_several_searches_before_anything_ran(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    load()
    Path("studies/search_y.yaml").write_text(GOOD)
    code, out, err = rhmc(capfd, "studies/search_x.yaml", "studies/search_y.yaml", "--profile", "paper")
    assert (code, out) == (3, "")
    assert err.splitlines() == [
        "search_x (paper): 18 of 18 trials are neither complete nor pruned",
        "search_y (paper): 18 of 18 trials are neither complete nor pruned",
        "next:  rhmc report --profile paper",
    ]
    assert not (tmp_path / "work").exists()
    made = sorted(path.name for path in (tmp_path / "results/paper/runs").iterdir())
    assert made == ["search_x.trials.parquet", "search_y.trials.parquet"]


def test_one_search_to_another_folder(capfd: pytest.CaptureFixture[str]) -> None:
    load()
    said = rhmc(capfd, "studies/search_x.yaml", "--out", "o", "--set", "trials=1")
    assert said.code == 3
    assert said.err.splitlines()[-1] == "next:  rhmc report --study studies/search_x.yaml --runs o"
    assert pq.read_metadata(f"o/{NAME}").num_rows == 2


def test_every_fault_of_every_file_is_a_line(capfd: pytest.CaptureFixture[str]) -> None:
    Path("studies/search_x.yaml").write_text(changed("high: 0.9", "high: 1.5"))
    Path("studies/search_y.yaml").write_text(changed("quick: 5", "quick: 0"))
    code, out, err = rhmc(capfd, "studies/search_x.yaml", "studies/search_y.yaml")
    assert (code, out) == (2, "")
    assert [line.partition(":")[0] for line in err.splitlines()] == ["studies/search_x.yaml", "studies/search_y.yaml"]
    load()
    said = rhmc(capfd, "studies/search_x.yaml", "studies/search_x.yaml")
    assert said == (2, "", "search_x: given 2 times; searches that go together need names of their own\n")
    assert not Path("results").exists()


def test_what_cannot_be_read_or_written_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    load()
    Path("a_file").write_text("")
    said = rhmc(capfd, "studies/search_x.yaml", "--out", "a_file/o")
    assert (said.code, said.out, said.err.count("\n")) == (2, "", 1)
    monkeypatch.setenv("OPTUNA_STORAGE", "optuna.db")
    said = rhmc(capfd, "studies/search_x.yaml")
    assert (said.code, said.out) == (2, "")
    assert said.err == "rhmc: OPTUNA_STORAGE=optuna.db: not the address of a database; sqlite:///FILE is one\n"
    assert not Path("results").exists()


def test_a_search_in_the_work_folder_is_read(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    search = load(GOOD, "quick", "trials=2")
    (tmp_path / "work").mkdir()
    with opened(Home(tmp_path / "work")) as storage:
        World(search, tmp_path, storage).launch()
    said = rhmc(capfd, "studies/search_x.yaml", "--set", "trials=2")
    assert (said.code, said.err) == (0, "next:  rhmc report --study studies/search_x.yaml\n")
    assert set(pd.read_parquet(f"results/quick/runs/{NAME}")["state"]) == {"complete"}
