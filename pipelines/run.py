"""Launch a study: what its plan still lacks goes through Ray Tune, results go to the log as they come."""

import json
import shlex
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Self

from rich.console import Console

from pipelines.fingerprint import fingerprint
from pipelines.host import host
from pipelines.plan import Item, commit, finished, items, study_card
from pipelines.progress import board, print_table
from pipelines.ray_settings import set_up_ray
from pipelines.recorder import Recorder
from pipelines.store import Home, StoreError, without_password
from pipelines.study import Study
from pipelines.tracker import Status, Tracker

if TYPE_CHECKING:
    from pipelines.mlflow_tracker import MlflowTracker

DONE, FAILED, BAD, INTERRUPTED, TERMINATED = 0, 1, 2, 130, 143  # exit codes


def run_study(study: Study, home: Path) -> int:
    """Bring a study to its end: skip what is finished, continue what was interrupted, train the rest.

    Args:
        study: the plan.
        home: the work folder.

    Returns:
        0 all finished, 1 some run failed, 2 something is in the way, 130 interrupted, 143 terminated. A second launch
        is always safe.
    """
    return guarded(home, study.name, study.profile, lambda place, interrupts: _launch(study, place, interrupts))


def guarded(home: Path, name: str, profile: str, launch: Callable[[Home, "Interrupts"], int]) -> int:
    """Hold a study or a search while it is launched; what is in the way becomes one line and an exit code.

    Args:
        home: the work folder.
        name: of the study or search.
        profile: its profile.
        launch: the work; gives the exit code.
    """
    place, interrupts = Home(home), Interrupts()
    try:
        with interrupts:
            place.prepare()
            with place.lock(name, profile):
                return launch(place, interrupts)
    except StoreError as error:
        print(f"rhmc: {error}", file=sys.stderr)
        return BAD
    except KeyboardInterrupt:
        print("rhmc: interrupted; the same command continues", file=sys.stderr)
        return interrupts.code
    except SystemExit:  # Ray's answer to SIGTERM while it starts
        print("rhmc: terminated; the same command continues", file=sys.stderr)
        return TERMINATED


class Interrupts:
    """What Ctrl-C and SIGTERM do: while runs train, the first asks each of them to save itself and end, the second
    leaves at once; before and afterwards there is nothing to save, and the first leaves at once.

    Attributes:
        code: the exit code, 128 + the number of the signal; 130 before any came.
        came: whether one came.
    """

    def __init__(self) -> None:
        self.code, self.came = INTERRUPTED, False
        self.stop: Path | None = None  # the file that asks

    def __enter__(self) -> Self:
        self.before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        self._listen()
        return self

    def _listen(self) -> None:
        for number in self.before:
            signal.signal(number, self._handle)

    def __exit__(self, *exception: object) -> None:
        for number, handler in self.before.items():
            signal.signal(number, handler)

    @contextmanager
    def go_to(self, stop: Path) -> Iterator[None]:
        """While runs train that look for the file `stop`; who waits for them looks with a `StopFile`."""
        self._listen()  # again: Ray, which has just started, takes SIGTERM for itself
        self.stop = stop
        try:
            yield
        finally:
            self.stop = None

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.code, self.came = 128 + number, True
        if self.stop is None or self.stop.exists():
            raise KeyboardInterrupt
        try:
            self.stop.touch()
        except OSError as error:  # a full disk
            raise KeyboardInterrupt from error


def _launch(study: Study, home: Home, interrupts: Interrupts) -> int:
    from pipelines.mlflow_tracker import MlflowTracker  # 3 s: only when something is launched

    card = study_card(study)
    tracker = MlflowTracker(card, home)
    status: Status = "interrupted"
    try:
        plan = items(study, fingerprint(), commit(), host())
        with board(Console()) as display:
            recorder = Recorder(card, plan, tracker, home, display)
            if recorder.skipped:
                display.say(f"{recorder.skipped} of {len(plan)} runs were finished before")
            left = recorder.reuse()
            while left and not interrupts.came:
                train(study, recorder, home, interrupts)
                left = recorder.again()
            recorder.overview.publish()
        status = "failed" if recorder.failures else "interrupted" if recorder.left else "finished"
    finally:
        tracker.close(status)
    _summary(study, recorder, tracker)
    return {"finished": DONE, "failed": FAILED}.get(status, interrupts.code)


# Ray


def train(study: Study, recorder: Recorder, home: Home, interrupts: Interrupts) -> None:
    """Train what the recorder still waits for, but for what another study is training at this moment.

    Raises:
        StoreError: the log failed, or Ray cannot be reached.
        KeyboardInterrupt: interrupted a second time, before every run had saved itself.
    """
    set_up_ray()
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
    concurrent, cpus = study.resources.concurrent, study.resources.cpus
    session = ray_session(concurrent, cpus, home.name(study.name, study.profile), home.root)
    try:
        with session as remarks, interrupts.go_to(stop):
            for remark in remarks:
                recorder.board.say(remark)
            fit(jobs, recorder, scratch, concurrent, cpus, stop)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def animated(study: Study, plan: list[Item]) -> set[str]:
    """Keys of the trainings that leave an animation: by default the first seed of every arm."""
    first: dict[str, str] = {}
    for item in plan:
        first.setdefault(item.card.arm, item.key)
    return {"none": set[str](), "first": set(first.values()), "all": {i.key for i in plan}}[study.resources.animate]


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
        f"       experiment {tracker.name!r} in {without_password(tracker.uri)}",
        f"next:  {next_command}",
    ]
    console.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)


def _arguments(study: Study) -> str:
    """What names this plan on the command line."""
    changes = [word for text in study.overrides for word in ("--set", text)]
    variant = ["--variant", study.variant] if study.variant else []
    return shlex.join([study.file or f"studies/{study.name}.yaml", "--profile", study.profile, *variant, *changes])


def _arms(plan: list[Item], tracker: Tracker) -> list[list[str]]:
    refs = {(run.arm, run.key): run.ref for run in tracker.recorded() if run.status == "finished"}
    there = [refs[place] for arm in _by_arm(plan).values() for place in arm if place in refs]
    scores = {row.ref: row.value for row in tracker.rows(there, {SCORE})}
    table = []
    for arm, places in _by_arm(plan).items():
        done = [refs[place] for place in places if place in refs]
        values = [scores[ref] for ref in done if ref in scores]
        mean = f"{sum(values) / len(values):.2f}" if values else "-"
        table.append([arm, f"{len(done)} of {len(places)}", mean])
    return table


def _by_arm(plan: list[Item]) -> dict[str, list[tuple[str, str]]]:
    """The planned runs of each arm, as arm and key; what is planned twice once."""
    arms: dict[str, dict[tuple[str, str], None]] = {}
    for item in plan:
        arms.setdefault(item.card.arm, {})[item.card.arm, item.key] = None
    return {arm: list(places) for arm, places in arms.items()}


SCORE = "final/return"
STATES = ("finished", "running", "interrupted", "failed", "missing")


def show_status(study: Study, home: Path, *, as_json: bool = False) -> int:
    """Print how far a study is: per arm the runs finished, under way, failed, missing, and stale (of other code).

    Returns:
        0 all finished, 1 not, 2 something is in the way.
    """
    try:
        arms, complete = _status(study, Home(home))
    except StoreError as error:
        print(f"rhmc: {error}", file=sys.stderr)
        return BAD
    if as_json:
        print(json.dumps({"study": study.name, "profile": study.profile, "finished": complete, "arms": arms}))
    else:
        columns = ["planned", *STATES, "stale"]
        print_table(Console(), ["arm", *columns], [[arm, *(str(one[c]) for c in columns)] for arm, one in arms.items()])
    return DONE if complete else FAILED


def _status(study: Study, home: Home) -> tuple[dict[str, dict[str, int]], bool]:
    from pipelines.mlflow_tracker import open_existing

    tracker = open_existing(study_card(study), home)
    recorded = tracker.recorded() if tracker else []
    plan = items(study, fingerprint(), "")
    # Runs of a driver that was killed are logged as running; a log in this folder knows no other driver than one here.
    own = tracker is not None and tracker.uri == f"sqlite:///{home.database}"
    seen = {"running": "interrupted"} if own and not home.driven(study.name, study.profile) else {}
    state = {(run.arm, run.key): seen.get(run.status, run.status) for run in recorded}
    planned = {(item.card.arm, item.key) for item in plan}
    stale = Counter(run.arm for run in recorded if (run.arm, run.key) not in planned)
    arms = {}
    for arm, places in _by_arm(plan).items():
        mine = Counter(state.get(place, "missing") for place in places)
        arms[arm] = {"planned": len(places)} | {kind: mine[kind] for kind in STATES} | {"stale": stale[arm]}
    return arms, planned <= finished(recorded)
