"""How far a whole launch is, in a line: the count, the estimate, and when it is shown."""

import io
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from rich.console import Console

from pipelines.execution import progress, tally
from pipelines.execution.joint_recorder import Recorders
from pipelines.execution.progress import LiveBoard, PlainBoard, SafeBoard, for_all
from pipelines.execution.recorder import Recorder
from pipelines.execution.tally import Tally, Training
from pipelines.tracking.plan import study_card
from pipelines.workspace.work_folder import Home
from tests.memory_tracker import MemoryTracker
from tests.pipelines.support import plan, setting, tiny

FAST, SLOW = Training("fast", 1000), Training("slow", 1000)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Sets the time."""
    now = [0.0]
    for module in (progress, tally):
        monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return lambda seconds: now.__setitem__(0, seconds)


def test_the_time_left_is_by_the_pace_of_each_kind(clock: Callable[[float], None]) -> None:
    queue = Tally(6, 1, [FAST, SLOW, FAST, SLOW, SLOW], 2)
    assert (str(queue), queue.left()) == ("1 of 6 runs finished", None)
    queue.start("a", FAST)
    queue.start("b", SLOW)
    clock(10)
    queue.point("a", 1000)
    queue.end("a", "finished")  # 100 steps/s
    clock(20)
    queue.point("b", 200)  # 10 steps/s
    assert str(queue) == "2 of 6 runs finished, 1 running"
    assert queue.left() == pytest.approx((80 + 10 + 200) / 2)
    clock(60)
    assert queue.left() == pytest.approx((40 + 10 + 200) / 2)  # 40 s later, though no point has come
    assert for_all(queue) == "2 of 6 runs finished, 1 running, about 2:05 left for all"


def test_the_longest_run_is_waited_for(clock: Callable[[float], None]) -> None:
    queue = Tally(1, 0, [SLOW], 8)
    queue.start("a", SLOW)
    clock(10)
    queue.point("a", 100)
    assert queue.left() == pytest.approx(90)


def test_a_kind_that_was_not_seen_counts_with_the_pace_of_all(clock: Callable[[float], None]) -> None:
    queue = Tally(2, 0, [FAST, SLOW], 1)
    queue.start("a", FAST)
    clock(10)
    queue.point("a", 1000)
    queue.end("a", "finished")
    assert queue.left() == pytest.approx(10)


def test_what_was_trained_in_an_earlier_launch_gives_no_pace(clock: Callable[[float], None]) -> None:
    queue = Tally(1, 0, [SLOW], 1)
    queue.start("a", SLOW, reached=800)
    clock(10)
    queue.point("a", 900)
    assert queue.left() == pytest.approx(10)


def test_a_run_that_is_taken_up_again_waits_once(clock: Callable[[float], None]) -> None:
    queue = Tally(1, 0, [SLOW], 1)
    queue.start("a", SLOW)
    clock(10)
    queue.point("a", 500)
    queue.end("a", "waiting")
    assert (queue.waiting[SLOW], queue.left()) == (1, pytest.approx(20))
    queue.start("a", SLOW, reached=500)
    assert (queue.waiting[SLOW], queue.left()) == (0, pytest.approx(10))
    queue.end("a", "failed")
    assert (str(queue), queue.left()) == ("0 of 1 runs finished, 1 failed", 0)


def test_a_copy_is_finished_without_work() -> None:
    queue = Tally(2, 0, [FAST], 1)
    queue.end("copy", "finished")
    assert (queue.finished, queue.waiting[FAST]) == (1, 1)


def test_lines_in_a_log_come_less_and_less_often(clock: Callable[[float], None]) -> None:
    out = io.StringIO()
    board = PlainBoard(Console(file=out, width=40))
    board.expect(Tally(2, 1, [Training("", 100_000)], 1))
    board.start("a", 100_000)
    for second in range(1, 10_001):
        clock(float(second))
        board.points("a", [{"step": 10.0 * second, "eval/return": 1.0, "time/steps_per_second": 10.0}])
    board.end("a", "finished", "finished")
    lines = out.getvalue().splitlines()
    assert lines[:2] == ["1 of 2 runs finished", "a: started"]
    assert lines[2] == "a: 100 of 100,000 steps, 10 steps/s, return 1.00, 2:46:30 left"
    assert lines[3] == "1 of 2 runs finished, 1 running, about 2:46:30 left for all"
    times = [int(line.split()[1].replace(",", "")) // 10 for line in lines if line.startswith("a: ") and " of " in line]
    gaps = [after - before for before, after in pairwise(times)]
    assert gaps == sorted(gaps)
    assert (gaps[0], gaps[-1], len(times)) == (10, 600, pytest.approx(50, abs=10))


def test_a_terminal_has_a_line_for_all(clock: Callable[[float], None]) -> None:
    out = io.StringIO()
    with LiveBoard(Console(file=out, force_terminal=True, width=160)) as board:
        board.expect(Tally(175, 20, [Training("", 1000)] * 155, 2, "trials"))
        board.start("a", 1000)
        board.start("b", 1000)
        clock(10)
        board.points("a", [{"step": 1000.0, "eval/return": 2.0}])
        board.end("a", "finished", "finished")
        board.progress.refresh()
        shown = out.getvalue().splitlines()[-2:]
    for part in ("21 of 175 trials", "1 running", "about 12:45 left for all"):
        assert part in "".join(shown)


def test_a_tally_that_fails_ends_no_launch(capsys: pytest.CaptureFixture[str]) -> None:
    with SafeBoard(lambda: PlainBoard(Console(file=io.StringIO()))) as board:
        board.expect(None)  # type: ignore[arg-type]
        board.say("goes on")
    assert capsys.readouterr().err.startswith("rhmc: progress: left out (")


def test_studies_that_are_launched_together_have_one_tally(tmp_path: Path) -> None:
    out, shelf = io.StringIO(), []
    board = PlainBoard(Console(file=out, width=200))
    studies = [tiny("first"), tiny("second", arms={"as slow": setting(lr=1e-4), "faster": setting(lr=1e-1)})]
    cards = [study_card(study) for study in studies]
    together = Recorders(
        [
            Recorder(card, plan(study), MemoryTracker(card, shelf), Home(tmp_path), board)
            for card, study in zip(cards, studies, strict=True)
        ]
    )
    board.expect(together.tally(2))
    slow, fast, faster = (item.key for item in together.todo())
    folder = Home(tmp_path).checkpoints(slow)
    folder.mkdir(parents=True)
    (folder / "policy.pt").write_bytes(b"weights")
    together.start(slow)
    together.result(slow, {"done": True, "stopped": False, "points": [{"step": 600.0, "eval/return": 1.0}]})
    assert board.tally is not None
    assert str(board.tally) == "2 of 4 runs finished"  # the second study's copy is one of them
    assert sum(board.tally.waiting.values()) == 2
    together.start(fast)
    together.result(fast, {"done": True, "stopped": False, "points": [], "error": "boom", "trace": "Traceback"})
    assert str(board.tally) == "2 of 4 runs finished, 1 failed"
    assert str(together.tally(2)) == "2 of 4 runs finished, 1 failed"
    together.start(faster)
    together.result(faster, {"done": True, "stopped": True, "points": []})
    assert str(board.tally) == "2 of 4 runs finished, 1 failed"
    assert sum(board.tally.waiting.values()) == 1
