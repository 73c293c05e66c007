"""Learning curves as figures. Same numbers in, same bytes out: Agg, fixed style, no dates."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from cycler import cycler
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from scipy.optimize import isotonic_regression

from reports.frame import FINAL, Results
from reports.paper import Curves
from reports.stats import FEW, curve
from reports.tables import describe_task, joined, number, readable, seeds, steps

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
INK, QUIET, FAINT = "#222222", "#666666", "#B5B5B5"
STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
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
    "savefig.dpi": 160,
}
SIZE = (9.0, 5.4)  # inches
LEFT, BOTTOM, WIDTH, TOP = 0.075, 0.17, 0.64, 0.865  # of the axes, without the legend's rows above
MARGIN = 0.03  # of words left of the axes
COLUMNS, ROW = 5, 0.036  # of the legend; height of a row
GAP = 0.043  # between two labels, in heights of the axes


class Label(NamedTuple):
    """Words at the height of a line's end."""

    y: float
    text: str
    colour: str
    bold: bool


class Drawing(NamedTuple):
    """A figure and the numbers in it: columns kind, name, step, value, low, high, seeds."""

    figure: Figure
    numbers: pd.DataFrame


def learning_curves(results: Results, spec: Curves) -> Drawing | None:
    """Every arm of the study with its 95 % band, scripted policies and the paper's levels as lines.

    Returns:
        None if the study has no points at all.
    """
    arms = results.arms(spec.study)
    curves = {arm: curve(points) for arm in arms if len(points := results.curve(spec.study, arm))}
    if not curves:
        return None
    rulers = _rulers(results, spec)
    levels = {arm: spec.levels[arm] for arm in arms if arm in spec.levels}
    with style.context(["default", STYLE]):
        figure = Figure(figsize=SIZE)
        FigureCanvasAgg(figure)
        height = TOP - BOTTOM - ROW * -(-len(arms) // COLUMNS)
        axes = figure.add_axes((LEFT, BOTTOM, WIDTH, height))
        labels = (
            _draw_rulers(axes, rulers) + _draw_levels(axes, levels) + _draw_curves(axes, curves, results, spec.study)
        )
        _finish(axes, curves, results.env(spec.study).get("kind", ""))
        _write_labels(axes, labels)
        _write_around(figure, axes, results, spec)
    return Drawing(figure, _numbers(curves, rulers, levels))


def save(drawing: Drawing, folder: Path, name: str) -> list[Path]:
    """Write `<name>.png`, `.pdf` and `.csv` to a folder."""
    png, pdf, csv = (folder / f"{name}.{kind}" for kind in ("png", "pdf", "csv"))
    with style.context(["default", STYLE]):
        drawing.figure.savefig(png, metadata={"Software": None})
        drawing.figure.savefig(pdf, metadata={"CreationDate": None, "Creator": None, "Producer": None})
    drawing.numbers.to_csv(csv, index=False, float_format="%.6g", lineterminator="\n")
    return [png, pdf, csv]


def spread(heights: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Heights moved as little as possible (least squares) so that neighbours are `gap` apart, within low and high."""
    if not len(heights):
        return []
    order = np.argsort(heights, kind="stable")
    steps_up = gap * np.arange(len(heights))
    fitted = isotonic_regression(np.asarray(heights, dtype=float)[order] - steps_up).x
    placed = np.clip(fitted, low, max(low, high - steps_up[-1])) + steps_up
    out = np.empty(len(heights))
    out[order] = placed
    return [float(y) for y in out]


def look(arm: str, arms: Sequence[str]) -> tuple[str, str]:
    """Colour and line style of an arm."""
    unknown = [name for name in arms if name not in LOOKS]
    return LOOKS[arm] if arm in LOOKS else (OTHERS[unknown.index(arm) % len(OTHERS)], "-")


def _rulers(results: Results, spec: Curves) -> dict[str, float]:
    table = results.yardsticks_of(spec.study)
    if FINAL not in table:
        return {}
    return {name: float(table[FINAL][name]) for name in spec.yardsticks if name in table.index}


def _draw_rulers(axes: Axes, rulers: Mapping[str, float]) -> list[Label]:
    for name, y in rulers.items():
        axes.axhline(y, color=FAINT, linewidth=1, linestyle=(0, (6, 2)) if name.endswith("_bound") else "-", zorder=1)
    return [Label(y, f"{readable(name)} {number(y)}", QUIET, False) for name, y in rulers.items()]


def _draw_levels(axes: Axes, levels: Mapping[str, float]) -> list[Label]:
    """The paper's final values; arms with the same value share a line."""
    labels = []
    for y in sorted(set(levels.values())):
        arms = [arm for arm in levels if levels[arm] == y]
        colour = look(arms[0], arms)[0] if len(arms) == 1 else QUIET
        axes.axhline(y, color=colour, linewidth=1.4, linestyle=":", zorder=2)
        labels.append(Label(y, f"paper, {joined(arms)}: {y:g}", colour, False))
    return labels


def _draw_curves(axes: Axes, curves: Mapping[str, pd.DataFrame], results: Results, study: str) -> list[Label]:
    labels = []
    for arm in reversed(list(curves)):  # the first arm on top
        rows, (colour, dashes) = curves[arm], look(arm, list(curves))
        whole = rows["n"] == rows["n"].max()  # where every seed that has begun still is
        axes.plot(rows["step"][whole], rows["mean"][whole], color=colour, linestyle=dashes, linewidth=1.9, zorder=4)
        rest = rows[~whole | whole.shift(-1, fill_value=True).eq(False)]
        if not whole.all():
            axes.plot(rest["step"], rest["mean"], color=colour, linewidth=1.4, alpha=0.45, zorder=4)
        axes.fill_between(rows["step"], rows["low"], rows["high"], color=colour, alpha=0.16, linewidth=0, zorder=3)
        finals = results.finals(study, arm)
        words = f"{arm} {number(float(finals.mean()))}" if len(finals) else f"{arm}, unfinished"
        labels.append(Label(float(rows["mean"].iloc[-1]), words, colour, True))
    return labels


def _finish(axes: Axes, curves: Mapping[str, pd.DataFrame], task: str) -> None:
    last = max(rows["step"].max() for rows in curves.values())
    axes.set_xlim(0, last or 1)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: steps(x)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}".replace("-", "−")))
    axes.set_xlabel("environment steps")
    per = "sum over an episode" if task == "navigation" else "100 × mean reward per step"
    axes.set_ylabel(f"return ({per})")


def _write_labels(axes: Axes, labels: Sequence[Label]) -> None:
    """Names to the right of the axes, each joined to its line."""
    low, high = axes.get_ylim()
    heights = [(label.y - low) / (high - low) for label in labels]
    for label, y, place in zip(labels, heights, spread(heights, GAP, 0.0, 1.0), strict=True):
        axes.plot(
            [1.0, 1.02, 1.03],
            [y, place, place],
            transform=axes.transAxes,
            color=label.colour,
            linewidth=0.8,
            alpha=0.7,
            clip_on=False,
        )
        weight = "bold" if label.bold else "normal"
        at: dict[str, Any] = {"transform": axes.transAxes, "va": "center_baseline", "fontsize": 8.5}
        axes.text(1.037, place, label.text, color=label.colour, fontweight=weight, **at)


def _write_around(figure: Figure, axes: Axes, results: Results, spec: Curves) -> None:
    """Title, legend with the number of seeds, and what made the figure."""
    arms = results.arms(spec.study)
    figure.text(MARGIN, 0.945, spec.title, fontsize=13, fontweight="bold")
    figure.text(MARGIN, 0.9, describe_task(results.env(spec.study)), fontsize=9.5, color=QUIET)
    for arm in arms:
        colour, dashes = look(arm, arms)
        axes.plot(
            [], [], color=colour, linestyle=dashes, linewidth=1.9, label=f"{arm} ({_seed_words(results, spec, arm)})"
        )
    figure.legend(
        loc="upper left",
        bbox_to_anchor=(MARGIN - 0.005, 0.89),
        ncols=COLUMNS,
        frameon=False,
        fontsize=8.5,
        handlelength=2.4,
        columnspacing=1.6,
        borderpad=0.4,
        borderaxespad=0.0,
    )
    figure.text(MARGIN, 0.022, footer(results, spec), fontsize=7.5, color=QUIET, linespacing=1.5)


def footer(results: Results, spec: Curves) -> str:
    """Profile, budget and seeds; what band and labels are; the code's fingerprint."""
    plan = results.plan(spec.study)
    counts = sorted({len(results.plan(spec.study, arm)) for arm in results.arms(spec.study)})
    prints = ", ".join(sorted(set(plan["fingerprint"].dropna().astype(str)) - {""})) or "unknown"
    budget = results.budget(spec.study)
    few = f" (fewer than {FEW} seeds: narrower than 95 %)" if 1 < counts[0] < FEW else ""
    few = " (none with one seed)" if counts[0] == 1 else few
    first = f"profile: {results.profile}, {steps(budget) if budget else 'unknown'} steps, "
    first += f"{'–'.join(map(str, counts))} {'seed' if counts == [1] else 'seeds'}"
    lines = f"lines: mean over seeds of greedy evaluation; band: 95 % bootstrap interval of the mean{few}"
    names = ["names: final return"]
    names += ["dotted: the paper's values"] if any(arm in spec.levels for arm in results.arms(spec.study)) else []
    names += ["grey: scripted policies without learning, and bounds"] if _rulers(results, spec) else []
    return f"{first}  ·  code {prints}\n{lines}\n{'; '.join(names)}"


def _seed_words(results: Results, spec: Curves, arm: str) -> str:
    found = seeds(results, spec.study, arm)
    return f"{found} {'seed' if found == '1' else 'seeds'}"


def _numbers(
    curves: Mapping[str, pd.DataFrame], rulers: Mapping[str, float], levels: Mapping[str, float]
) -> pd.DataFrame:
    parts = [
        rows.rename(columns={"mean": "value", "n": "seeds"}).assign(kind="curve", name=arm)
        for arm, rows in curves.items()
    ]
    lines = [("paper", *item) for item in levels.items()] + [("yardstick", *item) for item in rulers.items()]
    parts += [pd.DataFrame(lines, columns=["kind", "name", "value"])] if lines else []
    return pd.concat(parts, ignore_index=True)[["kind", "name", "step", "value", "low", "high", "seeds"]]
