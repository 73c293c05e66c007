"""The log on MLflow, the only module that talks to it.

One experiment per study and profile, in it one parent run for the study and one nested run per arm and key.
"""

import hashlib
import json
import logging
import os
import sqlite3
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from http.client import HTTPException
from pathlib import Path
from typing import Any, NamedTuple

from filelock import FileLock

from pipelines.specs import safe_names
from pipelines.tracking import arm_colours, saved_views
from pipelines.tracking.tracker import ADOPTED, VALUES_ONLY, Card, Recorded, Row, Status, StudyCard, unseen
from pipelines.workspace import relocation
from pipelines.workspace.addresses import fault, scrubbed, without_password
from pipelines.workspace.best_effort import decoration
from pipelines.workspace.errors import InputError
from pipelines.workspace.files import ABSENT, fault_of
from pipelines.workspace.leftovers import part_of, remove, scratch
from pipelines.workspace.provenance import Host
from pipelines.workspace.sqlite import address, connect, connecting, reading_address, settle, sqlite_file
from pipelines.workspace.work_folder import Home, StoreError, one_line, replace_durably, sync
from rhmc.types import Metrics

os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")  # the launch says where to look itself
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "4")  # 28 s: a server that was killed is back by then

from mlflow import MlflowClient
from mlflow.entities import Dataset, DatasetInput, Experiment, Metric, Param, Run, RunTag, ViewType
from mlflow.exceptions import MlflowException
from mlflow.store.artifact.artifact_repo import ArtifactRepository
from mlflow.store.artifact.artifact_repository_registry import get_artifact_repository
from mlflow.store.db import utils as database_utils
from sqlalchemy import create_engine
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.pool import NullPool

STATUS: dict[Status, str] = {
    "running": "RUNNING",
    "finished": "FINISHED",
    "failed": "FAILED",
    "interrupted": "KILLED",
}
FROM_MLFLOW: dict[str, Status] = {theirs: ours for ours, theirs in STATUS.items()}
SERVER = ("http://", "https://")  # how the address of one begins
BATCH = 1000  # values that one request may carry
PARENT = "study"  # tag `role` of the parent run; its runs have `run`
DATABASES = ("postgresql", "mysql", "mssql")  # with a server, that MLflow can write to itself
NOTE = "mlflow.note.content"  # the tag that MLflow shows as a description
LONGEST = 8000  # characters of a run's tag
MODULES = "modules"  # tag of a run: the digests of its code as JSON
TRACE = "error.txt"  # a run's file with why it failed
ARM = "arm"  # tag of a run; a run without it was logged by an older version
OLDER = (
    "the log holds runs of an older version (without the tag 'arm'), which are set aside: {}; `rhmc study run` trains "
    "them anew"
)
ARMS = "arms"  # the experiment's tag with its arms as JSON, in the order in which they came: it decides their colours
COLOURED = 100  # arms that the tag has room for; a view shows no more


def tracking_uri(home: Home) -> str:
    """`$MLFLOW_TRACKING_URI`, or SQLite in the work folder."""
    return os.environ.get("MLFLOW_TRACKING_URI") or address(home.database)


def experiment_name(study: StudyCard) -> str:
    """The experiment of a study and profile."""
    return f"{study.study} ({study.profile})"


class MlflowTracker:
    """See `Tracker`.

    Args:
        study: what is logged.
        home: the work folder.
        write: make the experiment and its parent run when they are missing, and mark runs that a killed driver left
            running as interrupted. The caller holds the study's lock.

    Raises:
        StoreError: the store cannot be reached, or is not MLflow's. All other methods raise it as well.
    """

    def __init__(self, study: StudyCard, home: Home, *, write: bool = True) -> None:
        self.study, self.home, self.uri = study, home, tracking_uri(home)
        self.remarks: list[str] = []  # what a person should know of this launch
        self.own = relocation.is_own(self.uri, home)
        with explained(self.uri):
            self.client = (writer if write else reader)(self.uri, home)
            self.experiment = self._experiment(home, write)
            self.arms = self._colour_arms() if write else []
            self.parent = self._parent() if write else None
            if write:
                self._interrupt_running()
            if older := len(self._search(f"tags.role = 'run' and tags.{ARM} IS NULL")):
                self.remarks.append(OLDER.format(older))

    def _experiment(self, home: Home, write: bool) -> str | None:
        name = experiment_name(self.study)
        found = self.client.get_experiment_by_name(name)
        if found is None and write:
            return self._create_experiment(name, None if self.served else home.artifacts.as_uri())
        if found is not None and found.lifecycle_stage != "active":
            if not write:
                return None
            self.client.restore_experiment(found.experiment_id)
            self.remarks.append(f"experiment {name!r} had been deleted in MLflow: it is restored, with its runs")
        return found.experiment_id if found else None

    def _create_experiment(self, name: str, artifacts: str | None) -> str:
        try:
            return self.client.create_experiment(name, artifacts)
        except MlflowException:
            found = self.client.get_experiment_by_name(name)  # made just now: the answer was lost and asked for again
            if found is None:
                raise
            return found.experiment_id

    def _colour_arms(self) -> list[str]:
        """The arms that have colours: those that had one keep it, for it is in the names of their runs' groups."""
        assert self.experiment is not None
        known: list[str] = json.loads(self.client.get_experiment(self.experiment).tags.get(ARMS, "[]"))
        arms = [*known, *(arm for arm in self.study.arms if arm not in known)][:COLOURED]
        if arms != known:
            self.client.set_experiment_tag(self.experiment, ARMS, json.dumps(arms, ensure_ascii=False))
        return arms

    @staticmethod
    def _look(arm: str, arms: Sequence[str]) -> list[tuple[str, str]]:
        """Tags that say how the runs of an arm are shown."""
        if arm not in arms:
            return [(arm_colours.TAG, arm)]
        place = arms.index(arm)
        try:
            return [(arm_colours.TAG, arm_colours.legend(arm, place)), (arm_colours.COLOUR, arm_colours.colour(place))]
        except Exception:  # a colour never ends a launch; without one MLflow picks it
            return [(arm_colours.TAG, arm)]

    def _parent(self) -> str:
        ref = self._only("tags.role = 'study'", self.study.study, {"role": PARENT}).info.run_id
        assert self.experiment is not None
        with decoration(f"{self.study.study}: description in the log", _note):
            self._describe(ref, self.study.note)
        with decoration(f"{self.study.study}: saved views in the log", _note):
            experiment = self.client.get_experiment(self.experiment)
            legends = [dict(self._look(arm, self.arms))[arm_colours.TAG] for arm in self.study.arms]
            save_views(self.client, experiment, saved_views.views(self.study.params, legends))
        self.client.update_run(ref, "RUNNING")
        return ref

    def _describe(self, ref: str, note: str) -> None:
        """Show the note behind the saved views: MLflow shows its first line unasked, as far as the window is wide."""
        assert self.experiment is not None
        note = fitting(f"{saved_views.links(self.experiment)} · {note}")
        self.client.set_experiment_tag(self.experiment, NOTE, note)
        self.client.set_tag(ref, NOTE, note)

    def _only(self, query: str, name: str, tags: dict[str, str], arm: str | None = None) -> Run:
        """The one run that matches, made if there is none.

        A request whose answer is lost is sent again, and then a server that was killed may have made the run twice.
        Both are empty: whatever was logged afterwards went to a run that this function chose, the oldest.
        """

        def there() -> list[Run]:
            found = self._search(query)
            return found if arm is None else [run for run in found if run.data.tags.get(ARM) == arm]

        runs = there()
        if not runs:
            self._create(name, tags)
            runs = there()
        run, *doubles = runs
        for double in doubles:
            self.client.delete_run(double.info.run_id)
        return run

    def _create(self, name: str, tags: dict[str, str]) -> Run:
        tags = tags | {"study": self.study.study, "profile": self.study.profile}
        assert self.experiment is not None
        return self.client.create_run(self.experiment, run_name=name, tags=tags)

    def _search(self, query: str, experiments: list[str] | None = None) -> list[Run]:
        """All runs that match, oldest first."""
        where = experiments or ([self.experiment] if self.experiment else [])
        runs: list[Run] = []
        page: str | None = None
        while where:
            found = self.client.search_runs(where, query, ViewType.ACTIVE_ONLY, 1000, ["attributes.start_time"], page)
            runs += found
            page = found.token
            if not page:
                break
        return runs

    def _interrupt_running(self) -> None:
        for run in self._search("tags.role = 'run' and attributes.status = 'RUNNING'"):
            self.client.set_terminated(run.info.run_id, STATUS["interrupted"])

    def recorded(self) -> list[Recorded]:
        """See `Tracker`."""
        return [run for _, run in self._listed([self.experiment] if self.experiment else [])]

    def finished_anywhere(self, keys: Collection[str]) -> dict[str, str]:
        """See `Tracker`."""
        with explained(self.uri):
            everywhere = [e.experiment_id for e in self.client.search_experiments(max_results=1000)]
        runs = [run for _, run in reversed(self._listed(everywhere)) if run.status == "finished"]
        return {run.key: run.ref for run in runs if run.key in keys}

    def _listed(self, experiments: Sequence[str]) -> list[tuple[str, Recorded]]:
        """Experiment and run of all runs there, oldest first; those of an older version are left out."""
        with explained(self.uri):
            sqlite = self.uri.startswith("sqlite:")
            return self._listed_sqlite(experiments) if sqlite else self._listed_client(experiments)

    def _listed_client(self, experiments: Sequence[str]) -> list[tuple[str, Recorded]]:
        query = f"tags.role = 'run' and tags.{ARM} IS NOT NULL"
        found = self._search(query, list(experiments)) if experiments else []
        return [(run.info.experiment_id, _recorded(run.info.run_id, run.info.status, run.data.tags)) for run in found]

    def _listed_sqlite(self, experiments: Sequence[str]) -> list[tuple[str, Recorded]]:
        """The client's answer, without the metrics and params that it would bring along: seconds for thousands."""
        query = (
            "SELECT r.experiment_id, r.run_uuid, r.status, t.key, t.value FROM runs r JOIN tags t USING (run_uuid) "
            f"WHERE r.lifecycle_stage = 'active' AND r.experiment_id IN ({', '.join('?' * len(experiments))}) "
            "ORDER BY r.start_time, r.run_uuid"
        )
        runs: dict[tuple[str, str, str], dict[str, str]] = {}
        with closing(connect(sqlite_file(self.uri))) as database:
            for experiment, ref, status, key, value in database.execute(query, list(experiments)).fetchall():
                runs.setdefault((str(experiment), ref, status), {})[key] = value
        return [
            (experiment, _recorded(ref, status, tags))
            for (experiment, ref, status), tags in runs.items()
            if tags.get("role") == "run" and ARM in tags
        ]

    def mark(self, ref: str, *, stale: bool) -> None:
        """See `Tracker`."""
        with explained(self.uri):
            if stale:
                self.client.set_tag(ref, saved_views.STALE, "yes")
            else:
                self.client.delete_tag(ref, saved_views.STALE)

    def start(self, card: Card) -> "MlflowRun":
        """See `Tracker`."""
        query = f"tags.role = 'run' and tags.spec = '{card.spec_id}' and tags.fingerprint = '{card.fingerprint}'"
        with explained(self.uri):
            run = self._only(query, card.name, self._tags(card), card.arm)
            if run.data.tags.get("imported", "") != card.imported:
                self.drop(run.info.run_id)
                run = self._only(query, card.name, self._tags(card), card.arm)
            ref = run.info.run_id
            if run.info.status != STATUS["running"]:
                self.client.update_run(ref, STATUS["running"])
            if "error" in run.data.tags:
                self.client.delete_tag(ref, "error")
            new = [Param(name, value) for name, value in card.params.items() if name not in run.data.params]
            if new:  # a new run, or one whose driver was killed between making it and this
                self.client.log_batch(ref, params=new)
            if card.env and not (run.inputs and run.inputs.dataset_inputs):
                with decoration(f"{card.name}: its task in the log", _note):
                    self.client.log_inputs(ref, [DatasetInput(task_of(card), [])])
            seen = {(row.metric, row.step) for row in self.rows([ref])} if run.data.metrics else set()
        return MlflowRun(self, card, ref, seen)

    def drop(self, ref: str) -> None:
        """See `Tracker`. The run lies among MLflow's deleted ones; its model is no longer offered."""
        with explained(self.uri):
            for version in self.client.search_model_versions(f"run_id = '{ref}'"):
                self.client.delete_model_version(version.name, version.version)
            self.client.delete_run(ref)

    def _tags(self, card: Card) -> dict[str, str]:
        return (
            dict(self._look(card.arm, self.arms))
            | {
                "role": "run",
                "mlflow.parentRunId": self.parent or "",
                ARM: card.arm,
                "algorithm": card.algorithm,
                "task": card.task,
                "seed": str(card.seed),
                "spec": card.spec_id,
                "fingerprint": card.fingerprint,
                "commit": card.commit,
            }
            | ({MODULES: json.dumps(dict(card.modules))} if card.modules else {})
            | {name: value for name, value in card.host._asdict().items() if value}
            | ({"imported": card.imported} if card.imported else {})
        )

    def rows(self, refs: Sequence[str], metrics: Collection[str] | None = None) -> list[Row]:
        """See `Tracker`. SQLite: a query per run; otherwise a request per metric and a hundred runs."""
        with explained(self.uri):
            found = (self._rows_sqlite if self.uri.startswith("sqlite:") else self._rows_client)(refs, metrics)
            return sorted(found)

    def _rows_client(self, refs: Sequence[str], metrics: Collection[str] | None = None) -> Iterator[Row]:
        from pipelines.tracking.histories import Histories

        first: dict[tuple[str, int, str], float] = {}
        for one in Histories(self.client, self.uri).of(self._runs(refs), keys_of(metrics)):
            first.setdefault((one.ref, one.step, safe_names.full(one.metric)), one.value)
        return (Row(*place, value) for place, value in first.items())

    def _runs(self, refs: Sequence[str]) -> Iterator[Run]:
        """The runs of these names, of whatever study."""
        mine = {run.info.run_id: run for run in self._search("tags.role = 'run'")} if len(refs) > 1 else {}
        return (mine[ref] if ref in mine else self.client.get_run(ref) for ref in refs)

    def _rows_sqlite(self, refs: Sequence[str], metrics: Collection[str] | None = None) -> Iterator[Row]:
        """The client's answer, read from MLflow's table `metrics` at once."""
        keys = sorted(keys_of(metrics) or ())
        some = f" AND key IN ({', '.join('?' * len(keys))})" if metrics is not None else ""
        query = f"SELECT step, key, value, is_nan FROM metrics WHERE run_uuid = ?{some} ORDER BY timestamp"
        with closing(connect(sqlite_file(self.uri))) as database:
            for ref in refs:
                first: dict[tuple[int, str], float] = {}
                for step, key, value, is_nan in database.execute(query, (ref, *keys)).fetchall():  # let writers in
                    first.setdefault((step, safe_names.full(key)), float("nan") if is_nan else value)
                yield from (Row(ref, *place, value) for place, value in first.items())

    def publish(self, note: str, files: Mapping[str, bytes]) -> None:
        """See `Tracker`."""
        assert self.parent is not None
        with explained(self.uri), scratch() as folder:
            self._describe(self.parent, note)
            for name, content in files.items():
                (Path(folder) / name).write_bytes(content)
            if files:
                self.keeps(self.parent).log_artifacts(str(folder))
            take_stock(self.uri)

    def close(self, status: Status) -> None:
        """See `Tracker`."""
        with explained(self.uri):
            self._interrupt_running()
            if self.parent:
                self.client.set_terminated(self.parent, STATUS[status])

    @property
    def name(self) -> str:
        """The experiment's name."""
        return experiment_name(self.study)

    def file(self, ref: str, name: str, folder: Path) -> Path | None:
        """See `Tracker`."""
        with explained(self.uri):
            return _copied(self.keeps(ref), name, folder)

    def files_of(self, ref: str) -> str:
        """The place where the files of a run are looked for."""
        with explained(self.uri):
            stored = self.client.get_run(ref).info.artifact_uri
            return str(relocation.run_folder(stored, self.home, own=self.own) or stored)

    def keeps(self, ref: str) -> ArtifactRepository:
        """The files of a run, where they are now."""
        stored = self.client.get_run(ref).info.artifact_uri
        there = relocation.run_folder(stored, self.home, own=self.own)
        return get_artifact_repository(there.as_uri() if there else stored, tracking_uri=self.uri)

    def where(self) -> str:
        """The way to look at the experiment: a command, or a server's address."""
        return without_password(self.uri) if self.served else "rhmc ui"

    @property
    def served(self) -> bool:
        """True if a server keeps the log, and its files."""
        return self.uri.startswith(SERVER)


class MlflowRun:
    """See `RunLog`."""

    def __init__(self, tracker: MlflowTracker, card: Card, ref: str, seen: set[tuple[str, int]]) -> None:
        self.tracker, self.card, self.ref, self.seen = tracker, card, ref, seen
        self.client, self.uri = tracker.client, tracker.uri

    def log(self, points: Sequence[Metrics]) -> None:
        """See `RunLog`."""
        now = int(time.time() * 1000)
        values = [
            Metric(safe_names.shown(metric), value, now, step) for metric, step, value in unseen(points, self.seen)
        ]
        with explained(self.uri):
            for start in range(0, len(values), BATCH):
                self.client.log_batch(self.ref, metrics=values[start : start + BATCH])

    def artifact(self, path: Path) -> None:
        """See `RunLog`."""
        with explained(self.uri):
            self.tracker.keeps(self.ref).log_artifact(str(path))

    def text(self, name: str, content: str) -> None:
        """See `RunLog`."""
        with explained(self.uri), scratch() as folder:  # not `log_text`, whose own folder a kill would leave
            file = folder / name
            file.write_text(scrubbed(content) if name == TRACE else content, encoding="utf-8")
            self.tracker.keeps(self.ref).log_artifact(str(file))

    def tag(self, name: str, value: str) -> None:
        """See `RunLog`."""
        with explained(self.uri):
            self.client.log_batch(self.ref, tags=[RunTag(name, scrubbed(value)[:5000])])

    def model(self, policy: Path) -> None:
        """See `RunLog`."""
        from pipelines.tracking.registry import register  # 1 s, and only when a run ends

        tracker = self.tracker
        assert tracker.experiment is not None
        try:
            with explained(self.uri):
                register(self.client, self.ref, tracker.experiment, tracker.study, self.card, policy)
        except InputError as error:  # a policy that cannot be read
            raise StoreError(str(error)) from error

    def finish(self, status: Status) -> None:
        """See `RunLog`."""
        with explained(self.uri):
            if status == "finished":
                self._make_durable()
            self.client.set_terminated(self.ref, STATUS[status])

    def _make_durable(self) -> None:
        """Files before the word that they are there: a run that is finished is never looked at again.

        Where a server keeps the files, that is its business.
        """
        tracker = self.tracker
        folder = relocation.run_folder(self.client.get_run(self.ref).info.artifact_uri, tracker.home, own=tracker.own)
        if folder and folder.is_dir():
            for path in (*folder.rglob("*"), folder, *list(folder.parents)[:3]):
                sync(path)


def task_of(card: Card) -> Dataset:
    """The task of a run, in the place that MLflow has for data: its settings stand for the episodes that it makes."""
    settings = json.dumps(dict(card.env), sort_keys=True)
    digest = hashlib.sha256(settings.encode()).hexdigest()[:8]
    return Dataset(card.task, digest, "code", json.dumps({"tags": dict(card.env)}, sort_keys=True), profile=settings)


def _note(text: str) -> None:
    print(f"rhmc: {text}", file=sys.stderr)


def fitting(note: str) -> str:
    """As much of a description as MLflow keeps, in whole lines: it refuses a longer one, or cuts it anywhere."""
    cut = "\n\nCut short: MLflow keeps no more.\n"
    return note if len(note) <= LONGEST else note[: LONGEST - len(cut)].rpartition("\n")[0] + cut


def keys_of(metrics: Collection[str] | None) -> set[str] | None:
    """The names that metrics of the program may have in MLflow; None for all."""
    return None if metrics is None else {name for metric in metrics for name in (metric, safe_names.shown(metric))}


def addresses(uri: str, server: str) -> list[tuple[str, str, str]]:
    """The saved views of every study in the web interface: experiment, view and address.

    A study that was logged before there were views gets them here.
    """
    quieten()
    if uri.startswith("sqlite:") and sqlite_file(uri).stat().st_size == 0:
        return []  # nothing yet, and asking would make the tables
    found = []
    with explained(uri):
        take_stock(uri)
        client = MlflowClient(uri, uri)
        for experiment in client.search_experiments(max_results=1000, order_by=["name ASC"]):
            if NOTE in experiment.tags:
                found += [(experiment, view) for view in _views_of(client, experiment)]
    return [(e.name, view.name, f"{server}/#/experiments/{e.experiment_id}/runs?{view.query}") for e, view in found]


def _views_of(client: MlflowClient, experiment: Experiment) -> list[saved_views.View]:
    there = saved_views.views({})
    if all(view.tag in experiment.tags for view in there):
        return there
    runs = client.search_runs([experiment.experiment_id], "tags.role = 'run'", max_results=100)
    params: dict[str, list[str]] = defaultdict(list)
    for run in runs:
        mine = params[run.data.params.get("method", "")]
        mine += [name for name in run.data.params if name not in (*mine, "method")]
    wanted = saved_views.views(params)
    save_views(client, experiment, wanted)
    return wanted


def save_views(client: MlflowClient, experiment: Experiment, wanted: Sequence[saved_views.View]) -> None:
    """Write the saved views of an experiment where they are not as they should be."""
    for view in wanted:
        written = view.written(experiment.creation_time or 0)
        if experiment.tags.get(view.tag) != written:
            client.set_experiment_tag(experiment.experiment_id, view.tag, written)


def fetch(ref: str, wanted: Sequence[str], home: Home, folder: Path) -> list[str]:
    """Write those of the wanted files that a run keeps to a folder.

    Args:
        ref: MLflow's id of the run, of whatever study.
        wanted: names of files.
        home: the work folder.
        folder: where to write them.

    Returns:
        The names of those that are there.

    Raises:
        StoreError: no store, no such run, or the store cannot be read.
    """
    log = open_existing(StudyCard("", "", ""), home)
    if log is None:
        raise StoreError(f"{sqlite_file(tracking_uri(home))}: nothing is logged yet, so there is no run {ref}")
    return [name for name in wanted if log.file(ref, name, folder)]


def versions(name: str, home: Home) -> dict[str, str] | list[str]:
    """The runs of a registered model by version, oldest first; the names of all models if it is none.

    Raises:
        StoreError: no store, or it cannot be read.
    """
    log = open_existing(StudyCard("", "", ""), home)
    if log is None:
        return []
    with explained(log.uri):
        known = [str(one.name) for one in log.client.search_registered_models()]
        if name not in known:
            return known
        found = log.client.search_model_versions(f"name = '{name}'")
        return {str(one.version): str(one.run_id) for one in sorted(found, key=lambda one: int(one.version))}


def _copied(kept: ArtifactRepository, name: str, folder: Path) -> Path | None:
    """A copy of a file in a folder, if it is kept."""
    if name not in {one.path for one in kept.list_artifacts()}:
        return None
    return Path(kept.download_artifacts(name, str(folder)))


class Counted(NamedTuple):
    """A run, wherever it is logged."""

    experiment: str
    status: Status
    fingerprint: str


def census(home: Home) -> list[Counted] | None:
    """Every run of every study in the store; None where there is no database yet.

    Raises:
        StoreError: the store cannot be reached, or is not MLflow's.
    """
    reader = open_existing(StudyCard("", "", ""), home)
    if reader is None:
        return None
    with explained(reader.uri):
        titles = {e.experiment_id: e.name for e in reader.client.search_experiments(max_results=1000)}
    runs = reader._listed(list(titles))
    return [Counted(titles[experiment], run.status, run.code) for experiment, run in runs]


def open_existing(study: StudyCard, home: Home) -> MlflowTracker | None:
    """The log for reading; None where there is no database yet (MLflow would make one)."""
    uri = tracking_uri(home)
    if uri.startswith("sqlite:") and _empty(sqlite_file(uri)):
        return None
    return MlflowTracker(study, home, write=False)


def _empty(file: Path) -> bool:
    """True if there is no database yet; a device or a pipe in its place is none and never will be."""
    return not file.exists() or (file.is_file() and file.stat().st_size == 0)


def prepared(home: Home) -> str:
    """The address of a store that others are about to use: it is one, and knows where the work folder is.

    Raises:
        StoreError: it cannot be reached, or is not MLflow's.
    """
    uri = tracking_uri(home)
    check(uri)
    quieten()
    with explained(uri):
        if not (uri.startswith("sqlite:") and sqlite_file(uri).stat().st_size == 0):
            relocation.bring_up_to_date(uri, home)
    return uri


def writer(uri: str, home: Home) -> MlflowClient:
    """MLflow's client of a store that is made if it is not there, with the addresses of files as they are now."""
    check(uri)
    quieten()
    if uri.startswith("sqlite:"):
        create_database(sqlite_file(uri))
    relocation.bring_up_to_date(uri, home)
    return MlflowClient(uri, uri)


def reader(uri: str, home: Home) -> MlflowClient:
    """MLflow's client of a store that it can only read.

    Raises:
        StoreError: a database of another MLflow, which it would bring up to date.
    """
    check(uri, write=False)
    quieten()
    if not uri.startswith("sqlite:"):
        return MlflowClient(uri, uri)
    path = sqlite_file(uri)
    with closing(connect(path)) as database:
        (found,) = database.execute("SELECT version_num FROM alembic_version").fetchone() or ("none",)
    if found != (known := database_utils._get_latest_schema_revision()):
        text = f"its schema is {found}, that of the MLflow here {known}: it can be read after `mlflow db upgrade`"
        raise StoreError(f"{path}: the database of another MLflow; {text}")
    here = reading_address(path)
    return MlflowClient(here, here)


def _recorded(ref: str, status: str, tags: Mapping[str, str]) -> Recorded:
    known: dict[str, str] = defaultdict(str, tags)
    key = f"{known['spec']}-{known['fingerprint']}"
    stale, host = saved_views.STALE in tags, Host(known["machine"], known["versions"])
    modules: Mapping[str, str] = json.loads(known[MODULES] or "{}")
    return Recorded(
        *(ref, known[ARM], key, FROM_MLFLOW[status], known["commit"], stale, host, known["error"]),
        *(VALUES_ONLY in tags, modules, known[ADOPTED]),
    )


# Environment errors


# MLflow makes the folders of a SQLite address as it is written, with %20 for a space. Ours are there.
database_utils._make_parent_dirs_if_sqlite = lambda db_uri: None


def quieten() -> None:
    """Keep MLflow and its migrations from talking: what goes wrong, such as a full disk, they raise as well."""
    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def check(uri: str, *, write: bool = True) -> None:
    """See early and cheaply that the store is one.

    Raises:
        StoreError: a file that is not MLflow's, or that is to be written and cannot; or a server that does not answer.
    """
    if said := fault("MLFLOW_TRACKING_URI", uri):
        raise StoreError(said)
    if uri.startswith("sqlite:"):
        _check_file(sqlite_file(uri), write)
    elif uri.startswith(SERVER):
        _check_server(uri)
    elif "://" not in uri:
        shown = without_password(uri)
        raise StoreError(f"MLFLOW_TRACKING_URI={shown}: not an address; http://HOST:PORT and sqlite:///FILE are some")
    elif uri.partition(":")[0].partition("+")[0] in DATABASES:
        with explained(uri):  # once: MLflow would try for a minute and a half
            create_engine(uri, poolclass=NullPool, connect_args=connecting(uri)).connect().close()


def _check_file(path: Path, write: bool) -> None:
    advice = "move it away, or name another store in MLFLOW_TRACKING_URI"
    if (fault := fault_of(path)) and fault != ABSENT:
        raise StoreError(f"{path}: not an MLflow database: {fault}; {advice}")
    try:
        if not path.exists() or path.stat().st_size == 0:
            if not path.parent.is_dir():
                raise StoreError(f"{path.parent}: no such folder (for the MLflow database)")
            return
        if write and not os.access(path, os.W_OK):
            raise StoreError(f"{path}: the MLflow database cannot be written to (read-only)")
        settle(path)
        with closing(connect(path)) as database:
            tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    except (sqlite3.Error, OSError) as error:
        raise StoreError(f"{path}: not an MLflow database ({error}); {advice}") from error
    if tables and not {"experiments", "runs", "metrics", "alembic_version"} <= tables:
        raise StoreError(f"{path}: a database, but not MLflow's; {advice}")


def take_stock(uri: str) -> None:
    """Let SQLite count how its tables are filled, some milliseconds' work.

    Without it, it looks for a metric of a hundred runs among that metric's values in all of them: among 10,000 runs
    MLflow's pages then take seconds instead of a tenth of one.
    """
    if uri.startswith("sqlite:"):
        with closing(connect(sqlite_file(uri), write=True)) as database:
            database.execute("PRAGMA analysis_limit = 1000")
            database.execute("ANALYZE")
            database.commit()


def create_database(path: Path) -> None:
    """Make MLflow's database where there is none. It takes seconds: whoever dies meanwhile leaves none, not a half."""
    with FileLock(f"{path}.lock"):
        if path.exists() and path.stat().st_size > 0:
            return
        part = part_of(path)
        try:
            MlflowClient(address(part)).search_experiments()
            replace_durably(part, path)
        finally:
            remove(part)


def _check_server(uri: str) -> None:
    place = urllib.parse.urlsplit(uri)
    bare = place._replace(netloc=place.netloc.rpartition("@")[2]).geturl()  # this page asks for no name
    try:
        urllib.request.urlopen(f"{bare.rstrip('/')}/health", timeout=10).close()
    except urllib.error.HTTPError:
        pass  # it answers; a server behind a gateway may lack this page
    except (OSError, HTTPException) as error:
        reason: Any = getattr(error, "reason", error)
        shown = without_password(uri)
        raise StoreError(f"{shown}: the MLflow server does not answer ({reason}); see MLFLOW_TRACKING_URI") from error


@contextmanager
def explained(uri: str) -> Iterator[None]:
    """Turn what MLflow, its database or the disk raise into one line that names the store."""
    try:
        yield
    except StoreError:
        raise
    except (MlflowException, SQLAlchemyError, sqlite3.Error, OSError, ImportError) as error:
        raise StoreError(f"{without_password(uri)}: MLflow cannot go on: {one_line(error)}") from error
