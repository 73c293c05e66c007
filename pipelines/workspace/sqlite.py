"""SQLite databases by their addresses, for whatever path, to write to or only to read."""

import os
import sqlite3
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

from sqlalchemy import URL, make_url
from sqlalchemy.exc import SQLAlchemyError

from pipelines.workspace.addresses import without_password
from pipelines.workspace.work_folder import StoreError

PATIENCE = 20.0  # seconds that a reader waits for a writer, as MLflow's own do
ANSWER = 20  # seconds that a database's server has to answer in its own language
WAL = 2  # what byte 18 of a file says whose writers keep a log beside it


def address(path: Path) -> str:
    """The address by which SQLAlchemy finds a file, whatever characters its path has."""
    return URL.create("sqlite", database=str(path)).render_as_string(hide_password=False)


def connecting(uri: str) -> dict[str, int]:
    """Arguments of a connection: so long it waits for a writer, or for a server that may be none of a database's."""
    kind = uri.partition(":")[0].partition("+")[0]
    if kind == "sqlite":
        return {"timeout": int(PATIENCE)}
    return {"connect_timeout": ANSWER} if kind in ("postgresql", "mysql") and "connect_timeout" not in uri else {}


def sqlite_file(uri: str) -> Path:
    """The file of an address.

    Raises:
        StoreError: it names none.
    """
    try:
        name = make_url(uri).database
    except SQLAlchemyError as error:
        shown = without_password(uri)
        raise StoreError(f"{shown}: not the address of a file; sqlite:////FOLDER/FILE is one") from error
    if not name or name == ":memory:":
        raise StoreError(f"{without_password(uri)}: names no file; sqlite:////FOLDER/FILE does")
    return Path(url2pathname(urlsplit(name).path) if name.startswith("file:") else name)


def reading_address(path: Path) -> str:
    """The address of a file for SQLAlchemy, that only reads."""
    name, _, query = _reading(path).partition("?")
    options = dict(part.split("=") for part in query.split("&"))
    return URL.create("sqlite", database=name, query=options | {"uri": "true"}).render_as_string(hide_password=False)


def connect(path: Path, *, write: bool = False) -> sqlite3.Connection:
    """A database that is there, beside whoever else writes."""
    return sqlite3.connect(f"{_uri(path)}?mode=rw" if write else _reading(path), timeout=PATIENCE, uri=True)


def _reading(path: Path) -> str:
    """SQLite's own address of a file that is only read.

    Nobody can write to a file whose folder is closed, so that it may be read without the locks of a log, which would
    have to be made there.
    """
    log = path.with_name(f"{path.name}-wal")
    closed = path.is_file() and not os.access(path.parent, os.W_OK)
    alone = closed and not (log.exists() and log.stat().st_size) and _keeps_log(path)
    return f"{_uri(path)}?mode=ro{'&immutable=1' if alone else ''}"


def _uri(path: Path) -> str:
    return path.absolute().as_uri()


def _keeps_log(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(19)[18:] == bytes([WAL])


def settle(path: Path) -> None:
    """Play back what a killed writer left half-done, which whoever only reads cannot.

    Raises:
        StoreError: the folder is closed.
    """
    journal = path.with_name(f"{path.name}-journal")
    if not journal.exists() or journal.stat().st_size == 0:
        return
    writable = os.access(path, os.W_OK) and os.access(path.parent, os.W_OK)
    try:
        with closing(connect(path, write=writable)) as database:
            database.execute("SELECT COUNT(*) FROM sqlite_master").fetchall()
    except sqlite3.OperationalError as error:
        if writable:
            raise
        text = "its last writer was killed; open it once where its folder can be written to"
        raise StoreError(f"{path}: {text} ({error})") from error
