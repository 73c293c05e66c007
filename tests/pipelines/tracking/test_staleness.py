"""A stale run says why it is: its code, its settings, or its place in the study."""

from pathlib import Path

from pipelines.specs.study import RunSpec
from pipelines.tracking.mlflow_tracker import MlflowTracker
from pipelines.tracking.plan import Item, items, resolved_yaml, study_card
from pipelines.tracking.staleness import stale_lines, stale_runs
from pipelines.tracking.tracker import ADOPTED, FROM, Recorded, Tracker
from pipelines.workspace.work_folder import Home
from tests.memory_tracker import MemoryTracker
from tests.pipelines.support import setting, tiny

STUDY = tiny()
CARD = study_card(STUDY)


def log(tracker: Tracker, item: Item, modules: dict[str, str] | None = None) -> None:
    """A finished run of other code."""
    card = item.card._replace(fingerprint="0ldc0de00000", modules=modules or {})
    run = tracker.start(card)
    run.text("config.yaml", resolved_yaml(item, CARD))
    run.finish("finished")


def reasons(plan: list[Item], recorded: list[Recorded], tracker: Tracker) -> list[str]:
    return stale_lines(stale_runs(plan, recorded, tracker))


def changed(item: Item, **algo: object) -> Item:
    """The item with other settings of the method."""
    one = item.spec.algo.model_copy(update=algo)
    spec = RunSpec(env=item.spec.env, algo=one, trainer=item.spec.trainer, seed=item.spec.seed)
    return item._replace(spec=spec, card=item.card._replace(spec_id=spec.id))


def test_modules_settings_arms_and_seeds_are_told_apart() -> None:
    slow, fast = items(STUDY)
    tracker = MemoryTracker(CARD, [])
    code = dict(slow.card.modules)
    log(tracker, slow, code | {"rhmc.algorithms.qlearning": "other", "rhmc.gone": "digest"})
    log(tracker, changed(fast, gamma=0.5, hidden_dim=17), code)
    assert reasons(items(STUDY), tracker.recorded(), tracker) == [
        "stale: arm 'slow', 1 run: changed since: rhmc.algorithms.qlearning, rhmc.gone",
        "stale: arm 'fast', 1 run: other settings: algo.gamma was 0.5, now 0.99, algo.hidden_dim was 17, now 64",
    ]
    assert reasons(items(STUDY), [], tracker) == []


def test_what_kept_no_list_or_had_another_torch() -> None:
    slow, fast = items(STUDY)
    tracker = MemoryTracker(CARD, [])
    log(tracker, slow)
    log(tracker, fast, dict(fast.card.modules))
    assert reasons(items(STUDY), tracker.recorded(), tracker) == [
        "stale: arm 'slow', 1 run: made by other code (0ldc0de00000), which kept no list of its modules",
        "stale: arm 'fast', 1 run: made with another version of torch",
    ]


def test_an_arm_or_seed_that_the_study_no_longer_has() -> None:
    slow, fast = items(STUDY)
    tracker = MemoryTracker(CARD, [])
    log(tracker, slow._replace(card=slow.card._replace(arm="gone")))
    spec = fast.spec.model_copy(update={"seed": 7})
    log(tracker, fast._replace(spec=spec, card=fast.card._replace(seed=7, spec_id=spec.id)))
    assert reasons(items(STUDY), tracker.recorded(), tracker) == [
        "stale: arm 'gone', 1 run: the study has no such arm now",
        "stale: arm 'fast', 1 run: the study has no seed 7 now",
    ]


def test_runs_of_one_reason_are_one_line_and_many_settings_are_cut() -> None:
    study = tiny(arms={"one": setting()}).model_copy(update={"seeds": 3})
    tracker = MemoryTracker(study_card(study), [])
    for item in items(study):
        log(tracker, changed(item, gamma=0.5, hidden_dim=17, batch_size=31, buffer_size=401, learning_starts=65))
    (line,) = reasons(items(study), tracker.recorded(), tracker)
    assert line.startswith("stale: arm 'one', 3 runs: other settings: algo.batch_size was 31, now 32, ")
    assert line.endswith(" and 1 more")
    tracker = MemoryTracker(study_card(study), [])
    log(tracker, changed(items(study)[0], gamma=0.5, hidden_dim=17, batch_size=31, buffer_size=401))
    (line,) = reasons(items(study), tracker.recorded(), tracker)
    assert line.endswith("algo.hidden_dim was 17, now 16"), "all four are named"


def test_a_run_whose_adopted_copy_is_in_the_log_is_not_stale() -> None:
    slow, fast = items(STUDY)
    tracker = MemoryTracker(CARD, [])
    for item in (slow, fast._replace(card=fast.card._replace(spec_id="named0ther00")), changed(fast, gamma=0.5)):
        log(tracker, item)
    for item in (slow, fast):
        copy = tracker.start(item.card)
        copy.tag(ADOPTED, f"{FROM}0ldc0de00000: seed 0 trained again")
        copy.finish("finished")
    kept = "stale: arm 'fast', 1 run: other settings: algo.gamma was 0.5, now 0.99"
    assert reasons(items(STUDY), tracker.recorded(), tracker) == [kept]
    unlisted = "which kept no list of its modules"
    other = slow.card._replace(fingerprint="0ther0000000", modules={})  # code of which nothing was adopted
    tracker.start(other).finish("finished")
    assert reasons(items(STUDY), tracker.recorded(), tracker) == [
        kept,
        f"stale: arm 'slow', 1 run: made by other code (0ther0000000), {unlisted}",
    ]
    (copy_of_fast,) = (run for run in tracker.shelf if run.card.key == fast.key)
    tracker.drop(copy_of_fast.ref)
    assert f"stale: arm 'fast', 1 run: made by other code (0ldc0de00000), {unlisted}" in reasons(
        items(STUDY), tracker.recorded(), tracker
    )


def test_mlflow_keeps_the_list(home: Path) -> None:
    slow = items(STUDY)[0]
    tracker = MlflowTracker(CARD, Home(home))
    log(tracker, slow, {"rhmc.training.trainer": "other"})
    (run,) = tracker.recorded()
    assert dict(run.modules) == {"rhmc.training.trainer": "other"}
    (line,) = reasons(items(STUDY), [run], tracker)
    assert line.endswith("rhmc.types") or " more" in line
