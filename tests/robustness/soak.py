"""Kill a study again and again, with Ray and MLflow's own server, and compare the end with an undisturbed launch.

    python -m tests.robustness.soak --kills 60 --seed 0

Prints a Markdown summary; exit code 1 if anything was lost, doubled, left open or came out different. Every second
study logs to a tracking server, the others to a database file. Who is killed when follows from the seed; what that hits
depends on the machine as well.
"""

import argparse
import os
import platform
import random
import signal
import subprocess
import sys
import time
import urllib.request
from collections import Counter
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil

from pipelines.execution import run
from pipelines.export.tables import write_tables
from pipelines.specs.study import Study
from pipelines.tracking.mlflow_tracker import create_database, open_existing
from pipelines.tracking.plan import items, study_card
from pipelines.workspace.work_folder import Home
from tests.pipelines.support import lasting, setting, started_by, tiny
from tests.robustness.chaos import WORKER, Run, damage, everything, faults, free_port

KINDS = ("driver", "worker", "server", "driver, politely", "node")
ROOT = Path(__file__).parents[2]
LONGEST = 5.0  # seconds between two kills
ATTEMPTS = 40  # launches in a row that may fail without a kill before a study counts as stuck


def study(points: int) -> Study:
    """Three trainings, one of them for two arms."""
    rates = {"slow": 1e-4, "fast": 1e-2, "other": 1e-3, "twin": 1e-3}
    return lasting(tiny("soak", points, {arm: setting(lr=rate) for arm, rate in rates.items()}))


class Campaign:
    """One study from its first launch to its end.

    Args:
        home: an empty folder.
        points: length of its curves.
        served: whether it logs to a tracking server.
        rng: decides what is killed when.
    """

    def __init__(self, home: Path, points: int, served: bool, rng: random.Random) -> None:
        self.home, self.points, self.rng = home, points, rng
        self.tally: Counter[str] = Counter()
        self.drivers: list[int] = []  # process ids, which are also their sessions
        self.port = free_port() if served else 0
        self.server: subprocess.Popen[bytes] | None = None
        self.uri = f"http://127.0.0.1:{self.port}" if served else f"sqlite:///{home}/mlflow.db"
        home.mkdir(parents=True, exist_ok=True)
        create_database(home / "mlflow.db")

    @property
    def kills(self) -> int:
        """So far."""
        return sum(count for name, count in self.tally.items() if name.startswith("killed"))

    def go(self, kills: int) -> None:
        """Launch until the study is finished, and kill at most so many times meanwhile."""
        failed = 0
        driver = self._launch()
        try:
            while driver.poll() != 0:
                if driver.poll() is not None:
                    failed += 1
                    assert failed < ATTEMPTS, f"stuck, see {self.home}/driver.log"
                    driver = self._relaunch()
                elif self.kills < kills:
                    self._wait(driver)
                    failed = 0 if self._kill(driver, self.rng.choice(KINDS)) else failed
                else:
                    self._serve()
                    time.sleep(0.2)
            self._serve()
            self.tally["processes left"] = len(self._left())
        finally:
            for pid in self.drivers:
                for process in started_by(pid):
                    process.kill()

    def _left(self) -> list[psutil.Process]:
        """The processes that drivers started and that are still there after a minute."""
        for _ in range(120):
            left = [process for pid in self.drivers for process in started_by(pid)]
            if not left:
                break
            time.sleep(0.5)
        return left

    def close(self) -> None:
        """End the server."""
        if self.server is not None:
            with suppress(ProcessLookupError):
                os.killpg(self.server.pid, signal.SIGKILL)
            self.server.wait()

    def _launch(self) -> subprocess.Popen[bytes]:
        self._serve()
        command = [sys.executable, "-W", "ignore", "-m", "tests.robustness.soak", "--drive", str(self.home)]
        environment = os.environ | {"MLFLOW_TRACKING_URI": self.uri}
        command += ["--points", str(self.points)]
        with (self.home / "driver.log").open("ab") as log:
            pipes = {"stdout": log, "stderr": log}
            driver = subprocess.Popen(command, cwd=ROOT, env=environment, **pipes, start_new_session=True)
        self.drivers.append(driver.pid)
        return driver

    def _relaunch(self) -> subprocess.Popen[bytes]:
        self.tally["launches that continued"] += 1
        if self.rng.random() < 0.5 and damage(self.home, self.rng):
            self.tally["checkpoints damaged"] += 1
        return self._launch()

    def _serve(self) -> None:
        """See that the server runs, if there is one."""
        if not self.port or (self.server is not None and self.server.poll() is None):
            return
        command = [sys.executable, "-W", "ignore", "-m", "mlflow", "server", "--host", "127.0.0.1", "--workers", "1"]
        command += ["--port", str(self.port), "--backend-store-uri", f"sqlite:///{self.home}/mlflow.db"]
        command += ["--artifacts-destination", str(self.home / "served")]
        environment = os.environ | {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}
        with (self.home / "server.log").open("ab") as log:
            self.server = subprocess.Popen(command, env=environment, stdout=log, stderr=log, start_new_session=True)
        for _ in range(3_000):
            assert self.server.poll() is None, f"no server, see {self.home}/server.log"
            with suppress(OSError), urllib.request.urlopen(f"{self.uri}/health", timeout=10):
                return
            time.sleep(0.1)
        raise AssertionError("the server does not answer")

    def _wait(self, driver: subprocess.Popen[bytes]) -> None:
        with suppress(subprocess.TimeoutExpired):
            driver.wait(self.rng.uniform(0.1, LONGEST) * (1 if self.rng.random() < 0.5 else 3))

    def _kill(self, driver: subprocess.Popen[bytes], kind: str) -> bool:
        """True if there was something to kill."""
        if kind == "server":
            if self.server is None:
                return False
            os.killpg(self.server.pid, signal.SIGKILL)
            self.server.wait()
            time.sleep(self.rng.uniform(0, LONGEST))
            self._serve()
        elif kind.startswith("driver"):
            if driver.poll() is not None:
                return False
            driver.send_signal(signal.SIGTERM if "politely" in kind else signal.SIGKILL)
            driver.wait()
        else:
            victims = started_by(driver.pid, WORKER if kind == "worker" else "raylet/raylet")
            if not victims:
                return False
            with suppress(psutil.Error):
                self.rng.choice(victims).kill()
        self.tally[f"killed: {kind}"] += 1
        return True


def result(home: Path, uri: str, points: int) -> tuple[list[Run], bytes]:
    """The content of the log at the end, and the exported values."""
    os.environ["MLFLOW_TRACKING_URI"] = uri
    plan = study(points)
    tracker = open_existing(study_card(plan), Home(home))
    write_tables(plan, items(plan), tracker, home / "out")
    return everything(plan, home), (home / "out" / "soak.parquet").read_bytes()


def soak(folder: Path, kills: int, seed: int, points: int) -> tuple[Counter[str], dict[str, int]]:
    """The totals of actions and faults."""
    rng, kills_left, number = random.Random(seed), kills, 0
    done: Counter[str] = Counter()
    wrong: Counter[str] = Counter()
    whole = Campaign(folder / "whole", points, False, rng)
    whole.go(0)
    expected = result(whole.home, whole.uri, points)
    wrong.update(faults(expected[0], expected[0]))
    while kills_left > 0:
        number += 1
        one = Campaign(folder / str(number), points, number % 2 == 0, rng)
        try:
            one.go(min(12, kills_left))
            runs, table = result(one.home, one.uri, points)
        finally:
            one.close()
        kills_left -= one.kills
        one.tally["studies"] = 1
        one.tally["workers replaced in a launch"] = (one.home / "driver.log").read_text().count("its worker died;")
        found = faults(runs, expected[0]) | {"exported tables that differ": int(table != expected[1])}
        found["checkpoints left"] = len(list(one.home.glob("checkpoints/*/*")))
        found["processes left"] = one.tally.pop("processes left")
        wrong.update(found)
        done.update(one.tally)
        print(f"study {number}: {dict(one.tally)}, wrong: {sum(found.values())}", file=sys.stderr, flush=True)
    return done, dict(wrong)


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=60, help="at least so many")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--points", type=int, default=150, help="points of each curve: longer studies meet more kills")
    parser.add_argument("--folder", type=Path, help="keep everything there")
    parser.add_argument("--drive", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.drive:
        return run.run_studies([study(chosen.points)], chosen.drive)
    start = time.monotonic()
    with TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
        done, wrong = soak(chosen.folder or Path(temporary), chosen.kills, chosen.seed, chosen.points)
    print(f"Seed {chosen.seed}, {time.monotonic() - start:,.0f} s, {os.cpu_count()} cores, {platform.platform()}.\n")
    print("| what was done | times |\n|---|---:|")
    print("\n".join(f"| {name} | {done[name]} |" for name in sorted(done)))
    print("\n| what must not be | times |\n|---|---:|")
    print("\n".join(f"| {name} | {count} |" for name, count in wrong.items()))
    return int(any(wrong.values()))


if __name__ == "__main__":
    sys.exit(main())
