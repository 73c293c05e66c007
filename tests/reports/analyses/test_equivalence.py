"""Results against published ones: every outcome, on either side of its threshold."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import t

from reports.analyses.equivalence import compare, compare_runs, differing, finals, read, summary, table
from reports.data.frame import TableError
from reports.data.stats import equivalence, equivalence_of_pairs
from tests.reports import factory

SEEDS = [60.0, 60.2, 59.9, 60.1, 60.3]
UNSHOWN = "not shown to be equivalent"


def tables(**arms: Sequence[float]) -> pd.DataFrame:
    """Values of a study whose arms have these final returns by seed."""
    points, _ = factory.study("main", arms)
    return points


def outcome(here: pd.DataFrame, published: pd.DataFrame, margin: float = 1.0) -> str:
    (one,) = compare(here, published, margin)
    return one.outcome


def test_equal_results_are_byte_equal_whatever_their_order_and_whatever_else_is_here() -> None:
    published = tables(a=SEEDS)
    here = tables(a=SEEDS, b=SEEDS, c=SEEDS).sample(frac=1, random_state=0)
    (one,) = compare(here, published)
    assert (one.outcome, one.holds, one.seeds, one.note) == ("byte-equal", True, 5, "")
    assert summary([one], "quick") == "byte-equal to the published quick results: 1 arm"


@pytest.mark.parametrize(
    ("shift", "expected", "holds"),
    [
        (0.5, "equivalent", True),
        (3.0, UNSHOWN, False),
        (-3.0, UNSHOWN, False),
    ],
)
def test_a_shifted_arm(shift: float, expected: str, holds: bool) -> None:
    published = tables(a=SEEDS, b=SEEDS)
    here = tables(a=[x + shift for x in SEEDS], b=SEEDS)
    first, second = compare(here, published)
    assert (first.arm, first.outcome, first.holds) == ("a", expected, holds)
    assert first.difference.value == pytest.approx(shift)
    assert first.note.startswith("first difference: seed 0, step ")
    assert second.outcome == "byte-equal"
    assert [row[:3] for row in table([first, second])] == [["main", "a", "5"]]
    assert f"1 arm {expected}" in summary([first, second], "quick")


def test_the_last_bit_of_one_value_counts() -> None:
    published = tables(a=SEEDS)
    here = published.copy()
    row = here.index[here["metric"] == "eval/return"][3]
    here.loc[row, "value"] = np.nextafter(here.loc[row, "value"], np.inf)
    assert outcome(here, published) == "equivalent"
    (found,) = differing(here, published)
    assert (found.seed, found.step, found.metric) == tuple(published.loc[row, ["seed", "step", "metric"]])
    assert f"{found.here!r} here, {found.published!r} published" in str(found)
    here.loc[row, "value"] = -0.0
    published.loc[row, "value"] = 0.0
    assert len(list(differing(here, published))) == 1


def test_a_value_that_is_not_here_counts_and_nan_equals_itself() -> None:
    published = tables(a=SEEDS)
    row = published.index[published["metric"] == "eval/return"][0]
    assert outcome(published.drop(row), published) == "equivalent"
    published.loc[row, "value"] = np.nan
    assert outcome(published.copy(), published) == "byte-equal"


def test_missing_seeds_and_other_settings_do_not_hold() -> None:
    published = tables(a=SEEDS)
    (one,) = compare(tables(a=SEEDS[:3]), published)
    assert (one.outcome, one.holds, one.seeds, one.note) == ("missing", False, 3, "seeds 3, 4 not here")
    (none,) = compare(published.iloc[:0], published)
    assert (none.outcome, none.seeds) == ("missing", 0)
    changed = published.assign(run=published["run"].str[::-1] + "x")
    assert outcome(changed, published) == "other settings"


def test_several_runs_of_an_arm_and_seed_are_told_apart() -> None:
    """As of a yardstick, which has one for each task."""
    published = pd.concat([tables(a=[60.0]), tables(a=[20.0]).assign(run="0ther")], ignore_index=True)
    assert outcome(published.sample(frac=1, random_state=0), published) == "byte-equal"
    here = published.copy()
    here.loc[here["run"] == "0ther", "value"] += 1.0
    assert {one.published for one in differing(here, published)} <= set(published[published["run"] == "0ther"]["value"])
    assert finals(published).tolist() == finals(published.iloc[::-1]).tolist()


def test_more_seeds_here_than_published_do_no_harm() -> None:
    assert outcome(tables(a=SEEDS), tables(a=SEEDS[:2])) == "byte-equal"


def test_two_seeds_that_differ_show_nothing() -> None:
    assert outcome(tables(a=[59.5, 61.0]), tables(a=[60.1, 60.4])) == UNSHOWN


@pytest.mark.parametrize("shift", [0.0, 0.7, -0.7, 0.95, 1.0, -1.2])
def test_equivalence_against_its_formula(shift: float) -> None:
    """Schuirmann 1987, with Welch's degrees of freedom."""
    x, y = np.array([1.0, 2.0, 4.0, 3.0]) / 10 + shift, np.array([2.0, 2.5, 3.0, 2.0, 3.5]) / 10
    vx, vy = x.var(ddof=1) / len(x), y.var(ddof=1) / len(y)
    df = (vx + vy) ** 2 / (vx**2 / (len(x) - 1) + vy**2 / (len(y) - 1))
    d, se = x.mean() - y.mean(), (vx + vy) ** 0.5
    expected = max(t.sf((d + 1.0) / se, df), t.cdf((d - 1.0) / se, df))
    assert equivalence(x, y, 1.0) == pytest.approx(expected)


def test_equivalence_where_there_is_little_to_go_by() -> None:
    one, two = np.array([1.0]), np.array([1.0, 1.0])
    assert np.isnan(equivalence(one, two, 1.0))
    assert equivalence(two, two + 0.5, 1.0) == 0.0
    assert equivalence(two, two + 1.0, 1.0) == 1.0


@pytest.mark.parametrize("shift", [0.0, 0.8, -0.8, 1.2, -1.2])
def test_equivalence_of_pairs_against_its_formula(shift: float) -> None:
    gaps = np.array([0.1, -0.2, 0.05, 0.3]) + shift
    mean, se = gaps.mean(), gaps.std(ddof=1) / 2
    assert equivalence_of_pairs(gaps, 1.0) == pytest.approx(max(t.sf((mean + 1) / se, 3), t.cdf((mean - 1) / se, 3)))
    assert np.isnan(equivalence_of_pairs(gaps[:1], 1.0))
    assert equivalence_of_pairs(np.array([0.5, 0.5]), 1.0) == 0.0
    assert equivalence_of_pairs(np.array([-1.0, -1.0]), 1.0) == 1.0


def test_folders_are_read_whole_or_not_at_all(tmp_path: Path) -> None:
    with pytest.raises(TableError, match="no exported tables"):
        read(tmp_path)
    factory.write(tmp_path, factory.study("main", {"a": SEEDS}), factory.study("more", {"b": SEEDS}))
    values, runs = read(tmp_path)
    assert set(values["study"]) == set(runs["study"]) == {"main", "more"}
    assert finals(values[values["study"] == "more"]).tolist() == SEEDS
    (tmp_path / "main.parquet").write_bytes(b"no table")
    with pytest.raises(TableError, match="not exported tables"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("shift", "spread", "expected"),
    [
        (0.5, 0.115, "equivalent"),  # p = 0.05 at 0.5 / (sqrt 2 spread) = 2.92, that is, 0.121
        (0.5, 0.127, UNSHOWN),
        (0.98, 0.001, "equivalent"),
        (1.02, 0.001, UNSHOWN),
        (-1.02, 0.001, UNSHOWN),
    ],
)
def test_arms_are_equivalent_within_one_point_at_five_percent(shift: float, spread: float, expected: str) -> None:
    published = tables(a=[60 - spread, 60 + spread])
    here = tables(a=[60 + shift - spread, 60 + shift + spread])
    (one,) = compare(here, published)
    assert one.outcome == expected
    (same,) = compare(here, published, margin=5.0)
    assert same.outcome == "equivalent"


@pytest.mark.parametrize(
    ("shift", "spread", "expected"),
    [
        (0.5, 0.075, "equivalent"),  # p = 0.05 at 0.5 / spread = 6.31, that is, 0.0792
        (0.5, 0.083, UNSHOWN),
        (0.98, 0.001, "equivalent"),
        (1.02, 0.001, UNSHOWN),
        (-1.02, 0.001, UNSHOWN),
    ],
)
def test_runs_are_equivalent_within_one_point_at_five_percent(shift: float, spread: float, expected: str) -> None:
    published = tables(a=[60.0, 61.0, 59.0])
    here = tables(a=[60 + shift - spread, 61 + shift + spread, 59.0])
    found = compare_runs(here, published)
    assert [(one.outcome, one.seeds) for one in found] == [(expected, 1), (expected, 1), ("byte-equal", 1)]
    assert compare_runs(here, published, margin=5.0)[0].outcome == "equivalent"
