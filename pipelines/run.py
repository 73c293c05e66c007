"""Launch a study: what its plan still lacks goes through Ray Tune, results go to the log as they come."""

import os
import shlex
import shutil
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from rich.console import Console

from pipelines.fingerprint import fingerprint
from pipelines.plan import Item, commit, finished, items, study_card
from pipelines.progress import board, print_table
from pipelines.recorder import Recorder
from pipelines.store import Home, StoreError
from pipelines.study import Study
from pipelines.tracker import Status, Tracker

if TYPE_CHECKING:
    from pipelines.mlflow_tracker import MlflowTracker

DONE, FAILED, BAD, INTERRUPTED = 0, 1, 2, 130  # exit codes

RAY_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_CHDIR_TO_TRIAL_DIR": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_AIR_NEW_OUTPUT": "0",
    "RAY_DEDUP_LOGS": "0",
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    "TUNE_DISABLE_SIGINT_HANDLER": "1",  # ours lets every run save itself first
    "TUNE_WARN_EXCESSIVE_EXPERIMENT_CHECKPOINT_SYNC_THRESHOLD_S": "0",
}


def run_study(study: Study, home: Path) -> int:
    """Bring a study to its end: skip what is finished, continue what was interrupted, train the rest.

    Args:
        study: the plan.
        home: the work folder.

    Returns:
        0 all finished, 1 some run failed, 2 something is in the way, 130 interrupted. A second launch is always safe.
    """
    place = Home(home)
    try:
        place.prepare()
        with place.lock(study.name, study.profile):
            return _launch(study, place)
    except StoreError as error:
        print(f"rhmc: {error}", file=sys.stderr)
        return BAD
    except KeyboardInterrupt:
        print("rhmc: interrupted; the same command continues", file=sys.stderr)
        return INTERRUPTED


def _launch(study: Study, home: Home) -> int:
    from pipelines.mlflow_tracker import MlflowTracker  # 3 s: only when something is launched

    card = study_card(study)
    tracker = MlflowTracker(card, home)
    status: Status = "interrupted"
    try:
        plan = items(study, fingerprint(), commit())
        with board(Console()) as display:
            recorder = Recorder(card, plan, tracker, home, display)
            if recorder.skipped:
                display.say(f"{recorder.skipped} of {len(plan)} runs were finished before")
            recorder.reuse()
            if recorder.left:
                train(study, recorder, home)
            recorder.overview.publish()
        status = "failed" if recorder.failures else "interrupted" if recorder.left else "finished"
    finally:
        tracker.close(status)
    _summary(study, recorder, tracker)
    return {"finished": DONE, "failed": FAILED}.get(status, INTERRUPTED)


# Ray


def train(study: Study, recorder: Recorder, home: Home) -> None:
    """Train what the recorder still waits for.

    Raises:
        StoreError: the log failed, or Ray cannot be reached.
        KeyboardInterrupt: interrupted a second time, before every run had saved itself.
    """
    os.environ.update({name: os.environ.get(name, value) for name, value in RAY_SETTINGS.items()})
    from pipelines.ray_driver import fit, ray_session  # 3 s

    scratch = home.scratch(study.name, study.profile)
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    stop = scratch / "stop"
    drawn = animated(study, recorder.plan)
    jobs = [
        {
            "key": item.key,
            "spec": item.spec.canonical(),
            "folder": str(home.checkpoints(item.key)),
            "checkpoint_every": study.resources.checkpoint_every,
            "stop": str(stop),
            "animate": item.key in drawn,
        }
        for item in recorder.todo()
    ]
    try:
        with ray_session(study.resources.concurrent * study.resources.cpus), interrupt_to(stop, recorder):
            fit(jobs, recorder, scratch, study.resources.concurrent, study.resources.cpus, stop)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def animated(study: Study, plan: list[Item]) -> set[str]:
    """Keys of the trainings that leave an animation: by default the first seed of every arm."""
    first: dict[str, str] = {}
    for item in plan:
        first.setdefault(item.card.arm, item.key)
    return {"none": set[str](), "first": set(first.values()), "all": {i.key for i in plan}}[study.resources.animate]


@contextmanager
def interrupt_to(stop: Path, recorder: Recorder) -> Iterator[None]:
    """The first Ctrl-C (or SIGTERM) asks every run to save itself and end; the second one leaves at once."""

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.exists():
            raise KeyboardInterrupt
        stop.touch()
        recorder.board.say("interrupted: each run stops at its next point and saves itself; again to leave at once")

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# What a person reads


def _summary(study: Study, recorder: Recorder, tracker: "MlflowTracker") -> None:
    console = Console()
    console.print()
    print_table(console, ["arm", "finished", "mean return"], _arms(recorder.plan, tracker))
    for name, error in recorder.failures.items():
        console.print(f"failed: {name}: {error}", markup=False, highlight=False, soft_wrap=True)
    next_command = f"rhmc {'study run' if recorder.left else 'export'} {_arguments(study)}"
    next_command += "   (continues)" if recorder.left else ""
    lines = [
        f"look:  {tracker.where()}",
        f"       experiment {tracker.name!r} in {tracker.uri}",
        f"next:  {next_command}",
    ]
    console.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)


def _arguments(study: Study) -> str:
    """What names this plan on the command line."""
    changes = [word for text in study.overrides for word in ("--set", text)]
    return shlex.join([study.file or f"studies/{study.name}.yaml", "--profile", study.profile, *changes])


def _arms(plan: list[Item], tracker: Tracker) -> list[list[str]]:
    refs = {(run.arm, run.key): run.ref for run in tracker.recorded() if run.status == "finished"}
    wanted = {(item.card.arm, item.key): item for item in plan}
    scores = {
        row.ref: row.value
        for row in tracker.rows([refs[place] for place in wanted if place in refs])
        if row.metric == "final/return"
    }
    table = []
    for arm in dict.fromkeys(item.card.arm for item in plan):
        places = [place for place in wanted if place[0] == arm]
        values = [scores[refs[place]] for place in places if refs.get(place) in scores]
        mean = f"{sum(values) / len(values):.2f}" if values else "-"
        table.append([arm, f"{len([p for p in places if p in refs])} of {len(places)}", mean])
    return table


def show_status(study: Study, home: Path) -> int:
    """Print how far a study is: per arm the runs finished, under way, failed, missing, and stale (of other code).

    Returns:
        0 all finished, 1 not, 2 something is in the way.
    """
    try:
        table, complete = _status(study, Home(home))
    except StoreError as error:
        print(f"rhmc: {error}", file=sys.stderr)
        return BAD
    print_table(
        Console(), ["arm", "planned", "finished", "running", "interrupted", "failed", "missing", "stale"], table
    )
    return DONE if complete else FAILED


def _status(study: Study, home: Home) -> tuple[list[list[str]], bool]:
    from pipelines.mlflow_tracker import open_existing

    tracker = open_existing(study_card(study), home)
    recorded = tracker.recorded() if tracker else []
    plan = items(study, fingerprint(), "")
    state = {(run.arm, run.key): run.status for run in recorded}
    planned = {(item.card.arm, item.key) for item in plan}
    table = []
    for arm in dict.fromkeys(item.card.arm for item in plan):
        mine = [state.get(place, "missing") for place in planned if place[0] == arm]
        stale = len([run for run in recorded if run.arm == arm and (run.arm, run.key) not in planned])
        kinds = ("finished", "running", "interrupted", "failed", "missing")
        table.append([arm, str(len(mine)), *(str(mine.count(kind)) for kind in kinds), str(stale)])
    return table, planned <= finished(recorded)
