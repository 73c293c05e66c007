"""Learning curves in small frames: of a study with several tasks a frame each, of one with many arms by their names.

Arms of a group have one task. In each frame stand the yardsticks of that task, in none those of another.
"""

from collections.abc import Mapping, Sequence
from itertools import takewhile
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, MaxNLocator

from reports.data.frame import FINAL, Results, in_order, without_count
from reports.data.paper import Curves
from reports.data.stats import Values
from reports.render.canvas import BLUE, FAINT, ORANGE, QUIET, Drawing, Look, blank, foot, head, look, styled
from reports.render.figures import (
    HEAD,
    LEGEND,
    ROW,
    WIDTH,
    draw_curve,
    held,
    legend_size,
    mean_curves,
    per,
    plotted,
    write_legend,
)
from reports.render.tables import describe_task, number, readable, spans, steps, tick

MOST = 12  # arms in one frame; of more the best and the worst have a colour
ROOM = 6  # arms of a group; a larger one is divided once more if its names allow
FRAMES = 24  # at most
COLUMNS = 3
TALL, WORDS, BELOW, END = 1.6, 0.14, 0.45, 0.62  # inches: of a frame, a line above it, its ticks, below all frames
LETTERS = 52  # on a line above a frame
BEST, WORST = Look(BLUE, "-", "o"), Look(ORANGE, "--", "s")


class Group(NamedTuple):
    """A frame: its title, its arms by their names there, and the heights of its yardsticks."""

    title: str
    arms: Mapping[str, str]
    yardsticks: Mapping[str, float]


def panels(results: Results, spec: Curves) -> Drawing | None:
    """A frame for every group of arms; None where one frame is enough: one task, and no more than `MOST` arms."""
    curves = mean_curves(results, spec.study)
    found = groups(results, spec, list(curves))
    if not found:
        return None
    names = in_order(name for group in found for name in group.arms)
    shared = names if len(names) <= MOST else []
    entries = {name: "\n".join(wrap(name, LEGEND)) for name in shared}
    columns, rows = legend_size(entries.values()) if entries else (1, 0)
    titles = [_title(results, spec.study, group) for group in found]
    top = WORDS * max(map(len, titles)) + 0.05
    lines = -(-len(found) // COLUMNS)
    with styled():
        height = HEAD + ROW * rows + lines * (top + TALL + BELOW) + END
        figure = blank(WIDTH, height)
        one = len(results.by_task(spec.study)) == 1
        range_ = heights(curves, found) if one else None
        for n, (group, title) in enumerate(zip(found, titles, strict=True)):
            row, column = divmod(n, COLUMNS)
            bottom = height - HEAD - ROW * rows - (row + 1) * (top + TALL) - row * BELOW
            axes = figure.add_axes((0.06 + 0.316 * column, bottom / height, 0.27, TALL / height))
            _draw(axes, results, spec.study, group, curves, shared)
            axes.set_ylim(*(range_ or heights(curves, [group])))
            axes.set_title("\n".join(title), fontsize=7.5, loc="left", linespacing=1.25, pad=3)
            _finish(axes)
        task = describe_task(results.env(spec.study)) if one else f"a frame for each of {len(found)} tasks"
        head(figure, spec.title, f"{task}; return ({per(results, results.task(spec.study))}) against environment steps")
        write_legend(figure, entries, names, columns, (height - HEAD) / height)
        foot(figure, frames_footer(results, spec.study, curves, bool(shared)))
    parts = [
        plotted({arm: curves[arm] for arm in group.arms.values()}, group.yardsticks, {}).assign(frame=group.title)
        for group in found
    ]
    return Drawing(figure, pd.concat(parts, ignore_index=True))


def groups(results: Results, spec: Curves, arms: Sequence[str]) -> list[Group]:
    """The frames of a study. arms: those with points. Empty where one frame is enough."""
    tasks = [(env, [arm for arm in own if arm in arms]) for env, own in results.by_task(spec.study)]
    if len(tasks) == 1:
        if len(arms) <= MOST:
            return []
        yardsticks = _two(results, tasks[0][0], spec)
        parts = by_name(arms)
        return [Group(key, {_rest(arm, key): arm for arm in own}, yardsticks) for key, own in parts.items()]
    tasks = [(env, own) for env, own in tasks if own]
    tasks.sort(key=lambda one: int(one[0].get("agents", 0)))
    return [Group(describe_task(env), _short(env, own), _two(results, env, spec)) for env, own in tasks]


def by_name(arms: Sequence[str]) -> dict[str, list[str]]:
    """Arms by the first key of their names (`full` of `full, horizon 1, alpha=0.1`), large groups by the next as well.

    One group, without a name, where keys do not divide them.
    """
    found = _divided(list(arms), 1)
    return found if 1 < len(found) <= FRAMES else {"": list(arms)}


def _divided(arms: list[str], keys: int) -> dict[str, list[str]]:
    parts: dict[str, list[str]] = {}
    for arm in arms:
        parts.setdefault(", ".join(arm.split(", ")[:keys]), []).append(arm)
    if len(parts) == len(arms):
        return {}
    out: dict[str, list[str]] = {}
    for own in parts.values():
        smaller = _divided(own, keys + 1) if len(own) > ROOM else {}
        out |= smaller if len(smaller) > 1 else {_common(own): own}
    return out


def _common(arms: Sequence[str]) -> str:
    """The keys that names begin with, all of them."""
    keys = [arm.split(", ") for arm in arms]
    same = takewhile(lambda column: len(set(column)) == 1, zip(*keys, strict=False))
    return ", ".join(column[0] for column in same)


def _rest(arm: str, key: str) -> str:
    return arm.removeprefix(key).removeprefix(", ") or arm


def _short(env: Mapping[str, Any], arms: Sequence[str]) -> dict[str, str]:
    """Arms by their names without the number of agents, where that is another name for each."""
    names = [without_count(arm, int(env["agents"])) if "agents" in env else arm for arm in arms]
    return dict(zip(names if len(set(names)) == len(names) else arms, arms, strict=True))


def _two(results: Results, env: Mapping[str, Any], spec: Curves) -> dict[str, float]:
    """The best policy without learning and the lowest bound of a task."""
    scores = results.yardsticks_on(env)
    known = {n: float(scores[FINAL][n]) for n in spec.yardsticks if FINAL in scores and n in scores.index}
    bounds = [name for name in known if name.endswith("_bound")]
    played = [name for name in known if name not in bounds]
    kept = [max(played, key=known.__getitem__)] if played else []
    kept += [min(bounds, key=known.__getitem__)] if bounds else []
    return {name: known[name] for name in kept}


def extremes(results: Results, study: str, group: Group) -> tuple[str, str] | None:
    """The names of the best and of the worst arm by the mean final return; None with fewer than two finished."""
    values = {name: x for name, arm in group.arms.items() if len(x := results.finals(study, arm))}
    order = sorted(values, key=lambda name: -float(values[name].mean()))
    return (order[0], order[-1]) if len(order) > 1 else None


def _title(results: Results, study: str, group: Group) -> list[str]:
    """Lines above a frame: its name, its best and its worst arm."""
    title = wrap(group.title or f"all {len(group.arms)} arms", LETTERS)
    ends = extremes(results, study, group)
    if ends is None:
        return title
    said = [
        f"{word}: {name}, {_mean(results.finals(study, group.arms[name]))}"
        for word, name in zip(SAID, ends, strict=True)
    ]
    return [*title, *(line for words in said for line in wrap(words, LETTERS))]


SAID = ("highest", "lowest")


def _mean(values: Values) -> str:
    return number(float(np.mean(values)))


def _draw(
    axes: Axes, results: Results, study: str, group: Group, curves: Mapping[str, pd.DataFrame], shared: Sequence[str]
) -> None:
    """Curves of a frame. shared: names whose looks all frames share; with none, a frame's two ends are coloured."""
    for name, y in group.yardsticks.items():
        axes.axhline(y, color=FAINT, linewidth=1, linestyle=(0, (6, 2)) if name.endswith("_bound") else "-", zorder=1)
        at: dict[str, Any] = {"transform": axes.get_yaxis_transform(), "va": "bottom", "ha": "right", "fontsize": 6.5}
        axes.text(0.99, y, f"{readable(name)} {number(y)}", color=QUIET, **at)
    ends = dict(zip(extremes(results, study, group) or (), (BEST, WORST), strict=False))
    for place, (name, arm) in enumerate(group.arms.items()):
        if shared:
            draw_curve(axes, curves[arm], look(name, shared), place)
        elif name in ends:
            draw_curve(axes, curves[arm], ends[name], place)
        else:
            axes.plot(curves[arm]["step"], curves[arm]["mean"], color="#CFCFCF", linewidth=0.8, zorder=2)


def heights(curves: Mapping[str, pd.DataFrame], found: Sequence[Group]) -> tuple[float, float]:
    """Heights of frames: what their arms hold after the first rise, and their yardsticks."""
    low, high = held({arm: curves[arm] for group in found for arm in group.arms.values()})
    lines = [y for group in found for y in group.yardsticks.values()]
    least, most = min([low, *lines]), max([high, *lines])
    return least, most + 0.08 * (most - least)


def _finish(axes: Axes) -> None:
    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: steps(x)))
    axes.yaxis.set_major_formatter(tick)
    axes.tick_params(labelsize=7)


def frames_footer(results: Results, study: str, curves: Mapping[str, pd.DataFrame], shared: bool) -> str:
    budget = results.budget(study)
    first = (
        f"profile: {results.profile}, {steps(budget) if budget else 'unknown'} steps; the axis is cut below what arms "
    )
    first += "hold after the first rise"
    band = spans(n for rows in curves.values() for n in rows["n"])
    coloured = "" if shared else "blue: highest, orange: lowest final return, grey: all other arms; "
    second = f"{coloured}lines: mean over seeds of greedy evaluation; band: {band}"
    third = "names: mean final return; grey lines: the best policy without learning, and the lowest bound (dashed)"
    return f"{first}\n{second}\n{third}"
