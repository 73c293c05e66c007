"""A fault in a table is reported in one line; values that are not there yet are missing, never zero."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from reports.data.exported import SHOWN
from reports.data.frame import RUNS, TableError, load
from tests.reports import factory
from tests.reports.factory import COVERAGE, NAVIGATION, Tables, study, write, yardsticks

Plant = Callable[[pd.DataFrame, pd.DataFrame], Tables]
ARMS = {"full": [70.0, 71.0, 72.0], "no filter": [60.0, 61.0, 62.0]}


def faults(folder: Path, *tables: Tables) -> list[str]:
    with pytest.raises(TableError) as error:
        load(write(folder, *tables), "quick")
    return str(error.value).splitlines()


def at(points: pd.DataFrame, metric: str, arm: str = "full", seed: int = 1) -> pd.Series:
    return (points["arm"] == arm) & (points["seed"] == seed) & (points["metric"] == metric)


def not_finite(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    return points.assign(value=points["value"].mask(at(points, "final/return"), np.nan)), runs


def hole_in_a_curve(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    here = at(points, "eval/return") & (points["step"] == 75_000)
    return points.assign(value=points["value"].mask(here, np.nan)), runs


def infinite(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    return points.assign(value=points["value"].mask(at(points, "final/return"), np.inf)), runs


def doubled(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    return pd.concat([points, points[at(points, "eval/return")].head(1)]), runs


def renamed(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    return points.assign(arm=points["arm"].replace("full", "Full")), runs


def hole(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    keep = ~((runs["arm"] == "full") & (runs["seed"] == 1))
    return points[points["run"].isin(runs["run"][keep])], runs[keep]


def shared(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    ids = {runs["run"].iloc[1]: runs["run"].iloc[0]}
    return points.replace({"run": ids}), runs.replace({"run": ids})


def no_final(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    return points[~at(points, "final/return")], runs


def ghost(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    return points, runs.assign(status=["missing", *runs["status"][1:]])


def other_profile(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    return points, runs.assign(profile=["paper", *runs["profile"][1:]])


def odd_status(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    return points, runs.assign(status=["done", *runs["status"][1:]])


def no_config(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    return points, runs.assign(config=["oops", *runs["config"][1:]])


def no_column(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    return points.drop(columns="value"), runs


def words(points: pd.DataFrame, runs: pd.DataFrame) -> Tables:
    return points.assign(value="many"), runs


@pytest.mark.parametrize(
    ("plant", "line"),
    [
        (not_finite, "ablation, arm 'full', seed 1, run {run}, step 150000: final/return is nan"),
        (hole_in_a_curve, "ablation, arm 'full', seed 1, run {run}, step 75000: eval/return is nan"),
        (infinite, "ablation, arm 'full', seed 1, run {run}, step 150000: final/return is inf"),
        (doubled, "ablation, arm 'full', seed 1, run {run}: eval/return at step 0 is there twice"),
        (hole, "ablation, arm 'full', seed 1: planned for other arms, and not for this one"),
        (no_final, "ablation, arm 'full', seed 1, run {run}: marked finished, and final/return is not there"),
        (ghost, "ablation, arm 'full', seed 0, run {first}: marked missing, and has points"),
        (other_profile, "ablation, arm 'full', seed 0: made with profile 'paper', and this report is of 'quick'"),
        (odd_status, "ablation, arm 'full', seed 0: status 'done' is none of finished, failed, partial, missing"),
        (no_config, "ablation, arm 'full', seed 0: column 'config' is no JSON object"),
        (no_column, "ablation.parquet: no column 'value'; there are study, arm, seed, run, step, metric"),
        (words, "ablation.parquet: column 'value' holds words, not numbers"),
    ],
)
def test_a_planted_fault_is_one_line(tmp_path: Path, plant: Plant, line: str) -> None:
    points, runs = study("ablation", ARMS)
    ids = {"run": runs["run"].iloc[1], "first": runs["run"].iloc[0]}
    assert faults(tmp_path, plant(points, runs)) == [line.format(**ids)]


def test_a_renamed_arm(tmp_path: Path) -> None:
    lines = faults(tmp_path, renamed(*study("ablation", ARMS)))
    assert len(lines) == 3  # one a seed
    assert "arm 'Full', seed 0" in lines[0]
    assert "not in the plan (planned arms: 'full', 'no filter')" in lines[0]


def test_two_seeds_with_one_id(tmp_path: Path) -> None:
    lines = faults(tmp_path, shared(*study("ablation", ARMS)))
    assert any("already stands for another seed of this arm" in line for line in lines)
    assert any("two values of eval/return" in line and "two runs share one id" in line for line in lines)


def test_one_run_may_stand_in_two_studies_if_its_values_agree(tmp_path: Path) -> None:
    points, runs = study("ablation", {"full": [70.0, 71.0]})
    again = points.assign(study="coverage", arm="RHMC"), runs.assign(study="coverage", arm="RHMC")
    assert load(write(tmp_path / "same", (points, runs), again), "quick").finals("coverage", "RHMC").tolist() == [
        70,
        71,
    ]
    changed = again[0].assign(value=again[0]["value"] + 1), again[1]
    assert any("two runs share one id" in line for line in faults(tmp_path / "other", (points, runs), changed))


def test_many_faults_of_a_kind_are_counted(tmp_path: Path) -> None:
    points, runs = study("ablation", ARMS)
    lines = faults(tmp_path, (pd.concat([points, points]), runs))
    assert len(lines) == SHOWN + 1
    assert lines[-1] == f"... and {len(points) - SHOWN} more of this kind"


def test_files_that_are_not_there_or_not_tables(tmp_path: Path) -> None:
    with pytest.raises(TableError, match="no tables here"):
        load(tmp_path / "nowhere", "quick")
    folder = write(tmp_path, study("ablation", ARMS))
    (folder / "ablation.runs.parquet").unlink()
    with pytest.raises(TableError, match=r"ablation\.runs\.parquet \(the planned runs\) is not beside it"):
        load(folder, "quick")
    (folder / "ablation.runs.parquet").write_text("text")
    with pytest.raises(TableError, match=r"ablation\.runs\.parquet: not a readable Parquet table"):
        load(folder, "quick")


def test_how_runs_were_made_may_be_missing(tmp_path: Path) -> None:
    folder = write(tmp_path, study("ablation", ARMS))
    whole = load(folder, "quick")
    assert (set(whole.runs["commit"]), whole.runs["seconds"].sum()) == ({"c0ffee"}, 9.0)
    made = pd.read_parquet(folder / "ablation.made.parquet")
    made[made["seed"] > 0].to_parquet(folder / "ablation.made.parquet")
    some = load(folder, "quick").runs.groupby("seed")
    assert some["commit"].unique().map(list).to_dict() == {0: [""], 1: ["c0ffee"], 2: ["c0ffee"]}
    assert some["seconds"].sum(min_count=1).isna().to_dict() == {0: True, 1: False, 2: False}
    (folder / "ablation.made.parquet").unlink()
    none = load(folder, "quick")
    assert none.runs[list(RUNS)].equals(whole.runs[list(RUNS)])
    assert none.points.equals(whole.points)
    assert set(none.runs[["commit", "machine", "versions", "adopted"]].to_numpy().ravel()) == {""}
    assert none.runs["seconds"].isna().all()


def test_how_a_run_was_made_stands_there_once(tmp_path: Path) -> None:
    folder = write(tmp_path, study("ablation", ARMS))
    made = pd.read_parquet(folder / "ablation.made.parquet")
    pd.concat([made, made.head(1)]).to_parquet(folder / "ablation.made.parquet")
    with pytest.raises(TableError, match=r"^ablation, arm 'full', seed 0, run \w+: how it was made is there twice$"):
        load(folder, "quick")


def test_tables_of_the_earlier_form_are_one_line(tmp_path: Path) -> None:
    folder = write(tmp_path, study("ablation", ARMS), study("coverage", {"RHMC": [1.0]}), study("reach", {"x": [1.0]}))
    for name in ("ablation", "coverage"):
        both = [pd.read_parquet(folder / f"{name}.{part}.parquet") for part in ("runs", "made")]
        both[0].merge(both[1]).drop(columns="machine").to_parquet(folder / f"{name}.runs.parquet")
    with pytest.raises(TableError) as error:
        load(folder, "quick")
    assert str(error.value) == (
        f"{folder}: of an earlier form: ablation.runs.parquet, coverage.runs.parquet; `rhmc export` and "
        "`rhmc yardsticks all` write them anew, and how runs were made to *.made.parquet"
    )


def test_unfinished_is_missing_and_not_zero(tmp_path: Path) -> None:
    points, runs = study("ablation", ARMS)
    status = runs["status"].tolist()
    status[1], status[5] = "partial", "missing"
    points = points[points["run"] != runs["run"].iloc[5]]
    points = points[~((points["run"] == runs["run"].iloc[1]) & (points["step"] > 75_000))]
    results = load(write(tmp_path, (points, runs.assign(status=status))), "quick")
    assert results.finals("ablation", "full").tolist() == [70, 72]
    assert results.finals("ablation", "no filter").tolist() == [60, 61]
    assert results.finals("ablation", "no such arm").tolist() == []
    assert results.curve("ablation", "full").groupby("seed")["step"].max().tolist() == [150_000, 75_000, 150_000]
    assert results.gaps({"ablation": ["full", "no regulation"], "coverage": ["RHMC"]}) == [
        "Study `ablation`, arm full: 1 of 3 seeds unfinished (seed 1).",
        "Study `ablation`, arm no filter: 1 of 3 seeds not run (seed 2).",
        "Study `ablation`: no such arm yet: no regulation.",
        "Study `ablation`: no yardsticks were run on this task.",
        "Study `coverage`: no results.",
    ]


def test_only_finished_runs_have_a_final_value(tmp_path: Path) -> None:
    points, runs = study("ablation", ARMS)
    status = ["finished", "partial", *runs["status"][2:]]  # cut off after its last point
    results = load(write(tmp_path, (points, runs.assign(status=status))), "quick")
    assert results.finals("ablation", "full").tolist() == [70, 72]


def test_yardsticks_belong_to_their_task(tmp_path: Path) -> None:
    six = yardsticks({"random": 12.0}, COVERAGE | {"agents": 6})
    there = yardsticks({"random": -59.0, "matching": -19.8}, NAVIGATION)
    here = yardsticks()
    tables = tuple(pd.concat(part, ignore_index=True) for part in zip(here, there, strict=True))
    folder = write(tmp_path, study("coverage", {"RHMC": [70.0, 71.0]}), (tables[0], tables[1]))
    results = load(folder, "quick")
    found = results.yardsticks_of("coverage")["final/return"]
    assert found.to_dict() == factory.YARDSTICK_RETURNS
    assert results.yardsticks_of("navigation").empty  # no such study
    results = load(write(tmp_path / "six", study("coverage", {"RHMC": [70.0, 71.0]}), six), "quick")
    assert results.yardsticks_of("coverage").empty


def test_arms_keep_their_order(tmp_path: Path) -> None:
    arms = {"zeta": [1.0, 2.0], "IQL": [1.0, 2.0], "no filter": [1.0, 2.0], "full": [1.0, 2.0]}
    results = load(write(tmp_path, study("ablation", arms)), "quick")
    assert results.arms("ablation") == ["full", "no filter", "IQL", "zeta"]
    assert results.budget("ablation") == 150_000
    assert results.budget("coverage") is None
