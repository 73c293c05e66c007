"""Files of a work folder that was moved or copied: MLflow keeps absolute addresses of them.

A reader looks where the folder is now. Before anything is written, the addresses are brought up to date, so that
MLflow's own server and its registry find the files as well, and nothing goes to the old place.
"""

from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

from sqlalchemy import (
    ColumnElement,
    Connection,
    String,
    column,
    create_engine,
    func,
    inspect,
    literal,
    select,
    table,
    update,
)
from sqlalchemy.pool import NullPool

from pipelines.workspace import sqlite
from pipelines.workspace.work_folder import Home

LOCATED = (  # MLflow's tables and columns with addresses of files
    ("runs", "artifact_uri"),
    ("logged_models", "artifact_location"),
    ("model_versions", "source"),
    ("model_versions", "storage_location"),
    ("experiments", "artifact_location"),
)
MOVABLE = ("sqlite", "postgresql", "mysql")  # databases whose addresses are brought up to date


def is_own(uri: str, home: Home) -> bool:
    """True if a store is the work folder's own database, which moves with it."""
    return uri.startswith("sqlite:") and sqlite.sqlite_file(uri).resolve() == home.database


def folder(uri: str) -> Path | None:
    """The folder that an address of files means; None if they are elsewhere than in folders."""
    place = urlsplit(uri)
    return Path(url2pathname(place.path)) if place.scheme in ("", "file") and place.path else None


def run_folder(stored: str, home: Home, *, own: bool) -> Path | None:
    """The present place of the files of a run.

    Args:
        stored: the address that MLflow keeps, `<artifacts>/<run>/artifacts`.
        home: the work folder.
        own: whether the store is its own.

    Returns:
        None if a server or another service keeps them.
    """
    there = folder(stored)
    if there is None or len(there.parts) < 3:
        return there
    here = home.artifacts.joinpath(*there.parts[-2:])
    return here if _moved(there.parents[1], home, [there.parent.name], own=own) else there


def _moved(stored: Path, home: Home, runs: Sequence[str], *, own: bool) -> bool:
    """True if the artifacts of a work folder that was elsewhere are those of this one.

    Another folder that keeps files of a database of ours by a person's wish, or another work folder that shares a
    database, stays where it is.
    """
    if stored == home.artifacts or stored.name != home.artifacts.name:
        return False
    if own:
        return not stored.is_dir() or (stored.parent / home.database.name).exists()
    return not stored.is_dir() and any((home.artifacts / run).is_dir() for run in runs)


def bring_up_to_date(uri: str, home: Home) -> None:
    """Let the addresses in a store name the present place of this work folder, all of them or none."""
    if uri.partition(":")[0].partition("+")[0] not in MOVABLE:
        return
    own = is_own(uri, home)
    engine = create_engine(uri, poolclass=NullPool, connect_args=sqlite.connecting(uri))
    try:
        with engine.connect() as database:
            if not inspect(database).has_table("experiments"):  # nobody has used it yet
                return
            moved = [stored for stored in _locations(database) if _of_moved(database, stored, home, own=own)]
            for stored in moved:
                _rename(database, stored, home.artifacts.as_uri())
            database.commit()
    finally:
        engine.dispose()


def _locations(database: Connection) -> list[str]:
    where = column("artifact_location", String)
    return list(database.scalars(select(where).select_from(table("experiments", where)).distinct()))


def _of_moved(database: Connection, stored: str, home: Home, *, own: bool) -> bool:
    there = folder(stored)
    if there is None or not _moved(there, home, (), own=True):  # cheap: decides most
        return False
    return own or _moved(there, home, _runs(database, stored), own=False)


def _runs(database: Connection, stored: str) -> list[str]:
    run, uri = column("run_uuid", String), column("artifact_uri", String)
    query = select(run).select_from(table("runs", run, uri)).where(_below(uri, stored))
    return list(database.scalars(query))


def _below(where: ColumnElement[str], stored: str) -> ColumnElement[bool]:
    return func.substr(where, 1, len(stored) + 1) == f"{stored}/"


def _rename(database: Connection, stored: str, new: str) -> None:
    for name, key in LOCATED:
        where = column(key, String)
        rows = table(name, where)
        database.execute(update(rows).where(where == stored).values({key: new}))
        tail = func.substr(where, len(stored) + 1)
        database.execute(update(rows).where(_below(where, stored)).values({key: literal(new, String).concat(tail)}))
