"""A tiny study; `python -m tests.pipelines.support HOME POINTS CONCURRENT` launches one with time to be killed in."""

import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import pytest

from pipelines.cli import main as cli
from pipelines.conformance.blocks import fitted, nested
from pipelines.specs.identity import code_id
from pipelines.specs.study import Resources, RunSpec, Setting, Study
from pipelines.tracking.plan import Item, items
from pipelines.workspace.process_pool import side_by_side
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import coverage

CODE = code_id("iql", "navigation")  # of all runs here
HOSTILE = "#x ?y %2F z'\"~{a}\n"  # the name of a folder


def setting(**algo: Any) -> Setting:
    """Navigation with two agents and IQL, a fraction of a second: most of it is play, so episodes are short."""
    return Setting.model_validate(
        {
            "env": {"kind": "navigation", "agents": 2, "episode": 7},
            "algo": {
                "kind": "iql",
                "learning_starts": 64,
                "batch_size": 32,
                "train_freq": 16,
                "hidden_dim": 16,
                "buffer_size": 400,
            },
            "trainer": {"steps": 600, "num_envs": 8, "evaluations": 3, "eval_episodes": 4, "final_episodes": 8},
        }
        | ({"algo": _own({"kind": "iql"} | algo)} if algo else {})
    )


def _own(algo: dict[str, Any]) -> dict[str, Any]:
    return nested(fitted(ALGORITHMS[algo["kind"]].config, {"learning_starts": 64, "batch_size": 32}) | algo)


def spec(seed: int = 0, **algo: Any) -> RunSpec:
    """A run of `setting`."""
    return RunSpec(**dict(setting(**algo)), seed=seed)


def tiny(
    name: str = "tiny",
    points: int = 3,
    arms: dict[str, Setting] | None = None,
    every: int = 2,
    concurrent: int = 2,
) -> Study:
    """Two arms with one seed. With Ray, each run at a time costs the start of a worker, some processor seconds."""
    if arms is None:
        arms = {"slow": setting(lr=1e-4), "fast": setting(lr=1e-2)}
    budget = {"evaluations": points, "steps": 200 * points}
    arms = {arm: one.model_copy(update={"trainer": one.trainer.model_copy(update=budget)}) for arm, one in arms.items()}
    return Study(
        name=name,
        profile="quick",
        question="Does the whole chain hold?",
        base=next(iter(arms.values())),
        arms=arms,
        seeds=1,
        steps=200 * points,
        resources=Resources(checkpoint_every=every, concurrent=concurrent),
    )


def lasting(study: Study) -> Study:
    """The study in coverage, whose long episodes make a point take a fraction of a second: time to be killed in."""
    env = coverage.Config(agents=2, targets=2)
    arms = {arm: one.model_copy(update={"env": env}) for arm, one in study.arms.items()}
    return study.model_copy(update={"base": next(iter(arms.values())), "arms": arms})


def plan(study: Study | None = None) -> list[Item]:
    """Its runs."""
    return items(study or tiny(), "abc-dirty")


class Said(NamedTuple):
    """The exit code and the output of a command."""

    code: int
    out: str
    err: str


def run_rhmc(*words: str) -> int:
    """The exit code of the command `rhmc`, in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["rhmc", *words])
        with pytest.raises(SystemExit) as caught:
            cli.main()
    return int(caught.value.code or 0)


def fresh(folder: Path, template: Path) -> Path:
    """A work folder with an empty MLflow database."""
    folder.mkdir(exist_ok=True)
    shutil.copy(template, folder / "mlflow.db")
    return folder


def jobs_of(module: str, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Fills with the number of processes that a module asks for, each time that it does."""
    seen: list[int] = []

    def watched(function: Callable[[Any], Any], items: Iterable[Any], jobs: int) -> Iterator[Any]:
        seen.append(jobs)
        return side_by_side(function, items, jobs)

    monkeypatch.setattr(f"{module}.side_by_side", watched)
    return seen


def started_by(driver: int, name: str = "") -> list[psutil.Process]:
    """The processes in the session of a driver, which may be gone, and has `name` in its command line."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            if os.getsid(process.pid) == driver and process.status() != psutil.STATUS_ZOMBIE:
                found += [process] if name in " ".join(process.cmdline()) else []
    return found


def all_end(driver: int, name: str = "") -> bool:
    """True if nothing that a driver started, with `name` in its command line, is left within a minute."""
    for _ in range(600):
        if not started_by(driver, name):
            return True
        time.sleep(0.1)
    return False


def interrupt(home: Path) -> None:
    """Send this process Ctrl-C, once a launch of it listens and has trained on."""
    before = set(home.glob("checkpoints/*/0*.pt"))
    for _ in range(30_000):  # ten minutes, for a busy machine
        listens = signal.getsignal(signal.SIGINT) is not signal.default_int_handler
        if listens and set(home.glob("checkpoints/*/0*.pt")) - before:
            os.kill(os.getpid(), signal.SIGINT)
            return
        time.sleep(0.02)


if __name__ == "__main__":
    from pipelines.execution import run

    study = lasting(tiny(points=int(sys.argv[2]), concurrent=int(sys.argv[3])))
    sys.exit(run.run_studies([study], Path(sys.argv[1])))
