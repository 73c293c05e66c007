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


class Look(NamedTuple):
    """The colour of an arm, the dashes of its line and the mark on it."""

    colour: str
    dashes: str
    mark: str

    @property
    def line(self) -> dict[str, Any]:
        """For matplotlib, without the mark."""
        return {"color": self.colour, "linestyle": self.dashes}

    @property
    def marked(self) -> dict[str, Any]:
        """For matplotlib, with the mark."""
        return self.line | {"marker": self.mark, "markersize": 5, "markeredgecolor": "white", "markeredgewidth": 0.5}


# One look per arm, everywhere. Hues are of Okabe and Ito and of Paul Tol, so chosen that the nearest two methods are
# as far apart as may be, also without red or without green, and dark enough for words on white. Every curve is named.
LOOKS: Mapping[str, Look] = {
    "full": Look("#0072B2", "-", "o"),
    "RHMC": Look("#0072B2", "-", "o"),
    "RHMC, team reward": Look("#0072B2", "--", "o"),
    "no regulation": Look("#D55E00", "-", "s"),
    "no filter": Look("#117733", "-", "p"),
    "HiT-MAC": Look("#D55E00", "-", "s"),
    "QMIX": Look("#EE3377", "-", "^"),
    "VDN": Look("#332288", "--", "v"),
    "IQL": Look("#111111", "-", "D"),
    "COMA": Look("#999933", "-", "P"),
    "MAPPO": Look("#44AA99", "-", "X"),
    "IPPO": Look("#117733", "--", "p"),
    "MADDPG": Look("#882255", "-.", "<"),
}
OTHERS = ("#B07C00", "#AA4499", "#56A0D3", "#8C564B")  # arms with no look of their own, in turn
ROUNDS = (("-", "h"), ("--", "d"), (":", "8"), ("-.", ">"))  # dashes and mark, by round of those colours
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


def look(arm: str, arms: Sequence[str]) -> Look:
    """The look of an arm among those of its figure: its own, its method's if no other has that, else one in turn."""
    if found := _own(arm, arms):
        return found
    turn = [name for name in arms if not _own(name, arms)].index(arm)
    return Look(OTHERS[turn % len(OTHERS)], *ROUNDS[turn // len(OTHERS) % len(ROUNDS)])


def _own(arm: str, arms: Sequence[str]) -> Look | None:
    """Of `RHMC, agents=4` the look of RHMC, if it is the figure's only arm of that method."""
    method = arm.partition(", ")[0]
    alone = sum(name.partition(", ")[0] == method for name in arms) == 1
    return LOOKS.get(arm) or (LOOKS.get(method) if alone else None)
