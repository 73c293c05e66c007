"""Results here against published ones, from the command line."""

import shutil
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from pipelines.cli.main import app
from pipelines.export.published import Again, folder, publish, retrain
from pipelines.export.tables import write_tables
from pipelines.specs.study import Study
from pipelines.tracking.plan import items, study_card
from pipelines.workspace.errors import InputError
from reports.analyses.equivalence import read
from reports.data.schema import VERSION
from rhmc.training.trainer import Trainer
from tests.memory_tracker import MemoryTracker
from tests.pipelines.support import setting, tiny

STUDY = tiny(arms={"slow": setting(lr=1e-4), "fast": setting(lr=1e-2)}).model_copy(update={"seeds": 2})


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tables of a finished study."""
    out = tmp_path_factory.mktemp("runs")
    export(STUDY, out)
    return out


def export(study: Study, out: Path, runs: int | None = None) -> None:
    tracker = MemoryTracker(study_card(study), [])
    for item in items(study)[:runs]:
        log = tracker.start(item.card)
        log.log(list(Trainer(item.spec.env, item.spec.algo, item.spec.trainer, item.spec.seed)))
        log.finish("finished")
    write_tables(study, items(study), tracker, out)


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


class Said(NamedTuple):
    code: int
    text: str


def verify(*words: str | Path) -> Said:
    result = CliRunner().invoke(app, ["verify", *map(str, words)])
    if isinstance(result.exception, InputError):
        return Said(2, str(result.exception))
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return Said(result.exit_code, result.output)


def edited(source: Path, out: Path, change: "pd.Series[float] | float", arm: str) -> Path:
    """The tables with the returns of an arm moved."""
    out.mkdir()
    values = pd.read_parquet(source / "tiny.parquet")
    mine = (values["arm"] == arm) & values["metric"].str.endswith("/return")
    values.loc[mine, "value"] += change
    values.to_parquet(out / "tiny.parquet")
    (out / "tiny.runs.parquet").write_bytes((source / "tiny.runs.parquet").read_bytes())
    return out


def test_what_is_published_is_small_and_verified(exported: Path) -> None:
    values, runs = read(exported)
    assert verify("--runs", exported).code == 2, "nothing is published yet"
    assert publish(values, runs, "quick") == folder("quick") == Path("results/published/quick")
    small, planned = read(folder("quick"))
    assert {name.partition("/")[0] for name in small["metric"]} == {"eval", "final"}
    assert len(small) < len(values)
    assert list(planned.columns) == ["study", "arm", "seed", "run", "profile", "config"]
    said = verify("--runs", exported)
    assert said == (0, "byte-equal to the published quick results: 2 arms\n")
    again = publish(values.sample(frac=1, random_state=1), runs, "quick") / "results.parquet"
    assert again.read_bytes() == (publish(values, runs, "quick") / "results.parquet").read_bytes()


def test_what_is_published_by_the_command_is_equal_to_what_it_is_of(exported: Path, tmp_path: Path) -> None:
    for file in exported.iterdir():
        if not file.name.endswith(".made.parquet"):
            (tmp_path / file.name).write_bytes(file.read_bytes())
    said = verify("--publish", "--runs", tmp_path)
    assert said == (0, "wrote results/published/quick\n")
    assert sorted(file.name for file in folder("quick").iterdir()) == ["results.parquet", "results.runs.parquet"]
    assert verify("--runs", exported) == (0, "byte-equal to the published quick results: 2 arms\n")
    moved = verify("--runs", edited(exported, tmp_path / "a", 3.0, "fast"))
    assert (moved.code, moved.text.splitlines()[-1]) == (
        4,
        "against the published quick results: 1 arm not shown to be equivalent, 1 arm byte-equal",
    )


def test_shifted_arms(exported: Path, tmp_path: Path) -> None:
    publish(*read(exported), "quick")
    said = verify("--runs", edited(exported, tmp_path / "a", 3.0, "fast"))
    assert said.code == 4
    assert "+3.00" in said.text
    assert "1 arm not shown to be equivalent" in said.text
    assert "1 arm byte-equal" in said.text
    wide = verify("--runs", tmp_path / "a", "--margin", "1e6")
    assert (wide.code, "equivalent" in wide.text) == (0, True)


def test_a_missing_seed_other_settings_and_another_profile(exported: Path, tmp_path: Path) -> None:
    publish(*read(exported), "quick")
    export(STUDY.model_copy(update={"seeds": 1}), tmp_path / "fewer")
    said = verify("--runs", tmp_path / "fewer")
    assert (said.code, "seed 1 not here" in said.text) == (4, True)
    export(
        tiny(points=2, arms={"slow": setting(), "fast": setting()}).model_copy(update={"seeds": 2}), tmp_path / "other"
    )
    said = verify("--runs", tmp_path / "other")
    assert (said.code, "other settings" in said.text) == (4, True)
    export(STUDY.model_copy(update={"profile": "paper"}), tmp_path / "paper")
    said = verify("--runs", tmp_path / "paper")
    assert said == (2, f"{tmp_path / 'paper'}: results of profile paper, and --profile is quick")
    assert verify("--profile", "paper", "--runs", exported).code == 2


def test_published_tables_of_an_older_version_are_not_compared(exported: Path, tmp_path: Path) -> None:
    shutil.copytree(exported, tmp_path / "old")
    file = tmp_path / "old" / "tiny.runs.parquet"
    pd.read_parquet(file).to_parquet(file)
    said = verify("--published", tmp_path / "old", "--runs", exported)
    remedy = "`rhmc study run` and `rhmc export` make them anew, `rhmc verify --publish` publishes them"
    assert said == (2, f"{tmp_path / 'old'}: tables of an older version, which are not compared; {remedy}")


def test_yardsticks_among_the_published_results_are_not_looked_for_in_a_log(
    exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_yardsticks = tmp_path / "all"
    with_yardsticks.mkdir()
    for file in exported.iterdir():
        (with_yardsticks / file.name).write_bytes(file.read_bytes())
        table = pd.read_parquet(file).assign(study="yardsticks")
        if "algorithm" in table:
            table["algorithm"] = "yardstick"
        changed = pa.Table.from_pandas(table, preserve_index=False).replace_schema_metadata(VERSION)
        pq.write_table(changed, with_yardsticks / file.name.replace("tiny", "yardsticks"))
    said = verify("--published", with_yardsticks, "--runs", with_yardsticks)
    assert said == (0, "byte-equal to the published quick results: 4 arms\n")
    again = verify("--published", with_yardsticks, "--retrain", "9", "--jobs", "1")
    assert again == (0, "byte-equal to the published quick results: 4 arms\n"), "the four trained runs"
    asked: list[str] = []
    monkeypatch.setattr("pipelines.export.published.export_log", lambda studies, *_: asked.extend(studies))
    verify("--published", with_yardsticks)
    assert asked == ["tiny"]


def test_unfinished_results_are_not_published(tmp_path: Path) -> None:
    export(STUDY, tmp_path / "half", runs=3)
    with pytest.raises(InputError, match=r"1 of 4 runs are not finished"):
        publish(*read(tmp_path / "half"), "quick")
    assert not Path("results").exists()


def test_runs_trained_anew(exported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    publish(*read(exported), "quick")
    said = verify("--retrain", "3", "--jobs", "1")
    assert said == (0, "byte-equal to the published quick results: 3 arms\n")
    monkeypatch.setattr("rhmc.algorithms.qlearning.linear", lambda start, end, over, step: 0.9)
    said = verify("--retrain", "3", "--jobs", "1", "--seed", "1")
    assert said.code == 4
    assert "first difference: seed" in " ".join(said.text.split())


def test_the_seed_draws_the_runs_that_are_trained_anew(exported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipelines.export.published._train", lambda spec: [])
    _, runs = read(exported)

    def drawn(seed: int, count: int = 2) -> list[tuple[str, int]]:
        return [(one.arm, one.seed) for one in retrain(runs, count, seed, 1)]

    assert drawn(3) == drawn(3)
    assert len({one for seed in range(20) for one in drawn(seed)}) == 4
    assert [len(drawn(0, count)) for count in (1, 2, 4, 9)] == [1, 2, 4, 4]


@pytest.mark.parametrize(("moved", "margin", "code"), [(0.98, [], 0), (1.02, [], 4), (1.02, ["--margin", "1.1"], 0)])
def test_options_of_what_is_trained_anew(
    exported: Path, monkeypatch: pytest.MonkeyPatch, moved: float, margin: list[str], code: int
) -> None:
    publish(*read(exported), "quick")
    values, _ = read(exported)
    asked: list[tuple[int, int, int]] = []

    def train(runs: pd.DataFrame, count: int, seed: int, jobs: int) -> list[Again]:
        asked.append((count, seed, jobs))
        groups = values[values["arm"] == "slow"].groupby(["seed", "run"])
        return [
            Again("tiny", "slow", int(str(one)), run, [(x.step, x.metric, x.value + moved) for x in rows.itertuples()])
            for (one, run), rows in groups
        ]

    monkeypatch.setattr("pipelines.export.published.retrain", train)
    assert verify("--retrain", "3", "--seed", "7", "--jobs", "5", *margin).code == code
    assert asked == [(3, 7, 5)]


def test_a_published_run_whose_settings_are_not_its_own(exported: Path) -> None:
    _, runs = read(exported)
    runs.loc[:, "run"] = "0" * 12
    with pytest.raises(InputError, match=r"published as run 0{12}, and its settings are those of"):
        list(retrain(runs, 1, 0, 1))
    runs.loc[:, "config"] = "{}"
    with pytest.raises(InputError, match=r"tiny, arm '\w+', seed \d: its published settings are none that this code"):
        list(retrain(runs, 1, 0, 1))
