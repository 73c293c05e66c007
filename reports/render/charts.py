"""Learning curves for the page: lines in units of the data, which a script shows, hides, stretches and reads.

A point stands once, as whole numbers in the path that draws it. All words are the page's, so that a phone has them in
its own size. What is drawn is what `figures` and `panels` draw of the same study.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.ticker import MaxNLocator

from reports.data.frame import Results, in_order
from reports.data.paper import Curves
from reports.render import figures, panels
from reports.render.canvas import QUIET, Look, look
from reports.render.tables import describe_task, joined, number, readable, seeds, steps, tick

FINE = 1000  # units of an axis at least: a point is at most that far off
PALE = "#9A9A9A"
GREY = Look(PALE, "-", "")  # of arms between the best and the worst, where there are many
DASHES: Mapping[str, str] = {"-": "", "--": "6 3", ":": "1.5 2.5", "-.": "7 2.5 1.5 2.5"}
TALL, LESS, SMALL, NAME = 22.0, 18.0, 12.0, 1.3  # rem: height of a plot, of one of two, of many; of a name beside it
CLOCKS = ((3600, "h"), (60, "min"), (1, "s"))
Tick = tuple[float, str]  # a place in percent, and its words


class Scale(NamedTuple):
    """Units of the paths."""

    steps: int  # environment steps of a unit to the right
    end: int  # units of the whole axis
    fine: int  # units upwards of a return of 1
    digits: int  # after the point of a final return; as many as `fine` has zeros of what is read off a curve

    def x(self, step: float) -> int:
        """Steps in units."""
        return round(step / self.steps)

    def y(self, value: float) -> int:
        """A return in units, which count downwards."""
        return -round(value * self.fine)


class Curve(NamedTuple):
    """A line of a plot, of an arm or at one height; `key` is its name in the figure."""

    key: str
    colour: str
    dashes: str
    mean: str
    faint: str = ""  # the part where fewer seeds have come so far
    band: str = ""
    seeds: Sequence[str] = ()
    pace: float = 0.0  # seconds of processor time a unit to the right; 0 where it is not known
    pale: bool = False  # one of many, without a band


class Name(NamedTuple):
    """The name of a line, and its value; a click on it shows and hides the line."""

    key: str
    arm: str  # nothing if it is no arm
    value: str
    about: str
    colour: str
    dashes: str
    end: float = 0.0  # height of the line's end, in percent from the top
    at: float = 0.0  # height of the name
    id: str = ""


class Plot(NamedTuple):
    """Axes: one shows everything, a second one enlarges heights."""

    title: str
    box: str  # the part that is seen: left, top, width and height in units
    grid: str
    ticks: Sequence[Tick]
    names: Sequence[Name]
    tall: float  # rem


class Frame(NamedTuple):
    """Lines, and one or two plots of them."""

    title: str
    curves: Sequence[Curve]
    plots: Sequence[Plot]


class Chart(NamedTuple):
    """A figure. seconds: of processor time at the right end of that axis, 0 where it is not known of every arm."""

    name: str
    about: str
    foot: str
    scale: Scale
    frames: Sequence[Frame]
    steps: Sequence[Tick]
    seconds: float
    times: Sequence[Tick]

    @property
    def places(self) -> dict[str, str]:
        """The anchor of each arm."""
        names = [name for frame in self.frames for plot in frame.plots for name in plot.names]
        return {name.arm: name.id for name in names if name.id}


def chart(results: Results, spec: Curves, name: str) -> Chart | None:
    """The learning curves of a study; None if it has no points at all. name: of the figure."""
    curves = figures.mean_curves(results, spec.study)
    if not curves:
        return None
    groups = panels.groups(results, spec, list(curves))
    one = len(results.by_task(spec.study)) == 1
    if groups:
        ranges = [panels.heights(curves, groups if one else [group]) for group in groups]
        scale = _scale(curves, ranges)
        made = _panels(results, spec.study, groups, ranges, scale)
        shared = len(in_order(key for group in groups for key in group.arms)) <= panels.MOST
        foot = panels.frames_footer(results, spec.study, curves, shared)
    else:
        made, scale = _whole(results, spec, curves)
        foot = figures.footer(results, spec)
    task = describe_task(results.env(spec.study)) if one else f"{len(results.by_task(spec.study))} tasks"
    seconds = _seconds(results, spec.study, curves)
    return Chart(
        name,
        f"{task}; return ({figures.per(results, results.task(spec.study))})",
        foot,
        scale,
        _numbered(name, made),
        [(100 * at / (scale.end * scale.steps), steps(at)) for at in _ticks(0, scale.end * scale.steps)],
        seconds,
        _clock(seconds),
    )


def _clock(seconds: float) -> list[Tick]:
    """The axis of processor time; nothing where it is not known."""
    if not seconds:
        return []
    unit, word = next((one for one in CLOCKS if seconds > 2 * one[0]), CLOCKS[-1])
    return [(100 * at * unit / seconds, f"{tick(at)} {word}" if at else "0") for at in _ticks(0, seconds / unit)]


def path(xs: Iterable[int], ys: Iterable[int]) -> str:
    """A line as the data of a path: its first point, then how far each is from the one before it."""
    points = list(zip(xs, ys, strict=True))
    points += points if len(points) == 1 else []  # a dot
    flat = [n for one, two in pairwise(points) for n in (two[0] - one[0], two[1] - one[1])]
    return f"M{_numbers(points[0])}l{_numbers(flat)}" if points else ""


def _numbers(found: Iterable[int]) -> str:
    """Whole numbers, with a blank only where nothing else parts them."""
    return "".join(f" {n}" if place and n >= 0 else str(n) for place, n in enumerate(found))


def _scale(curves: Mapping[str, pd.DataFrame], ranges: Sequence[tuple[float, float]]) -> Scale:
    last = max(float(rows["step"].max()) for rows in curves.values()) or 1.0
    span = min(high - low for low, high in ranges) or 1.0
    unit = 10 ** max(0, math.floor(math.log10(last / FINE)))
    fine = 10 ** max(0, math.ceil(math.log10(FINE / span)))
    return Scale(unit, max(1, round(last / unit)), fine, max(1, 1 - math.floor(math.log10(span))))


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers between two ends."""
    found = MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(low, high)
    return [float(x) for x in found if low <= x <= high]


class Line(NamedTuple):
    """A line at one height: a yardstick, or what the paper states."""

    key: str
    height: float
    colour: str
    dashes: str


class Entry(NamedTuple):
    """A name before it has a place: the height of its value, and that of its line's end."""

    name: Name
    height: float
    end: float


def _whole(results: Results, spec: Curves, curves: Mapping[str, pd.DataFrame]) -> tuple[list[Frame], Scale]:
    """All arms in one frame, with the heights of the last part enlarged where curves end close together."""
    arms = results.arms(spec.study)
    lines = _yardsticks(figures.yardsticks_in(results, spec))
    levels = figures.by_level({arm: spec.levels[arm] for arm in arms if arm in spec.levels})
    lines += [Line(f"paper, {joined(own)}", y, figures.level_colour(own), ":") for y, own in levels.items()]
    looks = {arm: look(arm, arms) for arm in curves}
    low, high = _range(curves, [line.height for line in lines])
    scale = _scale(curves, [(low, high)])
    drawn = [_flat(line, scale) for line in lines]
    drawn += [_curve(results, spec.study, arm, arm, looks[arm], scale) for arm in reversed(list(curves))]
    ours = [_entry(results, spec.study, arm, arm, looks[arm], scale) for arm in curves]
    theirs = [_line_entry(line, scale) for line in lines]
    late = figures.late_part(curves, [line.height for line in lines])
    if late is None:
        return [Frame("", drawn, [_plot("", (low, high), ours + theirs, scale, TALL)])], scale
    inside = [entry for entry in theirs if late.low < entry.height < late.high]
    title = f"The same, enlarged: {number(late.low, scale.digits)} to {number(late.high, scale.digits)}"
    plots = [_plot("", (low, high), theirs, scale, LESS), _plot(title, late[1:], ours + inside, scale, LESS)]
    return [Frame("", drawn, plots)], scale


def _panels(
    results: Results,
    study: str,
    groups: Sequence[panels.Group],
    ranges: Sequence[tuple[float, float]],
    scale: Scale,
) -> list[Frame]:
    """A frame for each group of arms; with many names, the best and the worst arm of each are coloured."""
    names = in_order(key for group in groups for key in group.arms)
    made = []
    for group, heights in zip(groups, ranges, strict=True):
        ends = dict(zip(panels.extremes(results, study, group) or (), (panels.BEST, panels.WORST), strict=False))
        looks = {key: look(key, names) if len(names) <= panels.MOST else ends.get(key, GREY) for key in group.arms}
        lines = _yardsticks(group.yardsticks)
        drawn = [_flat(line, scale) for line in lines]
        arms = list(group.arms.items())
        drawn += [_curve(results, study, key, arm, looks[key], scale) for key, arm in reversed(arms)]
        entries = [_line_entry(line, scale) for line in lines]
        entries += [_entry(results, study, key, arm, looks[key], scale) for key, arm in arms]
        entries.sort(key=lambda entry: -entry.height)
        plot = _plot("", heights, entries, scale, SMALL)
        made.append(Frame(group.title or f"all {len(arms)} arms", drawn, [plot]))
    return made


def _range(curves: Mapping[str, pd.DataFrame], lines: Sequence[float]) -> tuple[float, float]:
    """Heights of axes that show all curves with their bands, and all lines."""
    values = [rows[column].dropna() for rows in curves.values() for column in ("mean", "low", "high")]
    every = np.concatenate([*values, lines])
    margin = 0.04 * float(np.ptp(every)) or 1.0
    return float(every.min()) - margin, float(every.max()) + margin


def _yardsticks(found: Mapping[str, float]) -> list[Line]:
    return [Line(readable(name), y, QUIET, "--" if name.endswith("_bound") else "-") for name, y in found.items()]


def _flat(line: Line, scale: Scale) -> Curve:
    colour = PALE if line.colour == QUIET else line.colour
    return Curve(line.key, colour, DASHES[line.dashes], path([0, scale.end], [scale.y(line.height)] * 2))


def _curve(results: Results, study: str, key: str, arm: str, own: Look, scale: Scale) -> Curve:
    """The curve of an arm: its mean, its band and its seeds."""
    rows = results.mean_curve(study, arm)
    whole = rows["n"] == rows["n"].max()  # where every seed that has begun still is
    rest = rows[~whole | whole.shift(-1, fill_value=True).eq(False)] if not whole.all() else rows.iloc[:0]
    spread = rows.dropna(subset=["low", "high"])
    there_and_back = [*spread["step"], *spread["step"][::-1]], [*spread["high"], *spread["low"][::-1]]
    by_seed = results.curve(study, arm).groupby("seed")
    return Curve(
        key,
        own.colour,
        DASHES[own.dashes],
        _path(rows["step"][whole], rows["mean"][whole], scale),
        _path(rest["step"], rest["mean"], scale),
        _path(*there_and_back, scale),
        [_path(points["step"], points["value"], scale) for _, points in by_seed],
        _pace(results, study, arm) * scale.steps,
        own is GREY,
    )


def _path(at: Iterable[float], values: Iterable[float], scale: Scale) -> str:
    return path(map(scale.x, at), map(scale.y, values))


def _pace(results: Results, study: str, arm: str) -> float:
    """Seconds of processor time a step, the mean of finished runs; 0 where it is not known."""
    last = results.curve(study, arm).groupby("seed")["step"].max()
    runs = results.finished(study, arm)
    found = (runs["seconds"].astype(float) / runs["seed"].map(last)).replace(np.inf, np.nan).dropna()
    return float(found.mean()) if len(found) else 0.0


def _entry(results: Results, study: str, key: str, arm: str, own: Look, scale: Scale) -> Entry:
    """The name of an arm, at the height of its final return; at that of its last point if it has none."""
    finals, end = results.finals(study, arm), float(results.mean_curve(study, arm)["mean"].iloc[-1])
    height = float(finals.mean()) if len(finals) else end
    value = number(height, scale.digits) if len(finals) else "unfinished"
    count = seeds(results, study, arm)
    about = f"{arm} ({count} {'seed' if count == '1' else 'seeds'})"
    return Entry(Name(key, arm, value, about, own.colour, DASHES[own.dashes]), height, end)


def _line_entry(line: Line, scale: Scale) -> Entry:
    value = number(line.height, scale.digits)
    drawn = _flat(line, scale)
    return Entry(Name(line.key, "", value, line.key, drawn.colour, drawn.dashes), line.height, line.height)


def _plot(title: str, heights: tuple[float, float], entries: Sequence[Entry], scale: Scale, least: float) -> Plot:
    """Axes with their names, which stand as near to their lines as others let them; below it, where it is small.

    least: rem of height.
    """
    low, high = heights
    top, bottom = scale.y(high), scale.y(low)

    def place(value: float) -> float:
        return 100 * (high - value) / (high - low)

    tall = least if least == SMALL else max(least, NAME * len(entries))
    at = figures.spread([place(entry.height) for entry in entries], 100 * NAME / tall, 0.0, 100.0)
    names = [entry.name._replace(end=place(entry.end), at=y) for entry, y in zip(entries, at, strict=True)]
    ticks = _ticks(low, high)
    grid = "".join(f"M0 {scale.y(y)}h{scale.end}" for y in ticks)
    box = f"0 {top} {scale.end} {bottom - top}"
    return Plot(title, box, grid, [(place(y), tick(y)) for y in ticks], sorted(names, key=lambda x: x.at), tall)


def _numbered(name: str, frames: Sequence[Frame]) -> list[Frame]:
    """Frames with an anchor for each arm, `fig_7.3`: no other name of the page has a dot."""
    places: dict[str, str] = {}

    def anchored(one: Name) -> Name:
        if not one.arm or one.arm in places:
            return one
        places[one.arm] = f"{name}.{len(places) + 1}"
        return one._replace(id=places[one.arm])

    return [
        frame._replace(plots=[plot._replace(names=[anchored(one) for one in plot.names]) for plot in frame.plots])
        for frame in frames
    ]


def _seconds(results: Results, study: str, curves: Mapping[str, pd.DataFrame]) -> float:
    """Processor time of the longest curve; 0 where it is not known of every arm."""
    found = [_pace(results, study, arm) * float(rows["step"].max()) for arm, rows in curves.items()]
    return max(found) if min(found) > 0 else 0.0
