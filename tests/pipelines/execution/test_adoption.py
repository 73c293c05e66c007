"""Older runs are adopted where present trainings repeat them bit for bit, and only there."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from pipelines.bundles.bundle import pack, unpack
from pipelines.cli.main import app
from pipelines.execution.adoption import Older, compare, older, prove
from pipelines.export.tables import write_tables
from pipelines.specs.study import Study
from pipelines.tracking.mlflow_tracker import MlflowTracker, open_existing
from pipelines.tracking.plan import Item, items, resolved_yaml, study_card
from pipelines.tracking.tracker import Recorded
from pipelines.workspace.errors import InputError
from pipelines.workspace.provenance import Host
from pipelines.workspace.work_folder import Home
from rhmc.training.trainer import Trainer
from rhmc.types import Metrics
from tests.memory_tracker import MemoryTracker
from tests.pipelines.support import setting, tiny

STUDY = tiny(arms={"slow": setting(lr=1e-4), "fast": setting(lr=1e-2)})


def trained(item: Item) -> list[Metrics]:
    spec = item.spec
    return list(Trainer(spec.env, spec.algo, spec.trainer, spec.seed))


def before(study: Study, code: str = "0ldc0de00000", spec_id: str = "") -> MemoryTracker:
    """A log of finished runs of other code."""
    tracker = MemoryTracker(study_card(study), [])
    for item in items(study):
        card = item.card._replace(fingerprint=code, spec_id=spec_id or item.card.spec_id)
        log = tracker.start(card)
        log.log([point | {"time/seconds": 1.0} for point in trained(item)])
        log.text("config.yaml", resolved_yaml(item, study_card(study)))
        log.finish("finished")
    return tracker


def planted(tracker: MemoryTracker, arm: str, step: int, metric: str) -> tuple[float, float]:
    """The value of a logged metric, and that with another last bit, which takes its place."""
    (run,) = (run for run in tracker.shelf if run.card.arm == arm)
    (place,) = (i for i, row in enumerate(run.values) if (row.step, row.metric) == (step, metric))
    was = run.values[place].value
    other = float(np.nextafter(was, math.inf))
    run.values[place] = run.values[place]._replace(value=other)
    return was, other


def arms(found: Mapping[str, Sequence[Older]]) -> dict[str, list[str]]:
    return {arm: [one.run.code for one in some] for arm, some in found.items()}


def test_what_can_be_adopted_is_what_is_finished_under_other_code() -> None:
    tracker, plan = before(STUDY), items(STUDY)
    assert arms(older(plan, tracker)) == {"slow": ["0ldc0de00000"], "fast": ["0ldc0de00000"]}
    tracker.start(plan[0].card).finish("finished")
    assert arms(older(plan, tracker)) == {"fast": ["0ldc0de00000"]}
    tracker.start(plan[1].card._replace(fingerprint="newer")).finish("failed")
    assert arms(older(plan, tracker)) == {"fast": ["0ldc0de00000"]}
    tracker.start(plan[1].card._replace(fingerprint="newer")).finish("finished")
    assert arms(older(plan, tracker)) == {"fast": ["newer"]}
    assert older(items(tiny(points=5)), tracker) == {}, "other settings"


def test_a_run_that_had_another_name_is_known_by_the_settings_that_it_kept() -> None:
    found = older(items(STUDY), before(STUDY, spec_id="named0ther00"))
    assert arms(found) == {"slow": ["0ldc0de00000"], "fast": ["0ldc0de00000"]}


@pytest.mark.parametrize(("until", "last"), [(None, 600), (600, 600), (599, 400), (200, 200)])
def test_equal_trainings_prove_it(until: int | None, last: int) -> None:
    tracker = before(STUDY)
    proofs = list(prove(older(items(STUDY), tracker), tracker, 1, until, 1))
    said = [(one.arm, one.seeds, one.until, one.difference) for one in proofs]
    assert said == [("slow", [0], last, None), ("fast", [0], last, None)]
    assert str(proofs[0]).startswith(f"seed 0 trained again to step {last}, ")
    assert proofs[0].values > 8


@pytest.mark.parametrize("metric", ["train/reward", "eval/return"])
def test_the_last_bit_of_any_value_refuses_and_is_named(metric: str) -> None:
    tracker = before(STUDY)
    was, other = planted(tracker, "fast", 400, metric)
    slow, fast = prove(older(items(STUDY), tracker), tracker, 1, None, 1)
    assert slow.difference is None
    assert str(fast.difference) == f"arm 'fast', seed 0, step 400, {metric}: {other!r} before, {was!r} now"
    _, short = prove(older(items(STUDY), tracker), tracker, 1, 200, 1)
    assert short.difference is None, "the difference lies after what was compared"


def test_code_that_gives_other_results_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker = before(STUDY)
    monkeypatch.setattr("rhmc.algorithms.qlearning.linear", lambda start, end, over, step: 0.5)
    assert all(proof.difference for proof in prove(older(items(STUDY), tracker), tracker, 1, None, 1))


def test_a_metric_that_one_of_both_does_not_have_refuses() -> None:
    item = items(STUDY)[0]
    values = {(0, "eval/return"): 1.0, (200, "eval/return"): 2.0, (200, "time/seconds"): 3.0}
    assert compare(item, values, {k: v for k, v in values.items() if k[1] != "time/seconds"}) is None
    more = values | {(200, "train/loss"): 0.5}
    assert str(compare(item, values, more)).endswith("train/loss: nothing before, 0.5 now")
    assert str(compare(item, more, values)).endswith("train/loss: 0.5 before, nothing now")
    assert compare(item, {(0, "eval/return"): math.nan}, {(0, "eval/return"): math.nan}) is None
    assert compare(item, {(0, "eval/return"): 0.0}, {(0, "eval/return"): -0.0}) is not None
    assert compare(item, more | {(400, "eval/return"): 1.0}, more) is None, "further than what was trained now"


def test_a_point_before_training_proves_nothing() -> None:
    tracker = before(STUDY)
    with pytest.raises(InputError, match=r"--until: 199 is not allowed for arm 'slow'; must be at least 200"):
        list(prove(older(items(STUDY), tracker), tracker, 1, 199, 1))


# The command, on a log of MLflow


@pytest.fixture
def pair(home: Path, monkeypatch: pytest.MonkeyPatch) -> Study:
    """Two arms with two seeds, finished under other code on another machine; one value of `fast` has been moved."""
    study = STUDY.model_copy(update={"seeds": 2})
    tracker = MlflowTracker(study_card(study), Home(home))
    for item in items(study):
        log = tracker.start(item.card._replace(fingerprint="0ldc0de00000", commit="abc", host=Host("a machine", "")))
        points = trained(item)
        if (item.card.arm, item.card.seed) == ("fast", 1):
            points[1]["eval/return"] += 1.0
        log.log(points)
        log.finish("finished")
    tracker.close("finished")
    monkeypatch.setenv("RHMC_HOME", str(home))
    monkeypatch.setattr("pipelines.cli.study.load_studies", lambda *_: [study])
    return study


def adopted(home: Path, study: Study) -> dict[tuple[str, str], Recorded]:
    """The runs under their present names, by arm and key."""
    tracker = open_existing(study_card(study), Home(home))
    assert tracker is not None
    keys = {item.key for item in items(study)}
    return {(run.arm, run.key): run for run in tracker.recorded() if run.key in keys}


def command(*words: str) -> tuple[int, list[str]]:
    result = CliRunner().invoke(app, ["study", "adopt", "tiny.yaml", "--jobs", "1", *words])
    return result.exit_code, result.output.splitlines()


def test_an_arm_is_adopted_and_another_refused(pair: Study, home: Path, tmp_path: Path) -> None:
    code, (_, first, second) = command("--verify", "2")
    assert code == 4
    assert first.startswith("adopted: 2 runs of arm 'slow': seeds 0, 1 trained again to step 600, ")
    assert second.startswith("refused: arm 'fast', seed 1, step 200, eval/return: ")
    found = adopted(home, pair)
    assert {arm for arm, _ in found} == {"slow"}
    said = first.removeprefix("adopted: 2 runs of arm 'slow': ")
    for run in found.values():
        assert (run.status, run.commit, run.host.machine) == ("finished", "abc", "a machine"), "of what computed it"
        assert run.adopted == f"from code 0ldc0de00000: {said}"
    tracker = open_existing(study_card(pair), Home(home))
    assert tracker is not None
    write_tables(pair, items(pair), tracker, tmp_path / "out")
    rows = pq.read_table(tmp_path / "out" / "tiny.made.parquet").to_pylist()
    assert [(row["arm"], row["adopted"]) for row in rows if row["adopted"]] == [
        ("slow", f"from code 0ldc0de00000: {said}")
    ] * 2


def test_what_lies_after_the_step_or_in_other_seeds_is_not_compared(pair: Study, home: Path) -> None:
    code, lines = command("--verify", "1")
    assert (code, [line[:8] for line in lines[1:]]) == (0, ["adopted:"] * 2)
    assert len(adopted(home, pair)) == 4
    code, lines = command()
    assert (code, lines[1]) == (0, "no finished run of other code has the settings of a planned one that is missing")


def test_an_adoption_travels_in_a_bundle(pair: Study, home: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    command()
    there = tmp_path_factory.mktemp("there")
    pack(pair, there / "bundle", home, values_only=True)
    unpack(there / "bundle", there / "work")
    here, moved = adopted(home, pair), adopted(there / "work", pair)
    assert len(moved) == 4
    assert {place: run.adopted for place, run in moved.items()} == {place: run.adopted for place, run in here.items()}
    assert all(run.adopted.startswith("from code 0ldc0de00000: seed 0 trained again") for run in moved.values())
