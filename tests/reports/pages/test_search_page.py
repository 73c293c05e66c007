"""A report with a search: figure, winners and a section of its own, in the whole report and alone."""

import shutil
from pathlib import Path

import pytest

from reports.pages.build import build, write_report
from tests.reports.factory import noisy, study, write
from tests.reports.factory_trials import trials, write_trials
from tests.reports.hostile import NAMES

ARMS = {"RHMC": [60.0, "pruned", 62.0], "IQL": [50.0, 51.0, "failed"]}
TABLES = {f"tables/winners_search_x.{kind}" for kind in ("csv", "md", "tex")}
FIGURE = {f"figures/trials_search_x.{kind}" for kind in ("csv", "pdf", "png")}

pytestmark = pytest.mark.usefixtures("unpainted", "quick_resampling")


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    folder = write(tmp_path / "runs", study("reach", {"one": noisy(67), "six": noisy(63)}, points=4))
    return write_trials(folder, trials(ARMS))


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_search_has_a_figure_a_table_and_a_section(runs: Path, tmp_path: Path) -> None:
    build(runs, tmp_path / "out", "quick")
    assert set(content(tmp_path / "out")) > TABLES | FIGURE
    text = (tmp_path / "out" / "index.md").read_text()
    assert "**search_x**, a search: Which settings? (2 arms, each of 3 trials of 2 seeds and 50 k steps)" in text
    assert "![Best objective by number of trials, search search_x](figures/trials_search_x.png)" in text
    assert "## Winners of search search_x" in text
    assert "- Search `search_x`, arm IQL: of 3 trials 1 failed." in text
    page = (tmp_path / "out" / "index.html").read_text()
    section = page[page.index('id="search-search_x"') :]
    section = section[: section.index("</section>")]
    for words in ("Search search_x (5 of 6 trials finished)", "Which settings?", "Winners of search search_x"):
        assert words in section
    assert "rhmc search run studies/search_x.yaml --profile quick" in section
    assert page.count("Winners of search search_x") == section.count("Winners of search search_x")


def test_a_search_changes_nothing_of_the_studies(runs: Path, tmp_path: Path) -> None:
    build(runs, tmp_path / "with", "quick")
    (runs / "search_x.trials.parquet").unlink()
    build(runs, tmp_path / "without", "quick")
    first, second = content(tmp_path / "with"), content(tmp_path / "without")
    assert set(first) - set(second) == TABLES | FIGURE
    assert {name for name in second if first[name] != second[name]} == {"index.html", "index.md"}


def test_a_report_of_one_search(runs: Path, tmp_path: Path) -> None:
    assert write_report(runs, tmp_path / "out", "quick", "search_x") == "whole"
    text = (tmp_path / "out" / "index.md").read_text()
    assert text.startswith("# Search search_x, profile quick")
    assert "reach" not in text
    page = (tmp_path / "out" / "index.html").read_text()
    assert "Which settings? 2 arms, each of 3 trials of 2 seeds and 50 k steps." in page


def test_a_folder_with_searches_alone(runs: Path, tmp_path: Path) -> None:
    shutil.copytree(runs, tmp_path / "alone", ignore=shutil.ignore_patterns("reach*"))
    assert write_report(tmp_path / "alone", tmp_path / "out") == "whole"
    assert set(content(tmp_path / "out")) > TABLES | FIGURE


def test_arms_of_any_name(tmp_path: Path) -> None:
    folder = write_trials(tmp_path / "runs", trials({name: [60.0 + n, 61.0] for n, name in enumerate(NAMES)}))
    assert write_report(folder, tmp_path / "out", "quick", "search_x") == "whole"
