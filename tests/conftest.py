"""Work folders for tests, one Ray for all of them, one torch thread, and the longest files first.

Results of larger layers depend on the number of threads.
"""

import gc
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import settings

torch.set_num_threads(1)
settings.register_profile("tests", deadline=None)  # an example may wait for another test's processes
settings.load_profile("tests")
os.environ.pop("MLFLOW_TRACKING_URI", None)
os.environ.pop("RAY_ADDRESS", None)
os.environ.setdefault("RAY_worker_niceness", "0")  # else whatever else runs, such as other tests, starves them


def pytest_configure(config: pytest.Config) -> None:
    """Declare what marks the tests that start Ray."""
    config.addinivalue_line("markers", "ray: starts Ray (seconds)")


ROOMS = {Path(__file__).parent / name for name in ("pipelines", "robustness")}
KNOWN = [  # warnings of pinned packages about each other
    "ignore:The ``noload`` loader strategy is deprecated:DeprecationWarning",  # MLflow's use of SQLAlchemy 2.1
]
LONGEST = [  # files that take most processor time, so that no process of `pytest -n` has one of them left at the end
    *("conformance/test_algorithms", "robustness/test_cluster", "tuning/test_search", "robustness/test_interrupt"),
    *("robustness/test_own_package", "golden/test_golden", "bundles/test_bundle", "robustness/test_faults"),
    *("robustness/test_killed", "execution/test_run", "execution/test_private_node", "tuning/test_ray_workers"),
    *("workspace/test_addresses", "workspace/test_process_pool", "robustness/test_installed"),
    *("robustness/test_malformed", "reports/test_robust", "pages/test_build", "reports/test_hostile"),
]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the `LONGEST` first, all else stays in its order; tests of `ROOMS` pass over warnings that are `KNOWN`."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(f"{item.path.parent.name}/{item.path.stem}", len(places)))
    for item in items:
        if ROOMS & set(item.path.parents):
            for warning in KNOWN:
                item.add_marker(pytest.mark.filterwarnings(warning))


def pytest_collection_finish(session: pytest.Session) -> None:
    """Leave what the imports made, most of a million objects, out of every collection of garbage from here on."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh MLflow database: making one takes seconds, copying one does not."""
    from pipelines.tracking.mlflow_tracker import create_database
    from pipelines.workspace.work_folder import Home

    home = Home(tmp_path_factory.mktemp("template"))
    create_database(home.database)
    return home.database


@pytest.fixture
def home(tmp_path: Path, template: Path) -> Path:
    """A work folder with an empty MLflow database."""
    shutil.copy(template, tmp_path / "mlflow.db")
    return tmp_path


@pytest.fixture(scope="session")
def cluster() -> Iterator[None]:
    """Ray with two processors, shared by the tests of one process."""
    from pipelines.execution.ray_settings import RAY_SETTINGS

    os.environ.update(RAY_SETTINGS)
    from pipelines.execution.ray_driver import ray_session

    with ray_session(2):
        yield
