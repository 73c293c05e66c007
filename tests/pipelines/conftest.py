"""A log in memory for tests of the platform."""

import pytest

from tests.memory_tracker import MemoryRun


@pytest.fixture
def shelf() -> list[MemoryRun]:
    """Runs of a log in memory, which launches share."""
    return []
