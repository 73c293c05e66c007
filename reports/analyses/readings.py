"""Specification curve: what a part contributes under every reading of a study, and which factors decide (Simonsohn,
Simmons and Nelson 2020, "Specification curve analysis", 10.1038/s41562-020-0912-z).

An effect is the mean final return of the whole method less that of an arm without the part, under one reading: above
zero where the paper's order holds. Readings count once all planned seeds of both arms are finished. Their intervals
share one variance, pooled over arms and readings, as two seeds have none of their own. Main effects are those of a
linear model without interactions. A reading under which an arm learned nothing counts like any other, and is marked.
"""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy.stats import permutation_test, t
from statsmodels.regression.linear_model import OLS, RegressionResults
from statsmodels.tools.sm_exceptions import SingularMatrixWarning

from reports.data.frame import FINAL, Results, in_order
from reports.data.stats import LEVEL, SEED, Interval, holm
from reports.render.canvas import BLUE, FAINT, ORANGE, QUIET, Drawing, blank, foot, head, styled
from reports.render.tables import NONE, Table, describe_task, estimate, number, percent

RESAMPLES = 9_999  # swaps of labels
# Of the readings. By chance an interval is above zero in one of 40, and below in as many.
MOST, SOME, FEW = 2 / 3, 1 / 8, 1 / 20
NOTHING = "random"  # the yardstick that has learned nothing
TOLERANCE = 2.0  # points above it that are nothing still
# Inches: width, height of the upper axes, of a row of levels, of what is above and below, and of the words on the left
WIDE, TALL, ROW, ABOVE, BELOW, BESIDE = 9.6, 2.4, 0.145, 0.75, 0.55, 2.4
BETTER, WORSE = BLUE, ORANGE  # of effects whose interval is above, below zero

Values = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Contrast:
    """The whole method against an arm without a part, under R readings with S seeds each.

    Attributes:
        without: the arm as the study's file has it.
        levels: (R) by reading, a column for each factor, in the study's order.
        full: (R, S) final returns of the whole method.
        other: (R, S) of the arm.
        missing: readings that are not finished.
    """

    without: str
    levels: pd.DataFrame
    full: Values
    other: Values
    missing: int

    @cached_property
    def effects(self) -> Values:
        """(R,)."""
        return np.asarray((self.full - self.other).mean(1))

    @cached_property
    def fit(self) -> "Fit":
        """Result of `fitted`."""
        return fitted(self)


class Fit(NamedTuple):
    """Effects as a sum of one term for each factor, by least squares."""

    levels: pd.DataFrame  # factor, level, readings, and the effect there with its interval
    factors: pd.DataFrame  # factor, f, p and p corrected for the number of factors


Outcome = Literal["holds", "depends on the reading", "not shown", "reversed"]


def outcome(found: Contrast) -> Outcome:
    """The verdict on the paper's order, by the readings whose interval is above zero, and below.

    Holds: above in `MOST` or more, and below in `FEW` or fewer. Reversed: the same with the sides exchanged. Depends on
    the reading: above in more than `SOME`, and neither. Not shown: what is left.
    """
    above, below = sides(found)
    if above >= MOST and below <= FEW:
        return "holds"
    if below >= MOST and above <= FEW:
        return "reversed"
    return "depends on the reading" if above > SOME else "not shown"


def sides(found: Contrast) -> tuple[float, float]:
    """The shares of the readings whose interval is above zero, and below."""
    ranges = intervals(found)
    return float(np.mean([x.above(0) for x in ranges])), float(np.mean([x.below(0) for x in ranges]))


def deciding(found: Contrast) -> list[str]:
    """The factors that change the effect, after Holm's correction over all factors; the smallest p first."""
    table = found.fit.factors.sort_values("p_corrected", kind="stable")
    return [str(name) for name in table[table["p_corrected"] < 1 - LEVEL]["factor"]]


def contrasts(results: Results, study: str) -> list[Contrast]:
    """The first arm of a study with readings against each other one; none without readings."""
    kept: dict[str, list[Contrast]] = results.memo.setdefault("contrasts", {})
    if study not in kept:
        kept[study] = _contrasts(results, study)
    return kept[study]


def _contrasts(results: Results, study: str) -> list[Contrast]:
    table = results.levels[results.levels["study"] == study]
    arms = in_order(table["contrast"])
    return [_contrast(results, table, arms[0], arm) for arm in arms[1:]]


def _begun(results: Results, study: str) -> list[Contrast]:
    """The contrasts of which a reading is finished."""
    return [one for one in contrasts(results, study) if len(one.effects)]


def _contrast(results: Results, table: pd.DataFrame, full: str, without: str) -> Contrast:
    study = str(table["study"].iloc[0])
    named = table.drop_duplicates("arm").set_index(["contrast", "reading"])["arm"]
    order = table.sort_values("place")["factor"].unique()
    own = table[table["contrast"] == full]
    wide = own.pivot_table(index="reading", columns="factor", values="level", aggfunc="first")[list(order)]
    pairs = {r: [_whole(results, study, named[arm, r]) for arm in (full, without)] for r in wide.index}
    done = [r for r, values in pairs.items() if all(len(one) for one in values)]
    seeds = len(results.plan(study, named[full, wide.index[0]]))
    both = np.array([pairs[r] for r in done]).reshape(len(done), 2, seeds)
    return Contrast(without, wide.loc[done], both[:, 0], both[:, 1], len(wide) - len(done))


def _whole(results: Results, study: str, arm: str) -> Values:
    """Final returns of an arm, none as long as a planned seed is not finished."""
    values = results.finals(study, arm)
    return values if len(values) == len(results.plan(study, arm)) else values[:0]


def intervals(found: Contrast) -> list[Interval]:
    """The effect under each reading with its interval, from the variance pooled over all readings and both arms."""
    seeds = found.full.shape[1]
    if seeds < 2:
        return [Interval(float(x), np.nan, np.nan, seeds) for x in found.effects]
    cells = np.concatenate([found.full, found.other])
    reach = t.ppf((1 + LEVEL) / 2, cells.size - len(cells)) * np.sqrt(cells.var(1, ddof=1).mean() * 2 / seeds)
    return [Interval(float(x), float(x - reach), float(x + reach), seeds) for x in found.effects]


def permuted(found: Contrast) -> float:
    """Two-sided p of the median effect, if the arms' labels say nothing: swapped within each reading and seed."""

    def median(full: Values, other: Values, axis: int) -> Values:
        gaps = (full - other).reshape(*full.shape[:-1], *found.full.shape)
        return np.asarray(np.median(gaps.mean(-1), axis=-1))

    pairs = (found.full.ravel(), found.other.ravel())
    rng = np.random.default_rng(SEED)
    test = permutation_test(
        pairs, median, permutation_type="samples", vectorized=True, n_resamples=RESAMPLES, axis=-1, rng=rng
    )
    return float(test.pvalue)


def fitted(found: Contrast) -> Fit:
    """Main effects of the factors on the effect, each level's averaged over the levels of the other factors.

    NaN: intervals and F tests where no reading is left over, and what unfinished readings leave undetermined.
    """
    codes = [_coded(found.levels[name]) for name in found.levels]
    design = np.column_stack([np.ones(len(found.levels)), *codes])
    owner = np.repeat(np.arange(-1, len(codes)), [1, *(block.shape[1] for block in codes)])  # of each column; -1: mean
    fit = _least_squares(found.effects, design)
    rows: list[tuple[object, ...]] = []
    tests = []
    for at, name in enumerate(map(str, found.levels)):
        own = found.levels.iloc[:, at].tolist()
        counts = Counter(own)
        weights = design[[own.index(level) for level in counts]] * np.isin(owner, [-1, at])
        values = _determined(fit, weights).tolist()
        rows += [(name, level, n, *x) for (level, n), x in zip(counts.items(), values, strict=True)]
        tests.append((name, *_f_test(fit, _least_squares(found.effects, design[:, owner != at]))))
    levels = pd.DataFrame(rows, columns=["factor", "level", "readings", "effect", "low", "high"])
    factors = pd.DataFrame(tests, columns=["factor", "f", "p"])
    return Fit(levels, factors.assign(p_corrected=holm(factors["p"].to_numpy(np.float64))))


def _coded(levels: pd.Series) -> Values:
    """Levels as deviations from their mean: a row per reading, a column less than levels."""
    names, at = np.unique(levels.tolist(), return_inverse=True)
    own = np.eye(len(names))[at]
    return own[:, :-1] - own[:, -1:]


def _least_squares(values: Values, design: Values) -> RegressionResults:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SingularMatrixWarning)  # `_determined` leaves out what is not unique
        return OLS(values, design).fit()


def _determined(fit: RegressionResults, weights: Values) -> Values:
    """Weighted sums of a model's terms with their intervals, NaN where the readings do not determine them. (k, 3)."""
    with np.errstate(divide="ignore", invalid="ignore"):  # no degrees of freedom: the variance is NaN
        test = fit.t_test(weights)
        found = np.column_stack([test.effect, test.conf_int(1 - LEVEL)])
    found[:, 1:] = np.where(fit.df_resid > 0, found[:, 1:], np.nan)
    known = np.isclose(weights @ fit.model.pinv_wexog @ fit.model.exog, weights).all(1)
    return np.where(known[:, None], found, np.nan)


def _f_test(fit: RegressionResults, rest: RegressionResults) -> tuple[float, float]:
    """F and p of the terms that a model has more than another; NaN if they add nothing, or nothing is left over."""
    if fit.df_resid == 0 or rest.df_resid == fit.df_resid or fit.ssr == 0:
        return np.nan, np.nan
    ratio, p, _ = fit.compare_f_test(rest)
    return float(ratio), float(p)


def unlearned(results: Results, study: str, values: Values) -> NDArray[np.bool_]:
    """Readings under which an arm learned nothing: its mean is at most `TOLERANCE` above the random policy's. (R,).

    False everywhere without that yardstick.
    """
    scores = results.yardsticks_of(study)
    if FINAL not in scores or NOTHING not in scores.index:
        return np.zeros(len(values), bool)
    return np.asarray(values.mean(1) <= scores[FINAL].astype(float).to_dict()[NOTHING] + TOLERANCE)


# Figure


def fig_curve(results: Results, study: str, found: Contrast) -> Drawing | None:
    """Effects by reading, smallest first, with intervals; below, the level of every factor. None without a reading."""
    if not len(found.effects):
        return None
    table = curve(results, study, found).numbers
    lines = [(factor, level) for factor, levels in _named(results, study).items() for level in levels]
    height = ABOVE + TALL + ROW * (len(lines) + 1) + BELOW
    with styled():
        figure = blank(WIDE, height)
        head(figure, f"Whole method less '{found.without}', by reading", describe_task(results.env(study)))
        left, width = BESIDE / WIDE, 1 - (BESIDE + 0.2) / WIDE
        upper = figure.add_axes((left, 1 - (ABOVE + TALL) / height, width, TALL / height))
        lower = figure.add_axes((left, BELOW / height, width, ROW * len(lines) / height), sharex=upper)
        _draw_effects(upper, table)
        _draw_levels(lower, table, lines)
        foot(
            figure,
            "points of final return with 95 % intervals from the pooled variance; blue above zero, orange below; "
            "hollow: an arm learned nothing",
        )
    return Drawing(figure, table)


def _named(results: Results, study: str) -> dict[str, list[str]]:
    """The levels of each factor, in the study's order."""
    rows = results.levels[results.levels["study"] == study].sort_values(["place", "number"])
    return {str(name): list(group["level"].unique()) for name, group in rows.groupby("factor", sort=False)}


def _draw_effects(axes: Axes, table: pd.DataFrame) -> None:
    colours = np.select([table["low"] > 0, table["high"] < 0], [BETTER, WORSE], QUIET)
    idle = (table["full_unlearned"] | table["without_unlearned"]).to_numpy(bool)
    places = np.arange(len(table))
    axes.axhline(0, color=QUIET, linewidth=0.8)
    axes.vlines(places, table["low"], table["high"], colors=list(colours), linewidth=1.0, alpha=0.6)
    faces = np.where(idle, "white", colours)
    axes.scatter(places, table["effect"], s=14, c=list(faces), edgecolors=list(colours), linewidths=0.9, zorder=3)
    axes.set_ylabel("effect")
    axes.tick_params(labelbottom=False, bottom=False)


def _draw_levels(axes: Axes, table: pd.DataFrame, lines: list[tuple[str, str]]) -> None:
    """A mark where a reading has a level, a row for each level; every other factor is shaded."""
    factors = list(dict.fromkeys(factor for factor, _ in lines))
    for row, (factor, level) in enumerate(lines):
        places = np.flatnonzero(table[factor] == level)
        axes.scatter(places, np.full(len(places), row), s=7, marker="s", c="black", linewidths=0)
        if factors.index(factor) % 2:
            axes.axhspan(row - 0.5, row + 0.5, color=FAINT, alpha=0.35, linewidth=0, zorder=0)
    names = [f"{factor.removeprefix('algo.')}: {level}" for factor, level in lines]
    axes.set_yticks(range(len(lines)), names, fontsize=6.5)
    axes.set_ylim(len(lines) - 0.5, -0.5)
    axes.set_xlim(-1, len(table))
    axes.set_xticks([])
    axes.tick_params(left=False)
    axes.grid(visible=False)


# Tables

NOTE = (
    "Effect: mean final return of the whole method less that of the arm; above zero the paper's order holds. All "
    "intervals have one width, from the variance pooled over readings and arms."
)


def tables(results: Results, study: str) -> dict[str, Table]:
    """All tables of a study, by kind; none as long as no reading is finished."""
    found = _begun(results, study)
    if not found:
        return {}
    return {
        "effects": summary(results, study),
        "factors": main_effects(results, study),
        "readings": curves(results, study, found),
    }


def curves(results: Results, study: str, found: Sequence[Contrast]) -> Table:
    """The curves of all contrasts in one table; `arm` is what each is without."""
    each = {one.without: curve(results, study, one) for one in found}
    numbers, shown = (
        pd.concat(parts, names=[column]).reset_index(level=0).reset_index(drop=True)
        for column, parts in (
            ("arm", {arm: table.numbers for arm, table in each.items()}),
            ("Without", {arm: table.shown for arm, table in each.items()}),
        )
    )
    missing = (f" Without '{one.without}': {_missing(one)}" for one in found if one.missing)
    return Table(f"Effects by reading, study {study}", numbers, shown, NOTE + "".join(missing))


def curve(results: Results, study: str, found: Contrast) -> Table:
    """Readings by effect, smallest first, each with the level of every factor."""
    ranges = intervals(found)
    arms = {"full": found.full, "without": found.other}
    idle = {f"{key}_unlearned": unlearned(results, study, values) for key, values in arms.items()}
    means = {key: values.mean(1) for key, values in arms.items()}
    columns = {"effect": found.effects, "low": [x.low for x in ranges], "high": [x.high for x in ranges]}
    order = np.argsort(found.effects, kind="stable")
    numbers = pd.DataFrame({"reading": found.levels.index} | columns | means | idle)
    numbers = pd.concat([numbers, found.levels.reset_index(drop=True)], axis=1).iloc[order].reset_index(drop=True)
    shown = pd.DataFrame(
        {
            "Reading": numbers["reading"].str.removeprefix("reading="),
            "Effect [95 %]": [estimate(ranges[i]) for i in order],
            "Mean, full": numbers["full"].map(number),
            "Mean, without": numbers["without"].map(number),
            "Learned nothing": [_idle(row) for row in numbers[list(idle)].to_numpy(bool)],
        }
    )
    shown = pd.concat([shown, numbers[list(found.levels.columns)]], axis=1)
    note = f"{NOTE} {_missing(found)}" if found.missing else NOTE
    return Table(f"Effect of what '{found.without}' is without, by reading, study {study}", numbers, shown, note)


def _missing(found: Contrast) -> str:
    return f"{found.missing} more readings are not finished."


def _idle(row: NDArray[np.bool_]) -> str:
    return {(True, True): "both", (True, False): "full", (False, True): "without"}.get((row[0], row[1]), NONE)


def summary(results: Results, study: str) -> Table:
    """A row per contrast: in how many readings the paper's order holds, and by how much."""
    rows = []
    for found in _begun(results, study):
        ranges, effects = intervals(found), found.effects
        lost = 100 * (found.other.mean(1) / found.full.mean(1) - 1)
        quarter, median, three = np.quantile(effects, [0.25, 0.5, 0.75])
        full, other = (unlearned(results, study, x) for x in (found.full, found.other))
        rows.append(
            {"without": found.without, "readings": len(effects), "missing": found.missing}
            | {"outcome": outcome(found), "deciding": ", ".join(deciding(found))}
            | {"holds": (effects > 0).mean(), "clear": np.mean([x.above(0) for x in ranges])}
            | {"reversed": np.mean([x.below(0) for x in ranges])}
            | {"median": median, "lower_quartile": quarter, "upper_quartile": three, "p": permuted(found)}
            | {"median_change": np.median(lost), "full_unlearned": full.sum(), "without_unlearned": other.sum()}
            | {"both_unlearned": (full & other).sum()}
        )
    numbers = pd.DataFrame(rows)
    shown = pd.DataFrame([_summarised(row) for row in rows])
    note = (
        "Order holds: the whole method is better. Clear, reversed: the interval of the reading is above, below zero. "
        f"Outcome: `holds` where it is clear in {percent_of(MOST)} of the readings or more and reversed in "
        f"{percent_of(FEW)} or fewer; `reversed` the other way round; else `depends on the reading` where it is "
        f"clear in more than {percent_of(SOME)}, and `not shown` below. Deciding factors: p < {1 - LEVEL:.2f} "
        "in the F test, corrected for the number of factors. p: "
        f"permutation test of the median effect, {RESAMPLES:,} resamples. Learned nothing: at most {TOLERANCE:g} "
        "points above the random policy; such readings count."
    )
    return Table(f"Effects over the readings of study {study}", numbers, shown, note)


def percent_of(share: float) -> str:
    """A share in words."""
    return f"{100 * share:.3g} %"


def _summarised(row: Mapping[str, Any]) -> dict[str, str]:
    share = {name: f"{100 * row[name]:.0f} %" for name in ("holds", "clear", "reversed")}
    quartiles = f"[{number(row['lower_quartile'])}, {number(row['upper_quartile'])}]"
    idle = ", ".join(str(row[f"{name}_unlearned"]) for name in ("full", "without", "both"))
    return {
        "Without": row["without"],
        "Readings": str(row["readings"]),
        "Outcome": row["outcome"],
        "Deciding factors": row["deciding"] or NONE,
        "Order holds": share["holds"],
        "clear": share["clear"],
        "reversed": share["reversed"],
        "Median effect [quartiles]": f"{number(row['median'])} {quartiles}",
        "p": f"{row['p']:.4f}",
        "Median change": percent(row["median_change"]),
        "Learned nothing: full, without, both": idle,
    }


def main_effects(results: Results, study: str) -> Table:
    """A row per contrast, factor and level: the effect there, averaged over the other factors."""
    tables, shown = [], []
    for found in _begun(results, study):
        both = found.fit.levels.merge(found.fit.factors, on="factor").assign(without=found.without)
        tables.append(both)
        for row in both.to_dict("records"):
            value = Interval(row["effect"], row["low"], row["high"], row["readings"])
            shown.append(
                {"Without": found.without, "Factor": row["factor"], "Level": row["level"]}
                | {"Readings": str(row["readings"]), "Effect [95 %]": estimate(value)}
                | {"p (Holm)": number(row["p_corrected"], 4)}
            )
    note = "A linear model without interactions. p: F test of the factor, corrected for the number of factors."
    numbers = pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()
    return Table(f"Main effects of the factors of study {study}", numbers, pd.DataFrame(shown), note)
