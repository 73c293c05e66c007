"""The measurement of intervals finds one that is too narrow, and a test that raises too many alarms."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import mannwhitneyu, t

from benchmarks import interval_coverage as benchmark
from reports.data import stats

NORMAL, SKEWED = benchmark.SHAPES


def student(width: float) -> Callable[..., stats.Interval]:
    """Student's interval of a mean, so many times as wide as it should be."""

    def interval(x: stats.Values) -> stats.Interval:
        reach = width * t.ppf(0.975, len(x) - 1) * x.std(ddof=1) / np.sqrt(len(x))
        return stats.Interval(x.mean(), x.mean() - reach, x.mean() + reach, len(x))

    return interval


@pytest.mark.parametrize(("width", "mark"), [(1.0, ""), (0.6, " ↓"), (3.0, " ↑")])
def test_an_interval_of_another_width_is_marked(width: float, mark: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stats, "interval", student(width))
    found = benchmark.Share(*benchmark.of_mean(np.random.default_rng(0), NORMAL, 5, 600), 0.95)
    assert found.of == 600
    assert found.mark == mark
    assert str(found) == f"{found.held / 600:.3f}{mark}"


def test_tests_without_holms_correction_raise_alarms(monkeypatch: pytest.MonkeyPatch) -> None:
    def alarms() -> benchmark.Share:
        return benchmark.Share(*benchmark.alarms_of_holm(np.random.default_rng(0), NORMAL, 5, 80), 0.05)

    assert alarms().mark == ""
    monkeypatch.setattr(stats, "holm", lambda p: p)
    assert alarms().mark == " ↑"


def test_a_margin_that_is_too_wide_is_no_equivalence(monkeypatch: pytest.MonkeyPatch) -> None:
    right = stats.equivalence
    monkeypatch.setattr(stats, "equivalence", lambda x, y, margin: right(x, y, margin + benchmark.SPREAD))
    found = benchmark.alarms_of_equivalence(np.random.default_rng(0), NORMAL, 5, 200)
    assert benchmark.Share(*found, 0.05).mark == " ↑"


@pytest.mark.parametrize("shape", benchmark.SHAPES, ids=lambda shape: shape.name)
def test_shapes_have_mean_0_and_spread_1_and_their_own_quantiles(shape: benchmark.Shape) -> None:
    drawn = np.sort(shape.draw(np.random.default_rng(0), (100_000,)))
    for found in (drawn, shape.points):
        assert (found.mean(), found.std()) == pytest.approx((0, 1), abs=0.02)
    assert shape.below(np.quantile(drawn, [0.1, 0.5, 0.9])) == pytest.approx([0.1, 0.5, 0.9], abs=0.01)
    other = shape.draw(np.random.default_rng(1), (100_000,))
    better = mannwhitneyu(drawn + 0.5, other).statistic / len(drawn) ** 2
    assert shape.below(shape.points + 0.5).mean() == pytest.approx(better, abs=0.01)


def test_the_truth_of_a_reading_and_of_a_level_is_what_was_planted() -> None:
    still = np.full(len(benchmark.levels()), 1e-9)
    for make in (benchmark.of_readings, benchmark.of_noisy_readings, benchmark.of_levels):
        held, of = make(np.random.default_rng(0), NORMAL, still, 4)
        assert 0.5 < held / of <= 1
    assert benchmark.alarms_of_factors(np.random.default_rng(0), SKEWED, benchmark.uneven(), 4)[1] == 4


@pytest.mark.usefixtures("quick_resampling")
def test_every_row_is_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "SEEDS", (3, 5))
    rows = [*benchmark.over_seeds(4), *benchmark.over_readings(4)]
    assert [row[0] for row in rows] == [*benchmark.INTERVALS, *benchmark.TESTS, *benchmark.READINGS]
    assert {len(row) for row in rows} == {6}


def test_the_documents_table_has_every_row() -> None:
    text = (Path(__file__).parents[2] / "docs" / "report.md").read_text()
    rows = [*benchmark.INTERVALS, *benchmark.TESTS, *benchmark.READINGS]
    assert [row for row in rows if f"\n| {row} | 0." not in text] == []
