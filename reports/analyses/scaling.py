"""Figure 9: final return against the number of agents, for every method of a study that has several such numbers."""

from collections.abc import Mapping
from textwrap import wrap
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from reports.data.frame import FINAL, Results, in_order
from reports.data.stats import Interval, interval
from reports.render.canvas import FAINT, QUIET, Drawing, blank, foot, head, look, styled
from reports.render.figures import spread
from reports.render.tables import NONE, SPAN, Table, estimate, number, readable, seeds, spans, steps

STUDY = "scaling"
LETTERS = 34  # of a name on a line beside the axes


class Sweep(NamedTuple):
    """A study by number of agents: arms by method and number, the methods in the order of the report."""

    study: str
    arms: Mapping[str, Mapping[int, str]]

    @property
    def counts(self) -> list[int]:
        """Every number of agents that is planned."""
        return sorted({count for by_count in self.arms.values() for count in by_count})


def sweep(results: Results, study: str = STUDY) -> Sweep | None:
    """The study as a sweep; None with fewer than two numbers of agents."""
    by_count = results.by_agents(study)
    if len(by_count) < 2:
        return None
    names = in_order(method for arms in by_count.values() for method in arms)
    return Sweep(study, {name: {n: arms[name] for n, arms in by_count.items() if name in arms} for name in names})


def estimates(results: Results, found: Sweep) -> dict[str, dict[int, Interval]]:
    """Mean final return with its interval by method and number of agents; what has no finished run is not in it."""
    return {
        method: {
            count: interval(values) for count, arm in arms.items() if len(values := results.finals(found.study, arm))
        }
        for method, arms in found.arms.items()
    }


def figure(results: Results, found: Sweep) -> Drawing | None:
    """The figure; None as long as no run of the study is finished."""
    values = {method: by_count for method, by_count in estimates(results, found).items() if by_count}
    if not values:
        return None
    yardsticks = _yardsticks(results, found)
    with styled():
        picture = blank(9.0, 5.6)
        head(picture, "Final return by number of agents", _under(results, found))
        axes = picture.add_axes((0.075, 0.16, 0.66, 0.72))
        labels = [_draw(axes, method, values[method], list(values)) for method in reversed(list(values))]
        labels += [_draw_yardstick(axes, name, by_count) for name, by_count in yardsticks.items()]
        axes.set_xticks(found.counts)
        axes.set_xlabel("agents")
        axes.set_ylabel("final return")
        axes.yaxis.set_major_locator(MaxNLocator(8))
        _name(axes, labels)
        bars = spans(x.n for by_count in values.values() for x in by_count.values())
        foot(picture, f"points: mean over seeds; bars: {bars}\n{_missing_words(results, found)}")
    return Drawing(picture, _numbers(values, yardsticks))


def table(results: Results, found: Sweep) -> Table:
    """A row per method, a column per number of agents."""
    values = estimates(results, found)
    shown = []
    for method, arms in found.arms.items():
        cells = {f"{n} agents": _cell(results, found, values[method].get(n), arms.get(n)) for n in found.counts}
        shown.append({"Method": method} | cells)
    note = f"Mean {SPAN} over seeds, and the number of seeds where not all planned ones are finished."
    return Table(
        f"Final return by number of agents, study {found.study}", _numbers(values, {}), pd.DataFrame(shown), note
    )


def _cell(results: Results, found: Sweep, value: Interval | None, arm: str | None) -> str:
    if arm is None:
        return NONE
    done = seeds(results, found.study, arm)
    return estimate(value) + (f"; {done} seeds" if " of " in done else "")


def _under(results: Results, found: Sweep) -> str:
    env, budget = results.env(found.study), results.budget(found.study)
    task = f"{env.get('kind', '')} {env.get('preset', '')}".strip()
    targets = f", {env['targets']} targets" if "targets" in env else ""
    return f"{task}{targets}; {steps(budget) if budget else 'unknown'} steps; profile: {results.profile}"


def _yardsticks(results: Results, found: Sweep) -> dict[str, dict[int, float]]:
    """Yardsticks by number of agents, where they were run."""
    out: dict[str, dict[int, float]] = {}
    env = results.env(found.study)
    for count in found.counts:
        scores = results.yardsticks_on(env | {"agents": count})
        if FINAL in scores:
            for name, value in scores[FINAL].dropna().items():
                out.setdefault(str(name), {})[count] = float(value)
    return out


def _draw(axes: Axes, method: str, values: Mapping[int, Interval], methods: list[str]) -> tuple[float, str, str]:
    own = look(method, methods)
    colour, at, means = own.colour, list(values), [x.value for x in values.values()]
    axes.plot(at, means, linewidth=1.8, zorder=4, **own.marked)
    for n, x in values.items():
        if np.isfinite(x.low):
            axes.plot([n, n], [x.low, x.high], color=colour, linewidth=1.2, alpha=0.6, zorder=3)
    return means[-1], "\n".join(wrap(f"{method} {number(means[-1])}", LETTERS)), colour


def _draw_yardstick(axes: Axes, name: str, values: Mapping[int, float]) -> tuple[float, str, str]:
    dashes = (0, (6, 2)) if name.endswith("_bound") else "-"
    axes.plot(list(values), list(values.values()), color=FAINT, linestyle=dashes, linewidth=1, marker=".", zorder=1)
    last = list(values.values())[-1]
    return last, f"{readable(name)} {number(last)}", QUIET


def _name(axes: Axes, labels: list[tuple[float, str, str]]) -> None:
    low, high = axes.get_ylim()
    heights = [(y - low) / (high - low) for y, _, _ in labels]
    for (_, text, colour), place in zip(labels, spread(heights, 0.043, 0.0, 1.0), strict=True):
        axes.text(1.02, place, text, color=colour, transform=axes.transAxes, fontsize=8.5, va="center")


def _missing_words(results: Results, found: Sweep) -> str:
    absent = [
        f"{method} with {count}"
        for method, arms in found.arms.items()
        for count, arm in arms.items()
        if not len(results.finals(found.study, arm))
    ]
    return f"no finished run yet: {', '.join(absent[:6])}{' and more' if len(absent) > 6 else ''}" if absent else ""


def _numbers(
    values: Mapping[str, Mapping[int, Interval]], yardsticks: Mapping[str, Mapping[int, float]]
) -> pd.DataFrame:
    rows = [
        ("method", method, count, x.value, x.low, x.high, x.n)
        for method, by_count in values.items()
        for count, x in by_count.items()
    ]
    rows += [
        ("yardstick", name, n, value, np.nan, np.nan, 0) for name, by in yardsticks.items() for n, value in by.items()
    ]
    return pd.DataFrame(rows, columns=["kind", "name", "agents", "value", "low", "high", "seeds"])
