"""The plan of a study as its last launch kept it, and its runs in the log: how far it is, without the libraries that
train and log.

A kept plan counts only where everything that it was made of is as it was: the file and whatever it includes or could
include, the options, the code, the libraries, the database's schema. Where anything differs nothing is answered, and
the caller has to make the plan anew. Imports nothing heavy.
"""

import hashlib
import json
import os
import sqlite3
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, suppress
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from pipelines.specs.safe_names import study_name
from pipelines.workspace.work_folder import Home, whole

PACKAGES = Path(__file__).parents[2]  # what this project's packages are imported from
CODE = ("rhmc", "pipelines/specs", "pipelines/tracking")  # what decides a plan
STUDIES = ("*.yaml", "*/*.yaml", "*/*/*.yaml")  # files of a folder of studies
LIBRARIES = ("torch", "pydantic", "mlflow", "ruamel.yaml")
QUERY = """
    SELECT r.status, arm.value, spec.value, code.value, error.value
    FROM experiments e JOIN runs r USING (experiment_id)
    JOIN tags role ON role.run_uuid = r.run_uuid AND role.key = 'role' AND role.value = 'run'
    LEFT JOIN tags arm ON arm.run_uuid = r.run_uuid AND arm.key = 'arm'
    LEFT JOIN tags spec ON spec.run_uuid = r.run_uuid AND spec.key = 'spec'
    LEFT JOIN tags code ON code.run_uuid = r.run_uuid AND code.key = 'fingerprint'
    LEFT JOIN tags error ON error.run_uuid = r.run_uuid AND error.key = 'error'
    WHERE e.name = ? AND e.lifecycle_stage = 'active' AND r.lifecycle_stage = 'active'
    ORDER BY r.start_time, r.run_uuid
"""
STATUS = {"RUNNING": "running", "FINISHED": "finished", "FAILED": "failed", "KILLED": "interrupted"}  # MLflow's, ours


class Options(NamedTuple):
    """Options of a command line that decide a study's plan."""

    file: str
    profile: str
    variant: str
    overrides: tuple[str, ...]


class Place(NamedTuple):
    """A run, planned or logged."""

    arm: str
    key: str  # settings and code


class Seen(NamedTuple):
    """A logged run."""

    place: Place
    status: str
    error: str


class KeptPlan(NamedTuple):
    """A study's runs by name, in its order, and what a person should know of its file."""

    study: str
    runs: dict[str, Place]
    remarks: list[str]


def keep(home: Home, options: Options, plan: KeptPlan) -> None:
    """Write a plan beside the study's lock, which the caller holds. No launch fails for it."""
    with suppress(Exception):
        note = {"of": _made_of(options), "schema": _schema(home.database)} | plan._asdict()
        with whole(_file(home, options)) as part:
            part.write_text(json.dumps(note), encoding="utf-8")


def kept(home: Home, options: Options) -> tuple[KeptPlan, list[Seen]] | None:
    """The plan and the runs in the log, oldest first; None where the plan has to be made anew, or another log asked."""
    if os.environ.get("MLFLOW_TRACKING_URI"):
        return None
    try:
        note = json.loads(_file(home, options).read_text(encoding="utf-8"))
        if note["of"] != _made_of(options) or note["schema"] != _schema(home.database):
            return None
        runs = {name: Place(*place) for name, place in note["runs"].items()}
        return KeptPlan(note["study"], runs, list(note["remarks"])), _logged(home, note["study"], options.profile)
    except Exception:  # whatever is wrong, the long way says it
        return None


def _file(home: Home, options: Options) -> Path:
    name = study_name(Path(options.file), options.variant)
    return home.root / "locks" / f"{name}-{options.profile}.plan.json"


def _made_of(options: Options) -> str:
    """A digest of all that decides a plan."""
    whole = hashlib.sha256(json.dumps([str(Path(options.file).resolve()), *options[1:]]).encode())
    whole.update("\n".join([sys.version, *(f"{name} {version(name)}" for name in LIBRARIES)]).encode())
    for path in dict.fromkeys(path.resolve() for path in [*_code(), *_yaml(Path(options.file))]):
        whole.update(f"\0{path}\0".encode())
        whole.update(path.read_bytes())
    return whole.hexdigest()


def _code() -> Iterator[Path]:
    for folder in CODE:
        yield from sorted((PACKAGES / folder).rglob("*.py"))


def _yaml(file: Path) -> Iterator[Path]:
    """The file and what could be included: see `pipelines.specs.include`."""
    yield file
    for folder in (file.parent, Path("studies"), PACKAGES / "pipelines" / "studies"):
        for pattern in STUDIES:
            yield from sorted(folder.glob(pattern))


def _connect(database: Path) -> sqlite3.Connection:
    journal = database.with_name(f"{database.name}-journal")
    if journal.exists() and journal.stat().st_size:  # a killed writer's, which only the long way plays back
        raise sqlite3.OperationalError("a writer was killed")
    return sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", timeout=1.0, uri=True)


def _schema(database: Path) -> str:
    with closing(_connect(database)) as found:
        return str(found.execute("SELECT version_num FROM alembic_version").fetchone()[0])


def _logged(home: Home, study: str, profile: str) -> list[Seen]:
    """The runs of a study, each with all that it is known by; one of an older version has no arm and is none."""
    with closing(_connect(home.database)) as database:
        rows = database.execute(QUERY, [f"{study} ({profile})"]).fetchall()
    if any(arm is None for _, arm, *_ in rows):
        raise ValueError("runs of an older version, which the long way counts")
    return [Seen(Place(arm, f"{spec}-{code}"), STATUS[status], error or "") for status, arm, spec, code, error in rows]


def stale(plan: Iterable[Place], seen: Sequence[Seen]) -> bool:
    """True if the log has runs that are not of the plan: the reasons take the long way."""
    return not {one.place for one in seen} <= set(plan)
