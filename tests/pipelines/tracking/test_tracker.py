"""Both logs, MLflow's and the twin in memory, against what the protocol promises; then what is MLflow's alone."""

import json
import math
import shutil
import socket
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from mlflow import MlflowClient
from mlflow.data import get_source
from mlflow.entities import DatasetInput

from pipelines.specs.safe_names import shown
from pipelines.tracking import histories, mlflow_tracker
from pipelines.tracking.mlflow_tracker import MlflowTracker, open_existing
from pipelines.tracking.tracker import Card, Row, StudyCard, Tracker, points_of
from pipelines.workspace.addresses import without_password
from pipelines.workspace.provenance import Host
from pipelines.workspace.work_folder import Home, StoreError
from tests.memory_tracker import MemoryRun, MemoryTracker
from tests.robustness.chaos import Server

STUDY = StudyCard("demo", "quick", "**Why?**")
OTHER = StudyCard("other", "quick", "")
CARD = Card("full", 3, "5pec", "c0de", "iql", "coverage", "abc", {"algo.lr": "0.1", "seed": "3"})

Open = Callable[..., Tracker]


@pytest.fixture(params=["memory", "mlflow"])
def opened(request: pytest.FixtureRequest, home: Path) -> Open:
    """Opens a tracker of a store; again and again, as one launch after another does."""
    shelf: list[MemoryRun] = []

    def memory(study: StudyCard = STUDY) -> Tracker:
        return MemoryTracker(study, shelf)

    def mlflow(study: StudyCard = STUDY) -> Tracker:
        return MlflowTracker(study, Home(home))

    return memory if request.param == "memory" else mlflow


def point(step: int, **values: float) -> dict[str, float]:
    """A point of two metrics."""
    return {"step": float(step), "eval/return": step / 7, "train/loss": 1 / (step + 1)} | values


def logged_steps(tracker: Tracker, ref: str, metric: str) -> list[int]:
    """The steps of a metric as the log holds them, doubled ones twice."""
    if isinstance(tracker, MlflowTracker):
        return sorted(value.step for value in tracker.client.get_metric_history(ref, shown(metric)))
    return [row.step for row in tracker.rows([ref]) if row.metric == metric]


def test_the_task_of_a_run_is_its_dataset(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    card = CARD._replace(env={"kind": "coverage", "agents": 4})

    def logged(card: Card) -> list[DatasetInput]:
        return tracker.client.get_run(tracker.start(card).ref).inputs.dataset_inputs

    (first,) = logged(card)
    assert (first.dataset.name, json.loads(first.dataset.profile or "")) == ("coverage", card.env)
    source = get_source(first)  # MLflow's own reader
    assert json.loads(source.to_json())["tags"] == card.env
    assert [one.dataset.digest for one in logged(card)] == [first.dataset.digest]  # continued: no second one
    (same,) = logged(card._replace(seed=4, spec_id="seed"))
    (other,) = logged(card._replace(spec_id="other", env={"kind": "coverage", "agents": 5}))
    assert same.dataset.digest == first.dataset.digest != other.dataset.digest
    assert logged(CARD._replace(spec_id="unknown")) == []


def test_a_launch_goes_on_without_it(
    home: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    tracker = MlflowTracker(STUDY, Home(home))

    def refuse(*given: object) -> None:
        raise OSError("no room")

    monkeypatch.setattr(tracker.client, "log_inputs", refuse)
    tracker.start(CARD._replace(env={"kind": "coverage"})).finish("finished")
    assert [run.status for run in tracker.recorded()] == ["finished"]
    assert "full s3: its task in the log: left out (OSError: no room)" in capfd.readouterr().err


def test_what_is_logged_can_be_read(opened: Open) -> None:
    tracker = opened()
    run = tracker.start(CARD)
    run.log([point(0), point(8)])
    run.log([point(16)])
    assert points_of(tracker.rows([run.ref])) == [point(0), point(8), point(16)]
    assert tracker.rows([run.ref])[:2] == [
        Row(run.ref, 0, "eval/return", 0.0),
        Row(run.ref, 0, "train/loss", 1.0),
    ]


def test_a_continued_run_is_the_same_run_and_no_step_is_doubled(opened: Open) -> None:
    first = opened().start(CARD)
    first.log([point(0), point(8)])
    tracker = opened()
    assert [run.status for run in tracker.recorded()] == ["interrupted"]  # the first launch is gone
    second = tracker.start(CARD)
    assert second.ref == first.ref
    second.log([point(0), point(8) | {"eval/return": -1.0}, point(16)])
    assert points_of(tracker.rows([first.ref])) == [point(0), point(8), point(16)]
    assert logged_steps(tracker, first.ref, "eval/return") == [0, 8, 16]


def test_points_that_were_never_logged_are_filled_in(opened: Open) -> None:
    opened().start(CARD).log([point(0), {"step": 8.0, "eval/return": 8 / 7}])
    tracker = opened()
    run = tracker.start(CARD)
    run.log([point(0), point(8), point(16), point(24)])
    run.log([point(24), point(32)])
    assert points_of(tracker.rows([run.ref])) == [point(step) for step in (0, 8, 16, 24, 32)]
    assert logged_steps(tracker, run.ref, "eval/return") == [0, 8, 16, 24, 32]
    assert logged_steps(tracker, run.ref, "train/loss") == [0, 8, 16, 24, 32]


def test_some_metrics_are_read_alone(opened: Open) -> None:
    tracker = opened()
    run = tracker.start(CARD)
    run.log([point(step, **{"eval/coverage": 1.0}) for step in (0, 8)])
    wanted = {"eval/return", "train/loss", "none/such"}
    assert tracker.rows([run.ref], wanted) == [row for row in tracker.rows([run.ref]) if row.metric in wanted]
    assert [row.step for row in tracker.rows([run.ref], {"eval/return"})] == [0, 8]
    assert tracker.rows([run.ref], set()) == []


def test_runs_are_told_apart_by_arm_and_key(opened: Open) -> None:
    tracker = opened()
    cards = [CARD, CARD._replace(arm="none"), CARD._replace(spec_id="0ther"), CARD._replace(fingerprint="changed")]
    refs = [tracker.start(card).ref for card in cards]
    assert len(set(refs)) == 4
    assert [tracker.start(card).ref for card in cards] == refs
    assert {(run.arm, run.key) for run in tracker.recorded()} == {(card.arm, card.key) for card in cards}


@pytest.mark.parametrize("status", ["finished", "failed", "interrupted"])
def test_the_status_is_kept_and_a_new_launch_reopens(opened: Open, status: str) -> None:
    tracker = opened()
    tracker.start(CARD).finish(status)
    tracker.close("interrupted")
    assert [run.status for run in opened().recorded()] == [status]
    tracker = opened()
    tracker.start(CARD)
    assert [run.status for run in tracker.recorded()] == ["running"]
    tracker.close("interrupted")
    assert [run.status for run in tracker.recorded()] == ["interrupted"]


def test_a_stale_run_is_marked_until_it_is_planned_again(opened: Open) -> None:
    tracker = opened()
    refs = [tracker.start(card).ref for card in (CARD, CARD._replace(spec_id="0ther"))]
    assert [run.stale for run in tracker.recorded()] == [False, False]
    tracker.mark(refs[0], stale=True)
    assert [run.stale for run in opened().recorded()] == [True, False]
    opened().mark(refs[0], stale=False)
    assert [run.stale for run in opened().recorded()] == [False, False]


def test_a_launch_leaves_other_studies_alone(opened: Open) -> None:
    opened(OTHER).start(CARD)
    tracker = opened()
    tracker.start(CARD).finish("finished")
    tracker.close("finished")
    assert [run.status for run in tracker.recorded()] == ["finished"]


def test_a_finished_run_is_found_from_another_study(opened: Open) -> None:
    run = opened(OTHER).start(CARD)
    assert opened().finished_anywhere([CARD.key]) == {}
    run.finish("finished")
    assert opened().finished_anywhere([CARD.key, "more"]) == {CARD.key: run.ref}
    assert opened().finished_anywhere(["5pec-changed"]) == {}


def test_no_number_is_a_number_too(opened: Open) -> None:
    tracker = opened()
    run = tracker.start(CARD)
    run.log([point(0, **{"train/loss": math.nan})])
    values = [row.value for row in tracker.rows([run.ref]) if row.metric == "train/loss"]
    assert len(values) == 1
    assert math.isnan(values[0])


# MLflow alone


def test_how_a_run_looks_in_mlflow(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    log = tracker.start(CARD)
    log.text("config.yaml", "a: 1\n")
    (home / "policy.pt").write_bytes(b"weights")
    log.artifact(home / "policy.pt")
    run, parent = tracker.client.get_run(log.ref), tracker.client.get_run(tracker.parent)
    assert tracker.client.get_experiment(run.info.experiment_id).name == "demo (quick)"
    assert run.data.params == CARD.params
    expected = {
        "study": "demo",
        "profile": "quick",
        "arm": "full",
        "algorithm": "iql",
        "task": "coverage",
        "seed": "3",
        "spec": "5pec",
        "fingerprint": "c0de",
        "commit": "abc",
        "mlflow.parentRunId": tracker.parent,
    }
    assert run.data.tags.items() >= expected.items()
    assert "machine" not in run.data.tags  # not known: no empty word
    tracker.start(CARD._replace(spec_id="other", host=Host("a machine", "torch 2"))).finish("finished")
    assert {run.key: run.host for run in tracker.recorded()}["other-c0de"] == ("a machine", "torch 2")
    note = parent.data.tags["mlflow.note.content"]
    assert note.startswith("[Curves by arm](#/experiments/")
    assert ") · **Why?**" in note
    assert tracker.client.get_experiment(run.info.experiment_id).tags["mlflow.note.content"] == note
    assert tracker.file(log.ref, "none.pt", home) is None
    (home / "copy").mkdir()
    kept = tracker.file(log.ref, "policy.pt", home / "copy")
    assert kept is not None
    assert kept.read_bytes() == (home / "policy.pt").read_bytes()
    assert parent.data.metrics == {}
    assert sorted(a.path for a in tracker.client.list_artifacts(log.ref)) == ["config.yaml", "policy.pt"]
    assert run.info.artifact_uri.startswith((home / "artifacts").as_uri())


@pytest.mark.parametrize("lister", ["_listed_sqlite", "_listed_client"])
def test_runs_of_an_older_version_are_set_aside(home: Path, lister: str, monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    assert tracker.remarks == []
    old = tracker.start(CARD)
    tracker.client.set_tag(old.ref, "variant", CARD.arm)
    tracker.client.delete_tag(old.ref, "arm")
    for name in ("other", "third"):
        tracker.start(CARD._replace(spec_id=name)).finish("finished")
    monkeypatch.setattr(MlflowTracker, "_listed_sqlite", getattr(MlflowTracker, lister))
    for again in (MlflowTracker(STUDY, Home(home)), open_existing(STUDY, Home(home))):
        assert again is not None
        assert [run.key for run in again.recorded()] == ["other-c0de", "third-c0de"]
        assert [remark.partition("; ")[0] for remark in again.remarks] == [
            "the log holds runs of an older version (without the tag 'arm'), which are set aside: 1"
        ]
    assert MlflowTracker(STUDY, Home(home)).start(CARD).ref != old.ref


def test_a_study_keeps_one_parent_which_ends_as_the_launch_does(home: Path) -> None:
    first = MlflowTracker(STUDY, Home(home))
    assert first.client.get_run(first.parent).info.status == "RUNNING"
    first.close("interrupted")
    second = MlflowTracker(STUDY, Home(home))
    second.close("finished")
    assert second.parent == first.parent
    assert second.client.get_run(second.parent).info.status == "FINISHED"


def test_a_retried_run_forgets_its_error(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    run = tracker.start(CARD)
    run.tag("error", "boom")
    run.finish("failed")
    tracker.start(CARD)
    assert "error" not in tracker.client.get_run(run.ref).data.tags


def test_a_run_that_a_dying_server_made_twice_is_kept_once(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    for _ in range(2):
        tracker._create("full s3", tracker._tags(CARD))
        tracker._create("demo", {"role": "study"})
    run = tracker.start(CARD)
    run.log([point(0)])
    assert [(one.ref, one.status) for one in tracker.recorded()] == [(run.ref, "running")]
    again = MlflowTracker(STUDY, Home(home))
    assert again.parent == tracker.parent
    assert len(again._search("tags.role = 'study'")) == 1
    assert again.start(CARD).ref == run.ref


def test_params_that_a_killed_driver_did_not_write_are_filled_in(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    made = tracker._create("full s3", tracker._tags(CARD))
    run = tracker.start(CARD)
    assert run.ref == made.info.run_id
    assert tracker.client.get_run(run.ref).data.params == CARD.params


def test_an_experiment_whose_making_was_asked_for_twice(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    assert tracker._create_experiment("demo (quick)", None) == tracker.experiment


def test_files_are_durable_before_a_run_is_finished(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    run = tracker.start(CARD)
    run.text("config.yaml", "a: 1")
    seen = []
    monkeypatch.setattr(mlflow_tracker, "sync", lambda path: seen.append((path.name, tracker.recorded()[0].status)))
    run.finish("interrupted")
    assert seen == []
    run.finish("finished")
    assert ("config.yaml", "interrupted") in seen
    assert {"artifacts", run.ref} <= {name for name, _ in seen}
    assert {status for _, status in seen} == {"interrupted"}


def test_reading_at_once_and_through_the_client_agree(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    runs = [tracker.start(CARD._replace(seed=seed, spec_id=f"s{seed}")) for seed in range(3)]
    for run in runs:
        run.log([point(step, **{"eval/max": float("inf")}) for step in range(0, 40, 8)])
    refs = [run.ref for run in runs[:2]]
    assert sorted(tracker._rows_sqlite(refs)) == sorted(tracker._rows_client(refs)) == tracker.rows(refs)
    assert len(tracker.rows(refs)) == 2 * 3 * 5
    some = {"eval/return", "eval/max"}
    assert sorted(tracker._rows_sqlite(refs, some)) == sorted(tracker._rows_client(refs, some))
    assert len(tracker.rows(refs, some)) == 2 * 2 * 5


def test_listing_at_once_and_through_the_client_agree(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    other = MlflowTracker(OTHER, Home(home))
    for seed, status in enumerate(("finished", "failed", "interrupted", "finished")):
        tracker.start(CARD._replace(seed=seed, spec_id=f"s{seed}")).finish(status)
    other.start(CARD)
    deleted = tracker.start(CARD._replace(spec_id="deleted"))
    tracker.client.delete_run(deleted.ref)
    everywhere = [tracker.experiment, other.experiment]
    found = tracker._listed_sqlite(everywhere)
    assert found == tracker._listed_client(everywhere)
    assert [run.status for _, run in found] == ["finished", "failed", "interrupted", "finished", "running"]
    assert tracker._listed_sqlite([]) == tracker._listed_client([]) == []


def test_a_server_is_asked_for_a_metric_of_many_runs_at_once(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server = Server(home)
    server.start()
    asked: list[list[str]] = []
    page, one = histories.http_request, MlflowClient.get_metric_history
    monkeypatch.setattr(histories, "http_request", lambda *a, **k: asked.append(k["params"]["run_id"]) or page(*a, **k))
    monkeypatch.setattr(MlflowClient, "get_metric_history", lambda *a: asked.append(a[1:2]) or one(*a))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", server.uri)
    try:
        tracker = MlflowTracker(STUDY, Home(home))
        runs = [tracker.start(CARD._replace(spec_id=f"s{number}")) for number in range(3)]
        for number, run in enumerate(runs):
            run.log([point(step, **{"eval/odd": math.nan, "eval/max": math.inf}) for step in range(8 * (number + 1))])
        refs, asked[:] = [run.ref for run in runs], []
        found = tracker.rows(refs)
        with monkeypatch.context() as patch:
            patch.setattr(tracker, "uri", f"sqlite:///{home}/mlflow.db")
            alone = tracker.rows(refs)
        assert [len(refs) for refs in asked] == [3] * 4  # one for each metric
        assert str(found) == str(alone)
        assert len(found) == 4 * (8 + 16 + 24)
        for most in (17, 1):  # more than an answer holds: some are asked for in halves, some one by one
            monkeypatch.setattr(histories, "VALUES", most)
            asked.clear()
            assert str(tracker.rows(refs)) == str(found)
            assert [len(refs) for refs in asked][:5] == ([3, 1, 2, 1, 1] if most == 17 else [3, 1, 1, 2, 1])
        monkeypatch.setattr(histories, "PAGE", "/api/none")  # a server that has no such page
        assert str(tracker.rows(refs)) == str(found)
    finally:
        server.kill()


def test_a_long_history_is_logged_in_requests_of_a_thousand(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    run = tracker.start(CARD)
    run.log([point(step) for step in range(1100)])
    assert len(tracker.rows([run.ref])) == 2200


def test_a_deleted_experiment_is_taken_back(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    tracker.client.delete_experiment(tracker.experiment)
    assert open_existing(STUDY, Home(home)).recorded() == []
    assert MlflowTracker(STUDY, Home(home)).experiment == tracker.experiment


def test_reading_makes_nothing(tmp_path: Path, home: Path) -> None:
    assert open_existing(STUDY, Home(tmp_path / "none")) is None
    assert not (tmp_path / "none").exists()
    tracker = open_existing(STUDY, Home(home))
    assert tracker is not None
    assert tracker.recorded() == []
    assert tracker.client.get_experiment_by_name("demo (quick)") is None


def test_where_the_log_lies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert mlflow_tracker.tracking_uri(Home(tmp_path)) == f"sqlite:///{tmp_path}/mlflow.db"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://tracking:5000")
    assert mlflow_tracker.tracking_uri(Home(tmp_path)) == "http://tracking:5000"


# Environment errors: one line that names them


def refused(home: Path) -> str:
    """The remarks of an opened log."""
    with pytest.raises(StoreError) as caught:
        MlflowTracker(STUDY, Home(home))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_text_file_is_no_database(tmp_path: Path) -> None:
    (tmp_path / "mlflow.db").write_text("hello, this is a text file\n" * 100)
    assert f"{tmp_path}/mlflow.db: not an MLflow database" in refused(tmp_path)
    assert (tmp_path / "mlflow.db").read_text().startswith("hello")


def test_another_database_is_refused_and_left_alone(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "mlflow.db") as database:
        database.execute("CREATE TABLE birds (name TEXT)")
    database.close()
    before = (tmp_path / "mlflow.db").read_bytes()
    assert f"{tmp_path}/mlflow.db: a database, but not MLflow's" in refused(tmp_path)
    assert (tmp_path / "mlflow.db").read_bytes() == before


def test_a_damaged_database(home: Path) -> None:
    data = bytearray((home / "mlflow.db").read_bytes())
    data[4096:] = b"\xff" * (len(data) - 4096)
    (home / "mlflow.db").write_bytes(data)
    assert f"{home}/mlflow.db" in refused(home)


def test_a_database_of_another_mlflow(home: Path) -> None:
    with sqlite3.connect(home / "mlflow.db") as database:
        database.execute("UPDATE alembic_version SET version_num = 'bd07f7e963c5'")
    database.close()
    message = refused(home)
    assert f"{home}/mlflow.db" in message
    assert "schema" in message


def test_a_server_that_does_not_answer(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        uri = f"http://127.0.0.1:{free.getsockname()[1]}"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    assert refused(home).startswith(f"{uri}: the MLflow server does not answer")


def test_a_password_is_shown_nowhere(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://me:secret@127.0.0.1:1")
    said = refused(home)
    assert said.startswith("http://me:***@127.0.0.1:1: the MLflow server does not answer")
    assert "refused" in said
    assert without_password("postgresql://me:secret@there/mlflow") == "postgresql://me:***@there/mlflow"
    assert without_password("http://[") == "http://["


def test_a_database_server_that_is_not_there(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*words: object) -> None:
        raise AssertionError("MLflow tries for a minute and a half")

    monkeypatch.setattr(mlflow_tracker, "MlflowClient", never)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "postgresql://me:secret@127.0.0.1:1/mlflow")
    said = refused(home)
    assert said.startswith("postgresql://me:***@127.0.0.1:1/mlflow: MLflow cannot go on")
    assert "refused" in said


def test_an_address_without_its_kind(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "127.0.0.1:5000")
    assert refused(home).startswith("MLFLOW_TRACKING_URI=127.0.0.1:5000: not an address; http://HOST:PORT")


def test_a_store_in_no_folder(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{home}/none/mlflow.db")
    assert f"{home}/none: no such folder" in refused(home)


def test_an_address_that_mlflow_does_not_know(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "carrier-pigeon://roof")
    assert "carrier-pigeon://roof" in refused(home)


def test_a_store_lost_on_the_way(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    run = tracker.start(CARD)
    with sqlite3.connect(home / "mlflow.db") as database:
        database.execute("DROP TABLE metrics")
    database.close()
    with pytest.raises(StoreError, match=r"mlflow\.db: MLflow cannot go on"):
        run.log([point(0)])


def test_a_database_is_made_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Dies:
        def __init__(self, uri: str, *rest: str) -> None:
            mlflow_tracker.sqlite_file(uri).write_bytes(b"half a database")
            raise OSError("No space left on device")

    monkeypatch.setattr(mlflow_tracker, "MlflowClient", Dies)
    assert "No space left on device" in refused(tmp_path)
    assert not list(tmp_path.glob("mlflow.db*[!k]"))  # only the lock is left


def test_the_template_is_not_written_to(template: Path, tmp_path: Path) -> None:
    shutil.copy(template, tmp_path / "mlflow.db")
    assert open_existing(STUDY, Home(tmp_path)).recorded() == []


def test_a_database_whose_writer_was_killed_in_the_middle_of_a_write_is_used_again(home: Path) -> None:
    MlflowTracker(STUDY, Home(home)).close("finished")
    file = home / "mlflow.db"
    write = (
        "import os, sqlite3, sys\n"
        "d = sqlite3.connect(sys.argv[1], isolation_level=None)\n"
        "d.execute('PRAGMA cache_size = 1')\n"
        "d.execute('BEGIN')\n"
        "d.executemany('INSERT INTO experiment_tags VALUES (?, ?, 1)', [(f'k{i}', 'v' * 900) for i in range(2000)])\n"
        "os._exit(9)\n"
    )
    subprocess.run([sys.executable, "-c", write, str(file)], check=False)
    assert file.with_name("mlflow.db-journal").stat().st_size > 0
    tracker = MlflowTracker(STUDY, Home(home))
    assert len(tracker.client.get_experiment(tracker.experiment).tags) < 10
    assert not file.with_name("mlflow.db-journal").exists()
