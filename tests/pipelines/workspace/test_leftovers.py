"""Files of a killed process are swept by the next that does the same; files of a living one are left alone."""

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipelines.tracking.mlflow_tracker import create_database
from pipelines.tuning import trials
from pipelines.workspace import leftovers
from pipelines.workspace.leftovers import HOST, claim, dead, part_of, scratch, sweep_claimed, sweep_scratch
from pipelines.workspace.work_folder import Home, StoreError, whole

WAITS = "import sys; print('ready', flush=True); sys.stdin.read()"


@pytest.fixture
def living() -> Iterator[int]:
    """The number of a process that lives."""
    with subprocess.Popen([sys.executable, "-c", WAITS], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield process.pid
        process.kill()


@pytest.fixture(scope="module")
def gone() -> int:
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder as the system's temporary one, not swept yet."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    sweep_scratch.cache_clear()
    yield tmp_path
    sweep_scratch.cache_clear()


def test_a_writer_is_dead_if_its_machine_is_this_one_and_its_process_gone(living: int, gone: int) -> None:
    assert dead(f"{HOST}-{gone}")
    assert dead(f"{HOST}-{os.getpid()}")  # a former process had this number
    assert not dead(f"{HOST}-{living}")
    assert not dead(f"{HOST}-1")  # somebody else's
    assert not dead(f"0{HOST[1:]}f-{gone}")
    assert not any(map(dead, ("", "17", "-", f"{HOST}-", f"{HOST}-x", f"{HOST}-\u0662", "a.b")))


def test_who_writes_a_file_again_removes_the_parts_of_the_dead(tmp_path: Path, living: int, gone: int) -> None:
    left = [f"a.txt.{HOST}-{gone}.part-journal"]
    stays = [f"a.txt.{HOST}-{living}.part", f"b.txt.{HOST}-{gone}.part", "a.txt.part", "a.txt.backup", "a.txt.17.part"]
    stays += [f"a.txt.{HOST}-{gone}.part2"]
    for name in left + stays:
        (tmp_path / name).write_bytes(b"half")
    folder = tmp_path / f"a.txt.{HOST}-{gone}.part"  # a part may be a folder
    folder.mkdir()
    (folder / "inside").write_bytes(b"half")
    with whole(tmp_path / "a.txt") as part:
        part.write_bytes(b"all")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["a.txt", *stays])


def test_a_probe_of_a_dead_process_goes(tmp_path: Path, living: int, gone: int) -> None:
    for number in (living, gone):
        (tmp_path / f".probe.{HOST}-{number}.part").write_bytes(b"x")
    Home(tmp_path).prepare()
    assert [path.name for path in tmp_path.iterdir()] == [f".probe.{HOST}-{living}.part"]


def test_scratch_of_the_dead_is_swept_once(temporary: Path, living: int, gone: int) -> None:
    names = [f"rhmc-{HOST}-{number}-abc_{i}" for i, number in enumerate((living, gone, gone))]
    for name in (*names, "rhmc-other", "tmpabc"):
        (temporary / name).mkdir()
        (temporary / name / "unpacked").write_bytes(b"big")
    target = temporary / "target"
    target.mkdir()
    (temporary / f"rhmc-{HOST}-{gone}-link").symlink_to(target)  # somebody's trap
    with scratch() as folder:
        assert folder.stat().st_mode & 0o77 == 0
        assert Path(tempfile.gettempdir()) == folder  # also of libraries
    assert not folder.exists()
    assert {path.name for path in temporary.iterdir()} == {
        names[0], "rhmc-other", "tmpabc", "target", f"rhmc-{HOST}-{gone}-link"
    }  # fmt: skip


def test_a_process_killed_in_its_scratch_leaves_it_to_the_next(temporary: Path) -> None:
    code = "from pipelines.workspace.leftovers import scratch\n"
    code += "with scratch() as f:\n (f / 'x').touch()\n print(f, flush=True); input()"
    environment = os.environ | {"TMPDIR": str(temporary)}
    command, pipes = [sys.executable, "-c", code], {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, env=environment, encoding="utf-8", **pipes) as process:  # type: ignore[call-overload]
        left = Path(process.stdout.readline().strip())
        with scratch():
            assert (left / "x").exists()  # it lives
        process.send_signal(signal.SIGKILL)
    sweep_scratch.cache_clear()
    with scratch():
        assert not left.exists()


def test_claimed_folders(tmp_path: Path, living: int, gone: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in (living, gone):
        (tmp_path / f"ray-{number}").mkdir()
        monkeypatch.setattr(leftovers, "owner", lambda number=number: f"{HOST}-{number}")
        claim(tmp_path / f"ray-{number}")
    (tmp_path / "ray-other").mkdir()
    sweep_claimed(tmp_path, "ray-*")
    assert {path.name for path in tmp_path.iterdir()} == {f"ray-{living}", "ray-other"}


def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    refused = pytest.raises(StoreError, match="pipe: cannot be written: a device, a named pipe or a socket is there")
    with refused, whole(tmp_path / "pipe"):
        pass
    for create in (create_database, trials._create):
        with pytest.raises(OSError, match="a named pipe"):
            create(tmp_path / "pipe")
    assert (tmp_path / "pipe").is_fifo()


def test_no_part_where_there_is_no_folder(tmp_path: Path) -> None:
    assert part_of(tmp_path / "a" / "b").name.startswith("b.")
