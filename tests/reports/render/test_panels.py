"""Curves in small frames, and enlarged: who shares a frame, which yardsticks stand in it, who is in the legend."""

from pathlib import Path

import pandas as pd
import pytest
from matplotlib.text import Text

from reports.data.frame import Results, load
from reports.data.paper import read
from reports.render import figures, panels
from reports.render.canvas import Drawing
from tests.reports.factory import COVERAGE, YARDSTICK_RETURNS, Tables, noisy, study, write, yardsticks

pytestmark = pytest.mark.usefixtures("quick_resampling")
SPEC = read().curves_of("reach", "coverage")


def both(*parts: Tables) -> Tables:
    points, runs = (pd.concat(tables, ignore_index=True) for tables in zip(*parts, strict=True))
    return points, runs


def sized(agents: int, level: float) -> Tables:
    arms = {f"{name}, agents={agents}": noisy(level - n) for n, name in enumerate(("RHMC", "IQL"))}
    return study("reach", arms, env=COVERAGE | {"agents": agents}, points=4)


def of_two(folder: Path) -> Results:
    """Two and four sensors; yardsticks of both, which differ by 20."""
    few = yardsticks({name: x - 20 for name, x in YARDSTICK_RETURNS.items()}, COVERAGE | {"agents": 2})
    few = few[0].assign(run="few" + few[0]["run"]), few[1].assign(run="few" + few[1]["run"])
    return load(write(folder, both(sized(2, 45), sized(4, 65)), both(yardsticks(), few)), "quick")


def words(drawing: Drawing | None) -> list[str]:
    assert drawing is not None
    return [found.get_text() for found in drawing.figure.findobj(Text) if isinstance(found, Text)]


def legend(drawing: Drawing | None) -> list[str]:
    assert drawing is not None
    return [text.get_text() for box in drawing.figure.legends for text in box.get_texts()]


def test_two_tasks_have_no_bound_in_common(tmp_path: Path) -> None:
    results = of_two(tmp_path)
    assert results.yardsticks_of("reach").empty
    drawing = figures.learning_curves(results, SPEC)
    assert drawing is not None
    assert set(drawing.numbers["kind"]) == {"curve"}
    assert not [text for text in words(drawing) if "bound" in text or "planner" in text]


def test_each_task_has_a_frame_with_its_own_yardsticks(tmp_path: Path) -> None:
    drawing = panels.panels(of_two(tmp_path), SPEC)
    found = words(drawing)
    assert drawing is not None
    assert len(drawing.figure.axes) == 2
    for text in ("planner 53.9", "free heading (bound) 66.4", "planner 73.9", "free heading (bound) 86.4"):
        assert text in found
    table = drawing.numbers[drawing.numbers["kind"] == "yardstick"].set_index(["frame", "name"])["value"]
    assert table["coverage flat, 2 sensors x 5 targets", "planner"] == pytest.approx(53.9)
    assert table["coverage flat, 4 sensors x 5 targets", "planner"] == 73.9
    assert legend(drawing) == ["RHMC", "IQL"]
    assert any("highest: RHMC, 45.0" in text for text in found)


def test_how_a_task_is_observed_is_no_other_task(tmp_path: Path) -> None:
    parts = [study("reach", {form: noisy(60)}, env=COVERAGE | {"observation": form}) for form in ("paper", "extended")]
    results = load(write(tmp_path, both(*parts), yardsticks()), "quick")
    assert panels.panels(results, SPEC) is None
    assert not results.yardsticks_of("reach").empty


def test_arms_without_runs_are_in_no_legend(tmp_path: Path) -> None:
    points, runs = study("reach", {"RHMC": noisy(60), "IQL": noisy(50), "VDN": noisy(40)}, points=4)
    gone = runs["arm"] == "VDN"
    tables = points[~points["run"].isin(runs["run"][gone])], runs.assign(status=runs["status"].mask(gone, "missing"))
    drawing = figures.learning_curves(load(write(tmp_path, tables), "quick"), SPEC)
    assert legend(drawing) == ["RHMC (3 seeds)", "IQL (3 seeds)"]
    assert not [text for text in words(drawing) if "VDN" in text]


def test_curves_that_end_close_together_are_enlarged(tmp_path: Path) -> None:
    close = {f"arm {n}": noisy(60 + n, spread=0.1) for n in range(4)}
    drawing = figures.learning_curves(load(write(tmp_path / "a", study("reach", close)), "quick"), SPEC)
    assert drawing is not None
    whole, late = drawing.figure.axes
    assert late.get_xlim() == (75_000, 150_000)
    assert late.get_ylim()[0] < 60 < 63 < late.get_ylim()[1]
    assert late.get_ylim()[1] - late.get_ylim()[0] < 5 < whole.get_ylim()[1] - whole.get_ylim()[0]
    apart = close | {"arm 3": noisy(31)}
    drawing = figures.learning_curves(load(write(tmp_path / "b", study("reach", apart)), "quick"), SPEC)
    assert drawing is not None
    assert len(drawing.figure.axes) == 1


def grid(names: list[str]) -> Tables:
    return study("reach", {name: noisy(50 + n) for n, name in enumerate(names)}, points=3)


def test_many_arms_are_divided_by_their_names(tmp_path: Path) -> None:
    names = [f"full, horizon {h}, alpha={a}" for h in (1, 6, 18) for a in range(5)]
    names += [f"no filter, horizon 18, alpha={a}" for a in range(5)]
    assert {key: len(own) for key, own in panels.by_name(names).items()} == {
        "full, horizon 1": 5,
        "full, horizon 6": 5,
        "full, horizon 18": 5,
        "no filter, horizon 18": 5,
    }
    drawing = panels.panels(load(write(tmp_path, grid(names)), "quick"), SPEC)
    assert drawing is not None
    assert len(drawing.figure.axes) == 4
    assert legend(drawing) == [f"alpha={a}" for a in range(5)]
    assert any(
        text.startswith("full, horizon 1\nhighest: alpha=4, 54.0\nlowest: alpha=0, 50.0") for text in words(drawing)
    )


def test_arms_that_names_do_not_divide_have_one_frame_with_its_two_ends(tmp_path: Path) -> None:
    drawing = panels.panels(load(write(tmp_path, grid([f"arm {n}" for n in range(13)])), "quick"), SPEC)
    assert drawing is not None
    assert len(drawing.figure.axes) == 1
    assert "all 13 arms\nhighest: arm 12, 62.0\nlowest: arm 0, 50.0" in words(drawing)
    coloured = {line.get_color() for line in drawing.figure.axes[0].lines}
    assert coloured == {"#CFCFCF", panels.BEST.colour, panels.WORST.colour}
    assert drawing.numbers["name"].nunique() == 13


@pytest.mark.parametrize(("arms", "framed"), [(12, False), (13, True)])
def test_up_to_twelve_arms_of_a_task_share_a_frame(tmp_path: Path, arms: int, framed: bool) -> None:
    results = load(write(tmp_path, grid([f"arm {n}" for n in range(arms)])), "quick")
    assert (panels.panels(results, SPEC) is not None) == framed
