"""Several studies launched together: one queue, each log its own."""

import io
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from pipelines import ray_driver
from pipelines.errors import InputError
from pipelines.fingerprint import fingerprint
from pipelines.mlflow_tracker import MlflowTracker, open_existing
from pipelines.plan import study_card
from pipelines.progress import PlainBoard
from pipelines.recorder import Recorder
from pipelines.recorders import Recorders
from pipelines.run import run_studies
from pipelines.store import Home, StoreError
from pipelines.study import Study
from pipelines.tracker import MemoryRun, MemoryTracker, points_of
from tests.pipelines.chaos import fit_here
from tests.pipelines.support import plan, setting, tiny

POINTS = [{"step": float(step), "eval/return": step / 100} for step in (0, 200, 400)]
FIRST = tiny("first")  # slow and fast
SECOND = tiny("second", arms={"as slow": setting(lr=1e-4), "faster": setting(lr=1e-1)})


@pytest.fixture
def shelf() -> list[MemoryRun]:
    return []


@pytest.fixture
def both(shelf: list[MemoryRun], tmp_path: Path) -> Recorders:
    board = PlainBoard(Console(file=io.StringIO(), width=200))

    def one(study: Study) -> Recorder:
        card = study_card(study)
        return Recorder(card, plan(study), MemoryTracker(card, shelf), Home(tmp_path), board)

    return Recorders([one(FIRST), one(SECOND)])


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


def test_what_failed_for_one_study_is_tried_for_the_next_and_then_left(both: Recorders) -> None:
    slow, fast, faster = (item.key for item in both.todo())
    train(both, fast)
    train(both, faster)
    both.failed(slow, "boom", "Traceback")
    assert both.again()
    assert [item.name for item in both.todo()] == ["second / as slow s0"]
    both.failed(slow, "boom", "Traceback")
    assert not both.again()
    assert [one.status for one in both.each] == ["failed", "failed"]


def test_what_was_out_of_reach_is_asked_for_again_by_the_same_study(both: Recorders) -> None:
    slow, fast, faster = (item.key for item in both.todo())
    train(both, fast)
    both.start(slow)
    both.lost(slow)
    both.start(faster)
    both.placed(faster, "host (a)")
    both.died(faster)
    both.start(faster)
    both.result(faster, {"done": True, "stopped": True, "busy": True, "points": []})
    assert both.again()
    assert [item.name for item in both.todo()] == ["first / slow s0", "second / faster s0"]


def test_studies_that_share_workers_or_names_wrongly_are_refused(tmp_path: Path) -> None:
    alone = SECOND.model_copy(update={"resources": SECOND.resources.model_copy(update={"cpus": 2})})
    with pytest.raises(InputError, match=r"^resources\.cpus is 2 in second and 1 in first; studies that run together"):
        run_studies([FIRST, alone], tmp_path)
    with pytest.raises(InputError, match=r"^first: given 2 times"):
        run_studies([FIRST, FIRST], tmp_path)
    assert list(tmp_path.iterdir()) == []


# The whole chain, without Ray


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Trains in this process; the keys of each round."""
    rounds = []

    def fit(jobs: list[dict[str, Any]], *rest: Any) -> None:
        rounds.append([job["key"] for job in jobs])
        fit_here(jobs, *rest)

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
    last = f"{SECOND.runs()[1].spec.id}-{fingerprint()}"
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
