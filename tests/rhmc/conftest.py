"""The same random numbers in every test of the science, and episodes short enough for one."""

import pytest
import torch

from rhmc.envs import coverage


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seven steps to an episode of coverage."""
    monkeypatch.setitem(coverage.PRESETS, "flat", coverage.PRESETS["flat"]._replace(episode=7))
