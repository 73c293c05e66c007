"""The README's tables equal the report's."""

import re
from pathlib import Path

import pytest

from reports.data.paper import read

ROOT = Path(__file__).parents[3]
README = (ROOT / "README.md").read_text()
RESULTS = re.compile(r"^\| Arm \|.*\n(?:\|.*\n)+", re.MULTILINE)


def test_its_tables_are_tables_of_the_report() -> None:
    written = {path.read_text().strip() for path in (ROOT / "results" / "paper" / "tables").glob("final_*.md")}
    shown = [found.strip() for found in RESULTS.findall(README)]
    assert len(shown) >= 2
    assert [table.splitlines()[2] for table in shown if table not in written] == []


@pytest.mark.parametrize("target", re.findall(r"\]\(([^)#]+)\)", README))
def test_its_pictures_and_links_are_there(target: str) -> None:
    paper = f"https://doi.org/{read().source.doi}"
    assert target == paper or (ROOT / target).exists()
