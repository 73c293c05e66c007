"""Every test on one torch thread: results of larger layers depend on the number. The longest files begin first."""

import pytest
import torch

torch.set_num_threads(1)

LONGEST = [  # files that take most processor time, so that no process of `pytest -n` has one of them left at the end
    *("conformance/test_algorithms", "pipelines/test_cluster", "pipelines/test_search", "pipelines/test_interrupt"),
    *("pipelines/test_bundle", "pipelines/test_faults", "pipelines/test_killed", "pipelines/test_run"),
    *("pipelines/test_closed", "pipelines/test_pool", "pipelines/test_addresses", "pipelines/test_folder"),
    *("pipelines/test_malformed", "reports/test_robust", "reports/test_build", "reports/test_hostile"),
]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the `LONGEST` first, all else stays in its order."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(f"{item.path.parent.name}/{item.path.stem}", len(places)))
