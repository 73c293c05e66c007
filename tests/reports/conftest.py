"""Fixtures of the reports' tests."""

from collections.abc import Iterator

import pytest

from reports import stats


@pytest.fixture
def quick_resampling(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A tenth of the resamples, where many intervals are made."""
    for kept in (stats._picks, stats._shares):
        kept.cache_clear()
    monkeypatch.setattr(stats, "RESAMPLES", stats.RESAMPLES // 10)
    yield
    for kept in (stats._picks, stats._shares):
        kept.cache_clear()
