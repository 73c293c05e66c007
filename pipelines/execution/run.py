"""Launch studies: what their plans still lack goes through Ray Tune, results go to the log as they come."""

import json
import os
import shlex
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, NamedTuple, Self

from pipelines.execution.joint_recorder import Recorders
from pipelines.execution.progress import Board, board, print_table
from pipelines.execution.ray_settings import set_up_ray
from pipelines.execution.recorder import Recorder
from pipelines.specs.limits import absent
from pipelines.specs.source_file import another, remember
from pipelines.specs.study import Study
from pipelines.tracking.plan import Item, finished, given_twice, items, read_commit, study_card
from pipelines.tracking.staleness import stale_lines, stale_runs
from pipelines.tracking.tracker import Tracker
from pipelines.workspace.addresses import without_password
from pipelines.workspace.errors import InputError, visible
from pipelines.workspace.own_packages import named
from pipelines.workspace.provenance import Host, host
from pipelines.workspace.terminal import terminal
from pipelines.workspace.work_folder import Home, StoreError

if TYPE_CHECKING:
    from pipelines.tracking.mlflow_tracker import MlflowTracker

DONE, FAILED, BAD, INTERRUPTED, TERMINATED = 0, 1, 2, 130, 143  # exit codes


def run_studies(studies: Sequence[Study], home: Path) -> int:
    """Bring studies to their end: skip what is finished, continue what was interrupted, train the rest.

    Their runs are one queue, in the order of the studies: no worker is idle while the last run of a study trains, and
    what several of them ask for is trained once.

    Args:
        studies: the plans, one or more.
        home: the work folder.

    Returns:
        0 all finished, 1 some run failed, 2 environment error, 130 interrupted, 143 terminated. A second launch
        is always safe.

    Raises:
        InputError: the studies cannot be launched together.
    """
    devices = {arm.trainer.device: f"{one.name} / {name}" for one in studies for name, arm in one.arms.items()}
    if faults := [*_apart(studies), *missing_devices(devices.items())]:
        raise InputError(*faults)
    for remark in (remark for study in studies for remark in study.remarks):
        print(f"note: {remark}", file=sys.stderr)
    names = [(study.name, study.profile) for study in studies]
    return guarded(home, names, lambda place, interrupts: _launch(studies, place, interrupts))


def missing_devices(where: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Devices, each with who asks for it, that are not here; what a cluster has is its nodes' business."""
    if os.environ.get("RAY_ADDRESS", "local") not in ("", "local"):
        return
    for device, who in dict(where).items():
        yield from (f"trainer.device ({who}): {text}" for text in absent([device]))


def _apart(studies: Sequence[Study]) -> Iterator[str]:
    """The reason why studies cannot be launched together."""
    first = studies[0]
    yield from given_twice(studies)
    for study in studies:
        for field in ("concurrent", "cpus"):
            value, other = getattr(study.resources, field), getattr(first.resources, field)
            if value != other:
                yield (
                    f"resources.{field} is {value} in {study.name} and {other} in {first.name}; studies that run "
                    f"together share their workers: make them equal, or run them one after the other"
                )


def guarded(home: Path, names: Sequence[tuple[str, str]], launch: Callable[[Home, "Interrupts"], int]) -> int:
    """Hold studies or a search while they are launched; an environment error becomes one line and an exit code.

    Args:
        home: the work folder.
        names: of the studies or the search, each with its profile.
        launch: the work; gives the exit code.
    """
    place, interrupts = Home(home), Interrupts()
    try:
        with interrupts, ExitStack() as held:
            place.prepare()
            for name, profile in sorted(names):  # in one order everywhere
                held.enter_context(place.lock(name, profile))
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
    """Effect of Ctrl-C and SIGTERM: while runs train, the first asks each of them to save itself and end, the second
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


class Code(NamedTuple):
    """The code and machine that a launch logs with its runs: the same for all of its studies."""

    commit: str
    host: Host


class Launched(NamedTuple):
    """A study with its log and what keeps that in step."""

    study: Study
    tracker: "MlflowTracker"
    recorder: Recorder


def _launch(studies: Sequence[Study], home: Home, interrupts: Interrupts) -> int:
    with board(terminal()) as display, ExitStack() as logs:
        for study in studies:
            if remark := another(home, study.name, study.profile, study.file):
                display.say(remark)
            remember(home, study.name, study.profile, study.file)
        known = read_commit()
        if known.why:
            display.say(f"the commit is logged as unknown: {known.why}")
        code = Code(known.name, host())
        launched = [logs.enter_context(_logged(study, code, home, display)) for study in studies]
        recorders = Recorders([one.recorder for one in launched])
        if skipped := sum(one.skipped for one in recorders.each):
            display.say(f"{skipped} of {sum(len(one.plan) for one in recorders.each)} runs were finished before")
        left = recorders.reuse()
        while left and not interrupts.came:
            train(studies, recorders, home, interrupts)
            left = recorders.again()
        for one in launched:
            one.recorder.overview.publish()
    _summary(launched)
    found = {one.recorder.status for one in launched}
    return FAILED if "failed" in found else interrupts.code if "interrupted" in found else DONE


@contextmanager
def _logged(study: Study, code: Code, home: Home, display: Board) -> Iterator[Launched]:
    """A study's log while it is written to; whatever happens, it ends with how far the study came."""
    from pipelines.tracking.mlflow_tracker import MlflowTracker  # 3 s: only when something is launched

    card = study_card(study)
    tracker = MlflowTracker(card, home)
    recorder = None
    try:
        for remark in tracker.remarks:
            display.say(f"{study.name}: {remark}")
        recorder = Recorder(card, items(study, *code), tracker, home, display)
        yield Launched(study, tracker, recorder)
    finally:
        tracker.close(recorder.status if recorder else "interrupted")


# Ray


def train(studies: Sequence[Study], recorders: Recorders, home: Home, interrupts: Interrupts) -> None:
    """Train what the recorders still wait for, but for what another launch is training at this moment.

    Raises:
        StoreError: the log failed, or Ray cannot be reached.
        KeyboardInterrupt: interrupted a second time, before every run had saved itself.
    """
    set_up_ray()
    from pipelines.execution.ray_driver import fit, ray_session  # 3 s

    first, resources = studies[0], studies[0].resources
    scratch = home.scratch(first.name, first.profile)  # held by this launch, as the study is
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    stop = scratch / "stop"
    every = {study.name: study.resources.checkpoint_every for study in studies}
    plans = [one.plan for one in recorders.each]
    drawn = set().union(*(animated(study, plan) for study, plan in zip(studies, plans, strict=True)))
    jobs = [
        {
            "key": item.key,
            "spec": item.spec.canonical(),
            "folder": str(home.checkpoints(item.key)),
            "checkpoint_every": every[item.study],
            "stop": str(stop),
            "animate": item.key in drawn,
            "imports": named(),
        }
        for item in recorders.todo()
    ]
    session = ray_session(resources.concurrent, resources.cpus, home.name(first.name, first.profile), home.root)
    try:
        with session as remarks, interrupts.go_to(stop):
            for remark in remarks:
                recorders.board.say(remark)
            fit(jobs, recorders, scratch, resources.concurrent, resources.cpus, stop)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def animated(study: Study, plan: list[Item]) -> set[str]:
    """Keys of the trainings that leave an animation: by default the first seed of every arm."""
    first: dict[str, str] = {}
    for item in plan:
        first.setdefault(item.card.arm, item.key)
    return {"none": set[str](), "first": set(first.values()), "all": {i.key for i in plan}}[study.resources.animate]


# What a person reads


def _summary(launched: Sequence[Launched]) -> None:
    console = terminal()
    console.print()
    several = len(launched) > 1
    rows = [[*[one.study.name][:several], *row] for one in launched for row in _arms(one.recorder.plan, one.tracker)]
    print_table(console, [*["study"][:several], "arm", "finished", "mean return"], rows)
    for one in launched:
        for name, error in one.recorder.failures.items():
            console.print(visible(f"failed: {name}: {error}"), soft_wrap=True)
    tracker, left = launched[0].tracker, any(one.recorder.left for one in launched)
    experiments = ", ".join(repr(one.tracker.name) for one in launched)
    lines = [
        f"look:  {tracker.where()}",
        f"       experiment{'s' * several} {experiments} in {without_password(tracker.uri)}",
        f"next:  rhmc {'study run' if left else 'export'} {_arguments([one.study for one in launched])}",
    ]
    lines[-1] += "   (continues)" if left else ""
    console.print("\n".join(map(visible, lines)), soft_wrap=True)


def _arguments(studies: Sequence[Study]) -> str:
    """The command-line arguments that name these plans; the command line gives all of them the same options."""
    study = studies[0]
    changes = [word for text in study.overrides for word in ("--set", text)]
    variant = ["--variant", study.variant] if study.variant else []
    files = [one.file or f"studies/{one.name}.yaml" for one in studies]
    return shlex.join([*files, "--profile", study.profile, *variant, *changes])


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
    """Print how far a study is: per arm the runs finished, under way, failed (and why), missing, and stale (and why).

    Returns:
        0 all finished, 1 not, 2 environment error.
    """
    try:
        found = _status(study, Home(home))
    except StoreError as error:
        print(f"rhmc: {error}", file=sys.stderr)
        return BAD
    if as_json:
        print(json.dumps({"study": study.name, "profile": study.profile} | found._asdict()))
    else:
        columns = ["planned", *STATES, "stale"]
        rows = [[arm, *(str(one[c]) for c in columns)] for arm, one in found.arms.items()]
        print_table(terminal(), ["arm", *columns], rows)
        lines = [f"failed: {name}: {error}" for name, error in found.errors.items()]
        lines += [*found.stale, *(f"note: {remark}" for remark in (*study.remarks, *found.remarks))]
        terminal().print("\n".join(map(visible, lines)), soft_wrap=True, end="\n" if lines else "")
    return DONE if found.finished else FAILED


class Standing(NamedTuple):
    """The progress of a study."""

    finished: bool  # all of it
    arms: dict[str, dict[str, int]]  # runs by state
    errors: dict[str, str]  # of each failed run, by its name
    stale: list[str]  # why runs are no part of the plan, a line for each arm and reason
    remarks: list[str]  # of the log


def _status(study: Study, home: Home) -> Standing:
    from pipelines.tracking.mlflow_tracker import open_existing

    tracker = open_existing(study_card(study), home)
    recorded = tracker.recorded() if tracker else []
    plan = items(study)
    # Runs of a driver that was killed are logged as running; a log in this folder knows no other driver than one here.
    own = tracker is not None and tracker.own
    seen = {"running": "interrupted"} if own and not home.driven(study.name, study.profile) else {}
    state = {(run.arm, run.key): seen.get(run.status, run.status) for run in recorded}
    planned = {(item.card.arm, item.key) for item in plan}
    others = stale_runs(plan, recorded, tracker) if tracker else []
    of_arm = Counter(arm for arm, _ in others)
    arms = {}
    for arm, places in _by_arm(plan).items():
        mine = Counter(state.get(place, "missing") for place in places)
        arms[arm] = {"planned": len(places)} | {kind: mine[kind] for kind in STATES} | {"stale": of_arm[arm]}
    failed = {(run.arm, run.key): run.error for run in recorded if run.status == "failed"}
    errors = {item.name: failed[item.card.arm, item.key] for item in plan if (item.card.arm, item.key) in failed}
    return Standing(
        planned <= finished(recorded), arms, errors, stale_lines(others), tracker.remarks if tracker else []
    )
