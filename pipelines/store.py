"""The work folder: where it is, who may write to a study, and checkpoints that survive a killed process."""

import hashlib
import os
import shutil
import socket
import urllib.parse
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from filelock import BaseFileLock, FileLock, Timeout

from pipelines.errors import InputError
from pipelines.litter import part_of, remove
from rhmc.types import State

GLANCE = 0.5  # seconds that another process may hold a study's lock only to see whether it is free
KEEP = 2  # checkpoints kept: should the newest be damaged, the one before is used


class StoreError(InputError):
    """Something outside the program is in the way; str() is the whole message, one line."""


def work_folder() -> Path:
    """`$RHMC_HOME`, or `work` in the current folder."""
    return Path(os.environ.get("RHMC_HOME") or "work").resolve()


class Home:
    """The paths inside a work folder.

    Args:
        root: the folder; made when the first file is written.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self.database = self.root / "mlflow.db"
        self.artifacts = self.root / "artifacts"
        self.searches = self.root / "optuna.db"

    def checkpoints(self, key: str) -> Path:
        """Where the checkpoints of a run (spec id and fingerprint) lie."""
        return self.root / "checkpoints" / key

    def scratch(self, study: str, profile: str) -> Path:
        """What Ray writes while a study runs; worth nothing afterwards."""
        return self.root / "ray" / f"{study}-{profile}"

    def name(self, study: str, profile: str) -> str:
        """A short name of the study and profile in this folder, for what has to lie elsewhere."""
        return hashlib.sha256(f"{self.root}\0{study}\0{profile}".encode()).hexdigest()[:12]

    def prepare(self) -> None:
        """Make the folder and see that it can be written to.

        Raises:
            StoreError: it cannot.
        """
        probe = self.root / ".probe"
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            probe = part_of(probe)
            probe.write_bytes(b"x" * 4096)
            probe.unlink()
        except OSError as error:
            with suppress(OSError):
                probe.unlink(missing_ok=True)
            raise StoreError(f"{self.root}: cannot be written to: {error.strerror or error}") from error

    @contextmanager
    def lock(self, study: str, profile: str) -> Iterator[None]:
        """Hold a study and profile while driving it; the system lets go when the process dies, however it dies.

        Raises:
            StoreError: another process drives it.
        """
        path = self._lock_file(study, profile)
        path.parent.mkdir(parents=True, exist_ok=True)
        owner = path.with_suffix(".pid")
        lock = FileLock(path)
        try:
            lock.acquire(timeout=GLANCE)
        except Timeout as error:
            pid = owner.read_text(encoding="utf-8").strip() if owner.exists() else "unknown"
            message = f"{study} ({profile}) is already being run by process {pid} ({path}); wait for it or stop it"
            raise StoreError(message) from error
        try:
            owner.write_text(f"{os.getpid()} on {socket.gethostname()}\n", encoding="utf-8")
            yield
        finally:
            lock.release()

    def driven(self, study: str, profile: str) -> bool:
        """Whether a process drives the study and profile in this folder."""
        path = self._lock_file(study, profile)
        if not path.exists():
            return False
        with suppress(Timeout), FileLock(path).acquire(timeout=0):
            return False
        return True

    def _lock_file(self, study: str, profile: str) -> Path:
        return self.root / "locks" / f"{study}-{profile}.lock"


class Checkpoints:
    """The newest checkpoints of one run, as files `<point>.pt`.

    Args:
        folder: theirs alone.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def save(self, point: int, state: State) -> None:
        """Write a checkpoint whole or not at all, and drop those older than the last two."""
        save_atomically(self.folder / f"{point:08d}.pt", state)
        for old in self._files()[KEEP:]:
            old.unlink(missing_ok=True)

    def newest(self) -> State | None:
        """The newest checkpoint that is whole, or None. Damaged ones are removed, and what a killed writer left."""
        for part in self.folder.glob("*.part"):
            part.unlink(missing_ok=True)
        for file in self._files():
            try:
                return load_whole(file)
            except MemoryError:
                raise
            except Exception:  # zipfile, pickle and torch each raise several kinds
                file.unlink(missing_ok=True)
        return None

    def points(self) -> int:
        """Points of the grid that the newest checkpoint has behind it, 0 without one. It may not be readable."""
        files = self._files()
        return int(files[0].stem) if files else 0

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("[0-9]*.pt"), reverse=True)

    def lock(self) -> BaseFileLock:
        """Whoever trains the run holds it."""
        return FileLock(f"{self.folder}.lock")

    def clear(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def clear_unused(self) -> None:
        """Remove the folder, should there be one that no process trains in."""
        if self.folder.is_dir():
            with suppress(Timeout), self.lock().acquire(timeout=0):
                self.clear()


@contextmanager
def whole(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """A part to be written, file or folder, which then takes the place of `path`: a reader meets the old or the new.

    Args:
        path: the file; its folder is made when missing.
        durable: also after a power cut.

    Raises:
        StoreError: the disk is full or the folder closed; nothing half-written is left.
    """
    try:
        part = part_of(path)
    except OSError as error:
        raise StoreError(f"{path}: cannot be written: {reason(error)}") from error
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        if durable:
            replace_durably(part, path)
        else:
            part.replace(path)
    except BaseException as error:
        remove(part)
        if isinstance(error, OSError | RuntimeError):  # torch reports a failed write as RuntimeError
            raise StoreError(f"{path}: cannot be written: {reason(error)}") from error
        raise


def save_atomically(path: Path, state: Any) -> None:
    """`torch.save` so that a reader meets the old file or the new one, also after a power cut.

    Raises:
        StoreError: the disk is full or the folder closed; nothing half-written is left.
    """
    with whole(path, durable=True) as part, part.open("wb") as file:
        torch.save(state, file)


def load_whole(path: Path) -> Any:
    """What `save_atomically` wrote, or an exception of any kind.

    `torch.load` alone does not see bytes that changed inside a tensor, such as a block that a power cut left as zeros;
    the checksums that `torch.save` writes beside each tensor do.
    """
    with zipfile.ZipFile(path) as archive:
        if damaged := archive.testzip():
            raise zipfile.BadZipFile(f"{path}: {damaged} does not match its checksum")
    return torch.load(path, weights_only=True, map_location="cpu")


def replace_durably(part: Path, path: Path) -> None:
    """Rename a closed file over another so that a power cut leaves the old one or the new one, whole."""
    sync(part)
    part.replace(path)
    sync(path.parent)


def sync(path: Path) -> None:
    """Make the content of a file, or the names in a folder, durable."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def without_replay(state: Any) -> Any:
    """A copy of a state without what was kept to learn from: enough to act with, small enough to keep for good.

    A replay is recognised by its keys (`rows`, `next`, `size`), a half rollout by `rows`, or `rows` and `count`.
    """
    if isinstance(state, dict):
        if kind := KEPT.get(frozenset(state)):
            return kind()
        return {key: without_replay(value) for key, value in state.items()}
    if isinstance(state, list | tuple):
        return type(state)(without_replay(value) for value in state)
    return state


KEPT: dict[frozenset[str], Callable[[], State]] = {  # what learning keeps, by its keys, and the empty form of it
    frozenset(("rows", "next", "size")): lambda: {"rows": {}, "next": 0, "size": 0},
    frozenset(("rows",)): lambda: {"rows": []},
    frozenset(("rows", "count")): lambda: {"rows": {}, "count": torch.zeros(0, dtype=torch.int64)},
}


def without_password(uri: str) -> str:
    """An address as it may be shown."""
    try:
        password = urllib.parse.urlsplit(uri).password
    except ValueError:  # brackets that hold no address
        return uri
    return uri.replace(f":{password}@", ":***@", 1) if password else uri


def one_line(error: BaseException) -> str:
    """The first telling line of an error; of a traceback, which some libraries wrap as it is, the last."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    if not lines:
        return type(error).__name__
    return lines[-1] if lines[0].startswith("Traceback (") else lines[0]


def reason(error: BaseException) -> str:
    """What the system said, where a library wrapped it in words of its own."""
    inner: BaseException | None = error
    while inner is not None:
        if isinstance(inner, OSError) and inner.strerror:
            return inner.strerror
        inner = inner.__cause__ or inner.__context__
    return one_line(error)
