"""Fixtures of the reports' tests."""

from collections.abc import Iterator
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from reports.data import stats
from reports.pages.build import build
from tests.reports.factory import drawings, episode, half_done, methods, noisy, study, theorem, write, yardsticks


@pytest.fixture
def quick_resampling(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A tenth of the resamples, where many intervals are made."""
    for kept in (stats._picks, stats._shares):
        kept.cache_clear()
    monkeypatch.setattr(stats, "RESAMPLES", stats.RESAMPLES // 10)
    yield
    for kept in (stats._picks, stats._shares):
        kept.cache_clear()


@pytest.fixture
def unpainted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are made and their files are empty, for tests of names and words: paint is most of a report's time."""

    def empty(self: Figure, place: Path | StringIO, **options: Any) -> None:
        if isinstance(place, StringIO):
            place.write("<svg></svg>")
        else:
            place.write_bytes(b"")

    monkeypatch.setattr(Figure, "savefig", empty)


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole report with a half-finished study."""
    folder, out = tmp_path_factory.mktemp("tables"), tmp_path_factory.mktemp("report")
    ablation = study("ablation", {"full": noisy(70), "no regulation": noisy(60), "no filter": noisy(64)}, points=4)
    ablation[1].loc[ablation[1]["arm"] == "no filter", "seconds"] = 3.0  # twice what others take
    other = half_done(*study("reach", {"one <step>": noisy(67), "six steps": noisy(63)}, points=4))
    write(drawings(episode(methods(folder))), ablation, other, yardsticks(), theorem())
    build(folder, out, "quick")
    return out
