"""The fonts of figures, which decide the bytes of a PDF."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import matplotlib
import pytest
from matplotlib import font_manager

from reports.render import glyphs

OWN = Path(matplotlib.get_data_path(), "fonts", "ttf")


@pytest.fixture
def fonts() -> Iterator[font_manager.FontManager]:
    """The fonts that matplotlib knows, put back afterwards."""
    manager = font_manager.fontManager
    before = list(manager.ttflist)
    glyphs.families.cache_clear()
    yield manager
    manager.ttflist = before
    glyphs.families.cache_clear()
    glyphs.families()


@pytest.mark.parametrize("family", ["DejaVu Sans", "DejaVu Sans Mono", "DejaVu Serif"])
@pytest.mark.parametrize("weight", ["normal", "bold"])
def test_a_machines_own_copy_of_a_font_is_not_drawn_with(
    family: str, weight: str, fonts: font_manager.FontManager, tmp_path: Path
) -> None:
    """Also where a cache of another installation names that copy alone."""
    fonts.ttflist = [font for font in fonts.ttflist if not font.name.startswith("DejaVu")]
    for path in OWN.glob("DejaVu*.ttf"):
        fonts.addfont(shutil.copy(path, tmp_path))
    wanted = font_manager.FontProperties(family=[family], weight=weight)
    assert Path(fonts.findfont(wanted)).parent == tmp_path
    glyphs.settings()
    assert Path(fonts.findfont(wanted)).parent == OWN
