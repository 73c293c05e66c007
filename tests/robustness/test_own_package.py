"""A package of the user's own all the way: trained by Ray, killed, continued, exported, reported, played, edited."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import pytest

from pipelines.specs import identity
from pipelines.specs.study import RunSpec, Study
from pipelines.tracking.mlflow_tracker import open_existing
from pipelines.tracking.tracker import StudyCard
from pipelines.workspace.work_folder import Home
from rhmc.training.trainer import Trainer
from tests.pipelines.own_package import STUDY, untouched, write
from tests.pipelines.support import Said, all_end, run_rhmc
from tests.robustness.chaos import WORKER

OWN = "studies/own.yaml"
TEXT = STUDY.replace("evaluations: 3", "evaluations: 30").replace("steps: 600", "steps: 9000") + (
    "resources: {concurrent: 1, checkpoint_every: 1}\n"
)
ELSEWHERE = """\
  MAPPO elsewhere:
    env: {kind: navigation, agents: 2, episode: 7}
    algo: {kind: mappo, hidden_dim: 8, n_steps: 8, minibatches: 1}
    trainer: {evaluations: 2}
"""
COMMAND = [sys.executable, "-c", "import rhmc_command; rhmc_command.main()"]
MAIN = """\
import os, sys
from pipelines.cli import main
for words in {calls!r}:
    name, *sys.argv[1:] = words
    os.environ["RHMC_IMPORTS"] = name
    try:
        main.main()
    except SystemExit as end:
        print("exit", end.code or 0, flush=True)
"""
Rhmc = Callable[..., Said]


CARD = StudyCard("own", "quick", "", {}, [])


class Launched(NamedTuple):
    """The folder of a user after two launches, of which the first was killed."""

    folder: Path
    left: dict[str, str]  # the status of each run in the log after the first, by its id
    said: str  # by the second


@pytest.fixture(scope="module")
def launched(tmp_path_factory: pytest.TempPathFactory, template: Path) -> Launched:
    folder = tmp_path_factory.mktemp("own")
    write(folder / "studies")
    (folder / OWN).write_text(TEXT.replace("seeds: 1", f"{ELSEWHERE}seeds: 1"))
    home = folder / "work"
    home.mkdir()
    shutil.copy(template, home / "mlflow.db")
    how = {"cwd": folder, "env": os.environ | {"RHMC_HOME": str(home)}}
    with (folder / "first.txt").open("w") as out:
        words = [*COMMAND, "study", "run", OWN]
        process = subprocess.Popen(words, stdout=out, stderr=out, start_new_session=True, **how)  # type: ignore[call-overload]
        for _ in range(30_000):
            if process.poll() is not None or any(home.glob("checkpoints/*/00000004.pt")):
                break
            time.sleep(0.02)
        process.kill()
    assert process.wait() == -9, (folder / "first.txt").read_text()
    assert all_end(process.pid, WORKER)  # Ray's own agents take a minute more to miss their raylet
    left = statuses(home)
    done = subprocess.run([*COMMAND, "study", "run", OWN], capture_output=True, text=True, check=False, **how)  # type: ignore[call-overload]
    assert done.returncode == 0, done.stdout + done.stderr
    return Launched(folder, left, done.stdout + done.stderr)


def statuses(home: Path) -> dict[str, str]:
    """The status of each run in the log, by its id."""
    tracker = open_existing(CARD, Home(home))
    assert tracker is not None
    return {run.ref: run.status for run in tracker.recorded()}


@pytest.fixture
def rhmc(launched: Launched, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Iterator[Rhmc]:
    """Calls the command in that folder, as often as wanted, in this process."""
    monkeypatch.chdir(launched.folder)
    monkeypatch.setenv("RHMC_HOME", str(launched.folder / "work"))
    identity._code.cache_clear()
    with untouched():
        yield lambda *words: Said(run_rhmc(*words), *capfd.readouterr())
    identity._code.cache_clear()


def tables(folder: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    return pd.read_parquet(folder / "own.parquet"), pd.read_parquet(folder / "own.runs.parquet")


def trained(spec: RunSpec) -> dict[tuple[int, str], float]:
    """The values of a run that nobody interrupted, in this process."""
    points = list(Trainer(spec.env, spec.algo, spec.trainer, spec.seed))
    return {(int(point["step"]), name): value for point in points for name, value in point.items() if name != "step"}


@pytest.mark.ray
def test_a_killed_driver(launched: Launched) -> None:
    """What it leaves open the next launch takes up: the same runs, whole, nothing doubled."""
    home = launched.folder / "work"
    assert "running" in launched.left.values()  # nobody was left to say otherwise
    after = statuses(home)
    assert launched.left.keys() <= after.keys()
    assert list(after.values()) == ["finished"] * 3
    tracker = open_existing(CARD, Home(home))
    assert tracker is not None
    points = []
    for ref in after:
        steps = [value.step for value in tracker.client.get_metric_history(ref, "return")]
        assert len(steps) == len(set(steps))
        points.append(len(steps))
    assert sorted(points) == [3, 31, 31]
    assert not list(home.glob("checkpoints/*/*.pt"))


@pytest.mark.ray
def test_it_is_continued_bit_for_bit_exported_and_reported_beside_mappo(launched: Launched, rhmc: Rhmc) -> None:
    assert (
        "no animation (InputError: the task 'ring' offers no painter, so its episodes are not drawn)" in launched.said
    )
    assert rhmc("export", OWN, "--out", "runs").code == 0
    values, runs = tables(launched.folder / "runs")
    assert dict(zip(runs["arm"], runs["status"], strict=True)) == dict.fromkeys(
        ["MAPPO", "MAPPO elsewhere", "bandits"], "finished"
    )
    assert json.loads(runs.set_index("arm").loc["bandits", "config"])["imports"] == ["bandits.methods", "bandits.tasks"]
    for run in Study.load(OWN).runs()[:1]:
        mine = values[values["arm"] == run.arm]
        logged = {(s, m): v for s, m, v in zip(mine["step"], mine["metric"], mine["value"], strict=True)}
        assert logged == trained(run.spec)
    assert json.loads((launched.folder / "runs/own.tasks.json").read_text()) == {
        "ring": {"unit": "as the task defines it"}
    }
    assert rhmc("report", "--study", OWN, "--runs", "runs", "--out", "report").code == 0
    page = (launched.folder / "report/index.html").read_text()
    assert all(arm in page for arm in ("bandits", "MAPPO elsewhere"))


@pytest.mark.ray
def test_a_fresh_process_plays_a_policy_from_its_record_once_the_package_is_named(launched: Launched) -> None:
    files = sorted((launched.folder / "work/artifacts").rglob("policy.pt"))
    policy = next(file for file in files if b'"kind":"bandits"' in file.read_bytes())
    calls = [
        ["", "evaluate", str(policy)],
        ["bandits", "evaluate", str(policy), "--json"],
        ["bandits", "render", str(policy), "--out", "x.gif"],
    ]
    done = subprocess.run(
        [sys.executable, "-c", MAIN.format(calls=calls)],
        cwd=launched.folder / "studies",
        capture_output=True,
        text=True,
        check=True,
    )
    needs = "needs the module 'bandits.methods', which nobody has named here: if you trust its code, put its package"
    unnamed, undrawn = done.stderr.splitlines()
    assert unnamed == f"{policy}: {needs} 'bandits' into the variable RHMC_IMPORTS"
    assert undrawn == "the task 'ring' offers no painter, so its episodes are not drawn"
    first, played, second, third = done.stdout.splitlines()
    assert (first, second, third) == ("exit 2", "exit 0", "exit 2")
    (score,) = json.loads(played)
    assert score["values"]["faced"] == pytest.approx(score["values"]["return"])


@pytest.mark.ray
def test_a_bundle_of_it_imports_nothing_that_nobody_named(launched: Launched, rhmc: Rhmc, tmp_path: Path) -> None:
    bundle = tmp_path / "own.zip"
    assert rhmc("study", "export", OWN, str(bundle)).code == 0
    with untouched(), pytest.MonkeyPatch.context() as patch:
        for name in [name for name in sys.modules if name.partition(".")[0] == "bandits"]:
            patch.delitem(sys.modules, name)
        for table in _registered():
            for kind in {"bandits", "ring"} & table.keys():
                patch.delitem(table, kind)
        patch.setattr("pipelines.workspace.own_packages._named", {})
        patch.setenv("RHMC_HOME", str(tmp_path / "there"))
        patch.syspath_prepend(launched.folder / "studies")  # it could be imported
        said = rhmc("study", "import", str(bundle))
        assert said.code == 2
        assert said.err == (
            f"{bundle}: bundle.json: needs the module 'bandits.methods', which nobody has named here: if you trust its "
            "code, put its package 'bandits' into the variable RHMC_IMPORTS\n"
        )
        assert "bandits" not in sys.modules
        assert not (tmp_path / "there").exists()
        patch.setenv("RHMC_IMPORTS", "bandits")
        said = rhmc("study", "import", str(bundle))
        assert said.code == 0
        assert "3 finished runs taken in" in said.out
        assert "other code" not in said.out


def _registered() -> list[dict[str, object]]:
    from pipelines.specs import plugins

    return list(plugins.TABLES.values())


@pytest.mark.ray
def test_an_edit_of_it_ages_its_runs_and_no_others(launched: Launched, rhmc: Rhmc) -> None:
    page = launched.folder / "studies/bandits/methods.py"
    before = page.read_text()
    page.write_text(before.replace("STEP = 1.0", "STEP = 0.25"))
    try:
        said = rhmc("study", "status", OWN, "--json")
    finally:
        page.write_text(before)
    found = json.loads(said.out)
    assert {arm: (one["finished"], one["stale"]) for arm, one in found["arms"].items()} == {
        "bandits": (0, 1),
        "MAPPO": (0, 1),  # in the task of the package
        "MAPPO elsewhere": (1, 0),
    }
    assert "changed since: bandits.methods" in found["stale"][0]
