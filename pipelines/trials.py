"""The trials of a search in Optuna's database: asked for, told, taken up again. The only module that stores in Optuna.

Each arm has a study of its own there, named by search, profile, arm and the identity of its settings and code. A trial
has an `origin`, the number it was first asked under: one that was interrupted is closed as failed and its values are
enqueued again under the same origin, so that it keeps its checkpoints and counts once.

Every proposal has a sampler of its own, seeded by the search's seed and the trial's place in the budget. With one trial
at a time a search therefore gives the same proposals whether or not it was interrupted; with several, what a proposal
knows of the others depends on which of them were faster.
"""

import hashlib
import math
import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import optuna
from filelock import FileLock
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.pruners import BasePruner, MedianPruner, NopPruner, SuccessiveHalvingPruner
from optuna.samplers import BaseSampler, RandomSampler, TPESampler
from optuna.storages import BaseStorage, RDBStorage
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.engine import make_url
from sqlalchemy.exc import SQLAlchemyError

from pipelines.search import Dimension, Pruner, Sampler, Search, Value
from pipelines.store import Home, StoreError, one_line
from pipelines.study import Setting
from rhmc.types import Metrics

ATTEMPTS = 3  # launches that try a trial which raises
CLOSED = (TrialState.COMPLETE, TrialState.PRUNED)
OBJECTIVE = "final/return"  # what the report calls a run's final return; its mean over the seeds is maximised
CURVE = "eval/return"  # what a trial is pruned by


class Asked(NamedTuple):
    """A trial to be trained."""

    arm: str
    origin: int
    params: dict[str, Value]
    setting: Setting

    @property
    def name(self) -> str:
        """What a person calls it."""
        return f"{self.arm} t{self.origin}"


class Best(NamedTuple):
    """The best finished trial of an arm."""

    origin: int
    params: dict[str, Value]
    value: float
    returns: list[float]  # of each seed


class Ledger:
    """The trials of one arm.

    Args:
        search: whose.
        arm: its name.
        fingerprint: of the code.
        storage: see `open_storage`.
    """

    def __init__(self, search: Search, arm: str, fingerprint: str, storage: BaseStorage) -> None:
        self.search, self.arm = search, arm
        self.name = study_name(search, arm, fingerprint)
        self.study = optuna.create_study(
            storage=storage,
            study_name=self.name,
            direction="maximize",
            pruner=make_pruner(search.pruner),
            load_if_exists=True,
        )
        self.space = {name: distribution(one) for name, one in search.arms[arm].space.items()}
        self.live: dict[int, optuna.Trial] = {}

    def latest(self) -> dict[int, FrozenTrial]:
        """By origin the trial that stands for it: the newest one. One that died before it had values is none."""
        trials = self.study.get_trials(deepcopy=False)
        return {origin(t): t for t in trials if t.state != TrialState.FAIL or t.params.keys() == self.space.keys()}

    @property
    def spent(self) -> int:
        """Trials of the budget that are closed or under way."""
        return sum(t.state != TrialState.WAITING for t in self.latest().values())

    @property
    def left(self) -> int:
        """Trials of the budget that are still to be asked for."""
        return max(0, self.search.trials - self.spent)

    @property
    def closed(self) -> int:
        """Trials that gave a result, whole or pruned."""
        return sum(t.state in CLOSED for t in self.latest().values())

    def take_up(self) -> int:
        """Close what a former launch left open and enqueue it again, and what failed fewer than `ATTEMPTS` times.

        Returns:
            How many were enqueued.
        """
        latest, again = self.latest(), 0
        for trial in self.study.get_trials():
            if trial.state not in (TrialState.RUNNING, TrialState.FAIL):
                continue
            stands = latest.get(origin(trial), trial).number == trial.number
            if stands and self._may_go_on(trial):
                self.study.enqueue_trial(self._params(trial), user_attrs={"origin": origin(trial)})  # before it is
                again += 1  # closed: whoever dies in between has it twice, and the newest stands for it
            if trial.state == TrialState.RUNNING:
                self.study.tell(trial.number, state=TrialState.FAIL)
        return again

    def _may_go_on(self, trial: FrozenTrial) -> bool:
        failures = [t for t in self.study.get_trials(deepcopy=False) if origin(t) == origin(trial) and error_of(t)]
        return self._params(trial).keys() == self.space.keys() and len(failures) < ATTEMPTS

    def _params(self, trial: FrozenTrial) -> dict[str, Any]:
        return trial.params | trial.system_attrs.get("fixed_params", {})

    def ask(self) -> Asked | None:
        """The next trial: one that was enqueued, or a new proposal. None, and pruned, where the method refuses it."""
        self.study.sampler = make_sampler(self.search.sampler, self.spent)
        trial = self.study.ask(self.space)
        number = trial.user_attrs.get("origin", trial.number)
        self.live[number] = trial
        try:
            return Asked(self.arm, number, trial.params, self.search.arms[self.arm].at(trial.params))
        except ValueError as error:
            self._close(number, "pruned", f"refused: {one_line(error)}", TrialState.PRUNED)
            return None

    def report(self, trial: Asked, points: Sequence[Metrics], first: int, *, done: bool) -> str:
        """Take in points of a trial's curve.

        Args:
            trial: whose.
            points: new ones, means over the seeds.
            first: the number of the first of them; the point at step 0 has number 0.
            done: they are the last.

        Returns:
            Why the trial should be given up; nothing if it should not.
        """
        live = self.live[trial.origin]
        for number, point in enumerate(points, first):
            if not math.isfinite(point[CURVE] + point.get(OBJECTIVE, 0.0)):
                return f"no finite return at step {int(point['step'])}"
            live.report(point[CURVE], number)
        if done or first + len(points) <= self.search.pruner.warmup or not live.should_prune():
            return ""
        return f"behind the others at step {int(points[-1]['step'])}"

    def complete(self, trial: Asked, returns: Sequence[float]) -> float:
        """Close a trial with the final return of each seed; their mean is its value."""
        value = math.fsum(returns) / len(returns)
        live = self.live.pop(trial.origin)
        live.set_user_attr("returns", list(returns))
        self.study.tell(live, value)
        return value

    def prune(self, trial: Asked, why: str) -> None:
        """Close a trial that is given up. It stays in the budget, and the sampler learns from it."""
        self._close(trial.origin, "pruned", why, TrialState.PRUNED)

    def fail(self, trial: Asked, error: str) -> None:
        """Close a trial that raised."""
        self._close(trial.origin, "error", error, TrialState.FAIL)

    def _close(self, number: int, key: str, text: str, state: TrialState) -> None:
        live = self.live.pop(number)
        live.set_user_attr(key, text[:2000])
        self.study.tell(live, state=state)

    def best(self) -> Best | None:
        """The finished trial with the highest value, the earliest among equals."""
        done = [t for t in self.latest().values() if t.state == TrialState.COMPLETE]
        if not done:
            return None
        trial = max(done, key=lambda t: (t.value, -origin(t)))
        assert trial.value is not None
        return Best(origin(trial), trial.params, trial.value, trial.user_attrs["returns"])

    def counts(self) -> dict[str, int]:
        """How many trials of the budget are in which state."""
        states = [trial.state for trial in self.latest().values()]
        names = {"complete": TrialState.COMPLETE, "pruned": TrialState.PRUNED, "running": TrialState.RUNNING}
        names |= {"waiting": TrialState.WAITING, "failed": TrialState.FAIL}
        counted = {name: states.count(state) for name, state in names.items()}
        return counted | {"missing": max(0, self.search.trials - len(states))}


def origin(trial: FrozenTrial) -> int:
    """The number that a trial was first asked under."""
    return int(trial.user_attrs.get("origin", trial.number))


def error_of(trial: FrozenTrial) -> str:
    """What a trial raised, or nothing."""
    return str(trial.user_attrs.get("error", ""))


def study_name(search: Search, arm: str, fingerprint: str) -> str:
    """An arm's study in Optuna."""
    return f"{search.name} ({search.profile}) / {arm} / {search.identity(arm, fingerprint)}"


def stale(search: Search, arm: str, fingerprint: str, storage: BaseStorage) -> int:
    """Trials of the same arm under other settings or other code."""
    name = study_name(search, arm, fingerprint)
    names = optuna.get_all_study_names(storage)
    others = [n for n in names if n != name and n.rpartition(" / ")[0] == name.rpartition(" / ")[0]]
    return sum(len(optuna.load_study(study_name=n, storage=storage).get_trials(deepcopy=False)) for n in others)


# From the file's words to Optuna's


def distribution(one: Dimension) -> BaseDistribution:
    """A dimension as Optuna names it."""
    if one.choices is not None:
        return CategoricalDistribution(one.choices)
    assert one.low is not None
    assert one.high is not None
    if one.whole:
        return IntDistribution(int(one.low), int(one.high), log=one.log, step=int(one.step or 1))
    return FloatDistribution(one.low, one.high, log=one.log, step=one.step)


def make_sampler(cfg: Sampler, place: int) -> BaseSampler:
    """The sampler for the trial at a place of the budget."""
    seed = int.from_bytes(hashlib.sha256(f"{cfg.seed} {place}".encode()).digest()[:4])
    if cfg.kind == "random":
        return RandomSampler(seed=seed)
    return TPESampler(seed=seed, n_startup_trials=cfg.startup, multivariate=True, constant_liar=True)


def make_pruner(cfg: Pruner) -> BasePruner:
    """The pruner; a step is a point of the curve."""
    if cfg.kind == "median":
        return MedianPruner(n_startup_trials=cfg.startup, n_warmup_steps=cfg.warmup)
    if cfg.kind == "asha":
        return SuccessiveHalvingPruner(min_resource=cfg.warmup, reduction_factor=cfg.reduction)
    return NopPruner()


# The database


def storage_url(home: Home) -> str:
    """`$OPTUNA_STORAGE`, such as `postgresql+psycopg2://user@host/optuna`, or SQLite in the work folder."""
    return os.environ.get("OPTUNA_STORAGE") or f"sqlite:///{home.searches}"


def open_storage(home: Home, *, write: bool = True) -> BaseStorage | None:
    """The database, made where there is none; for reading alone, None where there is none.

    Raises:
        StoreError: it cannot be reached, or is not Optuna's.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    url = storage_url(home)
    if "://" not in url:
        raise StoreError(f"OPTUNA_STORAGE={url}: not the address of a database; sqlite:///FILE is one")
    try:
        with explained(url):
            return _open(url, write)
    except (OSError, ImportError, RuntimeError) as error:
        raise StoreError(f"{_shown(url)}: Optuna cannot use this database: {one_line(error)}") from error


def _open(url: str, write: bool) -> BaseStorage | None:
    if not url.startswith("sqlite:///"):
        return RDBStorage(url, engine_kwargs={"pool_pre_ping": True})
    file = Path(url.removeprefix("sqlite:///"))
    if not write and not file.exists():
        return None
    _create(file)
    return RDBStorage(url, engine_kwargs={"connect_args": {"timeout": 60}})


def _create(file: Path) -> None:
    """Make a SQLite database where there is none: whoever dies meanwhile leaves none, not a half."""
    with FileLock(f"{file}.lock"):
        if file.exists() and file.stat().st_size > 0:
            return
        part = file.with_name(f"{file.name}.part")
        part.unlink(missing_ok=True)
        try:
            RDBStorage(f"sqlite:///{part}").engine.dispose()
            part.replace(file)
        finally:
            part.unlink(missing_ok=True)


@contextmanager
def explained(url: str) -> Iterator[None]:
    """Turn what Optuna, its database or the disk raise into one line that names the storage, without a password."""
    try:
        yield
    except StoreError:
        raise
    except (optuna.exceptions.OptunaError, SQLAlchemyError, sqlite3.Error) as error:
        raise StoreError(f"{_shown(url)}: Optuna cannot go on: {one_line(error)}") from error


def _shown(url: str) -> str:
    try:
        return make_url(url).render_as_string(hide_password=True)
    except SQLAlchemyError:
        return "OPTUNA_STORAGE"
