"""Launch a search: ask for trials, train them to the next point, decide, record. What is finished stays finished.

The order of writing makes a kill at any moment harmless: a trial's result goes to the log first, then to Optuna, then
its checkpoints are dropped. Whatever the kill left open is taken up by the next launch from its checkpoint.
"""

import hashlib
import math
import shlex
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from ruamel.yaml import YAML

from pipelines.execution.progress import STARTS, Board, StopFile, board, print_table
from pipelines.execution.ray_settings import set_up_ray
from pipelines.execution.run import Interrupts, guarded, missing_devices
from pipelines.execution.tally import Ended, Tally, Training
from pipelines.specs.search import Search
from pipelines.tracking.initial import keep as keep_policies
from pipelines.tracking.plan import read_commit
from pipelines.tracking.source_file import another, remember
from pipelines.tracking.tracker import Card, RunLog, Status, StudyCard, Tracker
from pipelines.tuning.best_params import file_name, stem, winner_yaml, write_text
from pipelines.tuning.trials import OBJECTIVE, ArmStudy, BaseStorage, TrialRequest, explained, look, opened, storage_url
from pipelines.workspace.addresses import without_password
from pipelines.workspace.best_effort import decoration
from pipelines.workspace.errors import InputError, visible
from pipelines.workspace.exit_codes import Exit
from pipelines.workspace.own_packages import named
from pipelines.workspace.terminal import terminal
from pipelines.workspace.work_folder import Checkpoints, Home, StoreError
from reports.data.escaping import markdown, prose
from rhmc.types import Metrics

if TYPE_CHECKING:
    from pipelines.tracking.mlflow_tracker import MlflowTracker
    from pipelines.tuning.ray_workers import Failed, TrialJob

PATIENCE = 1.0  # seconds between two looks at whether Ctrl-C was pressed


class Workers(Protocol):
    """Processes that train trials, see `ray_workers.Pool`."""

    @property
    def free(self) -> int: ...

    def begin(self, job: "TrialJob") -> None: ...

    def next(self, timeout: float) -> "dict[str, dict[str, Any] | Failed]": ...

    def go_on(self, key: str) -> None: ...

    def end(self, key: str) -> None: ...


def run_search(search: Search, home: Path, out: Path | None = None) -> int:
    """Bring a search to its end: keep what is finished, take up what was interrupted, try the rest.

    Args:
        search: the plan.
        home: the work folder.
        out: the folder of the best settings; `best_params` beside the search's file if None. The work folder where
            the search was changed by overrides: a trial of the tool does not replace the result of a real search.

    Returns:
        0 every trial is finished or pruned, 3 some failed, 2 environment error, 130 interrupted, 143 terminated.
    """

    def launch(place: Home, interrupts: Interrupts) -> int:
        with opened(place) as storage:
            assert storage is not None
            return _launch(search, place, storage, out or best_params_folder(search, place), interrupts)

    devices = {arm.setting.trainer.device: name for name, arm in search.arms.items()}
    if faults := list(missing_devices(devices.items())):
        raise InputError(*faults)
    for remark in search.remarks:
        print(f"note: {remark}", file=sys.stderr)
    return guarded(home, [(search.name, search.profile)], launch)


def best_params_folder(search: Search, home: Home) -> Path:
    """The folder of the best settings."""
    return plots_folder(search, home) / "best_params" if search.overrides else Path(search.file).parent / "best_params"


def plots_folder(search: Search, home: Home) -> Path:
    """The folder of the plots."""
    return home.root / "searches" / f"{search.name}-{search.profile}"


def _launch(search: Search, home: Home, storage: BaseStorage, out: Path, interrupts: Interrupts) -> int:
    from pipelines.tracking.mlflow_tracker import MlflowTracker  # 3 s: only when something is launched

    url = storage_url(home)
    tracker = MlflowTracker(search_card(search), home)
    status: Status = "interrupted"
    try:
        with explained(url), board(terminal()) as display:
            if remark := another(home, search.name, search.profile, search.file):
                display.say(remark)
            remember(home, search.name, search.profile, search.file)
            for remark in tracker.remarks:
                display.say(remark)
            arm_studies = [ArmStudy(search, arm, storage) for arm in search.arms]
            for arm_study in arm_studies:
                again = arm_study.take_up()
                _clear(search, arm_study, home)
                display.say(
                    f"{arm_study.arm}: {arm_study.closed} of {search.trials} trials are done, {again} are taken up"
                )
            if any(arm_study.left for arm_study in arm_studies):
                _train(search, arm_studies, TrialLog(search, tracker, display), home, interrupts)
            whole = not any(arm_study.left or arm_study.live for arm_study in arm_studies)
            for arm_study in arm_studies if not whole else []:
                arm_study.take_up()
            written = results(search, arm_studies, tracker, home, out if whole else None, display.say)
        failed = any(arm_study.counts()["failed"] for arm_study in arm_studies)
        status = "interrupted" if not whole else "failed" if failed else "finished"
    finally:
        tracker.close(status)
    _summary(search, arm_studies, tracker, written, whole)
    return {"finished": int(Exit.DONE), "failed": int(Exit.UNFINISHED)}.get(status, interrupts.code)


def _clear(search: Search, arm_study: ArmStudy, home: Home) -> None:
    """Remove what a launch left that was killed between closing a trial and removing its checkpoints."""
    for request in arm_study.over():
        Checkpoints(home.checkpoints(trial_card(search, request, "").key)).clear_unused()


def _train(
    search: Search, arm_studies: Sequence[ArmStudy], trial_log: "TrialLog", home: Home, interrupts: Interrupts
) -> None:
    keep_policies(search.policies, home.root)
    trial_log.board.say(STARTS)
    set_up_ray()
    from pipelines.execution.ray_driver import ray_session  # 3 s
    from pipelines.tuning.ray_workers import Pool

    scratch = home.scratch(search.name, search.profile)
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    stop, resources = scratch / "stop", search.resources
    name = home.name(search.name, search.profile)
    session = ray_session(resources.concurrent, resources.cpus, name, home.root)
    try:
        with session as remarks, interrupts.go_to(stop):
            for remark in remarks:
                trial_log.board.say(remark)
            trial_log.board.expect(tally(search, arm_studies))
            Drive(search, arm_studies, Pool(resources.concurrent, resources.cpus), trial_log, home, stop).run()
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def tally(search: Search, arm_studies: Sequence[ArmStudy]) -> Tally:
    """All trials of all arms, as they are now."""
    closed = sum(arm_study.closed for arm_study in arm_studies)
    waiting = [Training(one.arm, search.steps) for one in arm_studies for _ in range(one.left)]
    return Tally(len(arm_studies) * search.trials, closed, waiting, search.resources.concurrent, "trials")


@dataclass
class Running:
    """A trial that is being trained."""

    arm_study: ArmStudy
    request: TrialRequest
    folder: Path  # of its checkpoints
    points: int = 0  # of its curve so far


class Drive:
    """Asks, trains and tells until the budget is spent or `stop` exists.

    Args:
        search: the plan.
        arm_studies: of every arm.
        pool: the workers.
        trial_log: the log.
        home: where checkpoints lie.
        stop: a file: once it exists, nothing new begins, and each trial saves itself at its next point.
    """

    def __init__(
        self,
        search: Search,
        arm_studies: Sequence[ArmStudy],
        pool: Workers,
        trial_log: "TrialLog",
        home: Home,
        stop: Path,
    ) -> None:
        self.search, self.arm_studies, self.pool, self.trial_log = search, arm_studies, pool, trial_log
        self.home, self.stop = home, StopFile(stop, trial_log.board)
        self.running: dict[str, Running] = {}

    def run(self) -> None:
        """To the end of the budget, or to the last trial that saved itself."""
        self._fill()
        while self.running:
            for key, result in self.pool.next(PATIENCE).items():
                self._take(key, result)
            self._fill()

    def _fill(self) -> None:
        """Keep every worker busy; the arm that has most left to try goes first, so that all advance together."""
        while not self.stop.exists() and self.pool.free:  # looked for first: it is announced while all are busy too
            arm_study = max(self.arm_studies, key=lambda one: one.left)
            if not arm_study.left:
                return
            request = arm_study.ask()
            if request is not None:
                self._begin(arm_study, request)

    def _begin(self, arm_study: ArmStudy, request: TrialRequest) -> None:
        key = self.trial_log.start(request)
        folder = self.home.checkpoints(key)
        self.running[key] = Running(arm_study, request, folder)
        self.pool.begin(
            {
                "key": key,
                "spec": request.setting.canonical(),
                "seeds": self.search.seed_list(),
                "folder": str(folder),
                "checkpoint_every": self.search.resources.checkpoint_every,
                "stop": str(self.stop.path),
                "imports": named(),
                "home": str(self.home.root),
            }
        )

    def _take(self, key: str, result: "dict[str, Any] | Failed") -> None:
        """Take in what a worker reports of a trial."""
        one = self.running[key]
        if not isinstance(result, dict):
            self._end(key)
            self.trial_log.fail(key, one.request, result.error, result.trace)
            one.arm_study.fail(one.request, result.error)
            return
        if "died" in result:
            self.trial_log.died(one.request)
            return
        if why := self._points(key, one, result["points"]):
            self._give_up(key, one, why)
        elif result.get("diverged"):  # a result of these values: tried again, it would be the same
            self._give_up(key, one, result["error"], "failed")
        elif result["stopped"]:
            self._end(key)
            self.trial_log.interrupt(key, one.request)
        elif result["done"]:
            self._end(key)
            self._complete(key, one, result["points"][-1])
        else:
            self.pool.go_on(key)

    def _give_up(self, key: str, one: Running, why: str, status: Status = "finished") -> None:
        """Prune a trial; `status` is that of its log."""
        self._end(key)
        self.trial_log.prune(key, one.request, why, status)
        one.arm_study.prune(one.request, why)
        Checkpoints(one.folder).clear()

    def _points(self, key: str, one: Running, points: Sequence[Metrics]) -> str:
        """Take in points one by one, so that a trial that continues with many is given up where it would have been.

        Returns:
            Why the trial should be given up; nothing if it should not.
        """
        for point in points:
            why = one.arm_study.report(one.request, point, one.points)
            self.trial_log.points(key, one.request, [point])
            one.points += 1
            if why:
                return why
        return ""

    def _complete(self, key: str, one: Running, last: Metrics) -> None:
        returns = [last[f"seeds/{seed}"] for seed in self.search.seed_list()]
        self.trial_log.complete(key, one.request, last["step"], math.fsum(returns) / len(returns))
        one.arm_study.complete(one.request, returns)
        Checkpoints(one.folder).clear()

    def _end(self, key: str) -> None:
        self.pool.end(key)
        del self.running[key]


# The log


class TrialLog:
    """Keeps the log and the board in step with the trials: a run for each, its curve the mean over the seeds.

    Args:
        search: whose.
        tracker: the log.
        display: the board.
    """

    def __init__(self, search: Search, tracker: Tracker, display: Board) -> None:
        self.search, self.tracker, self.board = search, tracker, display
        self.commit, why = read_commit()
        if why:
            display.say(f"the commit is logged as unknown: {why}")
        self.logs: dict[str, RunLog] = {}

    def start(self, request: TrialRequest) -> str:
        """A trial begins or continues; returns its key, which names it in the log and in the checkpoints."""
        card = trial_card(self.search, request, self.commit)
        log = self.logs[card.key] = self.tracker.start(card)
        log.tag("trial", str(request.trial_index))
        log.text("config.yaml", self._yaml(request, card))
        self.board.start(self._name(request), self.search.steps, kind=request.arm)
        return card.key

    def _yaml(self, request: TrialRequest, card: Card) -> str:
        head = {
            "search": self.search.name,
            "profile": self.search.profile,
            "arm": request.arm,
            "trial": request.trial_index,
        }
        names = {"fingerprint": card.fingerprint, "commit": card.commit, "seeds": self.search.seed_list()}
        out = StringIO()
        YAML().dump(head | names | request.setting.model_dump(mode="json"), out)
        return out.getvalue()

    def points(self, key: str, request: TrialRequest, points: list[Metrics]) -> None:
        """New points of a trial's curve."""
        self.logs[key].log(points)
        self.board.points(self._name(request), points)

    def complete(self, key: str, request: TrialRequest, step: float, value: float) -> None:
        """A trial ended: its value is the metric `objective`, which a pruned one has not."""
        self.logs[key].log([{"step": step, "objective": value}])
        self._end(key, request, "complete", "finished", f"objective {value:.2f}", "finished")

    def prune(self, key: str, request: TrialRequest, why: str, status: Status) -> None:
        """A trial is given up."""
        if status == "failed":
            self.logs[key].tag("error", why)
        self._end(key, request, "pruned", status, f"pruned, {why}", "finished")

    def interrupt(self, key: str, request: TrialRequest) -> None:
        """A trial saved itself for the next launch."""
        self._end(key, request, "interrupted", "interrupted", "stopped; the next launch continues it")

    def died(self, request: TrialRequest) -> None:
        """The process that trained a trial is gone; another one continues it."""
        self.board.say(f"{self._name(request)}: its worker died; another one continues it")

    def fail(self, key: str, request: TrialRequest, error: str, trace: str) -> None:
        """A trial raised: keep why, go on with the others."""
        self.logs[key].tag("error", error)
        self.logs[key].text("error.txt", trace)
        self._end(key, request, "failed", "failed", f"failed: {error}", "failed")

    def _end(
        self, key: str, request: TrialRequest, state: str, status: Status, text: str, ended: Ended = "waiting"
    ) -> None:
        log = self.logs.pop(key)
        log.tag("state", state)
        log.finish(status)
        self.board.end(self._name(request), text, ended)

    def _name(self, request: TrialRequest) -> str:
        return f"{self.search.name} / {request.name}"


def trial_card(search: Search, request: TrialRequest, commit: str) -> Card:
    """A trial as its log shows it. Two trials with the same values are two runs."""
    parts = (request.setting.stated(), str(search.seed_list()), str(request.trial_index), search.identity(request.arm))
    spec_id = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]
    kinds = request.setting.algo.kind, request.setting.env.kind
    params = {"method": kinds[0]} | {f"algo.{name}": str(value) for name, value in request.params.items()}
    return Card(
        request.arm,
        search.seed_list()[0],
        spec_id,
        search.code(request.arm),
        *kinds,
        commit,
        params,
        request.trial_index,
    )


def search_card(search: Search) -> StudyCard:
    """The search as its experiment shows it."""
    seeds = search.seed_list()
    spaces = [
        f"- {markdown(name)}: " + ", ".join(f"`{key}` {markdown(str(one))}" for key, one in arm.space.items())
        for name, arm in search.arms.items()
    ]
    note = (
        f"{prose(search.question)}\n\n"
        f"Search, profile `{search.profile}`: every arm has {search.trials} trials of {len(seeds)} seeds "
        f"({seeds[0]} to {seeds[-1]}) and {search.steps:,} environment steps each. Sampler {search.sampler.kind}, "
        f"pruner {search.pruner.kind}.\n\n" + "\n".join(spaces) + "\n\nA run is a trial: its curve is the mean over "
        "its seeds, `objective` the mean of their final returns. Pruned trials have no `objective`."
    )
    params = {name: [f"algo.{setting}" for setting in arm.space] for name, arm in search.arms.items()}
    return StudyCard(search.name, search.profile, note, params, list(search.arms))


# Results


class Written(NamedTuple):
    """Files that a launch left."""

    winners: list[Path]
    plots: list[Path]


def results(
    search: Search,
    arm_studies: Sequence[ArmStudy],
    tracker: Tracker,
    home: Home,
    out: Path | None,
    say: Callable[[str], None] = lambda _: None,
) -> Written:
    """Write the plots, and the winners once the budget is spent (`out` is given); keep all of them with the log.

    A plot that cannot be drawn, or not be shown in the log, is left out, and that is said.
    """
    written = Written([], [])
    for arm_study in arm_studies:
        title = f"{search.name} ({search.profile}): {arm_study.arm}"
        with decoration(f"{arm_study.arm}: plots", say):
            from pipelines.tuning.search_plots import plots

            written.plots.extend(plots(arm_study.study, title, plots_folder(search, home) / stem(arm_study.arm)))
        best = arm_study.best()
        if out is not None and best is not None:
            file = out / file_name(search, arm_study.arm)
            write_text(file, winner_yaml(search, arm_study.arm, best, arm_study.counts()))
            written.winners.append(file)
    files = (*written.plots, *written.winners)
    with decoration(f"{search.name}: overview in the log", say):
        tracker.publish(search_card(search).note, {file.name: file.read_bytes() for file in files})
    return written


def _summary(
    search: Search, arm_studies: Sequence[ArmStudy], tracker: "MlflowTracker", written: Written, whole: bool
) -> None:
    console = terminal()
    console.print()
    print_table(console, HEADER, [_row(arm_study) for arm_study in arm_studies])
    lines = [_best_line(arm_study) for arm_study in arm_studies]
    lines += [f"winner: {file}" for file in written.winners]
    lines += [f"plot:   {file}" for file in written.plots]
    lines += [f"look:   {tracker.where()}", f"        experiment {tracker.name!r} in {without_password(tracker.uri)}"]
    changes = [word for text in search.overrides for word in ("--set", text)]
    again = shlex.join([search.file, "--profile", search.profile, *changes])
    lines += [] if whole else [f"next:   rhmc search run {again}   (continues)"]
    console.print("\n".join(map(visible, lines)), soft_wrap=True)


HEADER = ["arm", "trials", "complete", "pruned", "running", "waiting", "failed", "missing", "best"]


def _row(arm_study: ArmStudy) -> list[str]:
    counts, best = arm_study.counts(), arm_study.best()
    numbers = [str(counts[name]) for name in HEADER[2:-1]]
    return [arm_study.arm, str(arm_study.search.trials), *numbers, f"{best.value:.2f}" if best else "-"]


def _best_line(arm_study: ArmStudy) -> str:
    best = arm_study.best()
    if best is None:
        return f"{arm_study.arm}: no trial is finished"
    values = ", ".join(f"{name}={_short(value)}" for name, value in best.params.items())
    value = f"{OBJECTIVE} {best.value:.2f} over {len(best.returns)} seeds"
    return f"{arm_study.arm}: {value} in trial {best.trial_index}: {values}"


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def standing_of(search: Search, place: Home) -> dict[str, int]:
    """The trials of all arms by state, closed ones as `finished`, with `planned` and `stale`.

    Raises:
        StoreError: the database cannot be read.
    """
    found = dict.fromkeys(("finished", "running", "failed", "missing", "stale"), 0)
    found["planned"] = search.trials * len(search.arms)
    with opened(place, write=False) as storage, explained(storage_url(place)):
        if storage is None:
            return found | {"missing": found["planned"]}
        for arm in search.arms:
            arm_study, stale = look(search, arm, storage)
            counts = arm_study.counts()
            running = counts["running"] if place.driven(search.name, search.profile) else 0
            mine = {"finished": arm_study.closed, "running": running, "failed": counts["failed"], "stale": stale}
            found |= {name: found[name] + count for name, count in (mine | {"missing": counts["missing"]}).items()}
    return found


def show_search(search: Search, home: Path) -> int:
    """Print how far a search is: trials by state, the best so far, and those of other settings or code (stale).

    Returns:
        0 every trial is closed, 3 not, 2 environment error.
    """
    place = Home(home)
    try:
        with opened(place, write=False) as storage, explained(storage_url(place)):
            if storage is None:
                print(f"{search.name} ({search.profile}): nothing has been tried yet")
                return Exit.UNFINISHED
            found = [look(search, arm, storage) for arm in search.arms]
            print_table(terminal(), [*HEADER, "stale"], [[*_row(arm_study), str(stale)] for arm_study, stale in found])
            print("\n".join(_best_line(arm_study) for arm_study, _ in found))
            whole = all(arm_study.closed >= search.trials for arm_study, _ in found)
            return Exit.DONE if whole else Exit.UNFINISHED
    except StoreError as error:
        print(f"rhmc: {error}", file=sys.stderr)
        return Exit.BAD
