"""Work that a study of thousands of runs must not repeat for each of them. Calls are counted, nothing is timed."""

import io
import sqlite3
from contextlib import closing
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from ray.tune.experiment import Experiment
from ray.tune.search import SearchGenerator
from rich.console import Console

from pipelines.execution.progress import PlainBoard
from pipelines.execution.ray_driver import Queue
from pipelines.execution.recorder import Recorder
from pipelines.execution.run import _arms
from pipelines.execution.trainable import RunTrainable
from pipelines.specs.study import Setting, Study
from pipelines.tracking.mlflow_tracker import LONGEST, NOTE, MlflowTracker, addresses, fitting
from pipelines.tracking.overview import Run, so_far
from pipelines.tracking.plan import LISTED, Item, study_card
from pipelines.tracking.tracker import Row, StudyCard
from pipelines.workspace.work_folder import Home
from tests.memory_tracker import MemoryRun, MemoryTracker
from tests.pipelines.support import plan, setting, tiny

STUDY = StudyCard("tiny", "quick", "")
MANY = """\
question: Which?
base:
  env: {kind: coverage, agents: 2, targets: 2}
  algo: {kind: iql}
grid:
  algo.lr: [1e-5, 2e-5, 3e-5, 4e-5, 5e-5, 6e-5, 7e-5, 8e-5, 9e-5, 1e-4]
  algo.gamma: [0.91, 0.92, 0.93, 0.94, 0.95, 0.96]
seeds: 1
steps: 1000
"""


def test_arms_are_not_compared_with_every_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = {"__eq__": 0, "canonical": 0}
    for name in calls:
        plain = getattr(Setting, name)

        def counted(*args: Any, name: str = name, plain: Any = plain) -> Any:
            calls[name] += 1
            return plain(*args)

        monkeypatch.setattr(Setting, name, counted)
    (tmp_path / "many.yaml").write_text(MANY)
    assert len(Study.load(tmp_path / "many.yaml").arms) == 60
    assert sum(calls.values()) <= 2 * 60  # once in each profile


class Counted(dict[str, Any]):
    """A job that counts how often it is copied."""

    copies = 0

    def __deepcopy__(self, memo: dict[int, Any]) -> "Counted":
        Counted.copies += 1
        return Counted(self)


def test_a_job_becomes_a_trial_when_it_is_its_turn_and_no_other_is_copied(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Counted, "copies", 0)
    jobs = [Counted(key=str(i)) for i in range(50)]
    search = SearchGenerator(Queue(jobs))
    search.add_configurations([Experiment("trials", RunTrainable, num_samples=len(jobs))])
    made = [search.next_trial() for _ in range(3)]
    assert [trial.config["job"]["key"] for trial in made] == ["0", "1", "2"]
    assert Counted.copies <= 5 * len(made)
    assert deepcopy(jobs[0])["key"] == "0"  # copying is what is counted
    rest = [search.next_trial() for _ in range(len(jobs) - len(made))]
    assert [trial.config["job"]["key"] for trial in rest] == [job["key"] for job in jobs[3:]]
    assert search.next_trial() is None
    assert search.is_finished()


class Asked(MemoryTracker):
    """A log that notes what it is asked for."""

    def __init__(self, study: StudyCard, shelf: list[MemoryRun]) -> None:
        super().__init__(study, shelf)
        self.listed, self.read = 0, list[Row]()

    def recorded(self) -> Any:
        """See `Tracker`."""
        self.listed += 1
        return super().recorded()

    def rows(self, refs: Any, metrics: Any = None) -> list[Row]:
        """See `Tracker`."""
        found = super().rows(refs, metrics)
        self.read += found
        return found


@pytest.fixture
def log() -> Asked:
    """Both runs of the study are finished, with three points of five metrics."""
    tracker = Asked(STUDY, [])
    for item in plan():
        run = tracker.start(item.card)
        names = ("eval/return", "eval/coverage", "train/loss", "train/q", "time/seconds")
        run.log([{"step": float(step)} | dict.fromkeys(names, 1.0) for step in (0, 200, 400)])
        run.log([{"step": 400.0, "final/return": 2.0}])
        run.finish("finished")
    return tracker


def test_a_launch_lists_the_runs_once_and_reads_what_it_shows(log: Asked, tmp_path: Path) -> None:
    board = PlainBoard(Console(file=io.StringIO()))
    recorder = Recorder(STUDY, plan(), log, Home(tmp_path), board)
    assert recorder.skipped == 2
    assert log.listed == 1
    assert {row.metric for row in log.read} == {"eval/return", "final/return"}
    assert len(log.read) == 2 * (3 + 1)
    assert [len(run.curve) for run in recorder.overview.runs.values()] == [3, 3]


def test_the_summary_reads_one_value_of_each_run(log: Asked) -> None:
    runs: list[Item] = plan()
    assert _arms(runs, log) == [["slow", "1 of 1", "2.00"], ["fast", "1 of 1", "2.00"]]
    assert len(log.read) == len(runs)


def filled(home: Path) -> set[str]:
    """The tables of which SQLite knows how they are filled."""
    with closing(sqlite3.connect(home / "mlflow.db")) as database:
        if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'sqlite_stat1'").fetchall():
            return set()
        return {table for (table,) in database.execute("SELECT tbl FROM sqlite_stat1")}


def test_sqlite_knows_how_to_find_the_metrics_of_some_runs(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    assert "metrics" not in filled(home)
    tracker.start(plan()[0].card).log([{"step": 0.0, "eval/return": 1.0}])
    tracker.publish("So far.", {})
    assert filled(home) >= {"metrics", "latest_metrics", "tags"}


def test_so_it_does_in_a_store_that_is_only_looked_at(home: Path) -> None:
    tracker = MlflowTracker(STUDY, Home(home))
    tracker.start(plan()[0].card).log([{"step": 0.0, "eval/return": 1.0}])
    addresses(tracker.uri, "http://127.0.0.1:5000")
    assert "metrics" in filled(home)


def test_a_study_of_many_arms_can_be_logged(home: Path) -> None:
    arms = {f"rate {i}": setting(lr=i * 1e-5) for i in range(1, 400)}
    card = study_card(tiny(arms=arms))
    tracker = MlflowTracker(card, Home(home))
    note = tracker.client.get_experiment(tracker.experiment).tags[NOTE]
    assert note == tracker.client.get_run(tracker.parent).data.tags[NOTE]
    assert f"- **rate {LISTED}**" in note
    assert f"- **rate {LISTED + 1}**" not in note
    assert note.endswith(f"{399 - LISTED} more arms are not listed here.")
    assert "399 arms" in note


def test_what_is_so_far_lists_as_many_arms() -> None:
    told = so_far([Run(f"arm {i}", 0, None, (), {}) for i in range(LISTED + 2)])
    assert told.count("| missing: 0 |") == LISTED
    assert told.endswith("\n\n2 more arms are not listed here.")
    assert "not listed" not in so_far([Run(f"arm {i}", 0, None, (), {}) for i in range(LISTED)])


def test_a_description_that_is_too_long_is_cut_between_lines(home: Path) -> None:
    line = "| an arm | a cell |\n"
    note = line * (3 * LONGEST // len(line))
    cut = fitting(note)
    assert len(cut) <= LONGEST
    assert set(cut.partition("\n\n")[0].splitlines()) == {line.strip()}
    assert cut.endswith("Cut short: MLflow keeps no more.\n")
    assert fitting(line) == line
    tracker = MlflowTracker(STUDY._replace(note=note), Home(home))
    kept = tracker.client.get_run(tracker.parent).data.tags[NOTE]
    assert len(kept) <= LONGEST
    assert kept.endswith(cut[-200:])  # behind the views, which come first
