"""Effects of the regulation mechanism and of the filter against alpha of Eq. 6, and the rewards behind them.

An effect is the mean final return of an arm less that of the same arm without the part, at one alpha; above zero the
part helps. Configurations say which arms these are: all their other settings are the same. An effect counts as soon as
both arms have a finished seed.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from reports.data.frame import Results
from reports.data.stats import Interval, curve, difference, interval
from reports.render.canvas import BLUE, GREEN, MARGIN, ORANGE, QUIET, Drawing, blank, foot, head, styled
from reports.render.figures import spread
from reports.render.tables import SPAN, Table, capital, describe_task, estimate, number, seeds, spans, steps, tick

STUDY = "alpha_regulation"
NONE = "none"  # the regulator that bounds nothing
NAMES = {"exact": "full", "paper": "Algorithm 1"}  # of regulators, as the study names its arms
BLUES = ("#6FB1DC", BLUE, "#003A5C")  # of horizons, the longest darkest
OWN = {"Algorithm 1": (ORANGE, "--"), "with regulation": (GREEN, "-"), "without regulation": (QUIET, "--")}
APART = 0.09  # of lines at one alpha, in places of the axis
QUANTITIES = (("assigned", "assigned pairs"), ("earned", "executed reward, Eq. 6"), ("regulated", "after regulation"))

Part = Literal["regulation", "filter"]


class Arm(NamedTuple):
    """An arm as its configuration has it; `rest` is every other setting but the seed."""

    alpha: float
    regulator: str
    horizon: int  # 0 without a regulator
    filtered: bool
    rest: str


class Effect(NamedTuple):
    """An arm with a part against the one without it, at one alpha; `line` names those of other alphas as well."""

    part: Part
    line: str
    horizon: int
    alpha: float
    arm: str
    without: str


def is_of(study: str) -> bool:
    """True for the study and its variants."""
    return study.partition("@")[0] == STUDY


def effects(results: Results, study: str) -> list[Effect]:
    """Every effect that is planned: regulation by horizon, then the filter, each by alpha."""
    found = {arm: name for name, config in results.configs(study).items() if (arm := _arm(config))}
    out = []
    for arm, name in found.items():
        bare = found.get(arm._replace(regulator=NONE, horizon=0))
        if arm.filtered and arm.regulator != NONE and bare:
            out.append(Effect("regulation", _line(arm), arm.horizon, arm.alpha, name, bare))
        open_ = found.get(arm._replace(filtered=False))
        if arm.filtered and open_:
            words = "without regulation" if arm.regulator == NONE else f"with regulation, {_line(arm)}"
            out.append(Effect("filter", words, arm.horizon, arm.alpha, name, open_))
    return sorted(out, key=lambda x: (x.part != "regulation", *_place(x.line), x.horizon, x.line, x.alpha))


def _arm(config: Mapping[str, Any]) -> Arm | None:
    """The arm of a configuration; None if it says nothing on regulation."""
    algo = dict(config.get("algo", {}))
    alpha, regulator, horizon, filtered = (algo.pop(name, None) for name in ("alpha", "regulator", "horizon", "filter"))
    if not isinstance(alpha, int | float) or not isinstance(horizon, int) or not isinstance(regulator, str):
        return None
    others = {name: value for name, value in config.items() if name != "seed"} | {"algo": algo}
    reach = 0 if regulator == NONE else horizon
    return Arm(float(alpha), regulator, reach, filtered == "on", json.dumps(others, sort_keys=True))


def _line(arm: Arm) -> str:
    if arm.regulator == "exact":
        return f"horizon {arm.horizon}"
    name = NAMES.get(arm.regulator, arm.regulator)
    return name if arm.horizon == 1 else f"{name}, horizon {arm.horizon}"


def _place(line: str) -> tuple[bool, bool]:
    """Horizons first, and what is without regulation last."""
    return (line.startswith("Algorithm"), line.startswith("without"))


def measured(results: Results, study: str, found: Effect) -> Interval | None:
    """The effect with its interval; None as long as an arm has no finished seed."""
    both = [results.finals(study, arm) for arm in (found.arm, found.without)]
    return difference(*both) if all(len(values) for values in both) else None


# Effects against alpha


def fig_effects(results: Results, study: str) -> Drawing | None:
    """Left the effect of regulation, right that of the filter, against alpha; None without any."""
    planned = effects(results, study)
    alphas = sorted({one.alpha for one in planned})
    drawn = {one: value for one in planned if (value := measured(results, study, one))}
    if not drawn:
        return None
    panels: dict[Part, str] = {
        "regulation": "of regulation: with it less 'no regulation'",
        "filter": "of the filter: with it less without it",
    }
    with styled():
        figure = blank(10.4, 4.6)
        head(figure, "Effect of regulation and of the filter by alpha", _under(results, study))
        for n, (part, title) in enumerate(panels.items()):
            axes = figure.add_axes((0.065 + 0.47 * n, 0.2, 0.3, 0.6))
            axes.set_title(title, fontsize=9.5, loc="left")
            _draw_effects(axes, results, study, {one: x for one, x in drawn.items() if one.part == part})
            _finish(axes, alphas)
        bars = spans(value.n for value in drawn.values())
        foot(
            figure,
            f"points: difference of mean final returns; bars: {bars}\nhollow: some planned seeds are not finished; "
            "above zero the part helps; the scales of both sides differ",
        )
    return Drawing(figure, _numbers(results, study, list(drawn)))


def _under(results: Results, study: str) -> str:
    budget = results.budget(study)
    length = steps(budget) if budget else "unknown"
    return f"{describe_task(results.env(study))}; {length} steps; profile: {results.profile}"


def _draw_effects(axes: Axes, results: Results, study: str, drawn: Mapping[Effect, Interval]) -> None:
    axes.axhline(0, color=QUIET, linewidth=1.1, zorder=1)
    places = {alpha: n for n, alpha in enumerate(sorted({one.alpha for one in effects(results, study)}))}
    lines = list(dict.fromkeys(one.line for one in drawn))
    labels = []
    for n, line in enumerate(lines):
        mine = {one: value for one, value in drawn.items() if one.line == line}
        colour, dashes = _look(line, lines)
        at = [places[one.alpha] + APART * (n - (len(lines) - 1) / 2) for one in mine]
        means = [value.value for value in mine.values()]
        axes.plot(at, means, color=colour, linestyle=dashes, linewidth=1.5, alpha=0.85, zorder=3)
        for x, (one, value) in zip(at, mine.items(), strict=True):
            face = colour if _whole(results, study, one) else "white"
            axes.plot(x, value.value, "o", markersize=4.5, color=colour, markerfacecolor=face, zorder=5)
            axes.vlines(x, value.low, value.high, color=colour, linewidth=1.3, alpha=0.75, zorder=4)
        labels.append((means[-1], line.replace(", ", ",\n"), colour))
    if not labels:
        axes.text(0.5, 0.55, "no two such arms are finished", color=QUIET, transform=axes.transAxes, ha="center")
        axes.tick_params(labelleft=False)
    low, high = axes.get_ylim()
    heights = [(y - low) / (high - low) for y, _, _ in labels]
    sizes = [0.065 * (1 + text.count("\n")) for _, text, _ in labels]
    for (_, text, colour), place in zip(labels, spread(heights, sizes, 0.0, 1.0), strict=True):
        axes.text(1.03, place, text, color=colour, transform=axes.transAxes, fontsize=8.5, va="center")


def _look(line: str, lines: Sequence[str]) -> tuple[str, str]:
    """Colour and dashes of a line: horizons from light to dark, the others by what they begin with."""
    for name, own in OWN.items():
        if line.startswith(name):
            return own
    horizons = [name for name in lines if not name.startswith(tuple(OWN))]
    place = horizons.index(line) / max(1, len(horizons) - 1)
    return BLUES[round(place * (len(BLUES) - 1))] if len(horizons) > 1 else BLUE, "-"


def _whole(results: Results, study: str, found: Effect) -> bool:
    return all(len(results.finals(study, a)) == len(results.plan(study, a)) for a in (found.arm, found.without))


def _finish(axes: Axes, alphas: Sequence[float]) -> None:
    axes.set_xlim(-0.4, len(alphas) - 0.6)
    axes.set_xticks(range(len(alphas)), [f"{alpha:g}" for alpha in alphas])
    axes.set_xlabel("alpha of Eq. 6")
    axes.set_ylabel("effect, points of final return")
    axes.yaxis.set_major_locator(MaxNLocator(7))
    axes.yaxis.set_major_formatter(tick)


def table_effects(results: Results, study: str) -> Table | None:
    """A row per effect and alpha, those that wait for runs as well; None without a finished one."""
    planned = effects(results, study)
    if not any(measured(results, study, one) for one in planned):
        return None
    numbers = _numbers(results, study, planned)
    shown = [
        {
            "Effect of": one.part,
            "In": one.line,
            "alpha": f"{one.alpha:g}",
            f"Effect {SPAN}": estimate(measured(results, study, one)),
            "Mean, with": number(row["mean"]),
            "Mean, without": number(row["mean_without"]),
            "Seeds: with, without": "; ".join(seeds(results, study, arm) for arm in (one.arm, one.without)),
        }
        for one, row in zip(planned, numbers.to_dict("records"), strict=True)
    ]
    note = (
        "Effect: mean final return of the arm with the part less that of the arm without it, all other settings the "
        "same; above zero the part helps. Regulation is taken off with the filter on."
    )
    title = f"Effect of regulation and of the filter by alpha, study {study}"
    return Table(title, numbers, pd.DataFrame(shown), note)


def described(results: Results, study: str) -> str:
    """The effects in words."""
    lines: dict[str, list[str]] = {}
    for one in effects(results, study):
        if value := measured(results, study, one):
            lines.setdefault(f"{one.part}, {one.line}", []).append(f"{number(value.value)} at {one.alpha:g}")
    words = "; ".join(f"{name} {', '.join(values)}" for name, values in lines.items())
    return f"Two charts of effects on the final return by alpha. {capital(words)}."


def _numbers(results: Results, study: str, found: Sequence[Effect]) -> pd.DataFrame:
    rows = []
    for one in found:
        value = measured(results, study, one) or Interval(np.nan, np.nan, np.nan, 0)
        finals = {"": results.finals(study, one.arm), "_without": results.finals(study, one.without)}
        rows.append(
            {"effect": one.part, "line": one.line, "alpha": one.alpha}
            | {"value": value.value, "low": value.low, "high": value.high}
            | {f"seeds{end}": len(values) for end, values in finals.items()}
            | {f"mean{end}": float(values.mean()) if len(values) else np.nan for end, values in finals.items()}
            | {"arm": one.arm, "without": one.without}
        )
    return pd.DataFrame(rows)


# The mechanism


def mechanism(results: Results, study: str) -> dict[float, Effect]:
    """By alpha: an exact regulator against none, with the longest horizon that has points."""
    known = [
        one
        for one in effects(results, study)
        if one.part == "regulation" and one.line.startswith("horizon") and len(_points(results, study, one.arm))
    ]
    longest = max((one.horizon for one in known), default=0)
    return {one.alpha: one for one in known if one.horizon == longest}


def _points(results: Results, study: str, arm: str, quantity: str = QUANTITIES[0][0]) -> pd.DataFrame:
    """Curve that an arm logged of a quantity while it trained."""
    rows = results.curve(study, arm, f"train/{quantity}")
    return rows[np.isfinite(rows["value"].astype(float))]


def fig_mechanism(results: Results, study: str) -> Drawing | None:
    """A column per alpha: pairs assigned, reward earned, and reward after regulation; None without points."""
    columns = mechanism(results, study)
    if not columns:
        return None
    horizon, parts = next(iter(columns.values())).horizon, []
    names = {f"full, horizon {horizon}": BLUE, "no regulation": ORANGE}
    counts: dict[str, set[int]] = {name: set() for name in names}
    with styled():
        figure = blank(10.4, 6.6)
        head(figure, "The mechanism, seen: what is assigned, earned and learned from", _under(results, study))
        shared: dict[str, Axes] = {}  # pairs are on one scale everywhere, both rewards of a column on one of their own
        for n, (alpha, one) in enumerate(columns.items()):
            left, wide = 0.075 + 0.925 / len(columns) * n, 0.925 / len(columns) - 0.045
            for row, (quantity, words) in enumerate(QUANTITIES):
                scale = "pairs" if not row else f"{alpha}"
                axes = figure.add_axes((left, 0.665 - 0.245 * row, wide, 0.19), sharey=shared.get(scale))
                shared.setdefault(scale, axes)
                for (name, colour), arm in zip(names.items(), (one.arm, one.without), strict=True):
                    points = _points(results, study, arm, quantity)
                    if len(points):
                        parts.append(_draw_band(axes, points, colour).assign(alpha=alpha, arm=name, quantity=quantity))
                        counts[name].add(points["seed"].nunique())
                _finish_small(axes, f"alpha {alpha:g}" if not row else "", words if not n else "", last=row == 2)
        shared["pairs"].set_ylim(bottom=0)
        _name(figure, names, counts)
        foot(
            figure,
            "means over the rows that the coordinator learned from, rewards per step, against environment steps\nband: "
            f"{spans(n for rows in parts for n in rows['n'])}; assigned pairs are on one scale; so are both rewards of "
            "an alpha",
        )
    order = ["alpha", "arm", "quantity", "step", "mean", "low", "high", "n"]
    return Drawing(figure, pd.concat(parts, ignore_index=True)[order])


def _draw_band(axes: Axes, points: pd.DataFrame, colour: str) -> pd.DataFrame:
    rows = curve(points)
    axes.plot(rows["step"], rows["mean"], color=colour, linewidth=1.7)
    axes.fill_between(rows["step"], rows["low"], rows["high"], color=colour, alpha=0.16, linewidth=0)
    return rows


def _name(figure: Figure, names: Mapping[str, str], counts: Mapping[str, set[int]]) -> None:
    """The two arms with their numbers of seeds, below the axes."""
    lines, words = [], []
    for name, colour in names.items():
        lines.append(Line2D([], [], color=colour, linewidth=1.9))
        span = " to ".join(map(str, sorted({min(counts[name], default=0), max(counts[name], default=0)})))
        words.append(f"{name} ({span} {'seed' if span == '1' else 'seeds'})")
    how: dict[str, Any] = {"ncols": 2, "frameon": False, "fontsize": 9, "borderpad": 0.0, "borderaxespad": 0.0}
    figure.legend(lines, words, loc="lower left", bbox_to_anchor=(MARGIN, 0.085), **how)


def _finish_small(axes: Axes, title: str, words: str, *, last: bool) -> None:
    axes.set_title(title, fontsize=9.5, loc="left")
    axes.set_ylabel(words, fontsize=8.5)
    axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: steps(x)))
    axes.yaxis.set_major_formatter(tick)
    axes.tick_params(labelsize=7.5, labelbottom=last)


def table_mechanism(results: Results, study: str) -> Table | None:
    """A row per alpha and arm: what the figure shows, in the last tenth of the points; None without points."""
    numbers, shown = [], []
    for alpha, one in mechanism(results, study).items():
        for name, arm in ((f"full, {one.line}", one.arm), ("no regulation", one.without)):
            found = {quantity: _last(_points(results, study, arm, quantity)) for quantity, _ in QUANTITIES}
            if all(value is None for value in found.values()):
                continue
            numbers += [
                {"alpha": alpha, "arm": name, "quantity": quantity} | value._asdict()
                for quantity, value in found.items()
                if value
            ]
            cells = {capital(words): _fine(found[quantity]) for quantity, words in QUANTITIES}
            shown.append({"alpha": f"{alpha:g}", "Arm": name} | cells)
            shown[-1]["Seeds"] = str(max(value.n for value in found.values() if value))
    if not shown:
        return None
    note = f"Mean over seeds {SPAN} in the last tenth of the points of each run's curve, unfinished runs included."
    title = f"Assigned, earned and learned from by alpha, study {study}"
    return Table(title, pd.DataFrame(numbers), pd.DataFrame(shown), note)


def _last(points: pd.DataFrame) -> Interval | None:
    """The mean of each seed's last tenth of points, over seeds."""
    means = [rows["value"].tail(-(-len(rows) // 10)).mean() for _, rows in points.groupby("seed")]
    return interval(np.array(means, dtype=np.float64)) if means else None


def _fine(found: Interval | None) -> str:
    return estimate(found, lambda x: number(x, 2))
