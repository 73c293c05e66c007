"""From a plan to a log: the recorder with the twin and no Ray, then the whole chain."""

import fcntl
import io
import json
import os
import re
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
import torch
from filelock import FileLock
from rich.console import Console
from ruamel.yaml import YAML

from pipelines.execution import progress, ray_driver, run, trainable
from pipelines.execution.joint_recorder import Recorders
from pipelines.execution.progress import LiveBoard, PlainBoard, duration
from pipelines.execution.recorder import Recorder
from pipelines.execution.run import Interrupts, _arguments, animated, run_studies, show_status
from pipelines.export.tables import export_study
from pipelines.specs.study import Study
from pipelines.tracking.mlflow_tracker import MlflowTracker, open_existing
from pipelines.tracking.plan import Item, commit, items, study_card, what_varies
from pipelines.tracking.tracker import StudyCard, points_of
from pipelines.workspace.work_folder import Checkpoints, Home, StoreError
from rhmc.algorithms import iql
from rhmc.training.trainer import Trainer
from tests.memory_tracker import MemoryRun, MemoryTracker
from tests.pipelines.support import CODE, plan, setting, spec, tiny
from tests.robustness.chaos import fit_here

STUDY = StudyCard("tiny", "quick", "")
POINTS = [{"step": float(step), "eval/return": step / 100, "time/steps_per_second": 50.0} for step in (0, 200, 400)]

Launch = Callable[..., Recorder]
STUDIES = Path(__file__).parents[3] / "studies"


@pytest.fixture
def launch(shelf: list[MemoryRun], tmp_path: Path) -> Launch:
    """A recorder as a new launch makes it."""

    def begin(runs: list[Item] | None = None, study: StudyCard = STUDY) -> Recorder:
        tracker, board = MemoryTracker(study, shelf), PlainBoard(Console(file=io.StringIO(), width=200))
        return Recorder(study, plan() if runs is None else runs, tracker, Home(tmp_path), board)

    return begin


def finish(recorder: Recorder, key: str) -> None:
    """The actions of a worker at its end."""
    folder = recorder.home.checkpoints(key)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "policy.pt").write_bytes(b"weights")
    recorder.result(key, {"done": True, "stopped": False, "points": POINTS[1:]})


def step(recorder: Recorder, key: str, *, stopped: bool = False) -> None:
    """A first result."""
    recorder.start(key)
    recorder.result(key, {"done": stopped, "stopped": stopped, "points": POINTS[:1]})


def test_a_finished_run_is_logged_whole_and_skipped_afterwards(launch: Launch, shelf: list[MemoryRun]) -> None:
    recorder = launch()
    slow, fast = [item.key for item in recorder.todo()]
    step(recorder, slow)
    finish(recorder, slow)
    assert points_of(shelf[0].values) == POINTS
    assert shelf[0].status == "finished"
    assert shelf[0].files["policy.pt"] == b"weights"
    assert not recorder.home.checkpoints(slow).exists()
    assert (recorder.left, recorder.skipped) == (1, 0)
    again = launch()
    assert [item.key for item in again.todo()] == [fast]
    assert again.skipped == 1


def test_what_was_logged_under_another_plan_is_set_aside_until_it_is_planned_again(
    launch: Launch, shelf: list[MemoryRun]
) -> None:
    recorder = launch()
    for key in [item.key for item in recorder.todo()]:
        step(recorder, key)
        finish(recorder, key)
    launch(plan()[:1])
    assert [run.tags for run in shelf] == [{}, {"stale": "yes"}]
    launch(plan()[1:])
    assert [run.tags for run in shelf] == [{"stale": "yes"}, {}]
    assert launch().skipped == 2
    assert [run.tags for run in shelf] == [{}, {}]


def test_the_whole_configuration_is_kept(launch: Launch, shelf: list[MemoryRun]) -> None:
    recorder = launch()
    item = recorder.todo()[0]
    step(recorder, item.key)
    finish(recorder, item.key)
    config = YAML(typ="safe").load(shelf[0].files["config.yaml"].decode())
    assert {name: config[name] for name in ("env", "algo", "trainer", "seed")} == item.spec.model_dump(mode="json")
    assert (config["arm"], config["commit"]) == ("slow", "abc-dirty")


def test_a_stopped_run_waits_for_the_next_launch(launch: Launch, shelf: list[MemoryRun]) -> None:
    recorder = launch()
    key = recorder.todo()[0].key
    step(recorder, key, stopped=True)
    assert shelf[0].status == "interrupted"
    assert recorder.left == 2
    again = launch()
    assert again.todo()[0].key == key
    again.start(key)
    finish(again, key)
    assert len(shelf) == 1
    assert points_of(shelf[0].values) == POINTS


def test_a_continued_run_says_at_which_step(launch: Launch) -> None:
    recorder = launch()
    first, second = (item.key for item in recorder.todo())
    Checkpoints(recorder.home.checkpoints(first)).save(3, {})
    step(recorder, first)
    step(recorder, second)
    said = recorder.board.console.file.getvalue().splitlines()
    assert said == ["tiny / slow s0: continues at step 400 of 600", "tiny / fast s0: started"]


def test_more_seeds_and_more_arms_train_only_what_is_new(launch: Launch, shelf: list[MemoryRun]) -> None:
    recorder = launch()
    for item in recorder.todo():
        step(recorder, item.key)
        finish(recorder, item.key)
    arms = {"slow": setting(lr=1e-4), "fast": setting(lr=1e-2), "faster": setting(lr=1e-1)}
    more = launch(plan(tiny(arms=arms).model_copy(update={"seeds": 2})))
    more.reuse()
    assert more.skipped == 2
    names = [(item.card.arm, item.card.seed) for item in more.todo()]
    assert names == [("slow", 1), ("fast", 1), ("faster", 0), ("faster", 1)]
    renamed = launch(plan(tiny(arms={"crawling": arms["slow"]})))
    renamed.reuse()
    assert (renamed.left, shelf[-1].card.arm, shelf[-1].status) == (0, "crawling", "finished")


def test_a_variant_shares_with_the_study_what_is_the_same_run(launch: Launch) -> None:
    recorder = launch()
    for item in recorder.todo():
        step(recorder, item.key)
        finish(recorder, item.key)
    variant = tiny("tiny@other", arms={"slow": setting(lr=1e-4), "new": setting(lr=1.0)})
    again = launch(plan(variant), study_card(variant))
    again.reuse()
    assert [item.card.arm for item in again.todo()] == ["new"]


def test_a_failure_is_kept_and_tried_again(launch: Launch, shelf: list[MemoryRun]) -> None:
    recorder = launch()
    key = recorder.todo()[0].key
    recorder.failed(key, "ValueError: no", "Traceback ... ValueError: no")
    assert [(name.split(" / ")[1], error) for name, error in recorder.failures.items()] == [
        ("slow s0", "ValueError: no")
    ]
    assert (shelf[0].status, shelf[0].tags["error"]) == ("failed", "ValueError: no")
    assert shelf[0].files["error.txt"].startswith(b"Traceback")
    assert launch().todo()[0].key == key


def test_a_failure_that_a_worker_tells_is_kept(launch: Launch, shelf: list[MemoryRun]) -> None:
    recorder = launch()
    key = recorder.todo()[0].key
    recorder.start(key)
    recorder.result(key, {"done": True, "stopped": False, "points": [], "error": "boom", "trace": "Traceback"})
    assert (shelf[0].status, shelf[0].tags["error"]) == ("failed", "boom")
    assert key not in [item.key for item in recorder.todo()]  # not again in this launch
    assert recorder.left == 2


def test_what_another_process_trains_is_waited_for(launch: Launch, shelf: list[MemoryRun]) -> None:
    recorder = launch()
    key, free = [item.key for item in recorder.todo()]
    recorder.start(key)
    recorder.result(key, {"done": True, "stopped": True, "busy": True, "points": []})
    step(recorder, free, stopped=True)
    assert [run.status for run in shelf] == ["interrupted", "interrupted"]
    together = Recorders([recorder])
    assert together.again()
    assert not together.again()  # asked for once


def test_a_run_whose_node_died_is_trained_once_more(launch: Launch, shelf: list[MemoryRun]) -> None:
    recorder = launch()
    key = recorder.todo()[0].key
    recorder.start(key)
    for node in ("host (a)", "host (b)"):
        recorder.placed(key, node)
    assert shelf[0].tags["nodes"] == "host (a), host (b)"
    recorder.lost(key)
    assert shelf[0].status == "interrupted"
    assert Recorders([recorder]).again()
    assert key in [item.key for item in recorder.todo()]
    assert recorder.failures == {}


def test_checkpoints_that_a_killed_launch_left_of_a_finished_run_go(launch: Launch) -> None:
    recorder = launch()
    key, other = [item.key for item in recorder.todo()]
    step(recorder, key)
    finish(recorder, key)
    for folder in (key, other):
        recorder.home.checkpoints(folder).mkdir(parents=True)
    again = launch()
    assert not again.home.checkpoints(key).exists()
    assert again.home.checkpoints(other).exists()


def test_arms_that_are_the_same_run_are_trained_once(launch: Launch, shelf: list[MemoryRun]) -> None:
    runs = plan()
    twin = runs[0]._replace(card=runs[0].card._replace(arm="twin"))
    recorder = launch([*runs, twin])
    assert [item.card.arm for item in recorder.todo()] == ["slow", "fast"]
    step(recorder, runs[0].key)
    finish(recorder, runs[0].key)
    assert [(run.card.arm, run.status) for run in shelf] == [("slow", "finished"), ("twin", "finished")]
    assert points_of(shelf[1].values) == POINTS
    assert shelf[1].tags["reused_from"] == shelf[0].ref


def test_a_study_whose_twin_could_not_be_copied_is_not_finished(
    launch: Launch, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise StoreError("the disk is full")

    run = plan()[0]
    recorder = launch([run, run._replace(card=run.card._replace(arm="twin"))])
    monkeypatch.setattr(recorder, "_copy", full)
    step(recorder, run.key)
    with pytest.raises(StoreError):
        finish(recorder, run.key)
    assert recorder.status == "interrupted"


def test_what_another_study_finished_is_copied(launch: Launch, shelf: list[MemoryRun]) -> None:
    other = launch(study=STUDY._replace(study="other"))
    key = other.todo()[0].key
    step(other, key)
    other.home.checkpoints(key).mkdir(parents=True)
    (other.home.checkpoints(key) / "episode.gif").write_bytes(b"GIF89a")
    finish(other, key)
    recorder = launch()
    recorder.reuse()
    assert [item.card.arm for item in recorder.todo()] == ["fast"]
    assert [(run.study.study, run.status) for run in shelf] == [("other", "finished"), ("tiny", "finished")]
    assert points_of(shelf[1].values) == POINTS
    assert shelf[1].files["policy.pt"] == shelf[0].files["policy.pt"] == b"weights"
    assert shelf[1].models == shelf[0].models == [b"weights"]
    assert shelf[1].files["episode.gif"] == b"GIF89a"


def test_other_code_is_another_run(launch: Launch) -> None:
    recorder = launch()
    for item in recorder.todo():
        step(recorder, item.key)
        finish(recorder, item.key)
    stale = [item._replace(card=item.card._replace(fingerprint="0ther")) for item in plan()]
    assert launch().left == 0
    assert launch(stale).left == 2


def test_params_are_what_varies_and_method_and_seed() -> None:
    assert [item.card.params for item in plan()] == [
        {"method": "iql", "algo.lr": "0.0001", "seed": "0"},
        {"method": "iql", "algo.lr": "0.01", "seed": "0"},
    ]
    kinds = plan(tiny(arms={"a": setting(), "b": setting(encoder="pairwise")}))
    assert kinds[1].card.params["algo.encoder"] == "pairwise"


def test_the_experiment_says_what_it_is_about() -> None:
    note = study_card(tiny()).note
    assert "Does the whole chain hold?" in note
    assert "Profile `quick`: 2 arms × 1 seeds, 600 environment steps each." in note
    assert "- **slow**: the base\n- **fast**: `algo.lr=0.01`" in note
    assert study_card(tiny()).params == {"iql": ["algo.lr"]}
    assert study_card(tiny().model_copy(update={"seeds": 2})).params == {"iql": ["algo.lr", "seed"]}


def test_the_method_is_named_once() -> None:
    study = Study.load(STUDIES / "coverage.yaml")
    params = study_card(study).params
    assert not any("algo.kind" in names for names in params.values())
    cards = [item.card for item in plan(study)]
    assert {name for card in cards for name in card.params} == {
        "method",
        *(n for names in params.values() for n in names),
    }
    assert {card.params["method"] for card in cards} >= {"rhmc", "qmix", "mappo"}


def test_the_first_seed_of_an_arm_leaves_an_animation() -> None:
    study = tiny().model_copy(update={"seeds": 2})
    runs = plan(study)
    assert animated(study, runs) == {item.key for item in runs if item.card.seed == 0}
    for which, keys in {"all": {item.key for item in runs}, "none": set()}.items():
        changed = study.model_copy(update={"resources": study.resources.model_copy(update={"animate": which})})
        assert animated(changed, runs) == keys


# What a person sees


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0 s"), (59.6, "1:00"), (185, "3:05"), (3785, "1:03:05")])
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_plain_lines_come_at_most_every_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    now, out = [0.0], io.StringIO()
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    board = PlainBoard(Console(file=out, width=40))
    board.start("full s0", 1000)
    for k in range(5):
        now[0] = 4.0 * k
        board.points("full s0", [{"step": 100.0 * k, "eval/return": 1.5 * k, "time/steps_per_second": 50.0}])
    board.end("full s0", "finished")
    assert out.getvalue().splitlines() == [
        "full s0: started",
        "full s0: 300 of 1,000 steps, 50 steps/s, return 4.50, 14 s left",
        "full s0: finished, return 6.00",
    ]


def test_a_terminal_gets_a_line_per_running_run() -> None:
    out = io.StringIO()
    with LiveBoard(Console(file=out, force_terminal=True, width=120)) as board:
        board.start("full s0", 1000)
        board.start("full s1", 1000)
        board.points("full s0", [{"step": 500.0, "eval/return": 2.0, "time/steps_per_second": 50.0}])
        board.progress.refresh()
        shown = out.getvalue()
        board.end("full s0", "finished")
    for part in ("full s0", "500/1,000", "50 steps/s", "return 2.00", "10 s left", "full s1", "starting"):
        assert part in shown
    assert "full s0: finished, return 2.00" in out.getvalue()


def test_runs_of_a_killed_driver_are_not_said_to_be_running(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study = tiny()
    plan = items(study)
    MlflowTracker(study_card(study), Home(home)).start(plan[0].card)

    def slow() -> dict[str, int]:
        assert show_status(study, home, as_json=True) == 3
        arm: dict[str, int] = json.loads(capsys.readouterr().out)["arms"]["slow"]
        return arm

    with Home(home).lock(study.name, study.profile):
        assert (slow()["running"], slow()["interrupted"]) == (1, 0)
    assert (slow()["running"], slow()["interrupted"]) == (0, 1)


def test_a_run_that_diverges_looks_failed_everywhere(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(ray_driver, "ray_session", lambda *args: nullcontext([]))
    monkeypatch.setattr(ray_driver, "fit", fit_here)
    study = tiny(arms={"calm": setting(lr=1e-3), "wild": setting(lr=1e6, learning_starts=0)})
    assert run_studies([study], home) == 3
    said = capsys.readouterr().out
    (line,) = [line for line in said.splitlines() if line.startswith("failed: ")]
    assert line.startswith("failed: tiny / wild s0: diverged: train/")
    assert "at step 200; every value must be finite" in line
    assert re.search(r"wild +0 of 1 +- *$", said, re.MULTILINE)

    assert show_status(study, home) == 3
    assert line in capsys.readouterr().out.splitlines()
    assert show_status(study, home, as_json=True) == 3
    told = json.loads(capsys.readouterr().out)
    assert (told["arms"]["wild"]["failed"], told["arms"]["wild"]["finished"]) == (1, 0)
    assert told["errors"] == {"tiny / wild s0": line.removeprefix("failed: tiny / wild s0: ")}

    tracker = open_existing(study_card(study), Home(home))
    assert tracker is not None
    wild = next(run for run in tracker.recorded() if run.arm == "wild")
    kept = {file.path for file in tracker.client.list_artifacts(wild.ref)}
    assert (wild.status, wild.error, kept) == ("failed", told["errors"]["tiny / wild s0"], {"config.yaml", "error.txt"})
    assert not list(tracker.client.search_model_versions(f"run_id = '{wild.ref}'"))
    assert {row.step for row in tracker.rows([wild.ref])} == {0}

    assert export_study(study, home / "out", home) == 3
    table = pq.read_table(home / "out" / "tiny.runs.parquet").to_pandas().set_index("arm")
    assert table.status.to_dict() == {"calm": "finished", "wild": "failed"}
    assert run_studies([study], home) == 3  # the same settings, the same end
    assert line in capsys.readouterr().out.splitlines()


# Environment errors


def test_a_second_driver_is_refused(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Home(home).lock("tiny", "quick"):
        assert run_studies([tiny()], home) == 2
    message = capsys.readouterr().err
    assert f"tiny (quick) is already being run by process {os.getpid()}" in message
    assert message.count("\n") == 1
    with Home(home).lock("tiny", "paper"), Home(home).lock("tiny", "quick"):
        pass  # another profile is free, and so is this one again


def test_a_work_folder_that_cannot_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert run_studies([tiny()], tmp_path / "file" / "work") == 2
    message = capsys.readouterr().err
    assert message.startswith(f"rhmc: {tmp_path}/file/work: cannot be written to: ")
    assert message.count("\n") == 1


def test_a_foreign_store(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mlflow.db").write_text("not a database\n" * 100)
    for command in (lambda study, home: run_studies([study], home), show_status):
        assert command(tiny(), tmp_path) == 2
        message = capsys.readouterr().err
        assert f"{tmp_path}/mlflow.db: not an MLflow database" in message
        assert message.count("\n") == 1


def test_a_server_that_is_not_mlflow(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Shop(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"<html>flowers</html>")

        def log_message(self, *args: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Shop) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        uri = f"http://127.0.0.1:{server.server_port}"
        monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
        assert run_studies([tiny()], home) == 2
        server.shutdown()
    message = capsys.readouterr().err
    assert uri in message
    assert message.count("\n") == 1


@pytest.mark.parametrize(("done", "code"), [(0, 3), (1, 3), (2, 0)])
def test_the_status_as_json_has_the_exit_code_of_the_table(
    done: int, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mlflow.db").touch()
    tracker = MemoryTracker(study_card(tiny()), [])
    for item in plan()[:done]:
        tracker.start(item.card).finish("finished")
    for name, value in (("own", True), ("remarks", [])):
        monkeypatch.setattr(tracker, name, value, raising=False)
    monkeypatch.setattr("pipelines.tracking.mlflow_tracker.open_existing", lambda *given: tracker)
    assert show_status(tiny(), tmp_path) == code
    capsys.readouterr()
    assert show_status(tiny(), tmp_path, as_json=True) == code
    told = json.loads(capsys.readouterr().out)
    assert told["finished"] == (code == 0)
    assert sum(arm["finished"] for arm in told["arms"].values()) == done


def test_the_status_before_anything_ran(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert show_status(tiny(), tmp_path) == 3
    assert capsys.readouterr().out.splitlines()[1].split() == ["slow", "1", "0", "0", "0", "0", "1", "0"]
    assert list(tmp_path.iterdir()) == []


# Signals


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_outside_training_ends_the_launch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals, code: int
) -> None:
    monkeypatch.setattr(run, "_launch", lambda *args: signal.raise_signal(number))
    before = signal.getsignal(number)
    assert run_studies([tiny()], tmp_path) == code
    assert signal.getsignal(number) is before
    with Home(tmp_path).lock("tiny", "quick"):
        pass  # let go of


def test_rays_own_answer_to_sigterm_ends_the_launch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "_launch", lambda *args: sys.exit(15))
    assert run_studies([tiny()], tmp_path) == 143


def test_the_first_signal_in_training_asks_and_the_second_ends(tmp_path: Path) -> None:
    stop = tmp_path / "stop"
    with Interrupts() as interrupts:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # as Ray does when it starts
        with interrupts.go_to(stop):
            assert not interrupts.came
            signal.raise_signal(signal.SIGTERM)
            assert (interrupts.came, interrupts.code, stop.exists()) == (True, 143, True)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
    assert interrupts.code == 130


def test_a_signal_on_a_full_disk_ends_the_launch(tmp_path: Path) -> None:
    with (
        Interrupts() as interrupts,
        interrupts.go_to(tmp_path / "none" / "stop"),
        pytest.raises(KeyboardInterrupt),
    ):
        signal.raise_signal(signal.SIGINT)


PRINTS = """
import sys
from pathlib import Path
from rich.console import Console
from pipelines.execution.progress import PlainBoard, StopFile
from pipelines.execution.run import Interrupts
board, path = PlainBoard(Console()), Path(sys.argv[1])
with Interrupts() as interrupts, interrupts.go_to(path):
    stop = StopFile(path, board)
    for k in range(2000):
        board.say(f"{k:100}")
        stop.exists()
print(interrupts.code)
"""


def test_a_signal_in_the_middle_of_a_print_disturbs_no_line(tmp_path: Path) -> None:
    """Nobody reads, so the pipe is full and the signal comes while a line is being written."""
    command = [sys.executable, "-c", PRINTS, str(tmp_path / "stop")]
    quiet = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    process = subprocess.Popen(command, cwd=Path(__file__).parents[3], env=quiet, text=True, **pipes)
    assert process.stdout is not None
    held = [-1, 0]
    while held[-1] != held[-2] or not held[-1]:  # until the pipe fills no further
        assert process.poll() is None, process.stdout.read()
        time.sleep(0.5)
        held.append(int.from_bytes(fcntl.ioctl(process.stdout, termios.FIONREAD, bytes(4)), sys.byteorder))
    process.send_signal(signal.SIGTERM)
    while not (tmp_path / "stop").exists():
        time.sleep(0.01)
    lines = process.communicate(timeout=60)[0].splitlines()
    said = [line for line in lines if "interrupted" in line]
    assert said == ["interrupted: each run stops at its next point and saves itself; again to leave at once"]
    assert [line for line in lines if line not in said] == [*(f"{k:100}" for k in range(2000)), "143"]


# The whole chain


def test_a_run_that_another_process_trains_is_trained_when_that_lets_go(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    launches = []

    def fit(jobs: list[dict[str, Any]], *rest: Any) -> None:
        launches.append([job["key"] for job in jobs])
        if len(launches) == 2:
            held.release()
        fit_here(jobs, *rest)

    monkeypatch.setattr(trainable, "PATIENCE", 0.0)
    monkeypatch.setattr(ray_driver, "fit", fit)
    monkeypatch.setattr(ray_driver, "ray_session", lambda *args: nullcontext([]))
    key = f"{tiny().runs()[0].spec.id}-{CODE}"
    Home(home).checkpoints(key).parent.mkdir()
    held = FileLock(f"{Home(home).checkpoints(key)}.lock")
    held.acquire()
    assert run_studies([tiny()], home) == 0
    assert launches == [[key, launches[0][1]], [key]]
    assert "slow s0: another process is training it; waiting for that" in capsys.readouterr().out


@pytest.mark.ray
def test_run_skip_fail_and_retry(home: Path, cluster: None, capsys: pytest.CaptureFixture[str]) -> None:
    study = tiny(concurrent=1)
    slow, fast = study.runs()
    blocked = Home(home).checkpoints(f"{slow.spec.id}-{CODE}")
    blocked.parent.mkdir()
    blocked.touch()  # a file where the checkpoints of `slow` should go

    assert run_studies([study], home) == 3
    said = capsys.readouterr()
    assert f"failed: {study.name} / slow s0: " in said.out
    assert str(blocked) in said.out
    assert "Traceback" not in said.out + said.err
    tracker = open_existing(study_card(study), Home(home))
    assert tracker is not None
    before = {run.arm: run for run in tracker.recorded()}
    assert {arm: run.status for arm, run in before.items()} == {"slow": "failed", "fast": "finished"}
    tags = tracker.client.get_run(before["slow"].ref).data.tags
    assert str(blocked) in tags["error"]
    assert show_status(study, home) == 3

    blocked.unlink()
    assert run_studies([study], home) == 0
    assert "1 of 2 runs were finished before" in capsys.readouterr().out
    after = {run.arm: run for run in tracker.recorded()}
    assert {arm: run.ref for arm, run in after.items()} == {arm: run.ref for arm, run in before.items()}
    assert {run.status for run in after.values()} == {"finished"}

    assert run_studies([study], home) == 0  # nothing to do, and Ray is not asked
    assert show_status(study, home) == 0
    assert not (home / "ray").exists() or not list((home / "ray").iterdir())

    assert export_study(study, home / "out", home) == 0
    trainer = Trainer(fast.spec.env, fast.spec.algo, fast.spec.trainer, fast.spec.seed)
    expected = [(int(p["step"]), name, value) for p in trainer for name, value in p.items() if name != "step"]
    rows = [row for row in tracker.rows([after["fast"].ref]) if not row.metric.startswith("time/")]
    assert [(row.step, row.metric, row.value) for row in rows] == sorted(expected)
    files = tracker.client.list_artifacts(after["fast"].ref)
    assert sorted(file.path for file in files) == ["config.yaml", "episode.gif", "policy.pt"]
    parent = tracker.client.search_runs([tracker.experiment], "tags.role = 'study'")[0]
    assert sorted(file.path for file in tracker.client.list_artifacts(parent.info.run_id)) == [
        "curves.png",
        "finals.csv",
    ]
    note = parent.data.tags["mlflow.note.content"]
    assert "2 of 2 runs are finished" in note
    assert {version.name for version in tracker.client.search_model_versions()} == {
        "tiny-quick-slow",
        "tiny-quick-fast",
    }


def test_the_kept_policy_acts(tmp_path: Path) -> None:
    from pipelines.workspace.work_folder import save_atomically, without_replay

    one = spec(3)
    trainer = Trainer(one.env, one.algo, one.trainer, one.seed)
    for _ in trainer:
        pass
    save_atomically(tmp_path / "policy.pt", without_replay(trainer.state_dict()))
    policy = torch.load(tmp_path / "policy.pt", weights_only=True)["algorithm"]
    assert isinstance(one.algo, iql.Config)
    actor = iql.build(one.algo, trainer.env.spec, 8, torch.Generator())
    actor.load_state_dict(policy)
    rng = torch.Generator()
    wanted = trainer.algorithm.act(trainer.obs, {}, rng, explore=False)[0]
    assert torch.equal(actor.act(trainer.obs, {}, rng, explore=False)[0], wanted)
    assert actor.experience.steps == 600


@pytest.mark.ray
def test_a_log_that_fails_stops_the_study(
    home: Path, cluster: None, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: Recorder, key: str, result: object) -> None:
        raise StoreError("the disk is full")

    monkeypatch.setattr(Recorder, "result", full)
    assert run_studies([tiny(points=300, concurrent=1)], home) == 2
    assert capsys.readouterr().err == "rhmc: the disk is full\n"
    tracker = open_existing(study_card(tiny()), Home(home))
    assert tracker is not None
    assert {run.status for run in tracker.recorded()} == {"interrupted"}


@pytest.mark.ray
def test_a_run_that_is_stopped_before_it_begins_has_not_failed(
    home: Path, cluster: None, launch: Launch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As when Ctrl-C comes while Ray still makes the worker."""
    from pipelines.execution.ray_driver import Bridge, fit

    monkeypatch.setattr(Bridge, "over", property(lambda self: self.error is not None))
    recorder, stop = Recorders([launch()]), home / "stop"
    stop.touch()
    jobs = [
        {
            "key": i.key,
            "spec": i.spec.canonical(),
            "folder": str(home / i.key),
            "checkpoint_every": 1,
            "stop": str(stop),
        }
        for i in recorder.todo()
    ]
    fit(jobs, recorder, home / "scratch", 1, 1, stop)
    (alone,) = recorder.each
    assert (alone.failures, alone.left) == ({}, 2)
    assert not list(home.rglob("*.pt"))


def test_a_commit_is_dirty_by_code_and_not_by_results(tmp_path: Path) -> None:
    def git(*words: str) -> None:
        names = ("-c", "user.name=n", "-c", "user.email=e")
        subprocess.run(["git", *names, *words], cwd=tmp_path, check=True, capture_output=True)

    files = [tmp_path / name for name in ("rhmc/a.py", "reports/pages/page.py", "results/paper/claims.md", "dvc.lock")]
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("one\n")
    assert commit(tmp_path) == "unknown"
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "x")
    clean = commit(tmp_path / "rhmc")
    assert re.fullmatch("[0-9a-f]{40}", clean)
    found = []
    for file in files:
        file.write_text("two\n")
        found.append(commit(tmp_path / "rhmc"))
        file.write_text("one\n")
    assert found == [f"{clean}-dirty", f"{clean}-dirty", clean, clean]


def test_a_setting_that_one_method_lacks_does_not_vary_for_that() -> None:
    specs = [run.spec for run in Study.load(STUDIES / "ablation.yaml").runs()]
    varying = what_varies(specs)
    assert {"algo.kind", "algo.regulator", "algo.filter", "seed"} <= set(varying)
    assert "algo.alpha" not in varying


def test_the_next_command_names_the_variant() -> None:
    study = Study.load(STUDIES / "ablation.yaml", "quick", ["seeds=1"], "paper_faithful")
    assert _arguments([study]) == f"{STUDIES / 'ablation.yaml'} --profile quick --variant paper_faithful --set seeds=1"


def test_the_next_command_names_the_file_and_the_changes() -> None:
    study = Study.load(STUDIES / "coverage.yaml", "quick", ["seeds=1", "algo.alpha=0.1"])
    assert _arguments([study]) == f"{STUDIES / 'coverage.yaml'} --profile quick --set seeds=1 --set algo.alpha=0.1"
