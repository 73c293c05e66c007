"""The files of a bundle, a folder or an archive, as a stranger may have made it.

No name, link, size or checksum is believed: a file has one of a few names, and is counted while it is read.
"""

import hashlib
import os
import re
import resource
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import IO, NamedTuple

from pipelines.specs.document import show
from pipelines.workspace.work_folder import StoreError, one_line

MANIFEST, RUNS, POINTS = "bundle.json", "runs.parquet", "points.parquet"
KEY = "[0-9a-f]{12}-[0-9a-f]{12}"  # spec id and fingerprint
NAME = re.compile(rf"{MANIFEST}|{RUNS}|{POINTS}|policies/{KEY}\.pt|checkpoints/{KEY}/[0-9]{{8}}\.pt")
FOLDER = re.compile(rf"policies/|checkpoints/({KEY}/)?")
NAMES = f"a bundle has {MANIFEST}, {RUNS}, {POINTS}, policies/KEY.pt and checkpoints/KEY/POINT.pt"
FILES = 20_000
UNPACKED = 2**35  # bytes of all files
MOST = {MANIFEST: 2**22, RUNS: 2**26, POINTS: 2**26}  # bytes of those that are read at once
ROOM = 2**32  # bytes of memory that a check may take
BLOCK = 2**20
STORED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
LOCAL = 30  # bytes before an entry's name in an archive
BROKEN = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, NotImplementedError, RuntimeError, ValueError)


class BundleError(Exception):
    """Something in a bundle is not as it should be; the text begins with the place."""


class Files(NamedTuple):
    """The files of a bundle."""

    sizes: Mapping[str, int]  # bytes by name, as the bundle tells
    reader: Callable[[str], IO[bytes]]

    def blocks(self, name: str) -> Iterator[bytes]:
        """The content of a file.

        Raises:
            BundleError: it cannot be read, or has another size than the bundle tells.
        """
        left = self.sizes[name]
        with _readable(name), self.reader(name) as file:
            while block := file.read(BLOCK):
                left -= len(block)
                if left < 0:
                    break
                yield block
        if left:
            raise BundleError(f"{name}: has not the {self.sizes[name]:,} bytes that the bundle tells of it")

    def read(self, name: str) -> bytes:
        """The content of a small file."""
        return b"".join(self.blocks(name))

    def copy(self, name: str, target: Path) -> str:
        """Write a file somewhere and return its SHA-256.

        Raises:
            StoreError: there is no room for it.
        """
        digest = hashlib.sha256()
        try:
            with target.open("wb") as out:
                for block in self.blocks(name):
                    digest.update(block)
                    out.write(block)
        except OSError as error:
            raise StoreError(f"{target}: cannot be written: {error.strerror or error}") from error
        return digest.hexdigest()


@contextmanager
def opened(bundle: Path) -> Iterator[Files]:
    """The files of a bundle. Nothing is unpacked.

    Raises:
        BundleError: it is neither a folder nor an archive with the files of a bundle.
    """
    with ExitStack() as held:
        with _readable(""):
            mode = bundle.stat().st_mode
            if stat.S_ISDIR(mode):
                files = Files(_of_folder(bundle), partial(_open, bundle))
            elif stat.S_ISREG(mode):
                archive = held.enter_context(zipfile.ZipFile(bundle))
                files = Files(_of_archive(archive, bundle.stat().st_size), archive.open)
            else:
                raise BundleError("neither a folder nor an archive")
        _check_sizes(files.sizes)
        yield files


@contextmanager
def _readable(name: str) -> Iterator[None]:
    """Turn what reading raises into one line."""
    place = f"{name}: " if name else ""
    try:
        yield
    except MemoryError as error:
        raise BundleError(f"{place}does not fit into {ROOM:,} bytes of memory") from error
    except OSError as error:
        raise BundleError(f"{place}cannot be read: {error.strerror or error}") from error
    except BROKEN as error:
        raise BundleError(
            f"{place}not a bundle of `rhmc study export`, or a damaged one ({one_line(error)})"
        ) from error


def _check_sizes(sizes: Mapping[str, int]) -> None:
    if len(sizes) > FILES:
        raise BundleError(f"{len(sizes):,} files; at most {FILES:,} are taken in")
    missing = [name for name in MOST if name not in sizes]
    if missing:
        raise BundleError(f"not a bundle of `rhmc study export`: no {missing[0]} in it")
    for name, most in MOST.items():
        if sizes[name] > most:
            raise BundleError(f"{name}: {sizes[name]:,} bytes; at most {most:,} are read")
    if (total := sum(sizes.values())) > UNPACKED:
        raise BundleError(f"{total:,} bytes unpacked; at most {UNPACKED:,} are taken in")


def _check_name(name: str) -> None:
    if not NAME.fullmatch(name):
        raise BundleError(f"{show(name)} is no file of a bundle; {NAMES}")


# Folders


def _of_folder(folder: Path, above: str = "") -> dict[str, int]:
    sizes: dict[str, int] = {}
    with os.scandir(folder) as entries:
        for entry in entries:
            name = f"{above}{entry.name}"
            if entry.is_symlink():
                raise BundleError(f"{show(name)}: a link; links are not followed")
            if entry.is_dir() and FOLDER.fullmatch(f"{name}/"):
                sizes |= _of_folder(folder / entry.name, f"{name}/")
                continue
            _check_name(name)
            if not entry.is_file():
                raise BundleError(f"{name}: not a file")
            sizes[name] = entry.stat(follow_symlinks=False).st_size
            if len(sizes) > FILES:
                break
    return sizes


def _open(folder: Path, name: str) -> IO[bytes]:
    """A file, should it still be one: neither a link nor a pipe that would never answer."""
    handle = os.open(folder / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise ValueError("not a file")
    return os.fdopen(handle, "rb")


# Archives


def _of_archive(archive: zipfile.ZipFile, size: int) -> dict[str, int]:
    infos = archive.infolist()
    files = [info for info in infos if not (FOLDER.fullmatch(info.orig_filename) and not info.file_size)]
    for info in files:
        _check_entry(info)
    names = [info.orig_filename for info in infos]
    if twice := next((name for name in names if names.count(name) > 1), "") if len(set(names)) < len(names) else "":
        raise BundleError(f"{twice}: twice in the archive; a file is in it once")
    free = 0
    for info in sorted(infos, key=lambda one: one.header_offset):
        if info.header_offset < free:
            raise BundleError(f"{info.orig_filename}: begins inside another file; each has bytes of its own")
        free = info.header_offset + LOCAL + len(info.orig_filename.encode()) + info.compress_size
    if free > size:
        raise BundleError("not a bundle of `rhmc study export`, or a damaged one (it is cut short)")
    return {info.orig_filename: info.file_size for info in files}


def _check_entry(info: zipfile.ZipInfo) -> None:
    name, mode = info.orig_filename, info.external_attr >> 16
    _check_name(name)
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG):
        raise BundleError(f"{name}: a link, or another thing that is not a file")
    if info.flag_bits & 1:
        raise BundleError(f"{name}: encrypted; a bundle has no password")
    if info.compress_type not in STORED:
        raise BundleError(f"{name}: compressed in way {info.compress_type}; files are stored or deflated")


@contextmanager
def limited(room: int = ROOM) -> Iterator[None]:
    """Let the process have only so much more memory meanwhile, where the system can say how much it has.

    A page of a table or a number in a checkpoint is a few bytes, whatever it asks for.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    with suppress(OSError, ValueError):  # no /proc: another system, which has no such limit
        taken = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
        wanted = taken + room
        resource.setrlimit(resource.RLIMIT_AS, (wanted if soft < 0 else min(soft, wanted), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
