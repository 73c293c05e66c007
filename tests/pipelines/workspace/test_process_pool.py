"""Several processes at once: the same results in the same order, errors as they are, and nothing left behind."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
import torch

from pipelines.workspace.errors import InputError
from pipelines.workspace.process_pool import side_by_side
from pipelines.workspace.work_folder import StoreError
from tests.depth import covering
from tests.pipelines.support import started_by
from tests.pipelines.workspace.pooled import faulty, first_after_last, killed, shared, sleepy, told

ROOT = Path(__file__).parents[3]
SPAWNED = "spawn_main"  # in the command line of a worker
LONG = 60.0  # seconds that no test waits
MARKED = """\
import sys
from functools import partial
from pipelines.cli import main
from pipelines.export import yardsticks
from tests.pipelines.workspace.pooled import marked
folder, real = sys.argv.pop(), yardsticks.side_by_side
yardsticks.side_by_side = lambda function, items, jobs: real(partial(marked, function, folder), items, jobs)
main.main()
"""  # the command `rhmc`, each of whose workers leaves a file in the folder of the last word when it begins to work


def workers() -> list[psutil.Process]:
    """Of this process; one that has just ended may take a moment to go."""
    return [p for p in psutil.Process().children(recursive=True) if SPAWNED in " ".join(p.cmdline())]


def test_results_come_in_the_order_of_the_items(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")  # what a process begins with, whatever the machine
    items = [(number, tmp_path / "last") for number in range(5)]
    numbers, who, threads = zip(*side_by_side(first_after_last, items, 2), strict=True)
    assert numbers == (0, 1, 2, 3, 4)
    assert set(threads) == {1}
    assert len(set(who)) == 2
    assert os.getpid() not in who
    assert workers() == []


def test_one_at_a_time_is_this_process_and_takes_an_item_when_its_turn_comes() -> None:
    items = iter(range(3))
    results = side_by_side(told, items, 1)
    assert next(results) == (0, os.getpid(), 1)
    assert next(items) == 1
    assert [number for number, *_ in results] == [2]


ERRORS = [InputError("one line"), StoreError("another"), ValueError("a", 1)]


@pytest.mark.parametrize(("jobs", "error"), covering([1, 2], ERRORS))
def test_an_error_reaches_the_caller_as_it_is_after_what_was_before_it(jobs: int, error: Exception) -> None:
    results = side_by_side(faulty, [1, error, 2], jobs)
    assert next(results) == 1
    with pytest.raises(type(error)) as caught:
        next(results)
    assert (type(caught.value), caught.value.args) == (type(error), error.args)
    assert workers() == []


def test_a_killed_process_is_one_line() -> None:
    with pytest.raises(StoreError, match=r"^a process that worked on this was killed, [^\n]*--jobs 1[^\n]*$"):
        list(side_by_side(killed, range(4), 2))
    assert workers() == []


def test_tensors_go_without_shared_memory() -> None:
    """And there may be more processes than items."""
    given = [torch.arange(3.0), torch.ones(2, 2)]
    for before, (was_shared, after) in zip(given, side_by_side(shared, given, 5), strict=True):
        assert not was_shared
        assert torch.equal(after, before + 1)


def test_who_stops_early_does_not_wait_for_the_rest() -> None:
    """Items larger than a pipe holds are on their way then."""
    begun = time.monotonic()
    results = side_by_side(sleepy, [(0.0, b""), *[(LONG, bytes(2**20))] * 8], 2)
    assert next(results) == 0
    del results
    assert time.monotonic() - begun < LONG / 2
    assert workers() == []


def test_a_caller_with_an_error_of_its_own_does_not_wait_either() -> None:
    begun = time.monotonic()
    with pytest.raises(ZeroDivisionError):
        [1 // size for size in side_by_side(sleepy, [(0.0, b""), (LONG, b""), (LONG, b"")], 2)]
    assert time.monotonic() - begun < LONG / 2
    assert workers() == []


@pytest.fixture
def _listening() -> Iterator[None]:
    """Programs that are started listen to Ctrl-C, also where the tests run in the background and do not themselves."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def starting(process: subprocess.Popen[bytes], marks: Path) -> bool:
    """True if the command's workers have begun: most of this processor time goes to imports."""
    return sum(one.cpu_times().user for one in started_by(process.pid, SPAWNED)) >= 1.0


def at_work(process: subprocess.Popen[bytes], marks: Path) -> bool:
    """True if both of the command's workers work on an item."""
    return len(list(marks.iterdir())) == 2


SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGKILL]


@pytest.mark.usefixtures("_listening")
@pytest.mark.parametrize(("how", "ready"), covering(SIGNALS, [starting, at_work]))
def test_nothing_is_left_of_a_command_that_is_stopped(
    how: signal.Signals, ready: Callable[[subprocess.Popen[bytes], Path], bool], tmp_path: Path
) -> None:
    """Ctrl-C reaches every process of a terminal, the other signals the one that was named."""
    out, marks = tmp_path / "out", tmp_path / "marks"
    marks.mkdir()
    words = ["yardsticks", "all", "--profile", "paper", "--jobs", "2", "--out", str(out), str(marks)]
    with (tmp_path / "said").open("w") as said:
        process = subprocess.Popen(
            [sys.executable, "-c", MARKED, *words], cwd=ROOT, stdout=said, stderr=said, start_new_session=True
        )
    try:
        while not ready(process, marks):
            assert process.poll() is None, (tmp_path / "said").read_text()
            time.sleep(0.05)
        if how == signal.SIGINT:
            os.killpg(process.pid, how)
        else:
            process.send_signal(how)
        assert process.wait(LONG) == (130 if how == signal.SIGINT else -how)
        end = time.monotonic() + LONG
        while (left := started_by(process.pid)) and time.monotonic() < end:
            time.sleep(0.02)
        assert left == []
    finally:
        for one in started_by(process.pid):
            one.kill()
    assert not out.exists()
    if how == signal.SIGINT:
        assert (tmp_path / "said").read_text().strip() == ""
