"""A log in memory for tests of the platform."""

import pytest

from pipelines.tracking.tracker import MemoryRun


@pytest.fixture
def shelf() -> list[MemoryRun]:
    """Runs of a log in memory, which launches share."""
    return []
