"""Analyses beyond the paper: assignments while training, transfer to other numbers, and the effect of the encoder."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, MaxNLocator

from reports.data.frame import ASSIGN, FINAL, Results
from reports.data.stats import Interval, curve, difference, interval
from reports.render.canvas import FAINT, QUIET, Drawing, blank, foot, head, look, styled
from reports.render.figures import MARKS, spread
from reports.render.tables import NONE, SPAN, Table, describe_task, estimate, number, readable, seeds, spans, steps

PANELS = (
    ("pairs", "assigned pairs"),
    ("conflicts", "targets with two agents or more"),
    ("free", "targets with no agent"),
)
LETTERS = 60  # of a name on a line of a legend
BESIDE_TRANSFER = ("best_window", "planner", "free_heading_bound")  # beside transferred policies


class Axis(NamedTuple):
    """One of the numbers that a policy is transferred along; `fixed` is the other, which stays as trained."""

    name: str
    fixed: str
    words: str


AXES = (Axis("agents", "targets", "sensors"), Axis("targets", "agents", "targets"))


# Assignments


def assigning(results: Results, study: str) -> list[str]:
    """Arms of a study whose assignments were watched."""
    rows = results.points[(results.points["study"] == study) & (results.points["metric"] == f"{ASSIGN}pairs")]
    return [arm for arm in results.arms(study) if arm in set(rows["arm"])]


def fig_assignments(results: Results, study: str) -> Drawing | None:
    """Assigned pairs, conflicts and free targets along the training; None where nothing was watched."""
    arms = assigning(results, study)
    if not arms:
        return None
    parts = []
    with styled():
        figure = blank(9.6, 4.3)
        head(figure, f"What is assigned while training, study {study}", describe_task(results.env(study)))
        handles: dict[str, Any] = {}
        for n, (metric, words) in enumerate(PANELS):
            axes = figure.add_axes((0.055 + 0.318 * n, 0.27, 0.27, 0.53))
            axes.set_title(words, fontsize=9, loc="left")
            for arm in arms:
                rows = curve(results.curve(study, arm, f"{ASSIGN}{metric}"))
                own = look(arm, results.arms(study))
                drawn = own.marked | {"markevery": max(1, len(rows) // MARKS), "linewidth": 1.8}
                (handles[arm],) = axes.plot(rows["step"], rows["mean"], **drawn)
                axes.fill_between(rows["step"], rows["low"], rows["high"], color=own.colour, alpha=0.16, linewidth=0)
                parts.append(rows.assign(arm=arm, quantity=metric))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: steps(x)))
            axes.xaxis.set_major_locator(MaxNLocator(4))
            axes.set_ylim(bottom=0)
        names = ["\n".join(wrap(f"{arm} ({_count(results, study, arm)})", LETTERS)) for arm in arms]
        how: dict[str, Any] = {"ncols": min(4, len(arms)), "frameon": False, "fontsize": 8.5}
        figure.legend(list(handles.values()), names, loc="lower left", bbox_to_anchor=(0.03, 0.07), **how)
        words = "mean per state of the training itself, exploration included, against environment steps"
        foot(figure, f"{words}; band: {spans(n for rows in parts for n in rows['n'])}")
    columns = ["arm", "quantity", "step", "mean", "low", "high", "n"]
    return Drawing(figure, pd.concat(parts, ignore_index=True)[columns])


def table_assignments(results: Results, study: str) -> Table | None:
    """Assignments of arms in the first and last tenth of their training, and the shortfall of Algorithm 1."""
    numbers, shown = [], []
    for arm in assigning(results, study):
        first, last, whole = (_tenths(results, study, arm, part) for part in ("first", "last", "whole"))
        horizons = sorted(int(name.removeprefix("lost_h")) for name in whole if name.startswith("lost_h"))
        lost = {h: whole[f"lost_h{h}"] for h in horizons}
        gaps = {h: whole[f"gap_h{h}"] for h in horizons}
        numbers.append(
            {"study": study, "arm": arm, "seeds": _seeds(results, study, arm), "states": whole["states"]}
            | {f"{name}_first": first[name] for name, _ in PANELS}
            | {f"{name}_last": last[name] for name, _ in PANELS}
            | {"idle_last": last["idle"]}
            | {f"lost_h{h}": x for h, x in lost.items()}
            | {f"gap_h{h}": x for h, x in gaps.items()}
        )
        shown.append(
            {"Arm": arm}
            | {f"{words.capitalize()}, first → last": f"{first[n]:.2f} → {last[n]:.2f}" for n, words in PANELS}
            | {"Idle agents, last": f"{last['idle']:.2f}"}
            | {f"Algorithm 1 short, horizon {h}": f"{100 * x:.2f} %" for h, x in lost.items()}
            | {f"Mean gap there, horizon {h}": number(gaps[h], 2) for h in horizons}
            | {"Seeds": _count(results, study, arm)}
        )
    if not numbers:
        return None
    note = (
        "Per state met in training. First and last: a tenth of the points of the curve. Algorithm 1 short: share of "
        "all those states, with the assignment held in them, where Algorithm 1 is below the optimum of Eq. 6 "
        "(alpha 0.1); the gap is the mean over these."
    )
    title = f"What is assigned, and Algorithm 1 in the states met, study {study}"
    return Table(title, pd.DataFrame(numbers), pd.DataFrame(shown).fillna(NONE), note)


def _tenths(results: Results, study: str, arm: str, part: str) -> dict[str, float]:
    """Means over the first or last tenth of the points, or all, by states; of gaps, by the states that are lost."""
    chosen = results.points[(results.points["study"] == study) & (results.points["arm"] == arm)]
    chosen = chosen[chosen["metric"].str.startswith(ASSIGN)]
    wide = chosen.pivot_table(index=["seed", "step"], columns="metric", values="value").reset_index()
    wide.columns = pd.Index([str(name).removeprefix(ASSIGN) for name in wide.columns])
    at = np.sort(wide["step"].unique())
    tenth = max(1, round(len(at) / 10))
    kept = {"first": at[:tenth], "last": at[-tenth:], "whole": at}[part]
    rows = wide[wide["step"].isin(kept)]
    weights = rows["states"].to_numpy(np.float64)
    out = {"states": float(weights.sum())}
    for name in rows.columns.difference(["seed", "step", "states"]):
        horizon = name.removeprefix("gap_h")
        own = weights * rows[f"lost_h{horizon}"].to_numpy(np.float64) if name.startswith("gap_h") else weights
        total = float(own.sum())
        out[str(name)] = float((own * rows[name].to_numpy(np.float64)).sum() / total) if total else np.nan
    return out


def _seeds(results: Results, study: str, arm: str) -> int:
    return int(results.curve(study, arm, f"{ASSIGN}pairs")["seed"].nunique())


def _count(results: Results, study: str, arm: str) -> str:
    done, planned = _seeds(results, study, arm), len(results.plan(study, arm))
    return f"{done} of {planned} seeds" if done < planned else f"{done} seeds"


# Transfer


def transferred(results: Results) -> dict[str, dict[str, dict[int, Interval]]]:
    """By axis, arm and number: mean return over seeds, the other number as trained. Empty if nothing was played."""
    table = results.moved
    out: dict[str, dict[str, dict[int, Interval]]] = {}
    for axis in AXES:
        rows = table[table[axis.fixed] == table[f"trained_{axis.fixed}"]]
        counts = {
            str(arm): {int(str(n)): interval(x["value"].to_numpy(np.float64)) for n, x in group.groupby(axis.name)}
            for arm, group in rows.groupby("arm")
        }
        out[axis.name] = {arm: by for arm, by in counts.items() if len(by) > 1}
    return {name: arms for name, arms in out.items() if arms}


def fig_transfer(results: Results) -> Drawing | None:
    """Return of policies with other numbers than they were trained with, yardsticks beside; None if none played."""
    found = transferred(results)
    if not found:
        return None
    rows: list[tuple[object, ...]] = []
    with styled():
        figure = blank(11.0, 5.4)
        trained = f"trained with {_trained(results, 'agents')} sensors and {_trained(results, 'targets')} targets"
        head(figure, "Trained once, played with other numbers", f"{results.moved['task'].iloc[0]}; {trained}")
        for n, axis in enumerate(axis for axis in AXES if axis.name in found):
            axes = figure.add_axes((0.055 + 0.49 * n, 0.17, 0.29, 0.67))
            yardsticks = _yardsticks(results, axis, sorted({count for by in found[axis.name].values() for count in by}))
            _panel(axes, found[axis.name], yardsticks, axis, _trained(results, axis.name))
            rows += [
                (axis.name, "method", arm, count, *x) for arm, by in found[axis.name].items() for count, x in by.items()
            ]
            rows += [
                (axis.name, "yardstick", name, count, value, np.nan, np.nan, 0)
                for name, by in yardsticks.items()
                for count, value in by.items()
            ]
        bars = spans(x.n for arms in found.values() for by in arms.values() for x in by.values())
        words = f"points: mean over seeds; bars: {bars}; grey bar: as trained; grey lines: without"
        foot(figure, f"{words} learning, and a bound")
    columns = ["along", "kind", "name", "count", "value", "low", "high", "seeds"]
    return Drawing(figure, pd.DataFrame(rows, columns=columns))


def table_transfer(results: Results) -> Table | None:
    """A row per arm, a column per size; None if none were played."""
    table = results.moved
    if table.empty:
        return None
    sizes = sorted(set(zip(table["agents"].astype(int), table["targets"].astype(int), strict=True)))
    numbers, shown = [], []
    for arm in _arms(table):
        cells = {"Arm": arm}
        for n, m in sizes:
            mine = table[(table["arm"] == arm) & (table["agents"] == n) & (table["targets"] == m)]
            found = interval(mine["value"].to_numpy(np.float64)) if len(mine) else None
            cells[f"{n} x {m}"] = estimate(found)
            if found:
                numbers.append({"arm": arm, "agents": n, "targets": m} | found._asdict())
        shown.append(cells)
    for name in BESIDE_TRANSFER:
        cells = {"Arm": readable(name)}
        for n, m in sizes:
            value = _yardstick(results, name, n, m)
            cells[f"{n} x {m}"] = number(value)
            numbers.append({"arm": name, "agents": n, "targets": m, "value": value, "n": 0})
        shown.append(cells)
    note = (
        f"Sensors x targets; policies trained with {_trained(results, 'agents')} x {_trained(results, 'targets')}, no "
        f"step of training with the others; mean {SPAN} over seeds. Below the methods: without learning, and a bound."
    )
    return Table("Transfer to other numbers of sensors and targets", pd.DataFrame(numbers), pd.DataFrame(shown), note)


def _arms(table: pd.DataFrame) -> list[str]:
    """Best first, by the mean over all sizes."""
    means = table.groupby("arm")["value"].mean().sort_values(ascending=False)
    return [str(arm) for arm in means.index]


def _trained(results: Results, name: str) -> int:
    return int(results.moved[f"trained_{name}"].iloc[0])


def _yardstick(results: Results, name: str, agents: int, targets: int) -> float:
    env = results.env(str(results.moved["study"].iloc[0])) | {"agents": agents, "targets": targets}
    scores = results.yardsticks_on(env)
    return float(scores[FINAL][name]) if FINAL in scores and name in scores.index else float("nan")


def _yardsticks(results: Results, axis: Axis, counts: Sequence[int]) -> dict[str, dict[int, float]]:
    found: dict[str, dict[int, float]] = {}
    for name in BESIDE_TRANSFER:
        for count in counts:
            numbers = {axis.name: count, axis.fixed: _trained(results, axis.fixed)}
            if np.isfinite(value := _yardstick(results, name, numbers["agents"], numbers["targets"])):
                found.setdefault(name, {})[count] = value
    return found


def _panel(
    axes: Axes,
    arms: Mapping[str, Mapping[int, Interval]],
    yardsticks: Mapping[str, Mapping[int, float]],
    axis: Axis,
    trained: int,
) -> None:
    axes.axvline(trained, color=FAINT, linewidth=6, alpha=0.35, zorder=0)
    labels = []
    for name, line in yardsticks.items():
        dashes = (0, (6, 2)) if name.endswith("_bound") else "-"
        axes.plot(list(line), list(line.values()), color=FAINT, linestyle=dashes, linewidth=1.2, marker=".", zorder=1)
        labels.append((list(line.values())[-1], f"{readable(name)} {number(list(line.values())[-1])}", QUIET))
    for arm, by in arms.items():
        colour, means = look(arm, list(arms)).colour, [x.value for x in by.values()]
        axes.plot(list(by), means, linewidth=1.7, zorder=4, **look(arm, list(arms)).marked)
        for count, x in by.items():
            if np.isfinite(x.low):
                axes.plot([count, count], [x.low, x.high], color=colour, linewidth=1.2, alpha=0.6, zorder=3)
        labels.append((means[-1], "\n".join(wrap(f"{arm} {number(means[-1])}", LETTERS // 2)), colour))
    axes.set_xticks(sorted({count for by in arms.values() for count in by}))
    axes.set_xlabel(axis.words)
    axes.set_ylabel("return")
    low, high = axes.get_ylim()
    places = spread([(y - low) / (high - low) for y, _, _ in labels], 0.05, 0.0, 1.0)
    for (_, text, colour), place in zip(labels, places, strict=True):
        axes.text(1.03, place, text, color=colour, transform=axes.transAxes, fontsize=8.5, va="center")


# Yardsticks by number, and the encoder


def table_numbers(results: Results) -> Table | None:
    """Yardsticks of coverage by number of sensors; None with fewer than two numbers."""
    found = {
        (int(task["agents"]), int(task["targets"])): scores
        for task, scores in results.yardsticks
        if task.get("kind") == "coverage" and task.get("preset") == "flat" and FINAL in scores
    }
    if len(found) < 2:
        return None
    names = sorted({str(name) for scores in found.values() for name in scores.index})
    value = {
        (name, size): float(scores[FINAL][name]) if name in scores.index else np.nan
        for size, scores in found.items()
        for name in names
    }
    order = sorted(names, key=lambda name: np.nanmean([value[name, size] for size in found]))
    numbers = [
        {"policy": name, "agents": n, "targets": m, "value": value[name, (n, m)]} for name in order for n, m in found
    ]
    shown = [
        {"Policy": readable(name)} | {f"{n} x {m}": number(value[name, (n, m)]) for n, m in sorted(found)}
        for name in order
    ]
    title = "Yardsticks by numbers of sensors x targets, coverage flat"
    return Table(title, pd.DataFrame(numbers), pd.DataFrame(shown))


def table_encoder(results: Results) -> Table | None:
    """Every two arms that differ in their encoder alone: what it is worth; None without such arms."""
    numbers, shown = [], []
    for study in results.studies:
        configs = results.configs(study)
        for a, b in combinations(configs, 2):
            if _but_encoder(configs[a]) != _but_encoder(configs[b]) or configs[a] == configs[b]:
                continue
            if {configs[arm]["algo"].get("encoder") for arm in (a, b)} != {"mlp", "pairwise"}:
                continue  # encoders with memory are another question
            flat, pairwise = sorted((a, b), key=lambda arm: str(configs[arm]["algo"].get("encoder")))
            x, y = results.finals(study, pairwise), results.finals(study, flat)
            gap = difference(x, y) if len(x) and len(y) else None
            numbers.append(
                {"study": study, "pairwise": pairwise, "flat": flat, "method": configs[a]["algo"]["kind"]}
                | {"pairwise_mean": _mean(x), "flat_mean": _mean(y)}
                | ({"difference": gap.value, "low": gap.low, "high": gap.high} if gap else {})
            )
            shown.append(
                {
                    "Study": study,
                    "Method": str(configs[a]["algo"]["kind"]),
                    "Pairwise": pairwise,
                    "Fully connected": flat,
                }
                | {"Pairwise, final": number(_mean(x)), "Fully connected, final": number(_mean(y))}
                | {f"Difference {SPAN}": estimate(gap)}
                | {"Seeds": f"{seeds(results, study, pairwise)}; {seeds(results, study, flat)}"}
            )
    if not numbers:
        return None
    note = (
        "Arms of one study whose settings differ in `encoder` alone: one network over pairs, pooled, or one over all."
    )
    return Table("What the encoder is worth", pd.DataFrame(numbers), pd.DataFrame(shown), note)


def _but_encoder(config: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration without its encoder and its seed."""
    algo = {name: value for name, value in config.get("algo", {}).items() if name != "encoder"}
    return {name: value for name, value in config.items() if name != "seed"} | {"algo": algo}


def _mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else float("nan")
