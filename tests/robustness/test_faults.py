"""Killed drivers, workers and servers, and damaged checkpoints: the end is that of a launch that nobody disturbed.

`make deep` kills more often; `make soak` does the same for longer, with Ray and MLflow's own server in every launch.
"""

import random
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import pytest
from mlflow import MlflowClient

from pipelines.export.tables import export_study
from tests.depth import often
from tests.pipelines.support import fresh, setting, tiny
from tests.robustness.chaos import KILLED, Run, Server, damage, everything, faults, launch, start_launch

RATES = {"slow": 1e-4, "fast": 1e-2, "twin": 1e-2}  # the last is copied from the one before
STUDY = tiny(points=often(8, 20), arms={arm: setting(lr=rate) for arm, rate in RATES.items()})
KILLS = often(5, 10)
NOTHING_WRONG = dict.fromkeys(faults([], []), 0)


class Whole:
    """The state that an undisturbed launch leaves."""

    def __init__(self, home: Path) -> None:
        assert launch(STUDY, home) == 0, (home / "driver.log").read_text()
        self.writes = int((home / "writes").read_text())
        self.runs, self.table = everything(STUDY, home), table(home)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, template: Path) -> Whole:
    return Whole(fresh(tmp_path_factory.mktemp("whole"), template))


def table(home: Path) -> bytes:
    """The exported values."""
    assert export_study(STUDY, home / "out", home) == 0
    return (home / "out" / "tiny.parquet").read_bytes()


def assert_as_whole(home: Path, whole: Whole) -> None:
    found: list[Run] = everything(STUDY, home)
    assert faults(found, whole.runs) == NOTHING_WRONG
    assert found == whole.runs
    assert table(home) == whole.table
    assert not list(home.glob("checkpoints/*/*")), "checkpoints of finished runs"


def test_drivers_killed_at_random_writes_and_damaged_checkpoints(tmp_path: Path, template: Path, whole: Whole) -> None:
    rng, kills, damages, campaign = random.Random(4), 0, 0, 0
    while kills < KILLS:
        campaign += 1
        home = fresh(tmp_path / str(campaign), template)
        status = KILLED
        while status != 0:
            status = launch(STUDY, home, rng.randrange(1, whole.writes // 3) if kills < KILLS else 0)
            assert status in (0, KILLED), (home / "driver.log").read_text()
            kills += status == KILLED
            damages += kills % 2 and bool(damage(home, rng))
        assert_as_whole(home, whole)
    assert damages >= 2


def test_servers_killed_at_random_writes(
    tmp_path: Path, template: Path, whole: Whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, kills, gave_up, campaign = random.Random(5), 0, 0, 0
    while kills < KILLS:
        campaign += 1
        home = fresh(tmp_path / str(campaign), template)
        server = Server(home)
        server.start()
        driver = start_launch(STUDY, home, uri=server.uri)
        server.kill()
        while driver.exitcode != 0:
            if driver.exitcode is not None:  # it gave up
                assert driver.exitcode == 2, (home / "driver.log").read_text()
                gave_up += 1
                assert gave_up < 30
            if not server.alive and (kills != 3 or driver.exitcode is not None):  # once, it stays dead
                kills += 1
                server.start(rng.randrange(1, whole.writes // 8) if kills < KILLS else 0)
            if driver.exitcode is not None:
                driver = start_launch(STUDY, home, uri=server.uri)
            time.sleep(0.01)
        if not server.alive:
            server.start()
        with monkeypatch.context() as patch:
            patch.setenv("MLFLOW_TRACKING_URI", server.uri)
            assert_as_whole(home, whole)
        server.kill()
    assert gave_up >= 1


def test_a_disk_that_is_full_at_first(tmp_path: Path, template: Path, whole: Whole) -> None:
    home = fresh(tmp_path / "home", template)
    with closing(sqlite3.connect(home / "mlflow.db")) as database:
        database.execute("VACUUM")  # no free pages: whatever is logged makes it grow
    assert launch(STUDY, home, room=(home / "mlflow.db").stat().st_size + 2**16) == 2
    said = (home / "driver.log").read_text()
    assert "Traceback" not in said
    assert [line for line in said.splitlines() if line.startswith("rhmc: ")][-1].startswith(f"rhmc: sqlite:///{home}")
    assert everything(STUDY, home) != whole.runs
    assert launch(STUDY, home) == 0
    assert_as_whole(home, whole)


def test_two_studies_at_once_and_a_reader(tmp_path: Path, template: Path, whole: Whole) -> None:
    home = fresh(tmp_path / "home", template)
    other = tiny("other", points=often(8, 20), arms={"slow": setting(lr=1e-4), "other": setting(lr=1e-3)})
    drivers = [start_launch(study, home) for study in (STUDY, other)]
    client, reads = MlflowClient(f"sqlite:///{home}/mlflow.db"), 0
    while any(driver.exitcode is None for driver in drivers):
        places = [place.experiment_id for place in client.search_experiments()]
        for run in client.search_runs(places, order_by=["metrics.`return` DESC"]):
            client.get_metric_history(run.info.run_id, "return")
        reads += 1
        time.sleep(0.02)
    said = (home / "driver.log").read_text()
    assert [driver.exitcode for driver in drivers] == [0, 0], said
    assert "locked" not in said
    assert reads > 3
    assert_as_whole(home, whole)
    runs = {run.name.split("/")[1]: run for run in everything(other, home)}
    mine = {run.name.split("/")[1]: run for run in whole.runs}
    assert runs["slow"].history == mine["slow"].history  # trained in one of the two, or in both
    assert runs["slow"].files["policy.pt"] == mine["slow"].files["policy.pt"]
    assert {run.status for run in runs.values()} == {"FINISHED"}
