"""The trials of a search in Optuna's database: asked for, told, taken up again. The only module that stores in Optuna.

Each arm has a study of its own there, named by search, profile, arm and the identity of its settings and code. A trial
has an index in the budget of its arm. One that was interrupted is closed as failed, and its values are enqueued again
under the same index, so that it keeps its checkpoints and counts once.

Every proposal has a sampler of its own, seeded by the search's seed and the trial's index. With one trial at a time a
search therefore gives the same proposals whether or not it was interrupted; with several, what a proposal knows of the
others depends on which of them were faster.
"""

import hashlib
import math
import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple, cast

import optuna
from filelock import FileLock
from optuna.pruners import BasePruner, MedianPruner, NopPruner, SuccessiveHalvingPruner
from optuna.samplers import BaseSampler, RandomSampler, TPESampler
from optuna.storages import BaseStorage, InMemoryStorage, RDBStorage
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.exc import SQLAlchemyError

from pipelines.specs.search import Dimension, Pruner, Sampler, Search, Value
from pipelines.specs.study import Setting
from pipelines.workspace.addresses import fault, scrubbed, without_password
from pipelines.workspace.leftovers import part_of, remove
from pipelines.workspace.sqlite import address, connecting, reading_address, settle, sqlite_file
from pipelines.workspace.work_folder import Home, StoreError, one_line
from rhmc.types import Metrics

ATTEMPTS = 3  # launches that try a trial which raises
CLOSED = (TrialState.COMPLETE, TrialState.PRUNED)
EXPORTED = {TrialState.COMPLETE: "complete", TrialState.PRUNED: "pruned", TrialState.FAIL: "failed"}  # others: partial
OBJECTIVE = "final/return"  # what the report calls a run's final return; its mean over the seeds is maximised
CURVE = "eval/return"  # what a trial is pruned by
TRIAL_INDEX, ERROR = "trial_index", "error"  # attributes of a trial


class TrialRequest(NamedTuple):
    """A trial to be trained."""

    arm: str
    trial_index: int  # in the budget of its arm, from 0
    params: dict[str, Value]
    setting: Setting

    @property
    def name(self) -> str:
        """The name for people."""
        return f"{self.arm} t{self.trial_index}"


class Best(NamedTuple):
    """The best finished trial of an arm."""

    trial_index: int  # in the budget of its arm, from 0
    params: dict[str, Value]
    value: float
    returns: list[float]  # of each seed


class Recorded(NamedTuple):
    """A trial of the budget as it is exported."""

    state: str  # complete, pruned, failed, partial (waiting or under way) or missing
    value: float  # NaN unless complete
    last: int  # number of the last point of its curve, 0 for the one at step 0
    params: dict[str, Value]


class ArmStudy:
    """The trials of one arm.

    Args:
        search: whose.
        arm: its name.
        storage: see `open_storage`.
    """

    def __init__(self, search: Search, arm: str, storage: BaseStorage) -> None:
        self.search, self.arm = search, arm
        self.name = study_name(search, arm)
        pruner = make_pruner(search.pruner)
        if self.name in optuna.get_all_study_names(storage):  # which may be closed to writers
            self.study = optuna.load_study(study_name=self.name, storage=storage, pruner=pruner)
        else:
            self.study = optuna.create_study(
                storage=storage, study_name=self.name, direction="maximize", pruner=pruner, load_if_exists=True
            )
        self.space = search.arms[arm].space
        self.live: dict[int, optuna.Trial] = {}

    def latest(self) -> dict[int, FrozenTrial]:
        """By index, the trial that counts: the newest one with all its values, or under way."""
        standing = {}
        for trial in self.study.get_trials(deepcopy=False):
            trial_index = trial_index_of(trial)
            if trial_index is not None and (trial.state != TrialState.FAIL or self._whole(trial)):
                standing[trial_index] = trial
        return standing

    def _whole(self, trial: FrozenTrial) -> bool:
        return values_of(trial).keys() == self.space.keys()

    @property
    def left(self) -> int:
        """Trials of the budget that are still to be asked for."""
        spent = sum(trial.state != TrialState.WAITING for trial in self.latest().values())
        return max(0, self.search.trials - spent)

    @property
    def closed(self) -> int:
        """Trials that gave a result, whole or pruned."""
        return sum(trial.state in CLOSED for trial in self.latest().values())

    def take_up(self) -> int:
        """Close what a former launch left open and enqueue it again, and what failed fewer than `ATTEMPTS` times.

        Returns:
            How many were enqueued.
        """
        latest, again = self.latest(), 0
        for trial in self.study.get_trials():
            trial_index = trial_index_of(trial)
            if trial.state not in (TrialState.RUNNING, TrialState.FAIL):
                continue
            if trial_index in latest and latest[trial_index].number == trial.number and self._may_go_on(trial):
                # Before it is closed: whoever dies in between has it twice, and the newest stands for both.
                self.study.enqueue_trial(values_of(trial), user_attrs={TRIAL_INDEX: trial_index})
                again += 1
            if trial.state == TrialState.RUNNING:
                self.study.tell(trial.number, state=TrialState.FAIL)
        return again

    def _may_go_on(self, trial: FrozenTrial) -> bool:
        same = [t for t in self.study.get_trials(deepcopy=False) if trial_index_of(t) == trial_index_of(trial)]
        return self._whole(trial) and sum(ERROR in t.user_attrs for t in same) < ATTEMPTS

    def ask(self) -> TrialRequest | None:
        """The next trial: one that was enqueued, or a new proposal. None, and pruned, where the method refuses it."""
        taken = self.latest()
        trial_index = next(number for number in count() if number not in taken)
        self.study.sampler = make_sampler(self.search.sampler, trial_index)
        trial = self.study.ask()
        if TRIAL_INDEX in trial.user_attrs:
            trial_index = int(trial.user_attrs[TRIAL_INDEX])
        else:
            trial.set_user_attr(TRIAL_INDEX, trial_index)
        self.live[trial_index] = trial
        params = {name: suggest(trial, name, one) for name, one in self.search.arms[self.arm].space.items()}
        try:
            return TrialRequest(self.arm, trial_index, params, self.search.arms[self.arm].at(params))
        except ValueError as error:
            self._close(trial_index, "pruned", f"refused: {one_line(error)}", TrialState.PRUNED)
            return None

    def over(self) -> list[TrialRequest]:
        """The trials that nothing more is done for, to be asked after `take_up`."""
        found = []
        for trial_index, trial in self.latest().items():
            if trial.state not in (TrialState.RUNNING, TrialState.WAITING):
                with suppress(ValueError):  # refused by the method: never trained
                    found.append(
                        TrialRequest(self.arm, trial_index, trial.params, self.search.arms[self.arm].at(trial.params))
                    )
        return found

    def report(self, trial: TrialRequest, point: Metrics, number: int) -> str:
        """Take in a point of a trial's curve.

        Args:
            trial: whose.
            point: means over the seeds.
            number: of the point; the one at step 0 has number 0.

        Returns:
            Why the trial should be given up; nothing if it should not.
        """
        live, step = self.live[trial.trial_index], int(point["step"])
        if not math.isfinite(point[CURVE] + point.get(OBJECTIVE, 0.0)):
            return f"no finite return at step {step}"
        live.report(point[CURVE], number)
        early = number < self.search.pruner.warmup or OBJECTIVE in point
        return "" if early or not live.should_prune() else f"behind the others at step {step}"

    def complete(self, trial: TrialRequest, returns: Sequence[float]) -> float:
        """Close a trial with the final return of each seed; their mean is its value."""
        value = math.fsum(returns) / len(returns)
        live = self.live.pop(trial.trial_index)
        live.set_user_attr("returns", list(returns))
        self.study.tell(live, value)
        return value

    def prune(self, trial: TrialRequest, why: str) -> None:
        """Close a trial that is given up. It stays in the budget, and the sampler learns from it."""
        self._close(trial.trial_index, "pruned", why, TrialState.PRUNED)

    def fail(self, trial: TrialRequest, error: str) -> None:
        """Close a trial that raised."""
        self._close(trial.trial_index, ERROR, error, TrialState.FAIL)

    def _close(self, number: int, key: str, text: str, state: TrialState) -> None:
        live = self.live.pop(number)
        live.set_user_attr(key, scrubbed(text)[:2000])
        self.study.tell(live, state=state)

    def best(self) -> Best | None:
        """The finished trial with the highest value, the earliest among equals."""
        closed = ((index, t) for index, t in sorted(self.latest().items()) if t.state == TrialState.COMPLETE)
        done = [(t.value, index, t) for index, t in closed if t.value is not None]  # a pruned one has a value as well
        if not done:
            return None
        value, trial_index, trial = max(done, key=lambda one: one[0])
        return Best(trial_index, trial.params, value, trial.user_attrs["returns"])

    def recorded(self) -> list[Recorded]:
        """Every trial of the budget, in its order, those that are missing as well."""
        latest = self.latest()
        return [_recorded(latest.get(trial_index)) for trial_index in range(self.search.trials)]

    def counts(self) -> dict[str, int]:
        """The number of trials of the budget in each state."""
        states = [trial.state for trial in self.latest().values()]
        names = {"complete": TrialState.COMPLETE, "pruned": TrialState.PRUNED, "running": TrialState.RUNNING}
        names |= {"waiting": TrialState.WAITING, "failed": TrialState.FAIL}
        counted = {name: states.count(state) for name, state in names.items()}
        return counted | {"missing": max(0, self.search.trials - len(states))}


def _recorded(trial: FrozenTrial | None) -> Recorded:
    if trial is None:
        return Recorded("missing", math.nan, 0, {})
    state = EXPORTED.get(trial.state, "partial")
    value = trial.value if trial.state == TrialState.COMPLETE and trial.value is not None else math.nan
    return Recorded(state, value, max(trial.intermediate_values, default=0), values_of(trial))


def trial_index_of(trial: FrozenTrial) -> int | None:
    """The index in the budget, from 0; None for a trial that died before it had one."""
    return trial.user_attrs.get(TRIAL_INDEX)


def values_of(trial: FrozenTrial) -> dict[str, Any]:
    """The values that a trial tries, also while it waits."""
    return trial.params | trial.system_attrs.get("fixed_params", {})


def study_name(search: Search, arm: str) -> str:
    """An arm's study in Optuna."""
    return f"{search.name} ({search.profile}) / {arm} / {search.identity(arm)}"


def look(search: Search, arm: str, storage: BaseStorage | None) -> tuple[ArmStudy, int]:
    """An arm's study for reading, empty where there is none, and how many trials have other settings or other code.

    storage: None where there is no database.
    """
    if storage is None:
        return ArmStudy(search, arm, InMemoryStorage()), 0
    name, names = study_name(search, arm), optuna.get_all_study_names(storage)
    others = [n for n in names if n != name and n.rpartition(" / ")[0] == name.rpartition(" / ")[0]]
    stale = sum(len(optuna.load_study(study_name=n, storage=storage).get_trials(deepcopy=False)) for n in others)
    return ArmStudy(search, arm, storage if name in names else InMemoryStorage()), stale


# From the file's words to Optuna's


def suggest(trial: optuna.Trial, name: str, one: Dimension) -> Value:
    """Let Optuna choose from a dimension."""
    if one.choices is not None:
        chosen: Value = trial.suggest_categorical(name, one.choices)
        return chosen
    assert one.low is not None
    assert one.high is not None
    if one.whole:
        return trial.suggest_int(name, int(one.low), int(one.high), log=one.log, step=int(one.step or 1))
    return trial.suggest_float(name, one.low, one.high, log=one.log, step=one.step)


def make_sampler(cfg: Sampler, trial_index: int) -> BaseSampler:
    """The sampler for the trial of this index."""
    seed = int.from_bytes(hashlib.sha256(f"{cfg.seed} {trial_index}".encode()).digest()[:4])
    if cfg.kind == "random":
        return RandomSampler(seed=seed)
    return TPESampler(seed=seed, n_startup_trials=cfg.startup, multivariate=True, constant_liar=True)


def make_pruner(cfg: Pruner) -> BasePruner:
    """The pruner; a step is a point of the curve."""
    if cfg.kind == "median":
        return MedianPruner(n_startup_trials=cfg.startup, n_warmup_steps=cfg.warmup)
    if cfg.kind == "asha":
        return Asha(min_resource=cfg.warmup, reduction_factor=cfg.reduction)
    return NopPruner()


class Asha(SuccessiveHalvingPruner):
    """Optuna's, but that a trial does not compete with what was left of it when it was interrupted."""

    def prune(self, study: optuna.Study, trial: FrozenTrial) -> bool:
        """True if to give the trial up."""
        return super().prune(cast(optuna.Study, _Standing(study)), trial)


class _Standing:
    """A study without its failed trials."""

    def __init__(self, study: optuna.Study) -> None:
        self.study = study

    def __getattr__(self, name: str) -> Any:
        return getattr(self.study, name)

    def get_trials(self, deepcopy: bool = True) -> list[FrozenTrial]:
        """As the study's."""
        return [trial for trial in self.study.get_trials(deepcopy) if trial.state != TrialState.FAIL]


# The database


def storage_url(home: Home) -> str:
    """`$OPTUNA_STORAGE`, such as `postgresql://user@host/optuna`, or SQLite in the work folder."""
    return os.environ.get("OPTUNA_STORAGE") or address(home.searches)


def open_storage(home: Home, *, write: bool = True) -> BaseStorage | None:
    """The database, made where there is none; for reading alone, None where there is none.

    Raises:
        StoreError: it cannot be reached, or is not Optuna's.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    url = storage_url(home)
    shown = without_password(url)
    if said := fault("OPTUNA_STORAGE", url):
        raise StoreError(said)
    if "://" not in url:
        raise StoreError(f"OPTUNA_STORAGE={shown}: not the address of a database; sqlite:///FILE is one")
    try:
        with explained(url):
            return _open(url, write)
    except (OSError, ImportError, RuntimeError) as error:
        raise StoreError(f"{shown}: Optuna cannot use this database: {one_line(error)}") from error


@contextmanager
def opened(home: Home, *, write: bool = True) -> Iterator[BaseStorage | None]:
    """`open_storage` for the length of a block."""
    storage = open_storage(home, write=write)
    try:
        yield storage
    finally:
        if isinstance(storage, RDBStorage):
            close(storage)


def close(storage: RDBStorage) -> None:
    """Close its connections: the session's, which is in use until then, and those that wait."""
    storage.remove_session()
    storage.engine.dispose()


def _open(url: str, write: bool) -> BaseStorage | None:
    if not url.startswith("sqlite:///"):
        return RDBStorage(url, engine_kwargs={"pool_pre_ping": True, "connect_args": connecting(url)})
    file = sqlite_file(url)
    if not write:
        if not file.exists() or file.stat().st_size == 0:
            return None
        settle(file)
        return RDBStorage(reading_address(file), skip_table_creation=True)
    _create(file)
    return RDBStorage(url, engine_kwargs={"connect_args": {"timeout": 60}})


def _create(file: Path) -> None:
    """Make a SQLite database where there is none: whoever dies meanwhile leaves none, not a half."""
    if not file.parent.is_dir():
        raise StoreError(f"{file.parent}: no such folder (for Optuna's database)")
    with FileLock(f"{file}.lock"):
        if file.exists() and file.stat().st_size > 0:
            return
        part = part_of(file)
        try:
            close(RDBStorage(address(part)))
            part.replace(file)
        finally:
            remove(part)


@contextmanager
def explained(url: str) -> Iterator[None]:
    """Turn what Optuna, its database or the disk raise into one line that names the storage, without a password."""
    try:
        yield
    except StoreError:
        raise
    except (optuna.exceptions.OptunaError, SQLAlchemyError, sqlite3.Error) as error:
        raise StoreError(f"{without_password(url)}: Optuna cannot go on: {one_line(error)}") from error
