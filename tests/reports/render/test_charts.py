"""Learning curves as charts: what the paths hold is what the figures show."""

import re
from pathlib import Path

import pytest

from reports.data.frame import load
from reports.data.paper import read
from reports.render import charts
from tests.reports.factory import noisy, study, write, yardsticks
from tests.reports.render.test_panels import SPEC, of_two


def points(path: str) -> list[tuple[int, int]]:
    """The points of a path, as a browser reads it."""
    flat = [int(n) for n in re.findall(r"-?\d+", path)]
    found, at = [], (0, 0)
    for x, y in zip(flat[::2], flat[1::2], strict=True):
        at = (at[0] + x, at[1] + y)
        found.append(at)
    return found


@pytest.mark.parametrize("ys", [[5], [-3, 4, 0], [10, -10, 10, 10]])
def test_a_path_goes_through_its_points(ys: list[int]) -> None:
    wanted = [(20 * n, y) for n, y in enumerate(ys)]
    assert points(charts.path([x for x, _ in wanted], ys)) == (wanted if len(ys) > 1 else wanted * 2)


def test_nothing_is_drawn_of_nothing() -> None:
    assert charts.path([], []) == ""


@pytest.fixture
def tables(tmp_path: Path) -> Path:
    points, runs = study("ablation", {"full": noisy(70), "no filter": noisy(64)}, points=6)
    late = (points["arm"] == "no filter") & (points["seed"] == 2) & (points["step"] > 75_000)
    gone = runs.index[(runs["arm"] == "no filter") & (runs["seed"] == 2)]
    runs.loc[gone, "status"] = "partial"
    return write(tmp_path, (points[~late], runs), yardsticks())


def test_paths_hold_the_means_the_bands_and_the_seeds(tables: Path) -> None:
    results, spec = load(tables, "quick"), read().figures["fig_10"]
    chart = charts.chart(results, spec, "fig_10")
    assert chart is not None
    scale, frame = chart.scale, chart.frames[0]
    curve = next(one for one in frame.curves if one.key == "full")
    rows = results.mean_curve("ablation", "full")

    def values(found: list[tuple[int, int]]) -> list[float]:
        return [-y / scale.fine for _, y in found]

    close = 1 / scale.fine
    assert [x * scale.steps for x, _ in points(curve.mean)] == rows["step"].tolist()
    assert values(points(curve.mean)) == pytest.approx(rows["mean"].tolist(), abs=close)
    band = points(curve.band)
    assert values(band[: len(rows)]) == pytest.approx(rows["high"].tolist(), abs=close)
    assert values(band[: len(rows) - 1 : -1]) == pytest.approx(rows["low"].tolist(), abs=close)
    for seed, one in enumerate(curve.seeds):
        own = results.curve("ablation", "full").set_index("seed").loc[seed, "value"].tolist()
        assert values(points(one)) == pytest.approx(own, abs=close)
    assert curve.pace == pytest.approx(1.5 / 150_000 * scale.steps)
    assert chart.seconds == pytest.approx(1.5)


def test_where_fewer_seeds_have_come_the_line_goes_on_faintly(tables: Path) -> None:
    chart = charts.chart(load(tables, "quick"), read().figures["fig_10"], "fig_10")
    assert chart is not None
    curve = next(one for one in chart.frames[0].curves if one.key == "no filter")
    assert points(curve.mean)[-1] == points(curve.faint)[0]
    assert points(curve.faint)[-1][0] == chart.scale.end
    assert set(chart.places.values()) == {"fig_10.1", "fig_10.2"}


def test_without_times_there_is_no_axis_of_them(tables: Path) -> None:
    for file in tables.glob("*.made.parquet"):
        file.unlink()
    chart = charts.chart(load(tables, "quick"), read().figures["fig_10"], "fig_10")
    assert chart is not None
    assert (chart.seconds, chart.times) == (0, [])


def test_each_task_has_a_frame_with_the_names_in_their_order(tmp_path: Path) -> None:
    chart = charts.chart(of_two(tmp_path), SPEC, "curves_reach")
    assert chart is not None
    assert [frame.title.partition(",")[2] for frame in chart.frames] == [
        " 2 sensors x 5 targets",
        " 4 sensors x 5 targets",
    ]
    names = [[(name.key, name.value) for name in frame.plots[0].names] for frame in chart.frames]
    best = [("free heading (bound)", "66.4"), ("planner", "53.9"), ("RHMC", "45.0"), ("IQL", "44.0")]
    assert names[0] == best
    assert list(chart.places) == ["RHMC, agents=2", "IQL, agents=2", "RHMC, agents=4", "IQL, agents=4"]


def test_of_many_arms_those_between_the_best_and_the_worst_are_grey(tmp_path: Path) -> None:
    arms = {f"part {n % 2}, horizon {n}": noisy(50 + n) for n in range(14)}
    chart = charts.chart(load(write(tmp_path, study("reach", arms, points=2)), "quick"), SPEC, "curves_reach")
    assert chart is not None
    coloured = {curve.key for frame in chart.frames for curve in frame.curves if curve.seeds and not curve.pale}
    assert coloured == {"horizon 0", "horizon 1", "horizon 12", "horizon 13"}
    assert len(chart.places) == 14
