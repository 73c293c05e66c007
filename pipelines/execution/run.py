"""Launch studies: what their plans still lack goes through Ray Tune, results go to the log as they come."""

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
from pipelines.execution.progress import STARTS, Board, board, print_table
from pipelines.execution.ray_settings import set_up_ray
from pipelines.execution.recorder import Recorder
from pipelines.execution.standing import Standing, by_arm, counted, show
from pipelines.specs.document import choices
from pipelines.specs.limits import absent
from pipelines.specs.study import Study
from pipelines.tracking.initial import keep as keep_policies
from pipelines.tracking.kept_plan import KeptPlan, Options, Place, keep
from pipelines.tracking.plan import Item, finished, given_twice, items, read_commit, study_card
from pipelines.tracking.source_file import another, remember
from pipelines.tracking.staleness import stale_lines, stale_runs
from pipelines.tracking.tracker import Tracker
from pipelines.workspace.addresses import without_password
from pipelines.workspace.errors import InputError, visible
from pipelines.workspace.exit_codes import Exit
from pipelines.workspace.own_packages import named
from pipelines.workspace.provenance import Host, host
from pipelines.workspace.terminal import terminal
from pipelines.workspace.work_folder import Home, StoreError

if TYPE_CHECKING:
    from pipelines.tracking.mlflow_tracker import MlflowTracker


def run_studies(studies: Sequence[Study], home: Path, arms: Sequence[str] = ()) -> int:
    """Bring studies to their end: skip what is finished, continue what was interrupted, train the rest.

    Their runs are one queue, in the order of the studies: no worker is idle while the last run of a study trains, and
    what several of them ask for is trained once.

    Args:
        studies: the plans, one or more.
        home: the work folder.
        arms: names of those that are trained; all if empty.

    Returns:
        0 all of these are finished, 3 some run failed, 2 environment error, 130 interrupted, 143 terminated. A second
        launch is always safe.

    Raises:
        InputError: the studies cannot be launched together.
    """
    devices = {arm.trainer.device: f"{one.name} / {name}" for one in studies for name, arm in one.arms.items()}
    if faults := [*_apart(studies), *missing_devices(devices.items())]:
        raise InputError(*faults)
    for remark in (remark for study in studies for remark in study.remarks):
        print(f"note: {remark}", file=sys.stderr)
    having = having_arms(studies, arms)
    names = [(study.name, study.profile) for study in having]
    return guarded(home, names, lambda place, interrupts: _launch(having, place, interrupts, arms))


def having_arms(studies: Sequence[Study], arms: Sequence[str]) -> Sequence[Study]:
    """The studies that have one of these arms; all where none is named.

    Raises:
        InputError: no study has such an arm.
    """
    known = list(dict.fromkeys(name for study in studies for name in study.arms))
    if faults := [f"--arm: '{arm}' is not allowed; {choices(arm, known)}" for arm in arms if arm not in known]:
        raise InputError(*faults)
    return [study for study in studies if not arms or not study.arms.keys().isdisjoint(arms)]


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
        return Exit.BAD
    except KeyboardInterrupt:
        print("rhmc: interrupted; the same command continues", file=sys.stderr)
        return interrupts.code
    except SystemExit:  # Ray's answer to SIGTERM while it starts
        print("rhmc: terminated; the same command continues", file=sys.stderr)
        return Exit.TERMINATED


class Interrupts:
    """Effect of Ctrl-C and SIGTERM: while runs train, the first asks each of them to save itself and end, the second
    leaves at once; before and afterwards there is nothing to save, and the first leaves at once.

    Attributes:
        code: the exit code, 128 + the number of the signal; 130 before any came.
        came: whether one came.
    """

    def __init__(self) -> None:
        self.code: int = Exit.INTERRUPTED
        self.came = False
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


def _launch(studies: Sequence[Study], home: Home, interrupts: Interrupts, arms: Sequence[str]) -> int:
    with board(terminal()) as display, ExitStack() as logs:
        for study in studies:
            if remark := another(home, study.name, study.profile, study.file):
                display.say(remark)
            remember(home, study.name, study.profile, study.file)
        known = read_commit()
        if known.why:
            display.say(f"the commit is logged as unknown: {known.why}")
        code = Code(known.name, host())
        launched = [logs.enter_context(_logged(study, code, home, display, arms)) for study in studies]
        recorders = Recorders([one.recorder for one in launched])
        if skipped := sum(one.skipped for one in recorders.each):
            display.say(f"{skipped} of {sum(len(one.wanted) for one in recorders.each)} runs were finished before")
        left = recorders.reuse()
        for study in studies if left else ():
            keep_policies(study.policies, home.root)
        while left and not interrupts.came:
            train(studies, recorders, home, interrupts)
            left = recorders.again()
        for one in launched:
            one.recorder.overview.publish()
    _summary(launched)
    if any(one.failures for one in recorders.each):
        return Exit.UNFINISHED
    return interrupts.code if any(one.left for one in recorders.each) else Exit.DONE


@contextmanager
def _logged(study: Study, code: Code, home: Home, display: Board, arms: Sequence[str] = ()) -> Iterator[Launched]:
    """A study's log while it is written to; whatever happens, it ends with how far the study came."""
    from pipelines.tracking.mlflow_tracker import MlflowTracker  # 3 s: only when something is launched

    card = study_card(study)
    tracker = MlflowTracker(card, home)
    recorder = None
    try:
        for remark in tracker.remarks:
            display.say(f"{study.name}: {remark}")
        plan = items(study, *code)
        recorder = Recorder(card, plan, tracker, home, display, arms)
        # A kept plan knows neither the code of other packages nor the policies that runs start from.
        if study.file and not any(item.spec.imports or item.spec.trainer.init for item in plan):
            options = Options(study.file, study.profile, study.variant, study.overrides)
            runs = {item.name: Place(item.card.arm, item.key) for item in plan}
            keep(home, options, KeptPlan(study.name, runs, list(study.remarks)))
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
    recorders.board.say(STARTS)
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
            "home": str(home.root),
        }
        for item in recorders.todo()
    ]
    session = ray_session(resources.concurrent, resources.cpus, home.name(first.name, first.profile), home.root)
    try:
        with session as remarks, interrupts.go_to(stop):
            for remark in remarks:
                recorders.board.say(remark)
            recorders.board.expect(recorders.tally(resources.concurrent))
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
    tracker, left = launched[0].tracker, any(one.recorder.left or one.recorder.later for one in launched)
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
    arms = by_arm(_places(plan))
    there = [refs[place] for places in arms.values() for place in places if place in refs]
    scores = {row.ref: row.value for row in tracker.rows(there, {SCORE})}
    table = []
    for arm, places in arms.items():
        done = [refs[place] for place in places if place in refs]
        values = [scores[ref] for ref in done if ref in scores]
        mean = f"{sum(values) / len(values):.2f}" if values else "-"
        table.append([arm, f"{len(done)} of {len(places)}", mean])
    return table


def _places(plan: Iterable[Item]) -> list[Place]:
    return [Place(item.card.arm, item.key) for item in plan]


SCORE = "final/return"


def show_status(study: Study, home: Path, *, as_json: bool = False) -> int:
    """Print how far a study is: per arm the runs finished, under way, failed (and why), missing, and stale (and why).

    Returns:
        0 all finished, 3 not, 2 environment error.
    """
    try:
        found = standing_of(study, Home(home))
    except StoreError as error:
        print(f"rhmc: {error}", file=sys.stderr)
        return Exit.BAD
    return show(study.name, study.profile, found, study.remarks, as_json=as_json)


def standing_of(study: Study, home: Home) -> Standing:
    """The progress of a study.

    Raises:
        StoreError: the log cannot be read.
    """
    tracker = None
    if os.environ.get("MLFLOW_TRACKING_URI") or home.database.exists():
        from pipelines.tracking.mlflow_tracker import open_existing  # 3 s: only where there may be a log

        tracker = open_existing(study_card(study), home)
    recorded = tracker.recorded() if tracker else []
    plan = items(study)
    # Runs of a driver that was killed are logged as running; a log in this folder knows no other driver than one here.
    own = tracker is not None and tracker.own
    seen = {"running": "interrupted"} if own and not home.driven(study.name, study.profile) else {}
    state = {Place(run.arm, run.key): seen.get(run.status, run.status) for run in recorded}
    planned = {(item.card.arm, item.key) for item in plan}
    others = stale_runs(plan, recorded, tracker) if tracker else []
    arms = counted(_places(plan), state, Counter(arm for arm, _ in others))
    failed = {(run.arm, run.key): run.error for run in recorded if run.status == "failed"}
    errors = {item.name: failed[item.card.arm, item.key] for item in plan if (item.card.arm, item.key) in failed}
    return Standing(
        planned <= finished(recorded), arms, errors, stale_lines(others), tracker.remarks if tracker else []
    )
