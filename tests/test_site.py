"""The documentation builds as a site without a warning: every link, every page in the contents, nothing fetched."""

import re
import subprocess
import sys
from pathlib import Path

from pipelines.cli.reference import settings_page, verbs_page, write_reference
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS
from tests.depth import often

ROOT = Path(__file__).parents[1]
LOADED = re.compile(r"<(?:script|link|img|iframe)\b[^>]*?\b(?:src|href)=\"(?:https?:)?//[^\"]*\"[^>]*>")


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    """Pages alone; with the modules and as HTML where there is time for it."""
    form = often(1, 2) > 1
    words = ["-b", "html"] if form else ["-b", "dummy", "-t", "pages"]
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        *words,
        "-c",
        "docs",
        "-d",
        str(tmp_path / "d"),
    ]
    built = subprocess.run([*command, ".", str(tmp_path / "site")], cwd=ROOT, capture_output=True, text=True)
    assert (built.returncode, built.stderr) == (0, "")
    pages = [page.read_text(encoding="utf-8") for page in (tmp_path / "site").rglob("*.html")]
    fetched = [tag for page in pages for tag in LOADED.findall(page) if 'rel="canonical"' not in tag]
    assert fetched == []


def test_every_page_is_in_the_contents() -> None:
    conf = (ROOT / "docs/conf.py").read_text(encoding="utf-8")
    pages = [
        path.relative_to(ROOT).with_suffix("").as_posix() for path in [*ROOT.glob("docs/*.md"), *ROOT.glob("*.md")]
    ]
    assert [page for page in pages if f'"{page}"' not in conf] == []


def test_the_reference_has_every_verb_and_every_kind(tmp_path: Path) -> None:
    verbs, settings = verbs_page(), settings_page()
    assert all(f"`rhmc {verb}`" in verbs for verb in ("study run", "search run", "report", "methods", "evaluate"))
    assert all(f"{{kind: {kind}}}" in settings for kind in (*ALGORITHMS, *ENVS))
    assert "| alpha | number at least 0, at most 1 | 0.1 | alpha_1 of Eq. 6 |" in settings
    assert "| clip_range | number above 0 | 0.2 |" in settings


def test_pages_that_are_as_they_were_are_not_written_again(tmp_path: Path) -> None:
    write_reference(tmp_path)
    before = {page.name: page.stat().st_mtime_ns for page in tmp_path.iterdir()}
    write_reference(tmp_path)
    assert {page.name: page.stat().st_mtime_ns for page in tmp_path.iterdir()} == before
    assert set(before) == {"verbs.md", "settings.md"}
