"""A report may be given anything, and its figures may fail: one line each, and no half report."""

import json
import os
import re
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from reports.data import paper
from reports.data.frame import TableError, load
from reports.pages import build as report
from reports.pages import gallery, sheets
from reports.pages.build import build, write_report
from reports.render import diagrams, figures, tables
from tests.reports.factory import drawings, episode, methods, noisy, reporting, study, write, yardsticks
from tests.reports.hostile import Page

pytestmark = pytest.mark.usefixtures("quick_resampling")
POINTS, RUNS, MADE = "reach.parquet", "reach.runs.parquet", "reach.made.parquet"
Plant = Callable[[Path], Any]


def fresh(folder: Path) -> Path:
    return write(folder, study("reach", {"one": noisy(60), "two": noisy(61)}, points=3))


def edit(name: str, column: str, change: Callable[[pd.DataFrame], Any]) -> Plant:
    def plant(folder: Path) -> None:
        table = pd.read_parquet(folder / name)
        table[column] = change(table)
        table.to_parquet(folder / name, index=False)

    return plant


def instead(make: Callable[[Path], Any], name: str = POINTS) -> Plant:
    def plant(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        make(folder / name)

    return plant


def config(text: str) -> Plant:
    return edit(RUNS, "config", lambda _: text)


def method(**task: Any) -> str:
    names = ("kind", "name", "source", "family", "training", "execution", "critic", "coordination")
    sizes = [{"task": task, "encoder": "mlp", "acting": 1, "all": 2}]
    return json.dumps([dict.fromkeys(names, "x") | {"actions": [], "parameters": sizes}])


REFUSED: dict[str, tuple[Plant, str]] = {
    "words": (edit(POINTS, "seed", lambda t: t["seed"].astype(str)), "column 'seed' holds words, not numbers"),
    "an empty seed": (
        edit(POINTS, "seed", lambda t: t["seed"].where(t.index > 0)),
        "column 'seed' has 1 empty cell of",
    ),
    "half a seed": (
        edit(POINTS, "seed", lambda t: t["seed"] + 0.5),
        "column 'seed' holds what is no whole number of 64",
    ),
    "a numbered arm": (edit(POINTS, "arm", lambda _: 1), "column 'arm' holds int64, not words"),
    "no arm": (edit(RUNS, "arm", lambda t: t["arm"].where(t.index > 0)), "column 'arm' has 1 empty cell of 6"),
    "a dictionary of numbers": (
        edit(POINTS, "arm", lambda t: pd.Categorical(t["seed"])),
        "'arm' holds int64, not words",
    ),
    "lists": (
        edit(POINTS, "value", lambda t: [[1.0]] * len(t)),
        "column 'value' holds list<element: double>, not number",
    ),
    "truth": (edit(POINTS, "value", lambda _: True), "column 'value' holds bool, not numbers"),
    "an empty return": (
        edit(POINTS, "value", lambda t: t["value"].where(t["metric"] != "final/return")),
        "step 150000: final/return is nan",
    ),
    "steps below zero": (
        edit(POINTS, "step", lambda t: t["step"] - 10**6),
        "column 'step' goes down to -1000000; 0 is",
    ),
    "no end of steps": (
        edit(POINTS, "step", lambda _: np.inf),
        "column 'step' holds what is no whole number of 64 bits",
    ),
    "steps of 2^63": (edit(POINTS, "step", lambda t: t["step"].astype("uint64") + np.uint64(2**63)), "of 64 bits"),
    "bytes": (edit(POINTS, "run", lambda t: t["run"].map(str.encode)), "column 'run' holds binary, not words"),
    "another study": (
        edit(RUNS, "study", lambda _: "../../x"),
        "says '../../x'; a table of that name is of study 'reach'",
    ),
    "a numbered code": (edit(RUNS, "fingerprint", lambda _: 7), "column 'fingerprint' holds int64, not words"),
    "worded seconds": (edit(MADE, "seconds", lambda _: "x"), "column 'seconds' holds words, not numbers"),
    "no status": (edit(RUNS, "status", lambda _: None), "column 'status'"),
    "no configuration": (edit(RUNS, "config", lambda _: None), "column 'config'"),
    "a list for a task": (config('{"env": [], "trainer": "x"}'), "column 'config' holds env: Input should be"),
    "worded steps": (config('{"trainer": {"steps": "x"}}'), "column 'config' holds trainer.steps: Input should be"),
    "worded agents": (
        config('{"env": {"kind": "x", "agents": "many"}}'),
        "column 'config' holds env.agents: Input should",
    ),
    "a deep configuration": (config("[" * 100_000), "column 'config' is no JSON object"),
    "a column twice": (
        instead(lambda p: pq.write_table(pa.table([pa.array(["x"])] * 2, names=["arm", "arm"]), p)),
        "column 'arm' stands there 2 times",
    ),
    "text": (instead(lambda p: p.write_text("hello")), "reach.parquet: not a readable Parquet table (5 bytes)"),
    "nothing": (instead(lambda p: p.write_bytes(b"")), "reach.parquet: not a readable Parquet table (0 bytes)"),
    "a folder": (instead(Path.mkdir), "reach.parquet: not a readable Parquet table (not a file)"),
    "a pipe": (instead(os.mkfifo), "reach.parquet: not a readable Parquet table (not a file)"),
    "a link to nowhere": (instead(lambda p: p.symlink_to("nowhere")), "not a readable Parquet table (not there)"),
    "a device": (instead(lambda p: p.symlink_to("/dev/null")), "not a readable Parquet table (not a file)"),
    "a pipe of methods": (
        instead(os.mkfifo, "methods.json"),
        "methods.json: not the methods as `rhmc methods --out` wri",
    ),
    "deep methods": (instead(lambda p: p.write_text("[" * 100_000), "methods.json"), "(nested too deeply)"),
    "endless methods": (
        instead(lambda p: p.write_text(method(kind="x").replace('"acting": 1', '"acting": Infinity')), "methods.json"),
        "0.parameters.0.acting: Input should be a finite number",
    ),
    "methods of no task": (
        instead(lambda p: p.write_text(method()), "methods.json"),
        "parameters.0.task.kind: Field req",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_table_of_another_form_is_a_line_and_the_old_report_stays(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant, line = REFUSED[name]
    plant(fresh(tmp_path / "runs"))
    old = tmp_path / "out" / "index.html"
    old.parent.mkdir()
    old.write_text("old")
    assert write_report(tmp_path / "runs", old.parent) == "refused"
    said = capsys.readouterr()
    assert line in said.err
    assert len(said.err.splitlines()) <= 6  # a line a fault, and of each kind the first five
    assert "Traceback" not in said.err
    assert list(old.parent.iterdir()) == [old]


@pytest.mark.parametrize(
    "plant",
    [
        edit(POINTS, "arm", lambda t: t["arm"].astype("category")),
        edit(POINTS, "seed", lambda t: t["seed"].astype("int8")),
        edit(POINTS, "seed", lambda t: t["seed"].astype(float)),
        edit(POINTS, "value", lambda t: t["value"].astype("float32").astype(float)),
        edit(RUNS, "more", lambda t: [[1]] * len(t)),
        edit(RUNS, "question", lambda _: None),
        edit(MADE, "seconds", lambda _: None),
    ],
    ids=["a dictionary of words", "small", "whole floats", "floats", "more columns", "no question", "no seconds"],
)
def test_the_same_in_another_form_is_the_same(plant: Plant, tmp_path: Path) -> None:
    before = load(fresh(tmp_path), "quick")
    plant(tmp_path)
    after = load(tmp_path, "quick")
    assert after.finals("reach", "one").tolist() == pytest.approx(before.finals("reach", "one").tolist())
    assert after.points.dtypes.tolist() == before.points.dtypes.tolist()
    assert build(tmp_path, tmp_path / "out", "quick", "reach").undrawn == []


# The paper's statements

STATED = paper.FILE.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("final: 70.5}", "final: many}", "table_2.rows.0.final: Input should be a valid number, not 'many'"),
        ("final: 70.5}", "final: .nan}", "table_2.rows.0.final: Input should be a finite number, not nan"),
        ("final: 70.5}", "finl: 70.5}", "table_2.rows.0.final: Field required"),
        ("place: Table 2\n  rows", "palce: Table 2\n  rows", "table_2.palce: Extra inputs are not permitted"),
        ("steps: {ablation: 5000000", "steps: {ablation: '5 M'", "steps.ablation: Input should be a valid integer"),
        ("numbers: {level: 70.5}", "numbers: {levl: 70.5}", "claims.C3b.numbers.level: missing; there are levl"),
        ("  C13:", "  C14:", "claims.C13: missing; there is a rule for it"),
        ("  C13:", "  C14:", "claims.C14: no rule in rules.py; there are rules for C1, C2a"),
        ("value: always optimal", "value: {a: 1}", "claims.C13.value: Input should be a valid string"),
        ("  coverage: [RHMC", "  covrage: [RHMC", "arms.coverage: missing; the arms that the paper shows"),
        ("claims:\n", "claims: [\n", "no YAML ("),
        ("claims:\n", "table_2:\n", "no YAML ("),
        ("  C1:\n", "  C1:\n    when: 2026-99-99\n", "paper.yaml: "),
    ],
)
def test_a_malformed_paper_is_a_line(
    old: str, new: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert old in STATED
    monkeypatch.setattr(paper, "FILE", tmp_path / "paper.yaml")
    paper.FILE.write_text(STATED.replace(old, new, 1), encoding="utf-8")
    assert write_report(fresh(tmp_path / "runs"), tmp_path / "out") == "refused"
    said = capsys.readouterr().err.splitlines()
    assert any(line in one for one in said)
    assert all(one.startswith("paper.yaml: ") for one in said)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "make", [Path.mkdir, os.mkfifo, lambda p: p.write_bytes(b"\xff"), lambda p: p.write_text("[" * 9999)]
)
def test_a_paper_that_is_no_text(make: Plant, tmp_path: Path) -> None:
    make(tmp_path / "paper.yaml")
    with pytest.raises(paper.PaperError, match=r"^paper\.yaml: (cannot be read|no text|no YAML).*$"):
        paper.read(tmp_path / "paper.yaml")


# Figures


def fails(*_: Any, **__: Any) -> Any:
    raise ValueError("no\nink")


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    """Tables of a report with every kind of figure."""
    folder = drawings(episode(methods(tmp_path / "runs")))
    arms = {f"arm {n}": noisy(60 + n) for n in range(7)}
    return write(folder, study("reach", arms, points=3), yardsticks())


BROKEN: tuple[tuple[Any, str, tuple[str, ...]], ...] = (
    (diagrams, "architecture", ("fig_1",)),
    (diagrams, "level", ("fig_2", "fig_3")),
    (gallery, "_regulation", ("fig_4",)),
    (gallery.scenes, "navigation", ("fig_5",)),
    (gallery.scenes, "coverage", ("fig_8",)),
    (gallery.scenes, "counterexamples", ("counterexamples",)),
    (figures, "learning_curves", ("curves_reach",)),
    (gallery.beyond, "fig_assignments", ("assignments_reach",)),
    (gallery.comparison, "profile", ("profile_reach",)),
    (gallery.comparison, "matrix", ("better_reach",)),
    (gallery.beyond, "fig_transfer", ("transfer",)),
)


def test_figures_that_cannot_be_drawn_keep_their_places(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name, _ in BROKEN:
        monkeypatch.setattr(module, name, fails)
    places = [place for _, _, some in BROKEN for place in some]
    out = whole.parent / "out"
    built = build(whole, out, "quick")
    assert built.undrawn == [f"{place}: could not be drawn (ValueError: no ink)" for place in places]
    page = Page((out / "index.html").read_text(encoding="utf-8"))
    assert set(places) <= set(page.values("id"))
    assert page.words.count("Could not be drawn: ValueError: no ink") == len(places)
    assert (out / "index.md").read_text(encoding="utf-8").count("Could not be drawn: ValueError: no ink") == len(places)
    assert {"final_reach.csv", "table_1.csv", "runs.csv"} <= {path.name for path in (out / "tables").iterdir()}
    assert [path.name for path in (out / "figures").glob("*.png")] == ["curves_reach_arms.png"]  # the rest is there


def test_a_figure_that_cannot_be_saved_leaves_its_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn = figures.learning_curves

    def broken(*given: Any) -> Any:
        drawing = drawn(*given)
        drawing.figure.text(0, 0, "x").draw = fails
        return drawing

    monkeypatch.setattr(figures, "learning_curves", broken)
    out = tmp_path / "out"
    assert write_report(fresh(tmp_path / "runs"), out) == "undrawn"
    said = capsys.readouterr()
    assert said.err == "curves_reach: could not be drawn (ValueError: no ink)\n"
    assert "start with" in said.out
    assert [path.name for path in (out / "figures").glob("curves_reach.*")] == ["curves_reach.csv"]


@pytest.mark.parametrize(
    "make", [os.mkfifo, Path.mkdir, lambda p: p.write_text("no"), lambda p: p.write_bytes(b"GIF89a")]
)
@pytest.mark.usefixtures("unpainted")
def test_an_animation_that_is_none_keeps_its_place(make: Plant, tmp_path: Path) -> None:
    make(fresh(tmp_path / "runs") / "episode_x.gif")
    built = build(tmp_path / "runs", tmp_path / "out", "quick")
    (line,) = built.undrawn
    assert line.startswith("episode_x.gif: could not be shown (the file is not a whole GIF (")
    assert "episode_x" in Page((tmp_path / "out" / "index.html").read_text(encoding="utf-8")).values("id")


@pytest.mark.parametrize(
    ("module", "name"), [(tables, "finals"), (report.rules, "judge"), (sheets.comparison, "pairs_table")]
)
def test_evidence_that_fails_is_an_error(
    module: Any, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fresh(tmp_path / "runs")
    monkeypatch.setattr(module, name, fails)
    with pytest.raises(ValueError, match="ink"):
        build(tmp_path / "runs", tmp_path / "out", "quick")
    assert not (tmp_path / "out").exists()


# The folder


def test_what_a_killed_report_left_is_swept(tmp_path: Path) -> None:
    runs, out = fresh(tmp_path / "runs"), tmp_path / "out"
    root, silent = Path(__file__).parents[2], subprocess.DEVNULL
    child = subprocess.Popen(reporting(runs, out, "reach"), cwd=root, stdout=silent, stderr=silent)
    end = time.monotonic() + 120
    while not list(out.glob(".report-*/figures/*")) and child.poll() is None and time.monotonic() < end:
        time.sleep(0.005)
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    left = list(out.glob(".report-*"))
    assert left
    (out / "mine.txt").write_text("no report")
    build(runs, out, "quick", "reach")
    assert list(out.glob(".*")) == []
    assert (out / "mine.txt").exists()


def test_two_reports_in_one_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs, out = fresh(tmp_path / "runs"), tmp_path / "out"
    with report._held(out):
        assert write_report(runs, out) == "refused"
    assert capsys.readouterr().err == f"{out}: another report is being written there; wait for it, or give --out\n"
    assert list(out.iterdir()) == []


def test_a_place_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = fresh(tmp_path / "runs")
    (tmp_path / "file").write_text("mine")
    for out in (tmp_path / "file", tmp_path / "file" / "below", tmp_path / ("x" * 300)):
        assert write_report(runs, out) == "refused"
        assert f"{out}: cannot be written (" in capsys.readouterr().err
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "words"), [("none", "no tables here"), ("x" * 300, "cannot be read (File name too long)")]
)
def test_no_place_for_tables(name: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(TableError, match=re.escape(words)):
        load(tmp_path / name, "quick")


def test_nothing_depends_on_the_locale(tmp_path: Path) -> None:
    runs, out = write(tmp_path / "runs", study("reach", {"基线": noisy(60)}, points=2)), tmp_path / "out"
    env = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    call = reporting(runs, out, "reach")
    done = subprocess.run(call, cwd=Path(__file__).parents[2], env=env, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "基线" in (out / "index.html").read_text(encoding="utf-8")
