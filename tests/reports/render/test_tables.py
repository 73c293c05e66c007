"""Tables: what they show of planted numbers."""

from pathlib import Path

from reports.data.frame import load
from reports.render import tables
from tests.reports.factory import study, theorem, write


def test_theorem_1_in_percent_of_the_instances(tmp_path: Path) -> None:
    found = tables.theorem(load(write(tmp_path, study("coverage", {"RHMC": [70.0, 71.0]}), theorem(40)), "quick"))
    assert found is not None
    assert found.numbers["share"].tolist() == [4.0, 8.0]
    assert found.shown["Tried"].tolist() == ["1,000", "1,000"]
    assert found.shown["Below the optimum"].tolist() == ["4.00 %", "8.00 %"]
    assert found.shown["Largest gap"].tolist() == ["1.10", "1.10"]
