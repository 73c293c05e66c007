"""The work folder: where it is, who may write to a study, and checkpoints that survive a killed process."""

import errno
import fcntl
import hashlib
import os
import shutil
import socket
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from filelock import BaseFileLock, FileLock, Timeout

from pipelines.workspace.addresses import scrubbed
from pipelines.workspace.errors import InputError
from pipelines.workspace.leftovers import part_of, remove
from pipelines.workspace.root import project

if TYPE_CHECKING:  # torch takes a second, and most verbs only look for the folder
    from rhmc.types import State

GLANCE = 0.5  # seconds that another process may hold a study's lock only to see whether it is free
KEEP = 2  # checkpoints kept: should the newest be damaged, the one before is used; and as many damaged ones
DAMAGED = ".damaged"  # after the name of a checkpoint that was set aside
OUT_OF_IT = errno.EINVAL  # what seeking to before the start of a file gives


class StoreError(InputError):
    """Environment error, from outside the program; str() is the whole message, one line, without passwords."""

    def __init__(self, text: str) -> None:
        super().__init__(scrubbed(text))


class DamagedError(StoreError):
    """A file's own content proves that it is not what was written."""


def work_folder() -> Path:
    """`$RHMC_HOME`, with `~` as a shell understands it, or `work` at the top of the checkout, else in this folder.

    Raises:
        StoreError: it is no path that the files of a database can have.
    """
    name = os.path.expanduser(os.environ.get("RHMC_HOME") or project() / "work")
    try:
        name.encode()
        return _followed(Path(name))
    except UnicodeEncodeError as error:
        raise StoreError(f"RHMC_HOME={name!a}: not in UTF-8; name another folder") from error
    except (OSError, RuntimeError) as error:  # links that lead to themselves
        raise StoreError(f"RHMC_HOME={name}: {reason(error)}; name another folder") from error


def _followed(path: Path) -> Path:
    """The path without links. Links that lead to themselves are an error before Python 3.13 alone."""
    found = path.resolve()
    try:
        found.stat()
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise
    return found


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
        """The folder where the checkpoints of a run (spec id and fingerprint) lie."""
        return self.root / "checkpoints" / key

    def scratch(self, study: str, profile: str) -> Path:
        """The folder that Ray writes to while a study runs; worth nothing afterwards."""
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
        """True if a process drives the study and profile in this folder."""
        with suppress(FileNotFoundError), self._lock_file(study, profile).open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # let go as the file is closed
            except BlockingIOError:
                return True
        return False

    def _lock_file(self, study: str, profile: str) -> Path:
        return self.root / "locks" / f"{study}-{profile}.lock"


class Checkpoints:
    """The newest checkpoints of one run, as files `<point>.pt`.

    Args:
        folder: theirs alone.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def save(self, point: int, state: "State") -> None:
        """Write a checkpoint whole or not at all, and drop those older than the last two."""
        save_atomically(self.folder / f"{point:08d}.pt", state)
        for old in self._files()[KEEP:]:
            old.unlink(missing_ok=True)

    def newest(self) -> "State | None":
        """The newest checkpoint that is whole, or None. Damaged ones are set aside; what a killed writer left goes.

        Raises:
            StoreError: one cannot be read, and nothing says that it is damaged. It stays where it is.
        """
        for part in self.folder.glob("*.part"):
            part.unlink(missing_ok=True)
        for file in self._files():
            try:
                return load_whole(file)
            except DamagedError:
                self._set_aside(file)
        return None

    def _set_aside(self, file: Path) -> None:
        """Keep the last damaged ones, under a name that no checkpoint has, until the run is finished."""
        try:
            file.replace(f"{file}{DAMAGED}")
            for old in sorted(self.folder.glob(f"*{DAMAGED}"), reverse=True)[KEEP:]:
                old.unlink(missing_ok=True)
        except OSError as error:
            raise StoreError(f"{file}: damaged, and cannot be renamed: {reason(error)}") from error

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
    import torch

    with whole(path, durable=True) as part, part.open("wb") as file:
        torch.save(state, file)


def load_whole(path: Path) -> Any:
    """The content that `save_atomically` wrote.

    `torch.load` alone does not see bytes that changed inside a tensor, such as a block that a power cut left as zeros;
    the checksums that `torch.save` writes beside each tensor do.

    Raises:
        DamagedError: cut short, a checksum that does not match, no archive at all.
        StoreError: it cannot be read now (memory, descriptors, rights, the disk), or not by this version.
        FileNotFoundError: there is none.
    """
    import torch

    try:
        with path.open("rb") as file:
            _check_sums(file)
            file.seek(0)
            return torch.load(file, weights_only=True, map_location="cpu")
    except DamagedError as error:
        raise DamagedError(f"{path}: damaged: {error}") from error
    except FileNotFoundError:
        raise
    except (OSError, MemoryError) as error:
        raise StoreError(f"{path}: cannot be read now: {reason(error)}; the file is left as it is") from error
    except Exception as error:  # its sums are right, so these are words of torch's about something else
        raise _not_loaded(path, error) from error


def _check_sums(file: BinaryIO) -> None:
    """Read an archive from end to end.

    Raises:
        DamagedError: it is none, or not the one that was written.
        OSError, MemoryError: it could not be read.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            damaged = archive.testzip()
    except Exception as error:  # zipfile meets what nobody wrote in many ways: bad offsets, flags, methods, names
        for inner in _chain(error):  # it calls a file that cannot be read no archive
            if isinstance(inner, MemoryError) or (isinstance(inner, OSError) and inner.errno not in (None, OUT_OF_IT)):
                raise inner from None
        raise DamagedError(one_line(error)) from error
    if damaged:
        raise DamagedError(f"{damaged} does not match its checksum")


def _not_loaded(path: Path, error: Exception) -> StoreError:
    text = one_line(error)
    if lacks_memory(error):
        return StoreError(f"{path}: cannot be read now: not enough memory; the file is left as it is")
    if isinstance(error, RuntimeError) and "PytorchStreamReader failed" in text:  # names and offsets have no checksum
        return DamagedError(f"{path}: damaged: {text}")
    return StoreError(f"{path}: whole, and not readable by this version ({text}); the file is left as it is")


def lacks_memory(error: BaseException) -> bool:
    """True if there was not enough memory, which torch says by a `RuntimeError`."""
    words = ("can't allocate memory", "not enough memory", "out of memory", "allocation failed")
    return isinstance(error, MemoryError) or any(word in str(error).lower() for word in words)


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


KEPT: dict[frozenset[str], "Callable[[], State]"] = {  # what learning keeps, by its keys, and the empty form of it
    frozenset(("rows", "next", "size")): lambda: {"rows": {}, "next": 0, "size": 0},
    frozenset(("rows",)): lambda: {"rows": []},
    frozenset(("rows", "count")): lambda: {"rows": {}, "count": _nothing()},
}


def _nothing() -> Any:
    import torch

    return torch.zeros(0, dtype=torch.int64)


def one_line(error: BaseException) -> str:
    """The first telling line of an error; of a traceback, which some libraries wrap as it is, the last."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    if not lines:
        return type(error).__name__
    return lines[-1] if lines[0].startswith("Traceback (") else lines[0]


def reason(error: BaseException) -> str:
    """The system's message, where a library wrapped it in words of its own."""
    for inner in _chain(error):
        if isinstance(inner, OSError) and inner.strerror:
            return inner.strerror
    return "not enough memory" if lacks_memory(error) else one_line(error)


def _chain(error: BaseException) -> Iterator[BaseException]:
    """An error and those that it came of."""
    inner: BaseException | None = error
    while inner is not None:
        yield inner
        inner = inner.__cause__ or inner.__context__
