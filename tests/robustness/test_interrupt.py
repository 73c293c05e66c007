"""A driver that is terminated or interrupted; the next launch must end where one launch would.

The same for its workers, which are Ray's here. A killed driver with such workers is in `test_own_package.py`; more
kills, without Ray, are in `test_faults.py`. What nobody disturbs is trained in this process: it must be equal wherever
it is trained, and a worker takes seconds to start.
"""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from pipelines.execution.run import run_studies
from pipelines.export.tables import export_study
from pipelines.specs.study import Study
from pipelines.tracking.mlflow_tracker import open_existing
from pipelines.tracking.plan import study_card
from pipelines.workspace.work_folder import Home
from tests.pipelines.support import all_end, interrupt, lasting, started_by, tiny
from tests.robustness.chaos import WORKER, launch_here

pytestmark = pytest.mark.ray
POINTS = 12
STUDY = lasting(tiny(points=POINTS, concurrent=1))


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory, template: Path) -> bytes:
    """The export of a launch that nobody disturbed."""
    home = tmp_path_factory.mktemp("whole")
    shutil.copy(template, home / "mlflow.db")
    assert launch_here(STUDY, home) == 0
    assert export_study(STUDY, home / "out", home) == 0
    return (home / "out" / "tiny.parquet").read_bytes()


def driver(home: Path) -> subprocess.Popen[str]:
    """Launch the study in a process of its own, both runs at once, and wait for its first checkpoint."""
    words = [str(home), str(POINTS), "2"]
    command = [sys.executable, "-W", "ignore", "-m", "tests.pipelines.support", *words]
    root = Path(__file__).parents[2]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    process = subprocess.Popen(command, cwd=root, text=True, **pipes, start_new_session=True)
    for _ in range(12_000):  # ten minutes, for a busy machine
        if list(home.glob("checkpoints/*/0*.pt")):
            return process
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    raise AssertionError(process.communicate()[0])


def statuses(home: Path) -> dict[str, str]:
    """Status of each run in the log."""
    tracker = open_existing(study_card(STUDY), Home(home))
    assert tracker is not None
    return {run.ref: run.status for run in tracker.recorded()}


def finish(home: Path, expected: bytes, launch: Callable[[Study, Path], int] = launch_here) -> None:
    """Launch again: the same runs, whole, nothing doubled."""
    before = statuses(home)
    assert launch(STUDY, home) == 0
    after = statuses(home)
    assert before.keys() <= after.keys()
    assert list(after.values()) == ["finished", "finished"]
    assert export_study(STUDY, home / "out", home) == 0
    assert (home / "out" / "tiny.parquet").read_bytes() == expected
    tracker = open_existing(study_card(STUDY), Home(home))
    assert tracker is not None
    for ref in after:
        history = tracker.client.get_metric_history(ref, "return")
        assert sorted(value.step for value in history) == [200 * k for k in range(POINTS + 1)]
    assert not list(home.glob("checkpoints/*/*.pt"))


def test_an_interrupted_launch(
    home: Path, uninterrupted: bytes, cluster: None, capfd: pytest.CaptureFixture[str]
) -> None:
    thread = threading.Thread(target=interrupt, args=(home,))
    thread.start()
    assert run_with_ray(STUDY, home) == 130
    thread.join()
    said = "".join(capfd.readouterr())
    assert "interrupted: each run stops at its next point" in said
    assert "Traceback" not in said
    assert set(statuses(home).values()) <= {"interrupted", "finished"}
    assert not list(home.glob("checkpoints/*/*.part"))
    finish(home, uninterrupted, run_with_ray)


def run_with_ray(study: Study, home: Path) -> int:
    """The work of `rhmc study run`, in this process."""
    return run_studies([study], home)


def newest(home: Path) -> int:
    """The last point that was saved, of the run that is furthest."""
    return max((int(file.stem) for file in home.glob("checkpoints/*/0*.pt")), default=0)


def test_killed_workers_and_a_terminated_driver(home: Path, uninterrupted: bytes) -> None:
    process = driver(home)
    workers = started_by(process.pid, WORKER)
    assert workers
    for worker in workers:
        worker.kill()
    time.sleep(0.1)  # what was being written is written
    points = newest(home)
    while process.poll() is None and newest(home) <= points:  # until another worker went on
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    out = process.communicate(timeout=600)[0]
    assert process.returncode == 143, out
    assert "its worker died; another one continues it" in out
    assert "failed" not in out
    assert "Traceback" not in out
    assert all_end(process.pid)
    finish(home, uninterrupted)
