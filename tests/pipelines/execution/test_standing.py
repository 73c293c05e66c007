"""The status of a study from the plan that its launch kept, and launches of some arms alone."""

import io
import json
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from rich.console import Console

from pipelines.execution import run, standing
from pipelines.execution.progress import PlainBoard
from pipelines.execution.recorder import Recorder
from pipelines.execution.run import having_arms, run_studies, show_status, standing_of
from pipelines.execution.standing import Options, quickly
from pipelines.specs.study import Study
from pipelines.tracking.kept_plan import KeptPlan, Place, keep
from pipelines.tracking.mlflow_tracker import MlflowTracker
from pipelines.tracking.plan import Item, items, study_card
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import Home
from tests.memory_tracker import MemoryRun, MemoryTracker
from tests.pipelines.support import fresh, plan, setting, tiny

TEXT = """
question: Which is it?
base:
  env: {kind: navigation, agents: 2}
  algo: {include: own}
arms:
  slow: {algo: {lr: 1e-4}}
  fast: {algo: {lr: 1e-2}}
seeds: 1
steps: 2_000
"""
INCLUDED = "algo: {kind: iql, encoder: mlp}\n"


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    (tmp_path / "own.yaml").write_text(INCLUDED)
    path = tmp_path / "reach.yaml"
    path.write_text(TEXT)
    return path


@pytest.fixture
def launched(file: Path, tmp_path: Path, template: Path) -> Home:
    """A work folder as a launch leaves it, whose first run is finished and whose second failed."""
    home = Home(fresh(tmp_path / "work", template))
    study = Study.load(file)
    tracker = MlflowTracker(study_card(study), home)
    slow, fast = items(study)
    tracker.start(slow.card).finish("finished")
    log = tracker.start(fast.card)
    log.tag("error", "boom")
    log.finish("failed")
    tracker.close("failed")
    runs = {item.name: Place(item.card.arm, item.key) for item in items(study)}
    (home.root / "locks").mkdir(exist_ok=True)
    keep(home, Options(str(file), "quick", "", ()), KeptPlan(study.name, runs, list(study.remarks)))
    return home


def options(file: Path, *overrides: str) -> Options:
    return Options(str(file), "quick", "", overrides)


def test_the_quick_answer_is_that_of_the_long_way(
    launched: Home, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert standing.show_quickly(file, "quick", None, (), launched.root, as_json=True) == 3
    quick = json.loads(capsys.readouterr().out)
    assert show_status(Study.load(file), launched.root, as_json=True) == 3
    assert json.loads(capsys.readouterr().out) == quick
    assert (quick["arms"]["slow"]["finished"], quick["errors"]) == (1, {"reach / fast s0": "boom"})


def test_the_quick_answer_loads_nothing_heavy(launched: Home, file: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from pipelines.execution.standing import show_quickly\n"
        f"code = show_quickly(Path({str(file)!r}), 'quick', None, (), Path({str(launched.root)!r}), as_json=False)\n"
        "print(code, sorted({'torch', 'mlflow', 'ray', 'pydantic', 'sqlalchemy', 'pandas'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "3 []"


def change_an_include(file: Path, home: Home) -> None:
    (file.parent / "own.yaml").write_text(INCLUDED + "# other\n")


def add_what_goes_before(file: Path, home: Home) -> None:
    (file.parent / "settings").mkdir()
    (file.parent / "settings" / "coverage.yaml").write_text(INCLUDED)


def change_the_file(file: Path, home: Home) -> None:
    file.write_text(TEXT.replace("seeds: 1", "seeds: 2"))


def bring_up_to_date(file: Path, home: Home) -> None:
    import sqlite3

    with closing(sqlite3.connect(home.database)) as database, database:
        database.execute("UPDATE alembic_version SET version_num = 'another'")


def log_elsewhere(file: Path, home: Home) -> None:
    study = Study.load(file).model_copy(update={"seeds": 2})
    tracker = MlflowTracker(study_card(study), home)
    tracker.start(items(study)[1].card).finish("finished")  # another seed: stale to the plan that was kept


def damage(file: Path, home: Home) -> None:
    (home.root / "locks" / "reach-quick.plan.json").write_text("{")


@pytest.mark.parametrize(
    "change",
    [change_an_include, add_what_goes_before, change_the_file, bring_up_to_date, log_elsewhere, damage],
)
def test_whatever_changed_takes_the_long_way(change, launched: Home, file: Path) -> None:  # type: ignore[no-untyped-def]
    assert quickly(launched, options(file)) is not None
    change(file, launched)
    assert quickly(launched, options(file)) is None


def test_other_options_and_another_log_take_the_long_way(
    launched: Home, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert quickly(launched, options(file, "seeds=2")) is None
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:1")
    assert quickly(launched, options(file)) is None


def test_other_code_takes_the_long_way(launched: Home, file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pipelines.tracking import kept_plan

    monkeypatch.setattr(kept_plan, "CODE", (*kept_plan.CODE, "pipelines/workspace"))
    assert quickly(launched, options(file)) is None


def test_a_killed_driver_s_runs_are_not_running(launched: Home, file: Path) -> None:
    study = Study.load(file)
    tracker = MlflowTracker(study_card(study), launched)
    tracker.start(items(study)[1].card)
    found = quickly(launched, options(file))
    assert found is not None
    assert (found[1].arms["fast"]["running"], found[1].arms["fast"]["interrupted"]) == (0, 1)
    with launched.lock("reach", "quick"):
        found = quickly(launched, options(file))
    assert found is not None
    assert found[1].arms["fast"]["running"] == 1


# Some arms alone


def recorder(shelf: list[MemoryRun], folder: Path, arms: tuple[str, ...], runs: list[Item] | None = None) -> Recorder:
    card = study_card(tiny())
    board = PlainBoard(Console(file=io.StringIO(), width=200))
    return Recorder(card, runs or plan(), MemoryTracker(card, shelf), Home(folder), board, arms)


def finish(one: Recorder, key: str) -> None:
    folder = one.home.checkpoints(key)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "policy.pt").write_bytes(b"weights")
    one.start(key)
    one.result(key, {"done": True, "stopped": False, "points": [{"step": 600.0, "eval/return": 1.0}]})


def test_other_arms_keep_their_checkpoints_and_wait(shelf: list[MemoryRun], tmp_path: Path) -> None:
    slow, fast = (item.key for item in plan())
    other = Home(tmp_path).checkpoints(fast)
    other.mkdir(parents=True)
    one = recorder(shelf, tmp_path, ("slow",))
    assert other.exists()
    assert ([item.key for item in one.todo()], one.left, len(one.wanted)) == ([slow], 1, 1)
    finish(one, slow)
    assert (one.left, one.later, one.status) == (0, {fast}, "interrupted")
    assert [run.stale for run in one.tracker.recorded()] == [False]
    rest = recorder(shelf, tmp_path, ())
    assert [item.key for item in rest.todo()] == [fast]
    finish(rest, fast)
    assert (rest.later, rest.status) == (set(), "finished")
    assert recorder(shelf, tmp_path, ("slow",)).status == "finished"


def test_studies_without_the_arm_are_left_out() -> None:
    one, two = tiny("one"), tiny("two", arms={"faster": setting(lr=1e-1)})
    assert [study.name for study in having_arms([one, two], ["faster"])] == ["two"]
    assert having_arms([one, two], []) == [one, two]
    with pytest.raises(InputError, match="--arm: 'fasst' is not allowed; allowed: slow, fast, faster; did you mean"):
        run_studies([one, two], Path("none"), ["slow", "fasst"])


def test_a_launch_of_an_arm_is_done_when_that_arm_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], template: Path
) -> None:
    home = fresh(tmp_path / "work", template)

    def here(studies: object, recorders: run.Recorders, place: Home, interrupts: object) -> None:
        for item in recorders.todo():
            for one in recorders.each:
                finish(one, item.key)

    monkeypatch.setattr(run, "train", here)
    monkeypatch.setattr("pipelines.tracking.mlflow_tracker.MlflowRun.model", lambda *given: None)
    assert run_studies([tiny()], home, ["fast"]) == 0
    said = capsys.readouterr().out
    assert "slow     0 of 1" in said
    assert "next:  rhmc study run studies/tiny.yaml --profile quick   (continues)" in said
    found = standing_of(tiny(), Home(home))
    assert (found.arms["fast"]["finished"], found.arms["slow"]["missing"], found.finished) == (1, 1, False)


def test_a_run_that_failed_leaves_half_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, template: Path) -> None:
    home = fresh(tmp_path / "work", template)

    def here(studies: object, recorders: run.Recorders, place: Home, interrupts: object) -> None:
        first, *_ = recorders.todo()
        recorders.start(first.key)
        recorders.failed(first.key, "boom", "Traceback")

    monkeypatch.setattr(run, "train", here)
    assert run_studies([tiny()], home) == 3
