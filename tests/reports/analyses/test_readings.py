"""Specification curves against effects that were planted, level by level."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from scipy.stats import f, t

from reports.analyses import readings
from reports.data.escaping import stem
from reports.data.frame import Results, load
from reports.data.paper import read as paper
from reports.pages import gallery, sheets
from reports.render.canvas import QUIET
from tests.reports.factory import study, write, yardsticks

FACTORS = {"alpha": ("0.02", "0.3", "1", "0.1"), "encoder": ("mlp", "pairwise"), "lr": ("0.001", "0.0005")}
Effect = Callable[[str, str, str], float]
SEEDS = np.array([-0.5, 0.5])


def read(folder: Path, effect: Effect, full: float = 60.0, noise: float = 0.0, drop: str = "") -> Results:
    """A study whose arm without regulation loses `effect` under each reading.

    Args:
        noise: deviation of what is added to every run.
        drop: an arm whose last seed is not there.
    """
    rng, arms, rows = np.random.default_rng(0), {}, []
    for places in product(*(range(len(levels)) for levels in FACTORS.values())):
        levels = {name: FACTORS[name][place] for name, place in zip(FACTORS, places, strict=True)}
        code = "reading=" + "".join(str(place + 1) for place in places)
        for contrast, level in (("full", full), ("no regulation", full - effect(*levels.values()))):
            arm = f"{contrast}, {code}"
            arms[arm] = list(level + SEEDS + rng.normal(size=2) * noise)
            for place, (factor, name) in enumerate(levels.items()):
                row = {"study": "read", "arm": arm, "contrast": contrast, "reading": code, "factor": factor}
                rows.append(row | {"place": place, "level": name, "number": places[place]})
    points, runs = study("read", arms, points=2)
    if drop:
        last = (runs["arm"] == drop) & (runs["seed"] == 1)
        runs.loc[last, "status"] = "partial"
        points = points[~((points["arm"] == drop) & (points["seed"] == 1) & (points["metric"] == "final/return"))]
    write(folder, (points, runs), yardsticks())
    pd.DataFrame(rows).to_parquet(folder / "read.readings.parquet")
    return load(folder, "quick")


def one(results: Results) -> readings.Contrast:
    (found,) = readings.contrasts(results, "read")
    return found


def by_alpha(alpha: str, encoder: str, lr: str) -> float:
    return {"0.02": -1.0, "0.1": 2.0, "0.3": 5.0, "1": 30.0}[alpha] + {"mlp": 0.0, "pairwise": 1.0}[encoder]


def test_effects_are_the_whole_method_less_the_arm_by_reading(tmp_path: Path) -> None:
    found = one(read(tmp_path, by_alpha))
    assert found.without == "no regulation"
    assert (len(found.effects), found.full.shape, found.missing) == (16, (16, 2), 0)
    assert list(found.levels.columns) == list(FACTORS)
    planted = [by_alpha(*row) for row in found.levels.to_numpy(str)]
    assert found.effects == pytest.approx(planted)


def test_intervals_share_the_pooled_variance(tmp_path: Path) -> None:
    found = one(read(tmp_path, by_alpha))
    reach = 2.0369 * np.sqrt(0.5 * 2 / 2)  # t with 32 degrees; each pair of seeds has variance 0.5
    for value, effect in zip(readings.intervals(found), found.effects, strict=True):
        assert (value.value, value.low, value.high) == pytest.approx((effect, effect - reach, effect + reach), abs=1e-4)
    single = replace(found, full=found.full[:, :1], other=found.other[:, :1])
    assert all(np.isnan(value.low) for value in readings.intervals(single))


def test_main_effects_are_those_that_were_planted(tmp_path: Path) -> None:
    fit = readings.fitted(one(read(tmp_path, by_alpha)))
    effects = fit.levels.set_index(["factor", "level"])["effect"]
    assert effects["alpha"].to_dict() == pytest.approx({"0.02": -0.5, "0.1": 2.5, "0.3": 5.5, "1": 30.5})
    assert effects["encoder"].to_dict() == pytest.approx({"mlp": 9.0, "pairwise": 10.0})
    assert effects["lr"].to_dict() == pytest.approx({"0.001": 9.5, "0.0005": 9.5})
    assert fit.levels.set_index(["factor", "level"])["readings"]["alpha"].to_dict() == dict.fromkeys(
        FACTORS["alpha"], 4
    )


def test_the_model_agrees_with_the_means_of_a_balanced_design_and_its_analysis_of_variance(tmp_path: Path) -> None:
    found = one(read(tmp_path, by_alpha, noise=3.0))
    fit = readings.fitted(found)
    between, left = {}, ((found.effects - found.effects.mean()) ** 2).sum()
    for name in FACTORS:
        groups = pd.Series(found.effects).groupby(found.levels[name].to_numpy())
        means = groups.mean()
        rows = fit.levels[fit.levels["factor"] == name].set_index("level")
        assert rows["effect"].to_dict() == pytest.approx(means.to_dict())
        between[name] = (groups.size() * (means - found.effects.mean()) ** 2).sum()
        left -= between[name]
    free = 16 - 1 - 3 - 1 - 1
    ratios = {name: between[name] / (len(FACTORS[name]) - 1) / (left / free) for name in FACTORS}
    assert fit.factors.set_index("factor")["f"].to_dict() == pytest.approx(ratios)
    reach = 2.2281 * np.sqrt(left / free / 8)  # t with 10 degrees; a level of two has 8 readings
    row = fit.levels.set_index(["factor", "level"]).loc[("encoder", "mlp")]
    assert (row["high"] - row["effect"], row["effect"] - row["low"]) == pytest.approx((reach, reach), rel=1e-4)


def by_hand(found: readings.Contrast) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The linear model from its normal equations, for designs that determine all of it: levels and factors."""
    blocks = {}
    for name in found.levels.columns:
        names = sorted(set(found.levels[name]))
        codes = np.vstack([np.eye(len(names) - 1), -np.ones(len(names) - 1)])  # the last level is less all others
        blocks[name] = codes[[names.index(level) for level in found.levels[name]]]
    design = np.column_stack([np.ones(len(found.levels)), *blocks.values()])
    inverse = np.linalg.inv(design.T @ design)

    def squares(x: readings.Values) -> float:
        return float(((found.effects - x @ np.linalg.lstsq(x, found.effects)[0]) ** 2).sum())

    free, terms, at = len(design) - design.shape[1], inverse @ design.T @ found.effects, 1
    variance = squares(design) / free
    rows, tests = [], []
    for name, block in blocks.items():
        columns = np.arange(at, at := at + block.shape[1])
        ratio = (squares(np.delete(design, columns, 1)) / variance - free) / len(columns)
        tests.append((name, ratio, f.sf(ratio, len(columns), free)))
        for level in dict.fromkeys(found.levels[name]):
            here = (found.levels[name] == level).to_numpy()
            weights = np.eye(len(terms))[0]
            weights[columns] = block[here][0]
            value, reach = weights @ terms, t.ppf(0.975, free) * np.sqrt(variance * weights @ inverse @ weights)
            rows.append((name, level, here.sum(), value, value - reach, value + reach))
    levels = pd.DataFrame(rows, columns=["factor", "level", "readings", "effect", "low", "high"])
    return levels, pd.DataFrame(tests, columns=["factor", "f", "p"])


def random(rows: list[tuple[str, ...]], names: tuple[str, ...] = tuple(FACTORS)) -> readings.Contrast:
    """A contrast with these levels whose effects are noise."""
    levels = pd.DataFrame(rows, columns=list(names))
    values = np.random.default_rng(len(rows)).normal(size=(2, len(rows), 2))
    return readings.Contrast("no regulation", levels, values[0], values[1], 0)


@pytest.mark.parametrize("count", [16, 13, 9, 8])
def test_the_model_agrees_with_its_normal_equations_in_any_design(count: int) -> None:
    every = list(product(*FACTORS.values()))
    found = random([every[n] for n in np.random.default_rng(3).permutation(16)[:count]])
    levels, factors = by_hand(found)
    pd.testing.assert_frame_equal(found.fit.levels, levels)
    pd.testing.assert_frame_equal(found.fit.factors.drop(columns="p_corrected"), factors)


def test_a_saturated_model_has_effects_and_no_intervals() -> None:
    rows = [("0.02", "mlp", "1"), ("0.02", "pairwise", "2"), ("1", "mlp", "2"), ("1", "pairwise", "1")]
    fit = random(rows).fit
    assert np.isfinite(fit.levels["effect"]).all()
    assert fit.levels[["low", "high"]].isna().all(axis=None)
    assert fit.factors[["f", "p", "p_corrected"]].isna().all(axis=None)


def test_what_the_readings_do_not_determine_is_nan() -> None:
    rows = [("0.02", "mlp", level) for level in "1122"] + [("1", "pairwise", level) for level in "1122"]
    fit = random(rows).fit  # no reading tells alpha from the encoder
    known = fit.levels["factor"] == "lr"
    assert np.isfinite(fit.levels[known][["effect", "low", "high"]]).all(axis=None)
    assert fit.levels[~known][["effect", "low", "high"]].isna().all(axis=None)
    assert fit.factors["p"].isna().tolist() == [True, True, False]
    assert fit.factors["p_corrected"].iloc[2] == fit.factors["p"].iloc[2]


def test_a_factor_of_which_one_level_is_finished_has_no_test() -> None:
    fit = random([("0.02", "mlp", level) for level in "11122"]).fit
    assert fit.factors["p"].isna().tolist() == [True, True, False]
    assert fit.levels["readings"].tolist() == [5, 5, 3, 2]


def test_factors_may_have_any_name() -> None:
    rows = list(product(*FACTORS.values()))
    odd = random(rows, ("C(a) + b", "", "'x\"")).fit
    assert odd.levels["effect"].tolist() == random(rows).fit.levels["effect"].tolist()


def test_what_a_report_needs_often_is_worked_out_once(tmp_path: Path) -> None:
    results = read(tmp_path, by_alpha)
    assert one(results) is one(results)
    assert one(results).fit is one(results).fit
    assert one(replace(results)) is not one(results)


def test_the_deciding_factor_is_found_and_the_others_are_not(tmp_path: Path) -> None:
    p = readings.fitted(one(read(tmp_path, by_alpha, noise=1.0))).factors.set_index("factor")["p_corrected"]
    assert p["alpha"] < 1e-6
    assert p["lr"] > 0.05


def test_the_permutation_test_finds_a_median_and_not_a_few_large_effects(tmp_path: Path) -> None:
    assert readings.permuted(one(read(tmp_path / "a", by_alpha))) < 0.001
    few: Effect = lambda alpha, encoder, lr: 30.0 if (alpha, encoder, lr) == ("1", "mlp", "0.001") else 0.0  # noqa: E731
    assert readings.permuted(one(read(tmp_path / "b", few, noise=1.0))) > 0.05
    most: Effect = lambda alpha, encoder, lr: -200.0 if (alpha, encoder, lr) == ("1", "mlp", "0.001") else 2.0  # noqa: E731
    assert readings.permuted(one(read(tmp_path / "c", most, noise=0.2))) < 0.001


def test_readings_that_learned_nothing_are_counted(tmp_path: Path) -> None:
    lost: Effect = lambda alpha, encoder, lr: 29.0 if alpha == "1" else 0.0  # noqa: E731
    results = read(tmp_path / "a", lost)
    (row,) = readings.summary(results, "read").numbers.to_dict("records")
    assert (row["full_unlearned"], row["without_unlearned"], row["both_unlearned"]) == (0, 4, 0)
    assert row["readings"] == 16
    table = readings.curve(results, "read", one(results)).shown
    assert table["Learned nothing"].tolist() == ["–"] * 12 + ["without"] * 4
    idle = read(tmp_path / "b", lambda *_: 0.0, full=31.0)
    (row,) = readings.summary(idle, "read").numbers.to_dict("records")
    assert (row["full_unlearned"], row["both_unlearned"]) == (16, 16)


def test_the_summary_counts_the_readings_in_which_the_order_holds(tmp_path: Path) -> None:
    (row,) = readings.summary(read(tmp_path, by_alpha), "read").numbers.to_dict("records")
    # -1 and 0 with alpha 0.02, 2 and 3 with 0.1, 5 and 6 with 0.3, 30 and 31 with 1; intervals reach 1.44 to each side
    assert (row["holds"], row["clear"], row["reversed"]) == (0.75, 0.75, 0.0)
    assert (row["median"], row["lower_quartile"], row["upper_quartile"]) == pytest.approx((4.0, 1.5, 12.0))
    assert row["median_change"] == pytest.approx(-100 * 4 / 60)
    (row,) = readings.summary(read(tmp_path / "b", lambda *_: -2.0), "read").numbers.to_dict("records")
    assert (row["holds"], row["clear"], row["reversed"]) == (0.0, 0.0, 1.0)


def test_the_curve_is_sorted_and_has_the_level_of_each_factor(tmp_path: Path) -> None:
    results = read(tmp_path, by_alpha)
    table = readings.curve(results, "read", one(results))
    assert table.numbers["effect"].is_monotonic_increasing
    assert [by_alpha(*row) for row in table.numbers[list(FACTORS)].to_numpy(str)] == pytest.approx(
        table.numbers["effect"].tolist()
    )
    assert table.shown["Effect [95 %]"].iloc[0] == "−1.0 [−2.4, 0.4]"
    first = table.numbers.iloc[0]
    assert (first["full"], first["without"]) == pytest.approx((60.0, 61.0))


def test_a_reading_that_is_not_finished_is_left_out_and_said(tmp_path: Path) -> None:
    results = read(tmp_path, by_alpha, drop="no regulation, reading=111")
    found = one(results)
    assert (len(found.effects), found.missing) == (15, 1)
    assert "reading=111" not in found.levels.index
    assert readings.curve(results, "read", found).note.endswith("1 more readings are not finished.")


def test_main_effects_as_a_table(tmp_path: Path) -> None:
    table = readings.main_effects(read(tmp_path, by_alpha, noise=1.0), "read")
    assert len(table.shown) == 8
    assert set(table.shown["Without"]) == {"no regulation"}
    assert list(table.shown["Factor"].unique()) == list(FACTORS)


def test_the_figure_has_every_reading_in_the_order_of_the_table(tmp_path: Path) -> None:
    results = read(tmp_path, by_alpha)
    found = one(results)
    drawing = readings.fig_curve(results, "read", found)
    assert drawing is not None
    upper, lower = drawing.figure.axes
    (marks,) = upper.collections[-1:]
    heights = np.asarray(marks.get_offsets())[:, 1]
    assert list(heights) == sorted(found.effects)
    assert list(drawing.numbers["effect"]) == list(heights)
    rows = [label.get_text() for label in lower.get_yticklabels()]
    assert rows == [f"{factor}: {level}" for factor, levels in FACTORS.items() for level in levels]
    for row, mark in enumerate(lower.collections):
        factor, level = rows[row].split(": ")
        places = np.asarray(mark.get_offsets())[:, 0].astype(int)
        assert list(drawing.numbers[factor].iloc[places].unique()) == [level]
        assert len(places) == (drawing.numbers[factor] == level).sum()


def test_colours_say_on_which_side_of_zero_an_interval_is(tmp_path: Path) -> None:
    results = read(tmp_path, lambda alpha, encoder, lr: {"0.02": -9.0, "0.1": 0.5, "0.3": 9.0, "1": 9.0}[alpha])
    drawing = readings.fig_curve(results, "read", one(results))
    assert drawing is not None
    edges = [to_hex(colour) for colour in drawing.figure.axes[0].collections[-1].get_edgecolors()]
    assert edges == [readings.WORSE.lower()] * 4 + [to_hex(QUIET)] * 4 + [readings.BETTER.lower()] * 8


def test_a_study_with_readings_has_its_own_tables_and_figures(tmp_path: Path) -> None:
    results = read(tmp_path, by_alpha)
    names = set(sheets.of_study(results, "read"))
    assert names == {"effects_read", "factors_read", "readings_read", "final_read"}
    pictures = gallery.study_gallery(results, paper(), "read")
    assert [one.name for one in pictures] == [f"readings_{stem('no regulation')}_read"]
    assert "(12 of 16)" in pictures[0].caption
    listed = readings.tables(results, "read")["readings"]
    assert list(listed.shown["Without"].unique()) == ["no regulation"]
    assert len(listed.numbers) == 16


def test_the_table_of_all_contrasts_has_what_the_table_of_each_has(tmp_path: Path) -> None:
    results = read(tmp_path, by_alpha, drop="no regulation, reading=111")
    found = one(results)
    both = readings.curves(results, "read", [found, replace(found, without="no filter", missing=0)])
    single = readings.curve(results, "read", found)
    for place, arm in enumerate(("no regulation", "no filter")):
        part = slice(15 * place, 15 * place + 15)
        assert set(both.numbers["arm"][part]) == set(both.shown["Without"][part]) == {arm}
        for whole, key, own in ((both.numbers, "arm", single.numbers), (both.shown, "Without", single.shown)):
            pd.testing.assert_frame_equal(whole[part].drop(columns=key).reset_index(drop=True), own)
    assert both.note.endswith("Without 'no regulation': 1 more readings are not finished.")


def test_nothing_is_shown_before_a_reading_is_finished(tmp_path: Path) -> None:
    results = read(tmp_path, by_alpha)
    none = replace(results, points=results.points[results.points["metric"] != "final/return"])
    assert readings.tables(none, "read") == {}
    assert readings.fig_curve(none, "read", one(none)) is None


def judged(above: int, below: int, of: int = 48) -> readings.Contrast:
    """A contrast with so many readings clearly above zero and below; the rest are at zero."""
    effects = np.repeat([10.0, -10.0, 0.0], [above, below, of - above - below])
    other = np.tile(SEEDS, (of, 1))
    levels = pd.DataFrame({"alpha": ["1"] * above + ["0"] * (of - above)})
    return readings.Contrast("no regulation", levels, other + effects[:, None], other, 0)


@pytest.mark.parametrize(
    ("above", "below", "said"),
    [
        (48, 0, "holds"),
        (32, 2, "holds"),  # 2 of 48 are fewer than a twentieth, 3 are more
        (32, 3, "depends on the reading"),
        (31, 0, "depends on the reading"),
        (7, 0, "depends on the reading"),
        (6, 0, "not shown"),  # an eighth
        (0, 0, "not shown"),
        (7, 41, "depends on the reading"),
        (6, 31, "not shown"),
        (2, 32, "reversed"),
        (3, 32, "not shown"),
        (2, 31, "not shown"),
    ],
)
def test_each_outcome_on_either_side_of_its_thresholds(above: int, below: int, said: str) -> None:
    assert readings.outcome(judged(above, below)) == said


def test_the_deciding_factors_are_those_that_change_the_effect(tmp_path: Path) -> None:
    found = one(read(tmp_path, by_alpha, noise=0.1))
    assert readings.deciding(found) == ["alpha", "encoder"]
    flat = one(read(tmp_path / "flat", lambda *levels: 3.0, noise=1.0))
    assert readings.deciding(flat) == []
    table = readings.summary(read(tmp_path / "again", by_alpha, noise=0.1), "read")
    assert table.shown[["Outcome", "Deciding factors"]].to_numpy().tolist() == [["holds", "alpha, encoder"]]
