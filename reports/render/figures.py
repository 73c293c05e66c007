"""Learning curves as figures: all arms of a study in one frame, and where they are many a frame for each beside it.

Same numbers in, same bytes out: Agg, fixed style, no dates.
"""

from collections.abc import Iterable, Mapping, Sequence
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from reports.data.frame import FINAL, Results
from reports.data.paper import Curves
from reports.render.canvas import FAINT, MARGIN, QUIET, Drawing, Look, blank, foot, head, look, save, styled
from reports.render.tables import describe_task, joined, number, readable, seeds, spans, steps, tick

__all__ = ["Drawing", "Label", "each_arm", "footer", "learning_curves", "per", "save", "spread"]
__all__ += ["draw_curve", "held", "legend_size", "mean_curves", "plotted", "write_labels", "write_legend"]

# In inches
WIDTH, TALL = 9.0, 3.6  # of the figure; least height of the axes
HEAD, FOOT, ROW, LINE = 0.68, 0.92, 0.2, 0.165  # above and below; a row of the legend; a line of words on the right
LETTERS, LEGEND = 34, 108  # that fit on a line on the right, and in a row of the legend
MANY = 6  # more arms than this get a frame each as well
COLUMNS = 4  # of those frames
LEFT, SHARE = 0.075, 0.64  # of the axes, of the figure's width
RISE = 0.15  # share of the budget in which curves rise
CROWDED = 0.25  # of the height: where more than three curves end within it, the last part is drawn enlarged as well
LATE = 0.5  # share of the budget after which that part begins
SHORT, GAP = 2.5, 0.75  # inches: least height of the axes where there are two, and between them
MARKS = 7  # on a curve


class Label(NamedTuple):
    """Words at the height of a line's end."""

    y: float
    text: str
    colour: str
    bold: bool
    end: float | None = None  # of the line, where that is not y

    @property
    def lines(self) -> int:
        """The number of lines that they take."""
        return self.text.count("\n") + 1


def learning_curves(results: Results, spec: Curves) -> Drawing | None:
    """Every arm of the study with its band over seeds, yardsticks and the paper's levels as lines.

    Returns:
        None if the study has no points at all.
    """
    arms = results.arms(spec.study)
    curves = mean_curves(results, spec.study)
    if not curves:
        return None
    yardsticks = yardsticks_in(results, spec)
    levels = {arm: spec.levels[arm] for arm in arms if arm in spec.levels}
    lines = _yardstick_labels(yardsticks) + _level_labels(levels)
    names, late = (
        _curve_labels(curves, results, spec.study),
        late_part(curves, [*yardsticks.values(), *levels.values()]),
    )
    entries = {arm: "\n".join(wrap(f"{arm} ({_seed_words(results, spec, arm)})", LEGEND)) for arm in curves}
    columns, rows = legend_size(entries.values())
    unit = per(results, results.env(spec.study).get("kind", ""))
    parts = [lines, names + _within(lines, late)] if late else [lines + names]
    talls = [max(SHORT if late else TALL, LINE * sum(label.lines for label in labels)) for labels in parts]
    with styled():
        height = HEAD + ROW * rows + sum(talls) + GAP * (len(talls) - 1) + FOOT
        figure = blank(WIDTH, height)
        for n, (labels, tall) in enumerate(zip(parts, talls, strict=True)):
            bottom = FOOT + sum(talls[n + 1 :]) + GAP * (len(talls) - 1 - n)
            axes = figure.add_axes((LEFT, bottom / height, SHARE, tall / height))
            _draw_yardsticks(axes, yardsticks)
            _draw_levels(axes, levels)
            for place, arm in reversed(list(enumerate(curves))):  # the first arm on top
                draw_curve(axes, curves[arm], look(arm, arms), place)
            _finish(axes, curves, unit)
            if late and n:
                axes.set_xlim(late.step, axes.get_xlim()[1])
                axes.set_ylim(late.low, late.high)
                axes.yaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 5, 10]))  # no 2.5: its digits take room
                axes.set_title("the same, enlarged: the part in the box above", fontsize=8.5, loc="left", color=QUIET)
            elif late:
                axes.set_xlabel("")
                _draw_box(axes, late)
            write_labels(axes, labels, LINE / tall)
        head(figure, spec.title, task_words(results, spec.study))
        write_legend(figure, entries, arms, columns, (height - HEAD) / height)
        foot(figure, footer(results, spec))
    return Drawing(figure, plotted(curves, yardsticks, levels))


class Late(NamedTuple):
    """The last part of the curves, which is enlarged: from a step on, between two heights."""

    step: float
    low: float
    high: float


def late_part(curves: Mapping[str, pd.DataFrame], lines: Sequence[float]) -> Late | None:
    """The part to enlarge; None where the curves end far enough from each other. lines: other heights of the axes."""
    last = max(float(rows["step"].max()) for rows in curves.values())
    late = [rows[rows["step"] >= LATE * last] for rows in curves.values()]
    ends = [float(rows["mean"].iloc[-1]) for rows in late if len(rows)]
    heights = [y for rows in curves.values() for y in (rows["mean"].min(), rows["mean"].max())] + list(lines)
    if len(ends) <= 3 or np.ptp(ends) > CROWDED * (max(heights) - min(heights)):
        return None
    values = pd.concat([rows["mean"] for rows in late])
    margin = 0.1 * float(np.ptp(values)) or 1.0
    return Late(LATE * last, float(values.min()) - margin, float(values.max()) + margin)


def _within(labels: Sequence[Label], late: Late | None) -> list[Label]:
    """The lines that are seen in the enlarged part as well."""
    return [label for label in labels if late and late.low < label.y < late.high]


def _draw_box(axes: Axes, late: Late) -> None:
    """Around the part that is enlarged."""
    width, height = axes.get_xlim()[1] - late.step, late.high - late.low
    axes.add_patch(
        Rectangle((late.step, late.low), width, height, fill=False, edgecolor=QUIET, linewidth=0.9, zorder=6)
    )


def task_words(results: Results, study: str) -> str:
    """The task of all arms, or how many they have."""
    found = results.by_task(study)
    return describe_task(found[0][0]) if len(found) == 1 else f"{len(found)} tasks, so no yardstick is common to all"


def legend_size(entries: Iterable[str]) -> tuple[int, int]:
    """Columns and rows of a legend."""
    entries = list(entries)
    columns = min(5, max(1, LEGEND // (max(map(len, entries)) + 8)))
    return columns, -(-len(entries) // columns) + sum(entry.count("\n") for entry in entries)


def each_arm(results: Results, spec: Curves) -> Drawing | None:
    """A small frame for every arm, the others faint behind it. None with `MANY` arms or fewer."""
    curves = mean_curves(results, spec.study)
    if len(curves) <= MANY:
        return None
    rows = -(-len(curves) // COLUMNS)
    height = HEAD + 1.75 * rows + 0.75
    with styled():
        figure = blank(WIDTH, height)
        words = (
            "coloured: the arm named above; grey: all others. The axis is cut below what arms hold after the first rise"
        )
        head(figure, f"{spec.title}, arm by arm", words)
        shared: Axes | None = None
        for n, arm in enumerate(curves):
            row, column = divmod(n, COLUMNS)
            bottom = (height - HEAD - 1.75 * (row + 1) + 0.25) / height
            place = (0.06 + 0.237 * column, bottom, 0.205, 1.2 / height)
            axes = figure.add_axes(place, sharex=shared, sharey=shared)
            shared = shared or axes
            for other, points in curves.items():
                if other != arm:
                    axes.plot(points["step"], points["mean"], color="#D5D5D5", linewidth=0.8, zorder=2)
            draw_curve(axes, curves[arm], look(arm, results.arms(spec.study))._replace(dashes="-"))
            _name_frame(axes, arm, results.finals(spec.study, arm))
            axes.set_ylim(*held(curves))
        foot(figure, footer(results, spec, levels=False))
    return Drawing(figure, plotted(curves, {}, {}))


def held(curves: Mapping[str, pd.DataFrame]) -> tuple[float, float]:
    """Heights between which all means are once `RISE` of the budget is spent, with a margin."""
    last = max(float(rows["step"].max()) for rows in curves.values())
    late = [rows.loc[rows["step"] >= RISE * last, "mean"] for rows in curves.values()]
    values = pd.concat(
        [rows if len(rows) else curve["mean"] for rows, curve in zip(late, curves.values(), strict=True)]
    )
    margin = 0.12 * float(values.max() - values.min()) or 1.0
    return float(values.min()) - margin, float(values.max()) + margin


def spread(heights: Sequence[float], gap: float | Sequence[float], low: float, high: float) -> list[float]:
    """Heights moved as little as possible (least squares) so that neighbours do not overlap, within low and high.

    Args:
        heights: where things would like to be.
        gap: how tall a thing is, or each of them.
        low: the middle of the lowest one stays above it.
        high: the middle of the highest one stays below it if there is room; it gives way if there is not.
    """
    if not len(heights):
        return []
    order = np.argsort(heights, kind="stable")
    sizes = np.broadcast_to(np.asarray(gap, dtype=float), len(heights))[order]
    steps_up = np.concatenate(([0.0], np.cumsum((sizes[1:] + sizes[:-1]) / 2)))
    fitted = isotonic_regression(np.asarray(heights, dtype=float)[order] - steps_up).x
    placed = np.clip(fitted, low, max(low, high - steps_up[-1])) + steps_up
    out = np.empty(len(heights))
    out[order] = placed
    return [float(y) for y in out]


def footer(results: Results, spec: Curves, *, levels: bool = True) -> str:
    """Profile, budget and seeds; what band and labels are; the code's fingerprint.

    levels: whether the figure shows the paper's values and the yardsticks.
    """
    plan = results.plan(spec.study)
    counts = sorted({len(results.plan(spec.study, arm)) for arm in results.arms(spec.study)})
    prints = ", ".join(sorted(set(plan["fingerprint"].dropna().astype(str)) - {""})) or "unknown"
    budget = results.budget(spec.study)
    first = f"profile: {results.profile}, {steps(budget) if budget else 'unknown'} steps, "
    first += f"{'–'.join(map(str, counts))} {'seed' if counts == [1] else 'seeds'}"
    band = spans(n for rows in mean_curves(results, spec.study).values() for n in rows["n"])
    lines = f"lines: mean over seeds of greedy evaluation; band: {band}"
    names = ["names: final return"]
    names += (
        ["dotted: the paper's values"] if levels and any(arm in spec.levels for arm in results.arms(spec.study)) else []
    )
    names += (
        ["grey: yardsticks (policies without learning, and bounds)"] if levels and yardsticks_in(results, spec) else []
    )
    return f"{first}  ·  code {prints}\n{lines}\n{'; '.join(names)}"


def mean_curves(results: Results, study: str) -> dict[str, pd.DataFrame]:
    """The mean curves of the arms that have points."""
    return {arm: rows for arm in results.arms(study) if len(rows := results.mean_curve(study, arm))}


def yardsticks_in(results: Results, spec: Curves) -> dict[str, float]:
    table = results.yardsticks_of(spec.study)
    if FINAL not in table:
        return {}
    return {name: float(table[FINAL][name]) for name in spec.yardsticks if name in table.index}


def _yardstick_labels(yardsticks: Mapping[str, float]) -> list[Label]:
    return [Label(y, f"{readable(name)} {number(y)}", QUIET, False) for name, y in yardsticks.items()]


def _level_labels(levels: Mapping[str, float]) -> list[Label]:
    """The paper's final values; arms with the same value share a line."""
    found = []
    for y, arms in by_level(levels).items():
        text = "\n".join(wrap(f"paper, {joined(arms)}: {y:g}", LETTERS + 4))
        found.append(Label(y, text, level_colour(arms), False))
    return found


def _curve_labels(curves: Mapping[str, pd.DataFrame], results: Results, study: str) -> list[Label]:
    labels = []
    for arm, rows in reversed(list(curves.items())):
        finals = results.finals(study, arm)
        words = f"{arm} {number(float(finals.mean()))}" if len(finals) else f"{arm}, unfinished"
        text = "\n".join(wrap(words, LETTERS, break_on_hyphens=False))
        end = float(rows["mean"].iloc[-1])
        height = float(finals.mean()) if len(finals) else end  # sorted as the words say
        labels.append(Label(height, text, look(arm, results.arms(study)).colour, True, end))
    return labels


def by_level(levels: Mapping[str, float]) -> dict[float, list[str]]:
    return {y: [arm for arm in levels if levels[arm] == y] for y in sorted(set(levels.values()))}


def level_colour(arms: Sequence[str]) -> str:
    return look(arms[0], arms).colour if len(arms) == 1 else QUIET


def _draw_yardsticks(axes: Axes, yardsticks: Mapping[str, float]) -> None:
    for name, y in yardsticks.items():
        axes.axhline(y, color=FAINT, linewidth=1, linestyle=(0, (6, 2)) if name.endswith("_bound") else "-", zorder=1)


def _draw_levels(axes: Axes, levels: Mapping[str, float]) -> None:
    for y, arms in by_level(levels).items():
        axes.axhline(y, color=level_colour(arms), linewidth=1.4, linestyle=":", zorder=2)


def draw_curve(axes: Axes, rows: pd.DataFrame, own: Look, place: int | None = None) -> None:
    """A mean curve with its band. place: of the arm in its figure, which keeps marks apart; None for no marks."""
    colour, whole = own.colour, rows["n"] == rows["n"].max()  # where every seed that has begun still is
    every = max(1, int(whole.sum()) // MARKS)
    how = own.line if place is None else own.marked | {"markevery": (place % every, every)}
    axes.plot(rows["step"][whole], rows["mean"][whole], linewidth=1.7, zorder=4, **how)
    rest = rows[~whole | whole.shift(-1, fill_value=True).eq(False)]
    if not whole.all():
        axes.plot(rest["step"], rest["mean"], color=colour, linewidth=1.4, alpha=0.45, zorder=4)
    axes.fill_between(rows["step"], rows["low"], rows["high"], color=colour, alpha=0.16, linewidth=0, zorder=3)


def _name_frame(axes: Axes, arm: str, finals: NDArray[np.float64]) -> None:
    """Name and final return above a small frame."""
    words = number(float(finals.mean())) if len(finals) else "unfinished"
    axes.set_title("\n".join(wrap(f"{arm}: {words}", 27)), fontsize=7.5, loc="left", fontweight="bold", pad=3)
    axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: steps(x)))
    axes.yaxis.set_major_formatter(tick)
    axes.tick_params(labelsize=7)


def _finish(axes: Axes, curves: Mapping[str, pd.DataFrame], unit: str) -> None:
    last = max(rows["step"].max() for rows in curves.values())
    axes.set_xlim(0, last or 1)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: steps(x)))
    axes.yaxis.set_major_formatter(tick)
    axes.set_xlabel("environment steps")
    axes.set_ylabel(f"return ({unit})")


UNITS = {"coverage": "100 × mean reward per step", "navigation": "sum over an episode"}


def per(results: Results, task: str) -> str:
    """Meaning of a return of a task, in words; of one that is not this project's, what it says of itself."""
    return UNITS.get(task) or results.units.get(task, "as the task defines it")


def write_labels(axes: Axes, labels: Sequence[Label], line: float) -> None:
    """Names to the right of the axes, each joined to its line. line: height of a line of words, in the axes'."""
    low, high = axes.get_ylim()
    heights = [(label.y - low) / (high - low) for label in labels]
    ends = [
        y if label.end is None else (label.end - low) / (high - low) for label, y in zip(labels, heights, strict=True)
    ]
    sizes = [line * label.lines for label in labels]
    for label, y, place in zip(labels, ends, spread(heights, sizes, 0.0, 1.0), strict=True):
        joint: dict[str, Any] = {"color": label.colour, "linewidth": 0.8, "alpha": 0.7, "clip_on": False}
        axes.plot([1.0, 1.02, 1.03], [y, place, place], transform=axes.transAxes, **joint)
        weight = "bold" if label.bold else "normal"
        at: dict[str, Any] = {"transform": axes.transAxes, "va": "center", "fontsize": 8.5, "linespacing": 1.05}
        axes.text(1.037, place, label.text, color=label.colour, fontweight=weight, **at)


def write_legend(figure: Figure, entries: Mapping[str, str], arms: Sequence[str], columns: int, top: float) -> None:
    """Above the axes: every arm that is drawn, with its number of seeds. arms: all that looks are shared out among."""
    lines = [Line2D([], [], linewidth=1.7, **look(arm, arms).marked) for arm in entries]
    how: dict[str, Any] = {"handlelength": 2.4, "columnspacing": 1.6, "borderpad": 0.0, "borderaxespad": 0.0}
    how |= {"loc": "upper left", "bbox_to_anchor": (MARGIN, top + 0.01), "frameon": False, "fontsize": 8.5}
    figure.legend(lines, list(entries.values()), ncols=columns, **how)  # named here: of itself it leaves out `_c`


def _seed_words(results: Results, spec: Curves, arm: str) -> str:
    found = seeds(results, spec.study, arm)
    return f"{found} {'seed' if found == '1' else 'seeds'}"


def plotted(
    curves: Mapping[str, pd.DataFrame], yardsticks: Mapping[str, float], levels: Mapping[str, float]
) -> pd.DataFrame:
    parts = [
        rows.rename(columns={"mean": "value", "n": "seeds"}).assign(kind="curve", name=arm)
        for arm, rows in curves.items()
    ]
    lines = [("paper", *item) for item in levels.items()] + [("yardstick", *item) for item in yardsticks.items()]
    parts += [pd.DataFrame(lines, columns=["kind", "name", "value"])] if lines else []
    return pd.concat(parts, ignore_index=True)[["kind", "name", "step", "value", "low", "high", "seeds"]]
