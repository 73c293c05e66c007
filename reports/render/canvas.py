"""Parts that all figures share: colours, style, the empty figure, the writing of files. Same input, same bytes."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from cycler import cycler
from matplotlib import style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from reports.data.escaping import cell
from reports.render import glyphs

# One colour and line per arm, everywhere. They differ in lightness as well, for colour-blind readers and grey print,
# and every curve is named at its end.
LOOKS: Mapping[str, tuple[str, str]] = {
    "full": ("#0072B2", "-"),
    "RHMC": ("#0072B2", "-"),
    "RHMC, team reward": ("#0072B2", "--"),
    "no regulation": ("#D55E00", "-"),
    "no filter": ("#009E73", "-"),
    "HiT-MAC": ("#D55E00", "-"),
    "QMIX": ("#AA4499", "-"),
    "VDN": ("#AA4499", "--"),
    "IQL": ("#111111", "-"),
    "COMA": ("#B07C00", "-"),
    "MAPPO": ("#56A0D3", "-"),
    "IPPO": ("#56A0D3", "--"),
    "MADDPG": ("#882255", "-."),
}
OTHERS = ("#44AA99", "#999933", "#CC6677", "#332288")  # arms with no look of their own, in turn
DASHES = ("-", "--", ":", "-.")  # by round of those colours
INK, QUIET, FAINT = "#222222", "#666666", "#B5B5B5"
BLUE, ORANGE, GREEN, PAPER = "#0072B2", "#D55E00", "#009E73", "#F4F6F8"
STYLE: dict[str, Any] = {
    "font.size": 9.5,
    "text.color": INK,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.prop_cycle": cycler(color=[INK]),
    "grid.color": "#EEEEEE",
    "grid.linewidth": 0.8,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",  # words as words
    "svg.hashsalt": "rhmc",  # the same names of parts every time
    "savefig.dpi": 160,
}
MARGIN = 0.03  # of words left of the axes


class Drawing(NamedTuple):
    """A figure and the numbers in it."""

    figure: Figure
    numbers: pd.DataFrame


@contextmanager
def styled() -> Iterator[None]:
    """Draw in the project's style, whatever the machine's settings are."""
    with style.context(["default", STYLE | glyphs.settings()]):
        yield


def blank(width: float, height: float) -> Figure:
    """An empty figure of that size in inches."""
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def head(figure: Figure, title: str, under: str = "") -> None:
    """Title and a line under it, at the same distance from the top in inches on every figure."""
    inches = float(figure.get_size_inches()[1])
    figure.text(MARGIN, 1 - 0.3 / inches, title, fontsize=13, fontweight="bold")
    figure.text(MARGIN, 1 - 0.54 / inches, under, fontsize=9.5, color=QUIET)


def foot(figure: Figure, text: str) -> None:
    """Small words at the bottom."""
    figure.text(MARGIN, 0.12 / float(figure.get_size_inches()[1]), text, fontsize=7.5, color=QUIET, linespacing=1.5)


def save(drawing: Drawing, folder: Path, name: str) -> bool:
    """Write `<name>.csv`, then `.png` and `.pdf`, to a folder. Whether a letter is in no font, see `letters`."""
    write_csv(drawing.numbers, folder / f"{name}.csv", digits="%.6g")
    with styled():
        lost = glyphs.settle(drawing.figure)
        drawing.figure.savefig(folder / f"{name}.png", metadata={"Software": None})
        drawing.figure.savefig(
            folder / f"{name}.pdf", metadata={"CreationDate": None, "Creator": None, "Producer": None}
        )
    return lost


def write_csv(table: pd.DataFrame, path: Path, digits: str | None = None) -> None:
    """A table with its words as `escape.cell` has them; numbers stay numbers. digits: how a float is written."""
    plain = table.copy()
    for name, column in table.items():
        if not pd.api.types.is_numeric_dtype(column):
            plain[name] = column.map(lambda value: cell(value) if isinstance(value, str) else value)
    plain = plain.rename(columns=lambda name: cell(str(name)))
    plain.to_csv(path, index=False, float_format=digits, lineterminator="\n", encoding="utf-8")


def look(arm: str, arms: Sequence[str]) -> tuple[str, str]:
    """Colour and line style of an arm among those of its figure."""
    if arm in LOOKS:
        return LOOKS[arm]
    turn = [name for name in arms if name not in LOOKS].index(arm)
    return OTHERS[turn % len(OTHERS)], DASHES[turn // len(OTHERS) % len(DASHES)]
