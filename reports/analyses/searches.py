"""Gain of a search's budget: the best objective against the number of trials, and the winner of each arm.

The objective is the final return, averaged over the seeds of a trial. Every trial of the budget counts as one, pruned
and failed ones as well; the best is that of complete trials alone, the earliest among equals.
"""

import json
from collections.abc import Mapping
from textwrap import wrap
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from reports.analyses import settings
from reports.data.frame import Results
from reports.data.trials import STATES, params
from reports.render import figures
from reports.render.canvas import Drawing, Look, blank, foot, head, look, styled
from reports.render.tables import NONE, Table, describe_task, joined, number, steps, tick

TRIED = ("complete", "pruned", "failed")  # states of a trial that is over
SPENT = ("complete", "pruned")
OWN = (
    "A trial's value is the mean final return over its seeds. Seeds and evaluation episodes are the search's own. The "
    "best of many trials was chosen for its value, which is therefore too high: a study on other seeds and episodes "
    "says what a winner is worth."
)
COST = (
    "t0 is an arm's first trial, as in the log. Steps are those of all seeds of all trials: budgets are equal in "
    "trials, and a pruned trial trains fewer steps."
)
POINTS = ["arm", "trials", "state", "value", "best"]


def curve(trials: pd.DataFrame) -> pd.DataFrame:
    """The best value so far of an arm, to the last trial that is over: columns trials, state, value, best; or no rows.

    Args:
        trials: of one arm, by index.
    """
    over = trials["state"].isin(TRIED).to_numpy()
    rows = trials.iloc[: int(np.flatnonzero(over)[-1]) + 1 if over.any() else 0]
    values = rows["value"].to_numpy(np.float64)
    found = {"trials": rows["trial"] + 1, "state": rows["state"], "value": values}
    return pd.DataFrame(found | {"best": np.fmax.accumulate(values) if len(values) else values})


def winner(trials: pd.DataFrame) -> pd.Series | None:
    """The complete trial with the highest value, the earliest among equals; None without one."""
    done = trials[trials["state"] == "complete"]
    return done.iloc[int(np.argmax(done["value"]))] if len(done) else None


def heading(results: Results, search: str) -> str:
    """The name of a search, and how much of its budget is spent where not all of it is."""
    states = results.trials.loc[results.trials["search"] == search, "state"]
    spent = int(states.isin(SPENT).sum())
    return f"Search {search}" + ("" if spent == len(states) else f" ({spent} of {len(states)} trials finished)")


def spoken(results: Results, search: str) -> str:
    """The budget of each arm in words: `9 arms, each of 30 trials of 1 seed and 300 k steps`."""
    rows = results.trials[results.trials["search"] == search]
    arms, trials, seeds = rows["arm"].nunique(), int(rows["trial"].max()) + 1, int(rows["seeds"].max())
    length = max((_config(text).get("trainer", {}).get("steps") or 0 for text in rows["config"]), default=0)
    counts = [_count(n, word) for n, word in ((arms, "arm"), (trials, "trial"), (seeds, "seed"))]
    return f"{counts[0]}, each of {counts[1]} of {counts[2]} and {steps(length) if length else 'unknown'} steps"


def _count(n: int, word: str) -> str:
    return f"{n:,} {word}{'s' * (n != 1)}"


def _config(text: str) -> dict[str, Any]:
    """The setting of a trial, which was checked as it was read."""
    return dict(json.loads(text))


def question(results: Results, search: str) -> str:
    """Question of a search."""
    return str(results.trials.loc[results.trials["search"] == search, "question"].iloc[0])


def _env(results: Results, search: str) -> dict[str, Any]:
    return dict(_config(str(results.trials.loc[results.trials["search"] == search, "config"].iloc[0])).get("env", {}))


# Best objective against trials


def fig_trials(results: Results, search: str) -> Drawing | None:
    """A line per arm: the best value so far against the number of trials; None without a complete trial."""
    tried = results.tried(search)
    curves = {arm: rows for arm, trials in tried.items() if (rows := curve(trials))["best"].notna().any()}
    if not curves:
        return None
    env, arms = _env(results, search), list(tried)
    entries = {arm: f"{arm} ({_over(trials)})" for arm, trials in tried.items() if trials["state"].isin(TRIED).any()}
    entries = {arm: "\n".join(wrap(text, figures.LEGEND)) for arm, text in entries.items()}
    columns, lines = figures.legend_size(entries.values())
    labels = [_label(arm, curves[arm], look(arm, arms).colour) for arm in reversed(curves)]
    tall = max(figures.TALL, figures.LINE * sum(label.lines for label in labels))
    with styled():
        height = figures.HEAD + figures.ROW * lines + tall + figures.FOOT
        figure = blank(figures.WIDTH, height)
        axes = figure.add_axes((figures.LEFT, figures.FOOT / height, figures.SHARE, tall / height))
        for arm in reversed(curves):  # the first arm on top
            _draw(axes, curves[arm], look(arm, arms))
        _finish(axes, max(len(trials) for trials in tried.values()), figures.per(results, env.get("kind", "")))
        figures.write_labels(axes, labels, figures.LINE / tall)
        under = f"{describe_task(env)}; {spoken(results, search)}; profile: {results.profile}"
        head(figure, f"Best objective by number of trials, search {search}", under)
        figures.write_legend(figure, entries, arms, columns, (height - figures.HEAD) / height)
        foot(
            figure,
            "line: highest mean final return of a complete trial so far; mark: a trial better than all before it"
            "\nname at the right: best of all trials; in brackets above: trials that are over, also pruned and failed",
        )
    return Drawing(figure, pd.concat([rows.assign(arm=arm) for arm, rows in curves.items()], ignore_index=True)[POINTS])


def _over(trials: pd.DataFrame) -> str:
    """`30 trials`, `12 of 30 trials`."""
    over = int(trials["state"].isin(TRIED).sum())
    return _count(over, "trial") if over == len(trials) else f"{over} of {_count(len(trials), 'trial')}"


def _label(arm: str, rows: pd.DataFrame, colour: str) -> figures.Label:
    best = float(rows["best"].iloc[-1])
    text = "\n".join(wrap(f"{arm} {number(best)}", figures.LETTERS, break_on_hyphens=False))
    return figures.Label(best, text, colour, True)


def _draw(axes: Axes, rows: pd.DataFrame, look: Look) -> None:
    axes.step(rows["trials"], rows["best"], where="post", linewidth=1.7, zorder=3, **look.line)
    better = rows[rows["best"].diff().ne(0) & rows["best"].notna()]
    axes.plot(better["trials"], better["best"], zorder=4, **look.marked | {"linestyle": ""})


def _finish(axes: Axes, trials: int, per: str) -> None:
    axes.set_xlim(1, max(trials, 2))
    axes.xaxis.set_major_locator(MaxNLocator(10, integer=True))
    axes.yaxis.set_major_formatter(tick)
    axes.set_xlabel("trials")
    axes.set_ylabel(f"best final return so far ({per})")


def described(results: Results, search: str) -> str:
    """The figure in words."""
    best = {arm: one for arm, trials in results.tried(search).items() if (one := winner(trials)) is not None}
    words = joined(f"{arm} {number(one['value'])} in t{one['trial']}" for arm, one in best.items())
    return f"Step chart of the best final return so far against trials. Best: {words}."


# Winners


def table_winners(results: Results, search: str) -> Table:
    """A row per arm, best value first and those without one last: its trials, the best of them and what they cost."""
    tried = results.tried(search)
    best = {arm: winner(trials) for arm, trials in tried.items()}
    order = sorted(tried, key=lambda arm: np.inf if (one := best[arm]) is None else -float(one["value"]))
    pace = {arm: {} if (one := best[arm]) is None else settings.replayed(_config(one["config"])) for arm in order}
    numbers = pd.DataFrame([_numbers(search, arm, tried[arm], best[arm], pace[arm]) for arm in order])
    shown = [
        {
            "Arm": row["arm"],
            "Trials": ", ".join(f"{row[state]} {state}" for state in STATES if row[state]),
            "Best": number(row["value"]),
            "In trial": NONE if best[row["arm"]] is None else f"t{row['trial']:.0f}",
            "Settings of the best": settings.words(params(row["params"])) or NONE,
            "Steps trained in all": steps(row["steps"]),
            "Rows replayed per environment step": settings.paced(pace[row["arm"]]),
        }
        for row in numbers.to_dict("records")
    ]
    note = f"{spoken(results, search)}. {OWN} {COST} {settings.PACE}"
    return Table(f"Winners of search {search}", numbers, pd.DataFrame(shown), note)


def _numbers(
    search: str, arm: str, trials: pd.DataFrame, best: pd.Series | None, pace: Mapping[str, float]
) -> dict[str, Any]:
    """A row of the winners with full digits; `trial` is the index in the budget, from 0."""
    found = {"value": np.nan, "trial": np.nan, "params": "{}"}
    if best is not None:
        found = {name: best[name] for name in found}
    first = trials.iloc[0]
    counts = trials["state"].value_counts()
    return (
        {"search": search, "arm": arm, "method": first["algorithm"], "fingerprint": first["fingerprint"]}
        | {state: int(counts.get(state, 0)) for state in STATES}
        | found
        | {"steps": int((trials["steps"] * trials["seeds"]).sum())}
        | {f"replayed_{level}".rstrip("_"): rate for level, rate in pace.items()}
    )
