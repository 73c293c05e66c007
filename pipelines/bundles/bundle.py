"""Runs of a study as a folder or an archive that another machine takes in, so that the study goes on there.

A bundle holds `bundle.json` (what it is), `runs.parquet` (a row per run), `points.parquet` (a row per run, step and
metric, `time/` included), `policies/<key>.pt` of finished runs and `checkpoints/<key>/` of those under way. One of
values only has no policies and no runs under way. What a bundle may hold is checked in `bundles.files` (names and
sizes), `bundles.rows` (the study, its runs and their values) and `bundles.states` (policies and checkpoints).
"""

import hashlib
import json
import math
import os
import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from filelock import Timeout

from pipelines.bundles.files import MANIFEST, BundleError, Files, limited, opened
from pipelines.bundles.rows import FORMAT, POINTS, RUNS, Entry, Manifest, Told, read
from pipelines.bundles.states import check_states, states_of
from pipelines.execution.recorder import keep
from pipelines.export.tables import write_parquet
from pipelines.specs.identity import present
from pipelines.specs.study import Study
from pipelines.tracking.plan import Item, commit, finished, items, resolved_yaml, study_card
from pipelines.tracking.policy import CONFIG, FILE
from pipelines.tracking.tracker import ADOPTED, VALUES_ONLY, Recorded, StudyCard, Tracker
from pipelines.workspace.leftovers import part_of
from pipelines.workspace.work_folder import Checkpoints, Home, StoreError, whole

ARCHIVE = ".zip"
DESK = "import"


class Packed(NamedTuple):
    """The runs that went into a bundle."""

    planned: int
    finished: int
    begun: int
    astray: Sequence[str] = ()  # finished, and left out because a value is not finite: one line each


class Taken(NamedTuple):
    """The runs that came out of a bundle; `foreign` of them were made by code that is not the code here."""

    study: str
    profile: str
    new: int
    known: int
    begun: int
    foreign: int


# Packing


def pack(study: Study, out: Path, home: Path, *, values_only: bool = False) -> Packed:
    """Write the runs of the present plan and code that are finished or under way.

    Args:
        study: the plan.
        out: a folder, or an archive if its name ends with `.zip`; there must be nothing yet.
        home: the work folder.
        values_only: leave policies and checkpoints behind.

    Raises:
        StoreError: nothing to pack, an environment error, or the disk is full. Nothing is left behind then.
    """
    from pipelines.tracking.mlflow_tracker import open_existing

    if os.path.lexists(out):
        raise StoreError(f"{out}: is there already; name a new one")
    place, card = Home(home), study_card(study)
    tracker = open_existing(card, place)
    plan = items(study)
    with whole(out) as part, _beside(part, out) as folder:
        packed = _fill(folder, plan, tracker, place, values_only)
        if packed.finished + packed.begun == 0:
            raise StoreError(f"{study.name} ({study.profile}): no run is finished or under way; nothing to export")
        runs = tuple((item.card.arm, item.key) for item in plan)
        code = {item.card.fingerprint: dict(item.card.modules) for item in plan}
        adopted = {run.key: run.adopted for run in tracker.recorded() if run.adopted} if tracker else {}
        adopted = {item.key: adopted[item.key] for item in plan if item.key in adopted}
        needed = tuple(sorted({module for item in plan for module in item.spec.imports}))
        fixed = {"format": FORMAT, "commit": commit(), "plan": runs, "code": code, "adopted": adopted}
        about = Manifest.model_validate(fixed | {"imports": needed} | card._asdict())
        (folder / MANIFEST).write_text(about.model_dump_json(indent=1) + "\n", encoding="utf-8")
        _check_packed(folder, out)
        if folder != part:
            _zip(folder, part)
    return packed


@contextmanager
def _beside(part: Path, out: Path) -> Iterator[Path]:
    """The folder to be filled: what becomes the bundle, or lies beside it until it is an archive."""
    if out.suffix != ARCHIVE:
        part.mkdir()
        yield part
        return
    folder = part_of(out.with_name(f"{out.name}.files"))
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _check_packed(folder: Path, out: Path) -> None:
    """Refuse to write a bundle that import would refuse: better known here than there."""
    try:
        with opened(folder) as files:
            read(files)
    except BundleError as error:
        raise StoreError(f"{out}: cannot be packed so that it can be taken in again: {error}") from error


def _fill(folder: Path, plan: list[Item], tracker: Tracker | None, home: Home, values_only: bool) -> Packed:
    recorded = {(run.arm, run.key): run for run in tracker.recorded()} if tracker else {}
    done = finished(recorded.values())
    runs: list[tuple[Any, ...]] = []
    points: list[tuple[Any, ...]] = []
    astray: list[str] = []
    for item in plan:
        place = (item.card.arm, item.key)
        digest = ""
        if tracker and place in done:
            ref = recorded[place].ref
            rows = tracker.rows([ref])
            if odd := [row for row in rows if not math.isfinite(row.value)]:
                astray.append(f"{item.name}: {odd[0].metric} is {odd[0].value} at step {odd[0].step:,}")
                continue
            points += [(len(runs), row.step, row.metric, row.value) for row in rows]
            bare = values_only or recorded[place].values_only
            digest = "" if bare else _policy(tracker, ref, item, folder / "policies" / f"{item.key}.pt")
        elif values_only or not _checkpoints(home.checkpoints(item.key), folder / "checkpoints" / item.key):
            continue
        made = recorded[place].commit if place in recorded else ""
        texts = json.dumps(item.card.params), item.spec.canonical()
        runs.append((item.key, item.card.arm, item.card.seed, made, *texts, place in done, digest))
    write_parquet(folder / "runs.parquet", RUNS, runs)
    write_parquet(folder / "points.parquet", POINTS, points)
    count = sum(run[6] for run in runs)
    return Packed(len(plan), count, len(runs) - count, astray)


def _policy(tracker: Tracker, ref: str, item: Item, file: Path) -> str:
    """Put a run's policy in its place and return its digest."""
    with TemporaryDirectory(dir=file.parents[1]) as name:  # in what a killed export leaves, and the next one removes
        kept = tracker.file(ref, FILE, Path(name))
        if kept is None:
            remedy = "put it back, or leave policies behind with --values-only"
            raise StoreError(f"{item.name}: its run keeps no {FILE} in {tracker.files_of(ref)}; {remedy}")
        file.parent.mkdir(exist_ok=True)
        kept.replace(file)
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _checkpoints(source: Path, target: Path) -> bool:
    """Copy the checkpoints of a run; one that is dropped meanwhile is passed over."""
    for file in sorted(source.glob("[0-9]*.pt")):
        target.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            shutil.copyfile(file, target / file.name)
    return target.is_dir() and any(target.iterdir())


def _zip(folder: Path, part: Path) -> None:
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(file for file in folder.rglob("*") if file.is_file()):
            archive.write(file, file.relative_to(folder).as_posix())


# Unpacking


def unpack(bundle: Path, home: Path) -> Taken:
    """Log the finished runs of a bundle and lay out the checkpoints of the others, whatever is here already kept.

    All of the bundle is checked before anything is written. A process that dies meanwhile leaves runs that are
    finished and whole, and others that are not called finished; taking the bundle in again completes them.

    Args:
        bundle: what `pack` wrote, or anything else: nothing in it is trusted.
        home: the work folder.

    Raises:
        StoreError: it is no bundle, or a damaged one; or an environment error here.
    """
    place = Home(home)
    try:
        with opened(bundle) as files:
            with limited():
                told = read(files)
            about = told.about
            card = StudyCard(about.study, about.profile, about.note, about.params, about.arms)
            with _desk(place) as desk:
                with limited():
                    seals = check_states(files, told.entries, card, desk)
                with place.lock(card.study, card.profile):
                    return _take_in(told, card, place, Stock(files, seals, desk))
    except BundleError as error:
        raise StoreError(f"{bundle}: {error}") from error


class Stock(NamedTuple):
    """The files of a bundle as they were checked."""

    files: Files
    seals: dict[str, str]  # SHA-256 by name
    desk: Path

    def copy(self, name: str, target: Path) -> None:
        """Write a file somewhere, the same that was checked."""
        if self.files.copy(name, target) != self.seals[name]:
            raise BundleError(f"{name}: has changed while it was taken in")


def _take_in(told: Told, study: StudyCard, home: Home, stock: Stock) -> Taken:
    from pipelines.tracking.mlflow_tracker import MlflowTracker

    with ExitStack() as held:
        further = [entry for entry in told.entries if _goes_further(entry, home, stock.files)]
        for entry in further:
            _hold(held, home, entry.item.key)
        tracker = MlflowTracker(study, home)
        complete = False
        try:
            there = {(run.arm, run.key): run for run in tracker.recorded()}
            known = finished(there.values())
            new = [entry for entry in told.entries if entry.finished and entry.place not in known]
            begun = [entry for entry in further if entry.place not in known]
            for entry in new:
                _log(tracker, study, entry, stock, told.about.adopted.get(entry.key, ""))
            for entry in begun:
                _lay_out(tracker, there.get(entry.place), home, entry, stock)
            complete = told.plan <= finished(tracker.recorded())
        finally:
            tracker.close("finished" if complete else "interrupted")
    here = present()
    foreign = sum(entry.item.card.fingerprint not in here for entry in told.entries)
    total = sum(entry.finished for entry in told.entries)
    return Taken(study.study, study.profile, len(new), total - len(new), len(begun), foreign)


def _log(tracker: Tracker, study: StudyCard, entry: Entry, stock: Stock, adopted: str) -> None:
    log = tracker.start(entry.item.card)
    log.log(entry.values.points())
    config = resolved_yaml(entry.item, study)
    log.text(CONFIG, config)
    if not entry.policy:
        log.tag(VALUES_ONLY, "yes")
    else:
        with TemporaryDirectory() as name:
            (Path(name) / CONFIG).write_text(config, encoding="utf-8")  # for a policy without its spec
            stock.copy(entry.files, Path(name) / FILE)
            keep(log, Path(name))
    if adopted:
        log.tag(ADOPTED, adopted)
    log.finish("finished")


def _goes_further(entry: Entry, home: Home, files: Files) -> bool:
    """True if a run under way has got further in the bundle than here."""
    if entry.finished:
        return False
    newest = states_of(files, entry)[-1]
    return int(Path(newest).stem) > Checkpoints(home.checkpoints(entry.item.key)).points()


def _hold(held: ExitStack, home: Home, key: str) -> None:
    folder = home.checkpoints(key)
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        held.enter_context(Checkpoints(folder).lock().acquire(timeout=0))
    except Timeout as error:
        raise StoreError(f"{folder}: another process is training this run; wait for it or stop it") from error


def _lay_out(tracker: Tracker, there: Recorded | None, home: Home, entry: Entry, stock: Stock) -> None:
    """Copy checkpoints to where the run looks for them, the newest last: it says that all are there.

    What the run has logged here is dropped: the checkpoint brings the values up to itself with it.
    """
    if there is not None:
        tracker.drop(there.ref)
    target = home.checkpoints(entry.item.key)
    for part in target.glob("*.part"):  # of a killed import: the run is held
        part.unlink()
    for name in states_of(stock.files, entry):
        with whole(target / Path(name).name, durable=True) as part:
            stock.copy(name, part)


@contextmanager
def _desk(home: Home) -> Iterator[Path]:
    """A folder in the work folder for what is on its way, and for what libraries put aside meanwhile.

    It is removed at the end; one that a killed import left is removed now.
    """
    fresh = not home.root.exists()
    home.prepare()
    desk, before = part_of(home.root / DESK), tempfile.tempdir
    try:
        desk.mkdir()
        tempfile.tempdir = str(desk)
        yield desk
    except OSError as error:
        raise StoreError(f"{desk}: cannot be written to: {error.strerror or error}") from error
    finally:
        tempfile.tempdir = before
        shutil.rmtree(desk, ignore_errors=True)
        if fresh:
            with suppress(OSError):  # something was taken in
                home.root.rmdir()
