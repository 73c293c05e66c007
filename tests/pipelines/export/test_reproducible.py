"""Declared outputs are the same bytes wherever results are equal, and the last line of `make repro` says so."""

import importlib
import inspect
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow.parquet as pq
import pytest
from ruamel.yaml import YAML

from pipelines.export.tables import write_tables
from pipelines.export.yardsticks import Evaluation, Scored, export_yardsticks
from pipelines.tracking.plan import items, study_card
from pipelines.workspace.provenance import Host
from reports.data.schema import MADE, METRICS, PLACE, RUNS, TRANSFER
from reports.pages import build
from rhmc.envs import coverage
from tests.memory_tracker import MemoryTracker
from tests.pipelines.support import run_rhmc, setting, tiny

ROOT = Path(__file__).parents[3]
PIPELINE: dict[str, Any] = YAML(typ="safe").load((ROOT / "dvc.yaml").read_text(encoding="utf-8"))
STAGES: dict[str, Any] = PIPELINE["stages"]
HOME = "results/${profile}/"
PAGE = {"index.html", "index.md", "measured"}  # of the report, and no out


def outs(stage: str) -> set[str]:
    """Below the folder of the profile."""
    names = {next(iter(out)) for out in STAGES[stage]["outs"]}
    return {name.removeprefix(HOME) for name in names if name.startswith(HOME)}


def deps(stage: str) -> set[str]:
    return {name.removeprefix(HOME) for name in STAGES[stage].get("deps", []) if name.startswith(HOME)}


class World(NamedTuple):
    """The place and time where the same results are made."""

    commit: str
    host: Host
    slowness: float
    adopted: str


HERE = World("c0ffee", Host("one core", "Python 3.11.7, torch 2.13.0+cpu"), 1.0, "")
THERE = World("decade-dirty", Host("two cores", "Python 3.13.0, torch 2.13.0+cu130"), 7.7, "from code 0123456789ab")


def make(folder: Path, world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Export a study and yardsticks that are in `dvc.yaml`, and report on them."""
    study = tiny("coverage", arms={"RHMC": setting(lr=1e-4), "IQL": setting(lr=1e-2)}).model_copy(update={"seeds": 2})
    runs = folder / "runs"
    tracker = MemoryTracker(study_card(study), [])
    for n, item in enumerate(items(study, world.commit, world.host)):
        log = tracker.start(item.card)
        steps = range(0, item.spec.trainer.steps + 1, 200)
        log.log([{"step": float(s), "eval/return": n + s / 9, "time/seconds": s * world.slowness} for s in steps])
        log.log([{"step": float(steps[-1]), "final/return": n + steps[-1] / 9}])
        log.finish("finished")
    recorded = [run._replace(adopted=world.adopted) for run in tracker.recorded()]
    monkeypatch.setattr(tracker, "recorded", lambda: recorded)
    write_tables(study, items(study), tracker, runs)
    monkeypatch.setattr("pipelines.export.yardsticks.commit", lambda: world.commit)
    monkeypatch.setattr("pipelines.export.yardsticks.host", lambda: world.host)
    evaluation = Evaluation(coverage.Config(agents=2, targets=2), ("best_window",), 4)
    score = {"coverage": 40.0, "return": 40.0, "sem": 0.5}
    export_yardsticks([Scored(evaluation, {"best_window": score})], "quick", runs)
    assert build.build(runs, folder, "quick").undrawn == []


def files(folder: Path) -> Iterator[str]:
    return (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_no_out_depends_on_commit_machine_or_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make(tmp_path / "here", HERE, monkeypatch)
    make(tmp_path / "there", THERE, monkeypatch)
    names = set(files(tmp_path / "here"))
    assert names == set(files(tmp_path / "there"))
    other = {n for n in names if (tmp_path / "here" / n).read_bytes() != (tmp_path / "there" / n).read_bytes()}
    declared = set().union(*map(outs, STAGES))
    assert {name for name in other if not declared.isdisjoint({name, *map(str, Path(name).parents)})} == set()
    assert {name for name in names if declared.isdisjoint({name, *map(str, Path(name).parents)})} == other
    assert other == {
        *("index.html", "index.md", "runs/coverage.made.parquet", "runs/yardsticks.made.parquet"),
        *(
            f"measured/{name}.{kind}"
            for name in ("made", "provenance", "time_coverage")
            for kind in ("csv", "md", "tex")
        ),
    }
    for world, folder in ((HERE, "here"), (THERE, "there")):
        told = (tmp_path / folder / "measured" / "provenance.csv").read_text() + "".join(
            (tmp_path / folder / "measured" / "made.csv").read_text()
        )
        for word in (world.commit, world.host.machine, world.host.versions, world.adopted):
            assert word in told


def test_the_pipeline_names_what_the_report_reads_and_writes() -> None:
    written = set(build.MADE)
    assert outs("report") == written - PAGE
    assert written >= PAGE
    assert deps("report") == set().union(*(outs(name) for name in STAGES if name != "report"))
    every = set().union(*map(outs, STAGES), *map(deps, STAGES))
    assert {name for name in every if name.endswith(".made.parquet") or name == "runs"} == set()


def test_what_dvc_plots_is_drawn_by_the_report() -> None:
    """The template names the columns of the figures' tables; the paper profile's are in git."""
    template = (ROOT / ".dvc" / "plots" / "curves.json").read_text(encoding="utf-8")
    fields = set(re.findall(r'"field": "(\w+)"', template)) - {"rev"}
    for plot in PIPELINE["plots"]:
        (about,) = plot.values()
        ((table, value),) = about["y"].items()
        assert about["template"] == "curves"
        columns = (ROOT / table.replace("${profile}", "paper")).read_text(encoding="utf-8").partition("\n")[0]
        assert fields | {"kind", about["x"], value} <= set(columns.split(","))
    assert json.loads(template)["transform"] == [{"filter": "datum.kind == 'curve'"}]


def test_dvc_compares_what_the_report_says() -> None:
    """At a place that is the same for every profile, and in git: else `dvc exp show` has nothing to compare."""
    assert PIPELINE["metrics"] == [next(iter(out)) for out in STAGES["metrics"]["outs"]]
    assert STAGES["metrics"]["deps"] == [f"{HOME}{build.METRICS}"]
    for name in PIPELINE["metrics"]:
        ignored = subprocess.run(["git", "check-ignore", "-q", name], cwd=ROOT, check=False).returncode
        assert ignored == 1


def test_no_other_table_has_room_for_how_it_was_made() -> None:
    own = set(MADE.names) - set(PLACE.names)
    assert own == {"commit", "seconds", "machine", "versions", "adopted"}
    for schema in (METRICS, RUNS, TRANSFER):
        assert own.isdisjoint(schema.names)
    published = list((ROOT / "results" / "paper" / "runs").glob("*.parquet"))
    assert published
    for file in published:
        assert own.isdisjoint(pq.read_schema(file).names) != file.name.endswith(".made.parquet"), file


# The last steps of `make repro`

COUNT = "verdicts --profile quick"
RHMC = """#!/bin/sh
echo "$*" >> calls
case "$1" in
profile) echo quick ;;
report) touch results/quick/index.html ;;
verify) echo "the verdict"; exit "$(cat verdict)" ;;
esac
"""


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """The makefile, with programs that only note how they were called; a profile that has run."""
    for name in ("Makefile", "requirements.lock", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / ".ci").mkdir()
    (tmp_path / ".ci" / "dvc_repro.py").write_text("exit(int(open('pipeline').read()))\n")
    tools = tmp_path / ".venv" / "bin"
    tools.mkdir(parents=True)
    (tools / "rhmc").write_text(RHMC)
    (tools / "rhmc").chmod(0o755)
    (tools / "python").symlink_to(sys.executable)
    (tmp_path / ".venv" / ".ready").touch()
    (tmp_path / "pipeline").write_text("0")
    (tmp_path / "verdict").write_text("0")
    (tmp_path / "results" / "quick" / "runs").mkdir(parents=True)
    return tmp_path


class Said(NamedTuple):
    code: int
    last: str
    calls: list[str]


def repro(clone: Path) -> Said:
    (clone / "calls").unlink(missing_ok=True)
    env = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL")}
    done = subprocess.run(["make", "repro"], cwd=clone, env=env, capture_output=True, text=True, check=False)
    calls = [line for line in (clone / "calls").read_text().splitlines() if line != "profile"]
    return Said(done.returncode, done.stdout.splitlines()[-1], calls)


def test_the_page_is_made_where_it_is_missing_or_old(clone: Path) -> None:
    page, made = clone / "results/quick/index.html", clone / "results/quick/runs/reach.made.parquet"
    assert repro(clone).calls == ["report --profile quick", COUNT]
    assert page.exists()
    made.touch()
    for path, time in ((made, 10), (made.parent, 10), (page, 20)):
        os.utime(path, (time, time))
    assert repro(clone).calls == [COUNT]
    os.utime(made, (30, 30))
    assert repro(clone).calls == ["report --profile quick", COUNT]


@pytest.mark.parametrize(("verdict", "code"), [(0, 0), (4, 0), (1, 2), (2, 2)])
def test_the_last_line_is_on_the_published_results(clone: Path, verdict: int, code: int) -> None:
    assert repro(clone).last.startswith("MLflow UI: ")
    (clone / "results" / "published" / "quick").mkdir(parents=True)
    (clone / "verdict").write_text(str(verdict))
    assert repro(clone) == (code, "the verdict", [COUNT, "verify --runs results/quick/runs --profile quick"])


def test_dvc_says_all_but_its_hint(tmp_path: Path) -> None:
    hint = "Use `dvc push` to send your updates to remote storage."
    assert f'ui.write("{hint}")' in inspect.getsource(importlib.import_module("dvc.commands.repro"))
    (tmp_path / "dvc").mkdir()
    (tmp_path / "dvc" / "__init__.py").touch()
    (tmp_path / "dvc" / "cli.py").write_text(
        f"def main(words):\n    print('one', words)\n    print({hint!r})\n    return 3\n"
    )
    command = [sys.executable, ROOT / ".ci" / "dvc_repro.py", "--dry"]
    env = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (3, "one ['repro', '--dry']\n", "")


LAST = list(STAGES)[-1]


@pytest.mark.parametrize(("name", "said"), [(LAST, f"stage {len(STAGES)} of {len(STAGES)}: {LAST}\n"), ("x", "")])
def test_a_stage_says_which_it_is(
    name: str, said: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("DVC_STAGE", name)
    assert run_rhmc("profile") == 0
    assert capfd.readouterr().err == said


def test_each_stage_begins_with_what_says_which_it_is() -> None:
    first = {
        name: stage["cmd"][0] if isinstance(stage["cmd"], list) else stage["cmd"] for name, stage in STAGES.items()
    }
    assert {command.split()[1] for command in first.values()} == {"profile", "fingerprint"}


def test_a_pipeline_that_stopped_is_not_verified(clone: Path) -> None:
    (clone / "results" / "published" / "quick").mkdir(parents=True)
    (clone / "pipeline").write_text("1")
    said = repro(clone)
    assert (said.code, said.calls) == (2, [])
    assert said.last == "Not finished. What is done is kept: `make repro` continues."
