"""Output that is only looked at never ends a launch, and shows names as they were typed."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from matplotlib.legend import Legend
from rich.console import Console

from pipelines.cli import common
from pipelines.execution import trainable
from pipelines.execution.progress import LiveBoard, PlainBoard, SafeBoard, print_table
from pipelines.execution.recorder import Recorder
from pipelines.tracking import mlflow_tracker, overview
from pipelines.tracking.overview import Run, so_far, table
from pipelines.tracking.plan import study_card
from pipelines.tracking.tracker import StudyCard
from pipelines.tuning import search_run
from pipelines.workspace.best_effort import WHY_NOT, decoration
from pipelines.workspace.terminal import terminal
from pipelines.workspace.work_folder import Home, StoreError
from reports.data import escaping
from tests.memory_tracker import MemoryRun, MemoryTracker
from tests.pipelines.support import plan, setting, tiny
from tests.reports.hostile import NAMES, QUESTION, csv_words, markdown_words

POINTS = [{"step": float(step), "eval/return": step / 100} for step in (0, 200, 400)]


def fails(*_: Any, **__: Any) -> Any:
    raise ValueError("no ink\nat all")


def refuses(*_: Any, **__: Any) -> Any:
    raise StoreError("the server says no")


@pytest.fixture
def said() -> io.StringIO:
    return io.StringIO()


def launch(said: io.StringIO, folder: Path, tracker: Any = None, files: tuple[str, ...] = ()) -> Recorder:
    """All trainings of the tiny study, from start to end. files: what a training leaves beside its policy."""
    card = study_card(tiny())
    board = PlainBoard(Console(file=said, width=200))
    recorder = Recorder(card, plan(), tracker or MemoryTracker(card, []), Home(folder), board)
    for item in recorder.todo():
        recorder.start(item.key)
        place = recorder.home.checkpoints(item.key)
        place.mkdir(parents=True)
        for name in ("policy.pt", *files):
            (place / name).write_text("OSError: no room")
        last = [*POINTS[1:], {"step": 600.0, "final/return": 5.0}]
        recorder.result(item.key, {"done": False, "stopped": False, "points": POINTS[:1]})
        recorder.result(item.key, {"done": True, "stopped": False, "points": last})
    recorder.overview.publish()
    return recorder


def test_a_description_that_is_refused_is_said_once(said: io.StringIO, tmp_path: Path) -> None:
    tracker = MemoryTracker(study_card(tiny()), [])
    tracker.publish = refuses  # type: ignore[method-assign]
    recorder = launch(said, tmp_path, tracker)
    assert recorder.status == "finished"
    assert [line for line in said.getvalue().splitlines() if "left out" in line] == [
        "tiny: description in the log: left out (StoreError: the server says no)",
        "tiny: overview in the log: left out (StoreError: the server says no)",
    ]


@pytest.mark.parametrize(("module", "name"), [(overview, "figure"), (overview.arm_colours, "colour")])
def test_a_figure_that_fails_leaves_the_rest(
    module: Any, name: str, said: io.StringIO, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, name, fails)
    tracker = MemoryTracker(study_card(tiny()), [])
    assert launch(said, tmp_path, tracker).status == "finished"
    assert "2 of 2 runs are finished" in tracker.note
    assert set(tracker.files) == {overview.TABLE}
    assert said.getvalue().count("figure in the log: left out (ValueError: no ink)") == 1


def test_an_animation_that_was_not_drawn_is_said(said: io.StringIO, tmp_path: Path) -> None:
    shelf: list[MemoryRun] = []
    launch(said, tmp_path, MemoryTracker(study_card(tiny()), shelf), files=(WHY_NOT,))
    assert "tiny / slow s0: no animation (OSError: no room)" in said.getvalue()
    assert [run.status for run in shelf] == ["finished", "finished"]


def test_an_animation_that_cannot_be_kept(said: io.StringIO, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = MemoryRun.artifact
    refused = lambda run, path: kept(run, path) if path.name == "policy.pt" else refuses()  # noqa: E731
    monkeypatch.setattr(MemoryRun, "artifact", refused)
    shelf: list[MemoryRun] = []
    launch(said, tmp_path, MemoryTracker(study_card(tiny()), shelf), files=("episode.gif",))
    assert said.getvalue().count("its animation: left out (StoreError: the server says no)") == 2
    assert [(run.status, set(run.files) >= {"policy.pt"}, len(run.models)) for run in shelf] == [
        ("finished", True, 1)
    ] * 2


def test_a_policy_that_cannot_be_kept_is_an_error(
    said: io.StringIO, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MemoryRun, "artifact", refuses)
    with pytest.raises(StoreError, match="says no"):
        launch(said, tmp_path)


def test_a_training_finishes_without_its_animation_and_without_a_note(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pipelines.policies.render

    class Folder:
        folder = tmp_path / "gone"

    monkeypatch.setattr(pipelines.policies.render, "episode_gif", fails)
    bare = object.__new__(trainable.RunTrainable)
    bare.job, bare.checkpoints = {"spec": "{"}, Folder()  # type: ignore[assignment, typeddict-item]
    bare._animate({"algorithm": {}})
    Folder.folder.mkdir()
    bare._animate({"algorithm": {}})
    assert (Folder.folder / WHY_NOT).read_text().startswith("ValidationError: ")


@pytest.mark.parametrize("name", ["start", "points", "end", "say", "__enter__", "__exit__"])
def test_a_board_that_fails_is_said_once(
    name: str, said: io.StringIO, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(PlainBoard, name, fails)
    with SafeBoard(lambda: PlainBoard(Console(file=said))) as board:
        for run in ("a", "b"):
            board.start(run, 100)
            board.points(run, POINTS)
            board.say("words")
            board.end(run, "finished")
    assert capsys.readouterr().err == "rhmc: progress: left out (ValueError: no ink)\n"
    assert ("words" in said.getvalue()) == (name != "say")


def test_a_board_that_cannot_be_made(capsys: pytest.CaptureFixture[str]) -> None:
    with SafeBoard(fails) as board:
        board.say("words")
    assert capsys.readouterr().err == "rhmc: progress: left out (ValueError: no ink)\n"


def test_a_colour_and_a_view_that_fail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(mlflow_tracker.arm_colours, "legend", fails)
    monkeypatch.setattr(mlflow_tracker.saved_views, "views", fails)
    home = Home(tmp_path)
    home.prepare()
    tracker = mlflow_tracker.MlflowTracker(study_card(tiny()), home)
    run = tracker.start(plan()[0].card)
    run.log(POINTS)
    run.finish("finished")
    tracker.close("finished")
    assert [one.status for one in tracker.recorded()] == ["finished"]
    assert capsys.readouterr().err.splitlines() == [
        "rhmc: tiny: description in the log: left out (ValueError: no ink)",  # which has links to the views
        "rhmc: tiny: saved views in the log: left out (ValueError: no ink)",
    ]


def test_a_plot_of_a_search_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pipelines.tuning.search_plots

    class Some:
        arm, study = "IQL", None

        def best(self) -> None: ...

    class Search:
        name, profile = "s", "quick"

    class Card:
        note = "note"

    monkeypatch.setattr(pipelines.tuning.search_plots, "plots", fails)
    monkeypatch.setattr(search_run, "search_card", lambda _: Card)
    told: list[str] = []
    card = StudyCard("s", "quick", "", {}, [])
    given: Any = (Search, [Some()], MemoryTracker(card, []), Home(tmp_path), None, told.append)
    assert search_run.results(*given) == ([], [])
    assert told == ["IQL: plots: left out (ValueError: no ink)"]


def test_what_cannot_be_said_is_left_out_as_well() -> None:
    with decoration("x", fails):
        fails()
    with pytest.raises(KeyboardInterrupt), decoration("x", fails):
        raise KeyboardInterrupt


# Names


@pytest.fixture
def hostile() -> StudyCard:
    arms = {name: setting(lr=10.0 ** -(2 + place)) for place, name in enumerate(NAMES)}
    return study_card(tiny(arms=arms).model_copy(update={"question": QUESTION}))


def test_a_description_shows_names_as_typed(hostile: StudyCard) -> None:
    words = markdown_words(hostile.note)
    assert words.startswith(QUESTION)
    assert [name for name in NAMES if not any(line.startswith(f"{name}: ") for line in words.split("\n"))] == []
    assert "(tag" not in words


def runs() -> list[Run]:
    return [
        Run(name, 0, "finished", [(0, 1.0), (100, 2.0 + place)], {"final/return": 2.0 + place})
        for place, name in enumerate(NAMES)
    ]


def test_what_is_known_so_far_shows_names_as_typed() -> None:
    words = markdown_words(so_far(runs()))
    assert [name for name in NAMES if name not in words.split("\n")] == []
    assert f"that of {NAMES[-1]}." in words
    assert "(tag" not in words


def test_the_table_in_the_log_has_no_formulas(tmp_path: Path) -> None:
    (tmp_path / "finals.csv").write_text(table(runs()), encoding="utf-8")
    _, *rows = csv_words(tmp_path / "finals.csv")
    assert [escaping.typed(row[0]) for row in rows] == list(NAMES)
    assert [row[0] for row in rows if row[0][0] in "=+-@"] == []


def test_the_figure_in_the_log_names_every_arm(hostile: StudyCard, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    monkeypatch.setattr(overview, "_drawn", lambda *given, draw=overview._drawn: drawn.append(draw(*given)) or drawn[0])
    assert overview.figure(hostile, runs()).startswith(b"\x89PNG")
    (legend,) = drawn[0].findobj(Legend)
    shown = ["".join(text.get_text().split()) for text in legend.get_texts()]
    wanted = ["".join(f"{name} (1)".split()) for name in NAMES[: overview.MOST]]
    wanted[9:12] = ["[U+57FAU+7EBF](1)", "[U+6D88U+878D](1)", "[U+1F41E]emoji(1)"]
    assert shown == wanted


def shown_by(write: Callable[[Console], None], *, live: bool = False) -> str:
    console = terminal(4000)
    console.file = io.StringIO()
    console._force_terminal = live
    write(console)
    return console.file.getvalue()


def test_a_terminal_shows_names_as_typed() -> None:
    text = shown_by(lambda console: print_table(console, ["arm", "[b]n"], [[name, "1"] for name in NAMES]))
    assert [name for name in NAMES if not any(line.startswith(f"{name} ") for line in text.splitlines())] == []
    assert "[b]n" in text
    for name in NAMES:
        assert shown_by(lambda console, name=name: PlainBoard(console).say(name)) == f"{name}\n"
        assert shown_by(lambda console, name=name: console.print(name)) == f"{name}\n"


def test_a_live_line_shows_names_as_typed() -> None:
    def write(console: Console) -> None:
        board = LiveBoard(console)
        for name in NAMES:
            board.start(name, 100)
        console.print(board.progress.get_renderable())

    text = shown_by(write)
    assert [name for name in NAMES if name not in text] == []


def test_a_table_of_a_verb_shows_names_as_typed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(common, "WIDTH", 600)
    common.table(["arm", "[x]"], [[name, ":bug:"] for name in NAMES])
    text = capsys.readouterr().out
    assert [name for name in NAMES if name not in text] == []
    assert "[x]" in text
