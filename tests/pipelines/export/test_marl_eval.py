"""Results for marl-eval: its tree, whole runs alone, names that it takes."""

import json
from pathlib import Path

import pytest

from pipelines.export.marl_eval import export_marl_eval
from pipelines.export.tables import write_parquet
from pipelines.workspace.errors import InputError
from reports.data.schema import METRICS, RUNS


def tables(folder: Path, runs: list[tuple[str, int, str]]) -> Path:
    """Tables of study `x`, whose runs are (arm, seed, status), with a curve of two points each."""
    values = [
        ("x", arm, seed, f"{arm}{seed}", step, metric, value + seed)
        for arm, seed, _ in runs
        for step, metric, value in [
            (0, "eval/return", 10.0),
            (0, "train/q", 3.0),
            (500, "eval/return", 20.0),
            (500, "eval/coverage", 21.0),
            (500, "final/return", 22.0),
        ]
    ]
    about = [
        ("x", arm, seed, f"{arm}{seed}", status, "iql", "coverage", "quick", "{}", "f", "?")
        for arm, seed, status in runs
    ]
    write_parquet(folder / "x.parquet", METRICS, values)
    write_parquet(folder / "x.runs.parquet", RUNS, about)
    return folder


def test_the_tree_is_the_one_that_it_reads(tmp_path: Path) -> None:
    runs = tables(tmp_path, [("full, wide", 0, "finished"), ("full, wide", 1, "finished"), ("IQL", 0, "finished")])
    assert export_marl_eval("x", runs, tmp_path / "out") == 0
    tree = json.loads((tmp_path / "out" / "x.marl_eval.json").read_text(encoding="utf-8"))
    assert list(tree) == ["coverage"]
    assert {arm: list(seeds) for arm, seeds in tree["coverage"]["x"].items()} == {
        "full; wide": ["seed_0", "seed_1"],
        "IQL": ["seed_0"],
    }
    assert tree["coverage"]["x"]["full; wide"]["seed_1"] == {
        "step_0": {"step_count": 0, "return": [11.0]},
        "step_1": {"step_count": 500, "return": [21.0], "coverage": [22.0]},
        "absolute_metrics": {"return": [23.0]},
    }


def test_what_is_not_finished_stays_out_and_is_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = tables(tmp_path, [("IQL", 0, "finished"), ("IQL", 1, "partial"), ("VDN", 0, "missing")])
    assert export_marl_eval("x", runs, tmp_path) == 1
    assert capsys.readouterr().err == "x: 2 of 3 runs are not finished and left out\n"
    tree = json.loads((tmp_path / "x.marl_eval.json").read_text(encoding="utf-8"))
    assert tree["coverage"]["x"].keys() == {"IQL"}
    assert tree["coverage"]["x"]["IQL"].keys() == {"seed_0"}


@pytest.mark.parametrize(
    ("runs", "said"),
    [
        ([], "no tables of this study; `rhmc export` writes them"),
        ([("IQL", 0, "partial")], "x.parquet: no finished run"),
        ([("a, b", 0, "finished"), ("a; b", 0, "finished")], "arm 'a, b' and the one with ';' for ',' would be one"),
    ],
)
def test_what_cannot_be_written_is_one_line(tmp_path: Path, runs: list[tuple[str, int, str]], said: str) -> None:
    folder = tables(tmp_path, runs) if runs else tmp_path
    with pytest.raises(InputError, match=said) as caught:
        export_marl_eval("x", folder, tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()
