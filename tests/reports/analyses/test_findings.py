"""What captions say first, of planted data: clear, overlapping, by number of agents."""

from pathlib import Path

import pandas as pd
import pytest

from reports.analyses import findings
from reports.analyses.scaling import sweep
from reports.data.frame import Results, load
from reports.pages.gallery import curve_caption
from tests.reports.factory import COVERAGE, noisy, study, write

pytestmark = pytest.mark.usefixtures("quick_resampling")


def results(folder: Path, arms: dict[str, list[float]]) -> Results:
    return load(write(folder, study("reach", arms, points=3)), "quick")


def test_clear_data(tmp_path: Path) -> None:
    found = results(tmp_path, {"A": noisy(70, 5, 0.2), "B": noisy(65, 5, 0.2), "C": noisy(60, 5, 0.2)})
    said = (
        "A ends highest, at 70.0, 5.0 above B, whose seeds all end lower; the gap is clear to all of the other 2 arms."
    )
    assert findings.of_curves(found, "reach") == said
    assert curve_caption(found, "reach").startswith(f"{said} ")
    assert findings.of_profile(found, "reach") == "The worst seed of A ends above every seed of 2 of the other 2 arms."
    assert findings.of_matrix(found, "reach").startswith(
        "A seed of A beats one of B, the next, with probability 1.00; 3 of 3"
    )


def test_overlapping_data(tmp_path: Path) -> None:
    found = results(tmp_path, {"A": noisy(60.5, 3, 2.0), "B": noisy(60, 3, 2.0), "C": noisy(59, 3, 0.5)})
    said = "A ends highest, at 60.5, 0.5 above B, whose seeds overlap with its own; "
    said += "the gap is clear to none of the other 2 arms."
    assert findings.of_curves(found, "reach") == said
    assert findings.of_profile(found, "reach") == "The worst seed of A ends above every seed of 0 of the other 2 arms."
    spread = "The seeds of A end furthest apart, over 4.0 points; those of C closest, over 1.0."
    assert findings.of_spread(found, "reach") == spread


def test_arms_that_end_alike(tmp_path: Path) -> None:
    two = results(tmp_path, {"A": [100.0, 100.0], "B": [100.0, 99.99]})
    said = "A ends highest, at 100.0, level with B, whose seeds overlap with its own; the gap is not clear."
    assert findings.of_curves(two, "reach") == said


def test_two_arms_and_one(tmp_path: Path) -> None:
    two = results(tmp_path / "two", {"A": noisy(70, 5, 0.2), "B": noisy(65, 5, 0.2)})
    assert findings.of_curves(two, "reach").endswith("whose seeds all end lower; the gap is clear.")
    assert findings.of_curves(results(tmp_path / "one", {"A": noisy(70)}), "reach") == "A ends highest, at 70.0."
    none = results(tmp_path / "none", {"A": [70.0]})
    assert curve_caption(none, "reach") == "No arm has two finished seeds yet."


@pytest.mark.parametrize(
    ("levels", "said"),
    [
        (
            {"A": {2: 50.0, 4: 60.0}, "B": {2: 48.0, 4: 55.0}},
            "A is highest at every number of agents, by 2.0 to 5.0; no line falls as agents are added.",
        ),
        (
            {"A": {2: 50.0, 4: 60.0}, "B": {2: 70.0, 4: 55.0}},
            "The highest is B with 2 and A with 4; B falls somewhere as agents are added.",
        ),
    ],
)
def test_by_number_of_agents(tmp_path: Path, levels: dict[str, dict[int, float]], said: str) -> None:
    parts = [
        study(
            "reach",
            {f"{arm}, agents={n}": noisy(levels[arm][n]) for arm in levels},
            env=COVERAGE | {"agents": n},
            points=3,
        )
        for n in (2, 4)
    ]
    points, runs = (pd.concat(tables, ignore_index=True) for tables in zip(*parts, strict=True))
    found = load(write(tmp_path, (points, runs)), "quick")
    swept = sweep(found, "reach")
    assert swept is not None
    assert findings.of_sweep(found, swept) == said
    assert findings.of_curves(found, "reach").startswith("Each frame's highest arm, with its gap to the next: ")


def test_assigned_and_moved_from_the_numbers_of_their_figures() -> None:
    rows = [("A", "pairs", 0, 9.0), ("A", "pairs", 10, 7.0), ("B", "pairs", 0, 8.0), ("B", "pairs", 10, 8.5)]
    said = findings.of_assigned(pd.DataFrame(rows, columns=["arm", "quantity", "step", "mean"]))
    assert said == "Pairs are 8.0 to 9.0 at the first point and 7.0 to 8.5 at the last; in 1 of 2 arms they grow fewer."
    moved = [("agents", "method", name, n, value) for n in (2, 4) for name, value in (("A", 50.0), ("B", 40.0 + n))]
    table = pd.DataFrame(moved, columns=["along", "kind", "name", "count", "value"])
    assert findings.of_moved(table) == "A is highest in 2 of 2 places."
