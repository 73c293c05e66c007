"""Runs of a study as a folder or an archive that another machine takes in, so that the study goes on there.

A bundle holds `bundle.json` (what it is), `runs.parquet` (a row per run), `points.parquet` (a row per run, step and
metric, `time/` included), `policies/<key>.pt` of finished runs and `checkpoints/<key>/` of those under way. One of
values only has no policies and no runs under way.
"""

import hashlib
import json
import shutil
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq
from filelock import FileLock, Timeout
from pydantic import ValidationError

from pipelines.export import write_parquet
from pipelines.identity import fingerprint
from pipelines.plan import Item, commit, finished, items, resolved_yaml, study_card
from pipelines.policy import CONFIG, FILE
from pipelines.recorder import keep
from pipelines.store import Checkpoints, Home, StoreError, whole
from pipelines.study import RunSpec, Study
from pipelines.tracker import Card, Row, StudyCard, Tracker, points_of
from rhmc.types import Frozen

FORMAT = 2
ARCHIVE = ".zip"
MANIFEST = "bundle.json"
RUNS = pa.schema(
    [
        ("key", pa.string()),  # spec id and fingerprint
        ("arm", pa.string()),
        ("seed", pa.int64()),
        ("commit", pa.string()),
        ("params", pa.string()),  # JSON
        ("config", pa.string()),  # the spec as canonical JSON
        ("finished", pa.bool_()),
        ("policy", pa.string()),  # SHA-256 of its file, empty without one
    ]
)
POINTS = pa.schema([("run", pa.int64()), ("step", pa.int64()), ("metric", pa.string()), ("value", pa.float64())])


class Manifest(Frozen):
    """What a bundle says of itself."""

    format: int
    study: str
    profile: str
    note: str
    params: dict[str, tuple[str, ...]]
    arms: tuple[str, ...]
    fingerprint: str
    commit: str


class Packed(NamedTuple):
    """What went into a bundle, in runs."""

    planned: int
    finished: int
    begun: int


class Taken(NamedTuple):
    """What came of a bundle, in runs; `foreign` is the fingerprint of its code where that is not the code here."""

    study: str
    profile: str
    new: int
    known: int
    begun: int
    foreign: str


class Entry(NamedTuple):
    """A run in a bundle."""

    item: Item
    finished: bool
    policy: str
    rows: list[Row]


# Packing


def pack(study: Study, out: Path, home: Path, *, values_only: bool = False) -> Packed:
    """Write the runs of the present plan and code that are finished or under way.

    Args:
        study: the plan.
        out: a folder, or an archive if its name ends with `.zip`; there must be nothing yet.
        home: the work folder.
        values_only: leave policies and checkpoints behind.

    Raises:
        StoreError: nothing to pack, something is in the way, or the disk is full. Nothing is left behind then.
    """
    from pipelines.mlflow_tracker import open_existing

    if out.exists():
        raise StoreError(f"{out}: is there already; name a new one")
    place, card = Home(home), study_card(study)
    tracker = open_existing(card, place)
    plan = items(study)
    with TemporaryDirectory() as name:
        folder = Path(name)
        try:
            packed = _fill(folder, plan, tracker, place, values_only)
            if packed.finished + packed.begun == 0:
                raise StoreError(f"{study.name} ({study.profile}): no run is finished or under way; nothing to export")
            about = Manifest(format=FORMAT, fingerprint=fingerprint(), commit=commit(), **card._asdict())
            (folder / MANIFEST).write_text(about.model_dump_json(indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            raise StoreError(f"{out}: cannot be written: {error.strerror or error}") from error
        _deliver(folder, out)
    return packed


def _fill(folder: Path, plan: list[Item], tracker: Tracker | None, home: Home, values_only: bool) -> Packed:
    recorded = {(run.arm, run.key): run for run in tracker.recorded()} if tracker else {}
    done = finished(recorded.values())
    runs: list[tuple[Any, ...]] = []
    points: list[tuple[Any, ...]] = []
    for item in plan:
        place = (item.card.arm, item.key)
        digest = ""
        if tracker and place in done:
            ref = recorded[place].ref
            points += [(len(runs), row.step, row.metric, row.value) for row in tracker.rows([ref])]
            digest = "" if values_only else _policy(tracker, ref, folder / "policies" / f"{item.key}.pt")
        elif values_only or not _checkpoints(home.checkpoints(item.key), folder / "checkpoints" / item.key):
            continue
        made = recorded[place].commit if place in recorded else ""
        texts = json.dumps(item.card.params), item.spec.canonical()
        runs.append((item.key, item.card.arm, item.card.seed, made, *texts, place in done, digest))
    write_parquet(folder / "runs.parquet", RUNS, runs)
    write_parquet(folder / "points.parquet", POINTS, points)
    count = sum(run[6] for run in runs)
    return Packed(len(plan), count, len(runs) - count)


def _policy(tracker: Tracker, ref: str, file: Path) -> str:
    """Put a run's policy in its place and return its digest, nothing if the log has none."""
    with TemporaryDirectory() as name:
        kept = tracker.file(ref, FILE, Path(name))
        if kept is None:
            return ""
        file.parent.mkdir(exist_ok=True)
        shutil.copyfile(kept, file)
    return _digest(file)


def _checkpoints(source: Path, target: Path) -> bool:
    """Copy the checkpoints of a run; one that is dropped meanwhile is passed over."""
    for file in sorted(source.glob("[0-9]*.pt")):
        target.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            shutil.copyfile(file, target / file.name)
    return target.is_dir() and any(target.iterdir())


def _deliver(folder: Path, out: Path) -> None:
    with whole(out) as part:
        if out.suffix != ARCHIVE:
            shutil.copytree(folder, part)
            return
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in sorted(file for file in folder.rglob("*") if file.is_file()):
                archive.write(file, file.relative_to(folder).as_posix())


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


# Unpacking


def unpack(bundle: Path, home: Path) -> Taken:
    """Log the finished runs of a bundle and lay out the checkpoints of the others, whatever is here already kept.

    All of the bundle is checked before anything is written.

    Args:
        bundle: what `pack` wrote.
        home: the work folder.

    Raises:
        StoreError: it is no bundle, or a damaged one; or something is in the way here.
    """
    from pipelines.mlflow_tracker import MlflowTracker

    with _opened(bundle) as folder:
        about, entries = _read(bundle, folder)
        place, card = Home(home), StudyCard(about.study, about.profile, about.note, about.params, about.arms)
        place.prepare()
        with place.lock(card.study, card.profile):
            tracker = MlflowTracker(card, place)
            try:
                known = finished(tracker.recorded())
                new = [e for e in entries if e.finished and (e.item.card.arm, e.item.key) not in known]
                for entry in new:
                    _log(tracker, card, entry, folder)
                begun = [e for e in entries if not e.finished and (e.item.card.arm, e.item.key) not in known]
                begun = [e for e in begun if _lay_out(folder / "checkpoints" / e.item.key, place, e.item.key)]
            finally:
                tracker.close("interrupted")
    foreign = "" if about.fingerprint == fingerprint() else about.fingerprint
    there = sum(entry.finished for entry in entries) - len(new)
    return Taken(about.study, about.profile, len(new), there, len(begun), foreign)


def _log(tracker: Tracker, study: StudyCard, entry: Entry, folder: Path) -> None:
    log = tracker.start(entry.item.card)
    log.log(points_of(entry.rows))
    log.text(CONFIG, resolved_yaml(entry.item, study))
    if entry.policy:
        with TemporaryDirectory() as name:
            (Path(name) / CONFIG).write_text(resolved_yaml(entry.item, study))  # for a policy without its spec
            shutil.copyfile(folder / "policies" / f"{entry.item.key}.pt", Path(name) / FILE)
            keep(log, Path(name))
    log.tag("imported", "yes")
    log.finish("finished")


def _lay_out(source: Path, home: Home, key: str) -> bool:
    """Copy checkpoints to where the run looks for them, unless it has got as far here."""
    target = home.checkpoints(key)
    if Checkpoints(source).points() <= Checkpoints(target).points():
        return False
    target.mkdir(parents=True, exist_ok=True)
    lock = FileLock(f"{target}.lock")
    try:
        with lock.acquire(timeout=0):
            for file in source.glob("[0-9]*.pt"):
                with whole(target / file.name, durable=True) as part:
                    shutil.copyfile(file, part)
    except Timeout as error:
        raise StoreError(f"{target}: another process is training this run; wait for it or stop it") from error
    return True


@contextmanager
def _opened(bundle: Path) -> Iterator[Path]:
    """The bundle as a folder."""
    if bundle.is_dir():
        yield bundle
        return
    with TemporaryDirectory() as name:
        try:
            with zipfile.ZipFile(bundle) as archive:
                archive.extractall(name)  # names that lead elsewhere are brought back inside
        except (OSError, zipfile.BadZipFile, ValueError, EOFError) as error:
            raise _damaged(bundle, getattr(error, "strerror", None) or error) from error
        yield Path(name)


def _read(bundle: Path, folder: Path) -> tuple[Manifest, list[Entry]]:
    try:
        about = Manifest.model_validate_json((folder / MANIFEST).read_bytes())
        if about.format != FORMAT:
            raise StoreError(f"{bundle}: a bundle of format {about.format}; this version reads {FORMAT}")
        runs, points = _table(folder / "runs.parquet", RUNS), _table(folder / "points.parquet", POINTS)
        rows: dict[int, list[Row]] = {}
        for point in points:
            rows.setdefault(point["run"], []).append(Row("", point["step"], point["metric"], point["value"]))
        entries = [_entry(about, run, rows.get(i, [])) for i, run in enumerate(runs)]
        _check(folder, entries)
    except FileNotFoundError as error:
        raise _damaged(bundle, f"no {Path(error.filename).name} in it") from error
    except ValidationError as error:
        raise _damaged(bundle, error.errors()[0]["msg"]) from error
    except (OSError, ValueError, KeyError, pa.ArrowException) as error:
        raise _damaged(bundle, error) from error
    return about, entries


def _table(file: Path, schema: pa.Schema) -> list[dict[str, Any]]:
    if not file.exists():
        raise FileNotFoundError(2, "missing", str(file))
    table = pq.read_table(file)
    if not table.schema.equals(schema):
        raise ValueError(f"{file.name} has other columns")
    return table.to_pylist()


def _entry(about: Manifest, run: dict[str, Any], rows: list[Row]) -> Entry:
    spec = RunSpec.model_validate_json(run["config"])
    if run["key"] != f"{spec.id}-{about.fingerprint}":
        raise ValueError(f"the settings of {run['arm']} s{run['seed']} are not those of its key")
    card = Card(
        run["arm"], spec.seed, spec.id, about.fingerprint, spec.algo.kind, spec.env.kind, run["commit"],
        {str(name): str(value) for name, value in json.loads(run["params"]).items()},
    )  # fmt: skip
    return Entry(Item(card, spec, about.study), run["finished"], run["policy"], rows)


def _check(folder: Path, entries: Iterable[Entry]) -> None:
    for entry in entries:
        file = folder / "policies" / f"{entry.item.key}.pt"
        if entry.policy and _digest(file) != entry.policy:
            raise ValueError(f"{file.name} has changed since it was written")
        if entry.finished and not any(row.metric.startswith("final/") for row in entry.rows):
            raise ValueError(f"{entry.item.name} is called finished and has no final value")


def _damaged(bundle: Path, why: object) -> StoreError:
    text = " ".join(str(why).split())
    return StoreError(f"{bundle}: not a bundle of `rhmc study export`, or a damaged one ({text})")
