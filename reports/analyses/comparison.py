"""Arms of one study against each other: pairs, performance profiles, probability of improvement, sample efficiency.

All of it is over seeds. Every run of a study plays the same evaluation episodes at its end, so their luck is the same
for all arms and cancels in a difference; single episodes are not exported, so there is nothing to pair below a seed.
"""

from collections.abc import Iterable, Sequence
from itertools import combinations
from math import comb
from textwrap import wrap
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from reports.data.frame import FINAL, Results
from reports.data.stats import Interval, area, difference, first_at, holm, improvement, interval, welch
from reports.render.canvas import Drawing, blank, foot, head, look, styled
from reports.render.tables import MEASURED, NONE, SPAN, Table, estimate, joined, number, steps

LETTERS, LONGEST = 44, 60  # of a name on a line of a legend, and beside a matrix
MOST = 12  # arms of a matrix that can still be read
MANY = MOST * (MOST - 1) // 2  # pairs of a table that is read from its beginning to its end
CLEAR = 0.05  # p after Holm's correction
LEVEL_SHARE = 0.9  # of the best arm's mean final return, where no yardstick gives a level
LEVEL_YARDSTICK = {"coverage": "best_window", "navigation": "nearest"}  # each agent alone, without learning


class Pair(NamedTuple):
    """Two arms. `p` is Welch's, `corrected` after Holm over all pairs of the study."""

    first: str
    second: str
    difference: Interval
    better: Interval
    p: float
    corrected: float


class Level(NamedTuple):
    """A return that counts as reached, and where it is from."""

    value: float
    words: str


def compared(results: Results, study: str) -> list[str]:
    """Arms with at least two finished seeds, best mean first."""
    arms = [arm for arm in results.arms(study) if len(results.finals(study, arm)) > 1]
    return sorted(arms, key=lambda arm: -float(results.finals(study, arm).mean()))


def pairs(results: Results, study: str) -> list[Pair]:
    """Every two arms of one task, the better one first."""
    if study not in (kept := results.memo.setdefault("pairs", {})):
        kept[study] = _pairs(results, study)
    return list(kept[study])


def _pairs(results: Results, study: str) -> list[Pair]:
    task = {arm: n for n, (_, arms) in enumerate(results.by_task(study)) for arm in arms}
    found = [(a, b) for a, b in combinations(compared(results, study), 2) if task[a] == task[b]]
    values = [(results.finals(study, a), results.finals(study, b)) for a, b in found]
    p = np.array([welch(x, y) for x, y in values])
    return [
        Pair(a, b, difference(x, y), improvement(x, y), float(one), float(corrected))
        for (a, b), (x, y), one, corrected in zip(found, values, p, holm(p), strict=True)
    ]


def pairs_table(results: Results, study: str) -> Table | None:
    """The pairs as a table, of many the clear ones first; None with fewer than two arms to compare."""
    found = pairs(results, study)
    if not found:
        return None
    if len(found) > MANY:
        found.sort(key=lambda x: not x.corrected < CLEAR)
    numbers = [
        {"study": study, "better": x.first, "other": x.second}
        | {"difference": x.difference.value, "difference_low": x.difference.low, "difference_high": x.difference.high}
        | {"probability": x.better.value, "probability_low": x.better.low, "probability_high": x.better.high}
        | {"p_welch": x.p, "p_holm": x.corrected, "seeds": x.difference.n}
        for x in found
    ]
    shown = [
        {
            "Higher mean": x.first,
            "Other": x.second,
            f"Difference {SPAN}": estimate(x.difference, lambda v: number(v, 2)),
            "P(first better) [95 %]": estimate(x.better, lambda v: f"{v:.2f}"),
            "p": _chance(x.p),
            "p, Holm": _chance(x.corrected),
            "Clear": "yes" if x.corrected < CLEAR else "no" if x.corrected >= CLEAR else NONE,
            "Seeds": str(x.difference.n),
        }
        for x in found
    ]
    return Table(f"Pairs of arms, study {study}", pd.DataFrame(numbers), pd.DataFrame(shown), _pairs_note(found))


def efficiency(results: Results, study: str) -> Table | None:
    """Mean height of the learning curve, and steps to the level of its task; None without finished runs."""
    levels = {arm: level for arm in results.arms(study) if (level := reference(results, study, arm))}
    rows = [(arm, runs) for arm in levels if len(runs := _learned(results, study, arm, levels[arm]))]
    if not rows:
        return None
    numbers, shown = [], []
    for arm, runs in rows:
        level = levels[arm]
        height, reached = interval(runs["area"].to_numpy()), runs["steps"].notna()
        steps_to, all_reached = runs["steps"].median(), bool(reached.all())
        numbers.append(
            {"study": study, "arm": arm, "area": height.value, "area_low": height.low, "area_high": height.high}
            | {"level": level.value, "reached": int(reached.sum()), "seeds": len(runs)}
            | {"median_steps": steps_to if all_reached else np.nan}
        )
        shown.append(
            {
                "Arm": arm,
                f"Mean height of the curve {SPAN}": estimate(height),
                "Seeds that reach the level": f"{int(reached.sum())} of {len(runs)}",
                "Steps to it, median": steps(steps_to) if all_reached else NONE,
            }
        )
    note = (
        f"{_levels(levels[arm] for arm, _ in rows)} Steps: to each finished seed's first evaluation at or above it, "
        "given where every seed reaches it."
    )
    return Table(f"Sample efficiency, study {study}", pd.DataFrame(numbers), pd.DataFrame(shown), note)


def time_to_level(results: Results, study: str) -> Table | None:
    """Processor time to the level of `efficiency`; None where there is no level, or of no arm a time."""
    levels = {arm: reference(results, study, arm) for arm in results.arms(study)}
    found = {arm: _learned(results, study, arm, level) for arm, level in levels.items()}
    medians = {arm: float(runs["seconds"].median(skipna=False)) for arm, runs in found.items() if len(runs)}
    if np.isnan(list(medians.values())).all():
        return None
    numbers = pd.DataFrame({"study": study, "arm": list(medians), "median_seconds": list(medians.values())})
    words = [NONE if np.isnan(x) else f"{x:.0f} s" for x in medians.values()]
    shown = pd.DataFrame({"Arm": list(medians), "Processor time to it, median": words})
    note = (
        f"{_levels(level for arm in medians if (level := levels[arm]))} "
        "The share of a run's seconds that its steps to the level are, "
        "given where every seed reaches it."
    )
    return Table(f"Processor time to the level, study {study}", numbers, shown, note, folder=MEASURED)


def _levels(found: Iterable[Level]) -> str:
    """The levels of arms in a sentence."""
    every = list(dict.fromkeys(found))
    values = joined(number(level.value) for level in every)
    words = joined(dict.fromkeys(level.words for level in every))
    return f"Level{'s, of each task its own' * (len(every) > 1)}: {values}, {words}."


def reference(results: Results, study: str, arm: str | None = None) -> Level | None:
    """The level of `efficiency`: each agent alone without learning, else 90 % of the best arm; None without runs.

    arm: in whose task; None for the one of all arms, of which there may be none.
    """
    tasks = [(env, arms) for env, arms in results.by_task(study) if arm is None or arm in arms]
    if len(tasks) != 1:
        return None
    env, arms = tasks[0]
    scores, name = results.yardsticks_on(env), LEVEL_YARDSTICK.get(str(env.get("kind")), "")
    if FINAL in scores and name in scores.index:
        return Level(float(scores[FINAL][name]), f"the score of the yardstick {name.replace('_', ' ')}")
    means = [float(values.mean()) for one in arms if len(values := results.finals(study, one))]
    if not means or max(means) <= 0:
        return None
    return Level(LEVEL_SHARE * max(means), f"{100 * LEVEL_SHARE:g} % of the best arm's mean final return")


def profile(results: Results, study: str) -> Drawing | None:
    """Share of seeds that end at or above a score, for every score; None with fewer than two arms, or several tasks."""
    arms = [arm for arm in results.arms(study) if len(results.finals(study, arm)) > 1]
    if len(arms) < 2 or len(results.by_task(study)) > 1:
        return None
    values = {arm: np.sort(results.finals(study, arm)) for arm in arms}
    low, high = min(x[0] for x in values.values()), max(x[-1] for x in values.values())
    margin = 0.03 * (high - low) or 1.0
    grid = np.unique(np.concatenate([*values.values(), [low - margin, high + margin]]))
    shares = {arm: above(x, grid) for arm, x in values.items()}
    with styled():
        rows = [wrap(f"{arm} ({len(values[arm])} seeds)", LETTERS) for arm in shares]
        height = max(4.6, 1.6 + 0.155 * sum(map(len, rows)))
        figure = blank(9.0, height)
        head(figure, f"Performance profile, study {study}", "share of seeds that end at or above a score")
        axes = figure.add_axes((0.075, 0.78 / height, 0.6, 1 - 1.56 / height))
        lines: list[Line2D] = []
        names = ["\n".join(row) for row in rows]
        for arm in shares:
            own = np.append(values[arm][:1], values[arm])  # drawn from its first seed to its last, lines apart
            left = np.append(1.0, above(values[arm], np.nextafter(values[arm], np.inf)))
            lines += axes.step(own, left, where="post", linewidth=1.8, **look(arm, results.arms(study)).marked)
        axes.set_xlabel("final return")
        axes.set_ylabel("share of seeds")
        axes.set_ylim(-0.02, 1.04)
        figure.legend(
            lines, names, loc="upper left", bbox_to_anchor=(0.69, 1 - 0.69 / height), frameon=False, fontsize=8
        )
        foot(
            figure,
            "A line right of another at every height is better in distribution; lines that cross are not ordered.",
        )
    points = [(arm, x, y, len(values[arm])) for arm, share in shares.items() for x, y in zip(grid, share, strict=True)]
    return Drawing(figure, pd.DataFrame(points, columns=["arm", "score", "share", "seeds"]))


def above(values: NDArray[np.float64], scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of values at or above each score. values: (n,) ascending, scores: (k,)."""
    return 1 - np.searchsorted(values, scores, side="left") / len(values)


def matrix(results: Results, study: str) -> Drawing | None:
    """Probability that a seed of the row beats one of the column; None with fewer than three arms, many, or tasks."""
    arms = compared(results, study)
    if not 3 <= len(arms) <= MOST or len(results.by_task(study)) > 1:
        return None
    table = np.array([[_beats(results, study, a, b) for b in arms] for a in arms])
    side = 0.52 * len(arms)
    names = ["\n".join(wrap(arm, LONGEST)) for arm in arms]
    longest, last = (max(map(len, text.split("\n"))) for text in ("\n".join(names), names[-1]))
    left = 0.35 + 0.082 * longest
    with styled():
        figure = blank(max(left + side + 0.4 + 0.05 * last, 6.4), side + 1.5 + 0.055 * longest)
        width, height = figure.get_size_inches()
        head(figure, f"Probability of improvement, study {study}", "that a seed of the row beats one of the column")
        axes = figure.add_axes((left / width, 0.45 / height, side / width, side / height))
        axes.imshow(table, cmap="RdBu", vmin=-0.3, vmax=1.3, aspect="auto")
        axes.grid(visible=False)
        axes.set_xticks(range(len(arms)), names, rotation=35, ha="left", rotation_mode="anchor", fontsize=8)
        axes.set_yticks(range(len(arms)), names, fontsize=8)
        axes.xaxis.tick_top()
        for (i, j), value in np.ndenumerate(table):
            if i != j:
                colour = "white" if abs(value - 0.5) > 0.45 else "black"
                axes.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=7.5, color=colour)
        foot(figure, "Blue: the row wins; red: the column. Intervals stand in the table of pairs.")
    rows = [(a, b, table[i, j]) for i, a in enumerate(arms) for j, b in enumerate(arms) if i != j]
    return Drawing(figure, pd.DataFrame(rows, columns=["arm", "against", "probability"]))


def _beats(results: Results, study: str, a: str, b: str) -> float:
    return 0.5 if a == b else improvement(results.finals(study, a), results.finals(study, b)).value


def _learned(results: Results, study: str, arm: str, level: Level | None) -> pd.DataFrame:
    """Of each finished seed: mean height of its curve, steps to the level, seconds to it (NaN where not reached)."""
    points = results.curve(study, arm)
    rows = []
    for run in results.finished(study, arm).itertuples():
        own = points[points["seed"] == run.seed]
        if not len(own) or level is None:
            continue
        at, heights = own["step"].to_numpy(np.float64), own["value"].to_numpy(np.float64)
        reached = first_at(at, heights, level.value)
        rows.append((area(at, heights), reached, float(str(run.seconds)) * reached / at[-1] if at[-1] else np.nan))
    return pd.DataFrame(rows, columns=["area", "steps", "seconds"])


def _chance(p: float) -> str:
    return NONE if np.isnan(p) else "< 0.001" if p < 0.001 else f"{p:.3f}"


def _pairs_note(found: Sequence[Pair]) -> str:
    least = min(x.difference.n for x in found)
    note = (
        "p: Welch's test over seeds; Holm: corrected for all pairs of this table. Intervals and ranges are of one pair "
        "each, not corrected. All arms play the same final episodes; single episodes are not exported, so the pairing "
        "is of arms, not of episodes."
    )
    if least < 4:
        note += f" With {least} seeds a side no test by ranks can come below p = {_rank_limit(least):.2g}."
    return note


def _rank_limit(n: int) -> float:
    """The smallest two-sided p of a permutation of n against n."""
    return 2 / comb(2 * n, n)
