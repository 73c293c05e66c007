"""Figure 9: methods by number of agents, however a study names its arms."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.text import Text

from reports.analyses import scaling
from reports.claims.verdicts import judge
from reports.data.frame import Results, load, without_count
from reports.data.paper import read
from tests.reports.factory import COVERAGE, Tables, noisy, study, write, yardsticks

pytestmark = pytest.mark.usefixtures("quick_resampling")
LEVELS = {"RHMC": {2: 40.0, 4: 66.0, 6: 75.0}, "IQL": {2: 41.0, 4: 60.0, 6: 70.0}}


def tables(levels: dict[str, dict[int, float]], form: str = "{}, agents={}", name: str = "scaling") -> Tables:
    """A study with an arm per method and number."""
    parts = []
    for method, by_count in levels.items():
        for count, level in by_count.items():
            points, runs = study(name, {method: noisy(level, 5)}, env=COVERAGE | {"agents": count}, points=4)
            parts.append((points.assign(arm=form.format(method, count)), runs.assign(arm=form.format(method, count))))
    points, runs = (pd.concat(tables, ignore_index=True) for tables in zip(*parts, strict=True))
    return points, runs


def read_in(folder: Path, *found: Tables) -> Results:
    return load(write(folder, *found), "quick")


@pytest.mark.parametrize("form", ["{}, agents={}", "{}, {} sensors", "{}, env.agents={}"])
def test_methods_are_found_whatever_the_arms_are_called(tmp_path: Path, form: str) -> None:
    results = read_in(tmp_path, tables(LEVELS, form))
    found = scaling.sweep(results)
    assert found is not None
    assert found.counts == [2, 4, 6]
    assert list(found.arms) == ["RHMC", "IQL"]
    means = {name: [x.value for x in by.values()] for name, by in scaling.estimates(results, found).items()}
    assert means == {name: pytest.approx(list(by.values())) for name, by in LEVELS.items()}


@pytest.mark.parametrize(
    ("arm", "name"),
    [
        ("RHMC, agents=4", "RHMC"),
        ("RHMC, mixed executors, 4 sensors", "RHMC, mixed executors"),
        ("RHMC, 14 sensors", "RHMC, 14 sensors"),
        ("RHMC, agents=4, alpha=0.1", "RHMC, alpha=0.1"),
        ("agents=4", "agents=4"),
    ],
)
def test_an_arm_without_its_number(arm: str, name: str) -> None:
    assert without_count(arm, 4) == name


def test_the_figure_has_every_number_and_the_yardsticks_of_each(tmp_path: Path) -> None:
    two, four = ({"best_window": 50.0}, COVERAGE | {"agents": 2}), ({"best_window": 65.3}, COVERAGE)
    sizes = [yardsticks(*pair) for pair in (two, four)]
    points, runs = (pd.concat(x, ignore_index=True) for x in zip(*sizes, strict=True))
    config = [text for _, plan in sizes for text in plan["config"]]
    ids = {"run": [f"y{n}" for n in range(2)]}
    points["run"] = ["y0"] * len(sizes[0][0]) + ["y1"] * len(sizes[1][0])
    results = read_in(tmp_path, tables(LEVELS), (points, runs.assign(config=config, **ids)))
    found = scaling.sweep(results)
    assert found is not None
    drawing = scaling.figure(results, found)
    assert drawing is not None
    table = drawing.numbers.set_index(["kind", "name", "agents"])["value"]
    assert table["method", "RHMC", 6] == pytest.approx(75)
    assert [table["yardstick", "best_window", n] for n in (2, 4)] == [50.0, 65.3]
    assert len(drawing.numbers) == 6 + 2
    words = [text.get_text() for text in drawing.figure.findobj(Text) if isinstance(text, Text)]
    assert {"RHMC 75.0", "IQL 70.0", "best window 65.3"} <= set(words)


def test_what_has_no_run_is_missing_and_not_zero(tmp_path: Path) -> None:
    points, runs = tables(LEVELS)
    gone = runs["arm"] == "IQL, agents=6"
    points = points[~points["run"].isin(runs["run"][gone])]
    results = read_in(tmp_path, (points, runs.assign(status=np.where(gone, "missing", runs["status"]))))
    found = scaling.sweep(results)
    assert found is not None
    drawing = scaling.figure(results, found)
    assert drawing is not None
    assert len(drawing.numbers) == 5
    assert any("no finished run yet: IQL with 6" in t.get_text() for t in drawing.figure.findobj(Text))  # type: ignore[attr-defined]
    shown = scaling.table(results, found).shown.set_index("Method")
    assert shown.loc["IQL", "6 agents"] == "–; 0 of 5 seeds"
    assert shown.loc["IQL", "4 agents"].startswith("60.0 [59.")


def test_one_number_is_no_sweep(tmp_path: Path) -> None:
    results = read_in(tmp_path, study("coverage", {"RHMC": noisy(66), "IQL": noisy(60)}))
    assert scaling.sweep(results, "coverage") is None
    assert scaling.sweep(results) is None  # no such study


@pytest.mark.parametrize(
    ("changed", "best", "stable"),
    [
        ({"IQL": {2: 30.0, 4: 60.0, 6: 70.0}}, True, True),
        ({}, False, True),  # with two sensors IQL is ahead
        ({"RHMC": {2: 60.0, 4: 66.0, 6: 50.0}, "IQL": {2: 40.0, 4: 60.0, 6: 40.0}}, True, False),  # best, and it falls
        ({"RHMC": {2: 60.0, 4: 40.0, 6: 50.0}}, False, False),
    ],
)
def test_c7(tmp_path: Path, changed: dict[str, dict[int, float]], best: bool, stable: bool) -> None:
    results = read_in(tmp_path, tables(LEVELS | changed))
    found = {claim.id: claim for claim in judge(results, read())}
    assert [found[name].verdict == "reproduced" for name in ("C7a", "C7b")] == [best, stable]
    claim = found["C7b"]
    assert list(claim.ours) == ["RHMC, 2 sensors", "RHMC, 4 sensors", "RHMC, 6 sensors"]
    assert (len(claim.runs), len(found["C7a"].runs)) == (15, 30)
    assert claim.commands[0].startswith("rhmc study run studies/scaling.yaml --profile quick && rhmc export")
