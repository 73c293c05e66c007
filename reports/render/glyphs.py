"""Words in a figure as they were typed: no mathematics, and no letter that is silently a box.

`SETTINGS` belongs to whatever draws, `settle` is called before a figure is saved. The fonts are matplotlib's own and,
for letters that those lack, the first of `FALLBACKS` that the machine has. A letter that none of them has stands as its
number between brackets, `[U+57FA]`, so that two names stay two; tables and pages have the names themselves.
"""

import unicodedata
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib import font_manager
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter

FALLBACKS = (  # by script: Chinese, Japanese and Korean; Arabic, Indic and others; pictures
    *("Noto Sans CJK SC", "Noto Sans SC", "Source Han Sans SC", "WenQuanYi Zen Hei", "WenQuanYi Micro Hei"),
    *("Microsoft YaHei", "PingFang SC", "SimHei", "Noto Sans CJK JP", "Droid Sans Fallback", "Arial Unicode MS"),
    *("Noto Sans", "Noto Sans Arabic", "Noto Sans Hebrew", "Noto Sans Devanagari", "Noto Sans Thai"),
    *("Noto Emoji", "Symbola", "Noto Sans Symbols", "Noto Sans Symbols 2"),
)
LOST = "Letters in square brackets, as [U+57FA], are in no font of the machine that drew this; tables have the names."


@cache
def families() -> tuple[str, ...]:
    """Of fonts, in the order in which they are asked for a letter."""
    _take_own_fonts()
    there = set(font_manager.fontManager.get_font_names())
    return ("DejaVu Sans", *(name for name in FALLBACKS if name in there))


def _take_own_fonts() -> None:
    """Let DejaVu be the files that come with matplotlib: a machine may have others, which a PDF holds parts of."""
    manager = font_manager.fontManager
    manager.ttflist = [font for font in manager.ttflist if not font.name.startswith("DejaVu")]
    for path in sorted(Path(matplotlib.get_data_path(), "fonts", "ttf").glob("DejaVu*.ttf")):
        manager.addfont(path)


def settings() -> Any:  # a mapping, as matplotlib types it
    """The settings under which a figure with words of users is drawn."""
    return {"text.parse_math": False, "font.family": list(families())}


def settle(figure: Figure) -> bool:
    """Replace what no font has by its number. Whether there was any."""
    lost = False
    for axis in _axes(figure):
        lost |= _settle_ticks(axis)
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_parse_math(False)  # also where it was made before `settings` held
        shown = readable(text.get_text(), text.get_fontproperties())
        if shown != text.get_text():
            text.set_text(shown)
            lost = True
    return lost


def readable(text: str, font: FontProperties) -> str:
    """The text with numbers in the place of letters that none of its fonts has."""
    have = frozenset[int]().union(*(_letters(path) for path in _paths(font)))
    if all(ord(sign) in have or sign == "\n" for sign in text):
        return text
    out, missing = "", list[str]()
    for sign in [*text, ""]:
        if sign and sign != "\n" and ord(sign) not in have:
            if not _invisible(sign):
                missing.append(f"U+{ord(sign):04X}")
            continue
        out += (f"[{' '.join(missing)}]" if missing else "") + sign
        missing = []
    return out


def _invisible(sign: str) -> bool:
    """True if nothing of it is seen: marks that join, order or vary the letters beside them."""
    return unicodedata.category(sign) == "Cf" or "\ufe00" <= sign <= "\ufe0f" or "\U000e0100" <= sign <= "\U000e01ef"


def _axes(figure: Figure) -> Iterator[Axis]:
    for axes in figure.axes:
        yield from (axes.xaxis, axes.yaxis)


def _settle_ticks(axis: Axis) -> bool:
    """The same for words at ticks, which are written anew whenever the figure is drawn."""
    write, ticks = axis.get_major_formatter(), axis.get_major_ticks()
    if not isinstance(write, FuncFormatter) or not ticks:
        return False
    font = ticks[0].label1.get_fontproperties()
    if all(readable(word, font) == word for word in write.format_ticks(list(axis.get_majorticklocs()))):
        return False
    axis.set_major_formatter(FuncFormatter(_readable_ticks(write, font)))
    return True


def _readable_ticks(write: FuncFormatter, font: FontProperties) -> Callable[[float, int | None], str]:
    return lambda x, place: readable(write(x, place), font)


def _paths(font: FontProperties) -> Iterator[str]:
    """Files of the fonts that are asked for its letters."""
    for family in font.get_family():
        one = font.copy()
        one.set_family(family)
        yield str(font_manager.findfont(one))


@cache
def _letters(path: str) -> frozenset[int]:
    return frozenset(font_manager.get_font(path).get_charmap())
