"""Several studies launched together: one queue, each log its own."""

import io
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from pipelines.execution import ray_driver
from pipelines.execution.joint_recorder import Recorders
from pipelines.execution.progress import PlainBoard
from pipelines.execution.recorder import Recorder
from pipelines.execution.run import run_studies
from pipelines.specs.study import Study
from pipelines.tracking.mlflow_tracker import MlflowTracker, open_existing
from pipelines.tracking.plan import study_card
from pipelines.tracking.tracker import StudyCard, points_of
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import Home, StoreError
from tests.memory_tracker import MemoryRun, MemoryTracker
from tests.pipelines.support import CODE, plan, setting, tiny
from tests.robustness.chaos import fit_here

POINTS = [{"step": float(step), "eval/return": step / 100} for step in (0, 200, 400)]
FIRST = tiny("first")  # slow and fast
SECOND = tiny("second", arms={"as slow": setting(lr=1e-4), "faster": setting(lr=1e-1)})


@pytest.fixture
def both(shelf: list[MemoryRun], tmp_path: Path) -> Recorders:
    board = PlainBoard(Console(file=io.StringIO(), width=200))

    def one(study: Study) -> Recorder:
        card = study_card(study)
        return Recorder(card, plan(study), MemoryTracker(card, shelf), Home(tmp_path), board)

    return Recorders([one(FIRST), one(SECOND)])


def full(*_: object) -> None:
    raise StoreError("the disk is full")


def train(together: Recorders, key: str) -> None:
    """A training from its start to its end."""
    together.start(key)
    together.result(key, {"done": False, "stopped": False, "points": POINTS[:1]})
    folder = together.each[0].home.checkpoints(key)
    folder.mkdir(parents=True)
    (folder / "policy.pt").write_bytes(b"weights")
    together.result(key, {"done": True, "stopped": False, "points": POINTS[1:]})


def logged(shelf: list[MemoryRun]) -> list[tuple[str, str, str]]:
    return [(run.study.study, run.card.arm, run.status) for run in shelf]


def test_what_two_studies_want_is_asked_for_once_in_their_order(both: Recorders) -> None:
    assert both.reuse()
    assert [item.name for item in both.todo()] == ["first / slow s0", "first / fast s0", "second / faster s0"]


def test_what_is_finished_for_one_study_is_finished_for_the_other(both: Recorders, shelf: list[MemoryRun]) -> None:
    key = both.todo()[0].key
    train(both, key)
    assert logged(shelf) == [("first", "slow", "finished"), ("second", "as slow", "finished")]
    assert points_of(shelf[1].values) == POINTS
    assert shelf[1].files["policy.pt"] == b"weights"
    assert not both.each[0].home.checkpoints(key).exists()
    assert [one.left for one in both.each] == [1, 1]


def test_each_study_logs_its_own(both: Recorders, shelf: list[MemoryRun]) -> None:
    for item in both.todo():
        train(both, item.key)
    assert sorted(logged(shelf)) == [
        ("first", "fast", "finished"),
        ("first", "slow", "finished"),
        ("second", "as slow", "finished"),
        ("second", "faster", "finished"),
    ]
    assert [one.status for one in both.each] == ["finished", "finished"]
    assert not both.again()


def test_the_logs_under_way_are_those_of_all(both: Recorders) -> None:
    _, fast, faster = (item.key for item in both.todo())
    both.start(fast)
    both.start(faster)
    assert set(both.logs) == {fast, faster}
    both.failed(faster, "boom", "Traceback")
    assert set(both.logs) == {fast}
    assert [one.failures for one in both.each] == [{}, {"second / faster s0": "boom"}]
    assert [one.status for one in both.each] == ["interrupted", "failed"]


def test_what_failed_for_one_study_failed_for_the_other_and_is_not_tried_again(
    both: Recorders, shelf: list[MemoryRun]
) -> None:
    slow, fast, faster = (item.key for item in both.todo())
    train(both, fast)
    train(both, faster)
    both.start(slow)
    both.result(slow, {"done": True, "stopped": False, "points": [], "error": "boom", "trace": "Traceback"})
    assert [one.failures for one in both.each] == [{"first / slow s0": "boom"}, {"second / as slow s0": "boom"}]
    assert [(run.status, run.tags["error"]) for run in shelf if run.card.key == slow] == [("failed", "boom")] * 2
    assert [one.status for one in both.each] == ["failed", "failed"]
    assert both.todo() == []
    assert not both.again()


def test_a_worker_that_died_for_good_failed_for_both(both: Recorders) -> None:
    slow = both.todo()[0].key
    both.failed(slow, "its worker died", "Traceback")  # before it told anything
    assert [list(one.failures) for one in both.each] == [["first / slow s0"], ["second / as slow s0"]]


def test_what_another_process_trains_is_waited_for_by_the_same_study(both: Recorders) -> None:
    _, fast, faster = (item.key for item in both.todo())
    train(both, fast)
    both.start(faster)
    both.died(faster)
    both.start(faster)
    both.result(faster, {"done": True, "stopped": True, "busy": True, "points": []})
    assert both.again()
    assert [item.name for item in both.todo()] == ["first / slow s0", "second / faster s0"]
    assert not both.again()  # asked for once


def test_what_its_node_took_along_is_trained_once_more(both: Recorders, shelf: list[MemoryRun]) -> None:
    slow = both.todo()[0].key
    both.start(slow)
    both.placed(slow, "host (a)")
    both.lost(slow)
    assert (shelf[0].tags["nodes"], shelf[0].status) == ("host (a)", "interrupted")
    assert both.again()
    assert both.todo()[0].key == slow


def test_what_another_process_finished_meanwhile_is_copied(both: Recorders, shelf: list[MemoryRun]) -> None:
    slow, fast, faster = (item.key for item in both.todo())
    train(both, fast)
    train(both, faster)
    both.start(slow)
    both.result(slow, {"done": True, "stopped": True, "busy": True, "points": []})
    elsewhere = StudyCard("elsewhere", "quick", "")
    theirs = MemoryTracker(elsewhere, shelf).start(both.each[0].todo()[0].card)
    theirs.log(POINTS)
    theirs.finish("finished")
    assert not both.again()
    assert [one.status for one in both.each] == ["finished", "finished"]


def test_a_run_is_finished_once_all_of_it_is_kept(both: Recorders, monkeypatch: pytest.MonkeyPatch) -> None:
    for item in both.todo()[1:]:
        train(both, item.key)
    monkeypatch.setattr("pipelines.execution.recorder.keep", full)
    with pytest.raises(StoreError):
        train(both, both.todo()[0].key)
    assert [one.status for one in both.each] == ["interrupted", "interrupted"]


def test_a_run_that_could_not_be_copied_is_not_finished(both: Recorders, monkeypatch: pytest.MonkeyPatch) -> None:
    for item in both.todo()[1:]:
        train(both, item.key)
    monkeypatch.setattr(both.each[1], "_copy", full)
    with pytest.raises(StoreError):
        train(both, both.todo()[0].key)
    assert [one.status for one in both.each] == ["finished", "interrupted"]


def with_resources(study: Study, **changes: Any) -> Study:
    return study.model_copy(update={"resources": study.resources.model_copy(update=changes)})


def test_studies_that_share_workers_or_names_wrongly_are_refused(tmp_path: Path) -> None:
    alone = with_resources(SECOND, cpus=2)
    with pytest.raises(InputError, match=r"^resources\.cpus is 2 in second and 1 in first; studies that run together"):
        run_studies([FIRST, alone], tmp_path)
    with pytest.raises(InputError, match=r"^first: given 2 times"):
        run_studies([FIRST, FIRST], tmp_path)
    assert list(tmp_path.iterdir()) == []


# The whole chain, without Ray


@pytest.fixture
def jobs() -> list[Any]:
    """All that were handed out."""
    return []


@pytest.fixture
def here(jobs: list[Any], monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Trains in this process; the keys of each round."""
    rounds = []

    def fit(given: list[dict[str, Any]], *rest: Any) -> None:
        rounds.append([job["key"] for job in given])
        jobs.extend(given)
        fit_here(given, *rest)

    monkeypatch.setattr(ray_driver, "fit", fit)
    monkeypatch.setattr(ray_driver, "ray_session", lambda *args: nullcontext([]))
    return rounds


def statuses(study: Study, home: Path) -> list[str]:
    tracker = open_existing(study_card(study), Home(home))
    assert tracker is not None
    parent = tracker.client.search_runs([tracker.experiment], "tags.role = 'study'")[0]
    return [parent.info.status, *sorted(run.status for run in tracker.recorded())]


def test_a_launch_of_two_studies(home: Path, here: list[list[str]], capsys: pytest.CaptureFixture[str]) -> None:
    assert run_studies([FIRST, SECOND], home) == 0
    said = capsys.readouterr().out
    assert [len(keys) for keys in here] == [3]
    assert "second / as slow s0: the same training was finished before; copied" in said
    table = [line.split()[:2] for line in said.partition("study ")[2].splitlines()[1:5]]
    assert table == [["first", "slow"], ["first", "fast"], ["second", "as"], ["second", "faster"]]
    assert "experiments 'first (quick)', 'second (quick)' in sqlite:" in said
    assert said.endswith("next:  rhmc export studies/first.yaml studies/second.yaml --profile quick\n")
    for study in (FIRST, SECOND):
        assert statuses(study, home) == ["FINISHED", "finished", "finished"]

    assert run_studies([SECOND, FIRST], home) == 0
    assert "4 of 4 runs were finished before" in capsys.readouterr().out
    assert len(here) == 1


def test_each_study_has_its_own_checkpoints_and_animations(home: Path, here: list[list[str]], jobs: list[Any]) -> None:
    studies = [with_resources(FIRST, animate="none"), with_resources(SECOND, animate="first", checkpoint_every=7)]
    assert run_studies(studies, home) == 0
    assert [(job["animate"], job["checkpoint_every"]) for job in jobs] == [(True, 2), (False, 2), (True, 7)]


def test_the_locks_are_taken_in_one_order(home: Path, here: list[list[str]], monkeypatch: pytest.MonkeyPatch) -> None:
    """Two launches of the same studies in another order would else wait for one another."""
    taken, lock = [], Home.lock
    monkeypatch.setattr(Home, "lock", lambda self, *names: taken.append(names[0]) or lock(self, *names))
    assert run_studies([SECOND, FIRST], home) == 0
    assert taken == ["first", "second"]


def test_a_failure_of_the_second_study_is_one_of_the_launch(
    home: Path, here: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    blocked = Home(home).checkpoints(f"{SECOND.runs()[1].spec.id}-{CODE}")
    blocked.parent.mkdir(parents=True)
    blocked.touch()  # a file where the checkpoints should go
    assert run_studies([FIRST, SECOND], home) == 3
    said = capsys.readouterr().out
    assert "failed: second / faster s0: " in said
    assert said.endswith("rhmc study run studies/first.yaml studies/second.yaml --profile quick   (continues)\n")
    assert (statuses(FIRST, home)[0], statuses(SECOND, home)[0]) == ("FINISHED", "FAILED")


def test_a_study_that_is_driven_elsewhere_holds_up_the_launch(
    home: Path, here: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    with Home(home).lock("second", "quick"):
        assert run_studies([FIRST, SECOND], home) == 2
    assert "second (quick) is already being run" in capsys.readouterr().err
    with Home(home).lock("first", "quick"):
        pass  # let go of
    assert not here


def test_what_was_finished_when_a_launch_broke_down_is_logged_so(
    home: Path, here: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    last = f"{SECOND.runs()[1].spec.id}-{CODE}"
    before = Recorder.result

    def full(self: Recorder, key: str, result: dict[str, Any]) -> None:
        if key == last:
            raise StoreError("the disk is full")
        before(self, key, result)

    monkeypatch.setattr(Recorder, "result", full)
    assert run_studies([FIRST, SECOND], home) == 2
    assert statuses(FIRST, home) == ["FINISHED", "finished", "finished"]
    assert statuses(SECOND, home)[0] == "KILLED"
    assert MlflowTracker(study_card(SECOND), Home(home)).recorded()[-1].status == "interrupted"
