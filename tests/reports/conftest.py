"""Fixtures of the reports' tests."""

from collections.abc import Iterator

import pytest

from reports import stats


@pytest.fixture
def quick_resampling(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A tenth of the resamples, where many intervals are made."""
    stats._picks.cache_clear()
    monkeypatch.setattr(stats, "RESAMPLES", stats.RESAMPLES // 10)
    yield
    stats._picks.cache_clear()
