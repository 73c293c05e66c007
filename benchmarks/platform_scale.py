"""The cost of 1,000 and 10,000 queued runs for the driver, the commands and MLflow's pages. Prints Markdown.

Trials are simulated: a worker makes its points up and ends with the untrained policy of a small team. The driver is the
real one (plan, recorder, log, registry, Ray). Of a study, a first launch finishes some runs and is interrupted; all
but a few of the others are then written to MLflow's database as copies of one of these, without models and files; a
second launch does the rest. Seconds of processor time beside those on the clock, which other work on the machine
stretches.
"""

import argparse
import json
import os
import random
import resource
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import env_speed
import psutil
from platform_overhead import ROOT, Stopwatch

from pipelines.execution.ray_settings import set_up_ray
from pipelines.execution.trainable import RunTrainable
from pipelines.specs.study import RunSpec, Study
from rhmc.training.trainer import Trainer, grid_step
from rhmc.types import Metrics, State

FILE = """\
question: What do the learning rate and the discount do to each other?
base:
  env: {{kind: coverage, preset: flat, agents: 2, targets: 2}}
  algo: {{kind: iql, hidden_dim: 16, batch_size: 32, learning_starts: 64, buffer_size: 400}}
  trainer: {{num_envs: 8, evaluations: {points}}}
grid:
  algo.lr: [{rates}]
  algo.gamma: [0.90, 0.91, 0.92, 0.93, 0.94, 0.95, 0.96, 0.97, 0.98, 0.99]
  algo.tau: [0.001, 0.002, 0.003, 0.004, 0.005, 0.006, 0.007, 0.008, 0.009, 0.010]
seeds: 10
steps: 100_000
resources: {{animate: none}}
"""
MADE_UP = ("eval/return", "eval/return_sem", "eval/coverage", "train/reward", "train/loss", "train/q", "train/grad")
REPEATS = 5  # of each request
PAGE = 100  # runs that MLflow's table and charts load at once


def write_study(folder: Path, runs: int, points: int) -> Path:
    """A grid of so many runs, a multiple of 1,000 up to 10,000."""
    rates = ", ".join(f"{i}e-4" for i in range(1, runs // 1000 + 1))
    path = folder / "many.yaml"
    path.write_text(FILE.format(rates=rates, points=points), encoding="utf-8")
    return path


# Simulated trials


class MadeUp:
    """Stands for a trainer: the points of its curve are random, the weights those of the start."""

    def __init__(self, spec: RunSpec) -> None:
        self.real = Trainer(spec.env, spec.algo, spec.trainer, spec.seed)
        self.rng, self.step, self.point = random.Random(spec.id), 0, -1

    @property
    def done(self) -> bool:
        """True if the last point is there."""
        return self.point >= self.real.cfg.evaluations

    def __next__(self) -> Metrics:
        self.point += 1
        self.step = grid_step(self.real.cfg, self.point)
        made = {"step": float(self.step)} | {name: self.rng.random() for name in MADE_UP}
        return made | ({"final/return": self.rng.random(), "final/coverage": self.rng.random()} if self.done else {})

    def state_dict(self) -> State:
        """As the trainer's."""
        return self.real.state_dict() | {"step": self.step, "point": self.point}

    def load_state_dict(self, state: State) -> None:
        """As the trainer's."""
        self.step, self.point = state["step"], state["point"]


class Simulated(RunTrainable):
    """A worker that trains nothing. Ray gets it by value."""

    def make_trainer(self) -> Any:
        """The generator of the made-up points."""
        return MadeUp(RunSpec.model_validate_json(self.job["spec"]))


def drive(file: Path, until: int, out: Path) -> None:
    """`rhmc study run`, interrupted after so many finished runs (0: not)."""
    from pipelines.cli import main as cli
    from pipelines.execution import ray_driver, recorder, run
    from pipelines.tracking import mlflow_tracker, overview

    set_up_ray()
    import ray

    ray_driver.RunTrainable = Simulated  # type: ignore[misc]
    watch, marks, ends = Stopwatch(), dict[str, list[float]](), list[list[float]]()
    for owner, name, label in (
        (run, "study_card", "plan"),
        (run, "items", "plan"),
        (mlflow_tracker.MlflowTracker, "__init__", "open the log"),
        (recorder.Recorder, "__init__", "read what is there"),
        (recorder.Recorder, "reuse", "read what is there"),
        (ray, "init", "start Ray"),
        (mlflow_tracker.MlflowTracker, "start", "begin a run"),
        (mlflow_tracker.MlflowRun, "log", "log its points"),
        (mlflow_tracker.MlflowRun, "model", "register its policy"),
        (mlflow_tracker.MlflowRun, "finish", "finish it"),
        (overview.Overview, "publish", "overview"),
        (run, "_summary", "summary"),
    ):
        watch.watch(owner, name, label)
    start, finish = recorder.Recorder.start, recorder.Recorder._finish

    def started(self: recorder.Recorder, key: str) -> None:
        marks.setdefault("first trial", now())
        start(self, key)

    def finished(self: recorder.Recorder, key: str) -> None:
        finish(self, key)
        ends.append(now())
        if len(ends) == until:
            os.kill(os.getpid(), signal.SIGINT)

    recorder.Recorder.start, recorder.Recorder._finish = started, finished  # type: ignore[method-assign]
    sys.argv = ["rhmc", "study", "run", str(file)]
    try:
        cli.main()
    finally:
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
        report = {"marks": marks, "ends": ends, "parts": watch.spent, "exit": now(), "memory": memory}
        out.write_text(json.dumps(report), encoding="utf-8")


def now() -> list[float]:
    """Seconds on the clock since the launch, and of this process."""
    return [time.time() - float(os.environ["LAUNCHED"]), time.process_time()]


# The rest of the store


def fill(file: Path, home: Path, leave: int) -> int:
    """Copy a finished run to all planned ones that are not logged, but for the last few; returns how many."""
    from pipelines.tracking.mlflow_tracker import open_existing
    from pipelines.tracking.plan import commit, items, study_card
    from pipelines.workspace.work_folder import Home

    study = Study.load(file)
    tracker = open_existing(study_card(study), Home(home))
    assert tracker is not None
    there = {(run.arm, run.key): run for run in tracker.recorded()}
    model = next(run.ref for run in there.values() if run.status == "finished")
    todo = [item for item in items(study, commit()) if (item.card.arm, item.key) not in there]
    with closing(sqlite3.connect(home / "mlflow.db")) as database:
        copies = {table: Rows(database, table, model) for table in ("runs", "tags", "params", *METRICS)}
        for i, item in enumerate(todo[: len(todo) - leave]):
            card, ref, better = item.card, f"{i:032x}", random.Random(i).random()
            about = {"arm": card.arm, "seed": str(card.seed), "spec": card.spec_id, "mlflow.runName": card.name}
            copies["runs"].write({"run_uuid": ref, "name": card.name}, {})
            copies["tags"].write({"run_uuid": ref}, about)
            copies["params"].write({"run_uuid": ref}, card.params)
            for table in METRICS:
                copies[table].write({"run_uuid": ref}, {"final/return": better})
        database.commit()
    return len(todo) - leave


METRICS = ("metrics", "latest_metrics")


class Rows:
    """The rows that one run has in a table of MLflow's, to be written again for others."""

    def __init__(self, database: sqlite3.Connection, table: str, run: str) -> None:
        self.database = database
        self.columns = [name for _, name, *_ in database.execute(f"PRAGMA table_info({table})")]
        self.rows = database.execute(f"SELECT * FROM {table} WHERE run_uuid = ?", (run,)).fetchall()
        self.insert = f"INSERT INTO {table} VALUES ({', '.join('?' * len(self.columns))})"

    def write(self, same: dict[str, Any], values: dict[str, Any]) -> None:
        """Write them with these columns in all of them, and with these values by key."""
        made = []
        for row in self.rows:
            cells = dict(zip(self.columns, row, strict=True)) | same
            if cells.get("key") in values:
                cells["value"] = values[cells["key"]]
            made.append(tuple(cells.values()))
        self.database.executemany(self.insert, made)


# Commands


class Cost(NamedTuple):
    """The resources that a process took."""

    wall: float  # seconds
    cpu: float  # seconds
    memory: float  # MiB at most
    report: dict[str, Any] | None = None  # a launch's own


def environment(home: Path) -> dict[str, str]:
    """For our processes."""
    paths = f"{ROOT}{os.pathsep}{ROOT / 'benchmarks'}"
    ours = {"RHMC_HOME": str(home), "OMP_NUM_THREADS": "1", "PYTHONPATH": paths, "LAUNCHED": str(time.time())}
    return os.environ | ours


def command(words: list[str], home: Path, codes: tuple[int, ...] = (0, 1)) -> Cost:
    """Run to its end; processor seconds without those of Ray's processes and workers."""
    start = time.perf_counter()
    with (home / "log").open("w", encoding="utf-8") as log:
        python = [sys.executable, "-W", "ignore", *words]
        process = subprocess.Popen(python, cwd=ROOT, env=environment(home), stdout=log, stderr=log)
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in codes:
        sys.exit(
            f"{' '.join(words)} ended with {process.returncode}:\n{(home / 'log').read_text(encoding='utf-8')[-3000:]}"
        )
    return Cost(time.perf_counter() - start, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 2**10)


def rhmc(home: Path, *words: str) -> Cost:
    """A command of the program."""
    return command(["-m", "pipelines.cli.main", *words], home)


def launch(file: Path, home: Path, until: int) -> Cost:
    """A launch with simulated trials."""
    out = home / "report.json"
    words = [__file__, "--drive", str(file), "--until", str(until), "--out", str(out)]
    cost = command(words, home, (130,) if until else (0,))
    report = json.loads(out.read_text(encoding="utf-8"))
    return Cost(cost.wall, report["exit"][1], report["memory"], report)  # without Ray's processes and workers


# Pages


@contextmanager
def server(home: Path) -> Iterator[tuple[str, Callable[[], float]]]:
    """`rhmc ui`: its address, and the MiB that its processes hold."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"http://127.0.0.1:{port}"
    words = [sys.executable, "-W", "ignore", "-m", "pipelines.cli.main", "ui", "--port", str(port)]
    with (home / "log").open("w", encoding="utf-8") as log:
        process = subprocess.Popen(words, cwd=ROOT, env=environment(home), stdout=log, stderr=log)
    try:
        while process.poll() is None:
            with suppress(OSError), urllib.request.urlopen(f"{address}/health", timeout=10):
                break
            time.sleep(0.1)
        family = psutil.Process(process.pid)
        yield address, lambda: sum(p.memory_info().rss for p in family.children(recursive=True)) / 2**20
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait()


def ask(url: str, body: dict[str, Any] | None = None) -> tuple[float, float, Any]:
    """The quickest of some answers in seconds, its MiB, and what it says."""
    best = float("inf")
    for _ in range(REPEATS):
        data = json.dumps(body).encode() if body else None
        request = urllib.request.Request(url, data, {"Content-Type": "application/json"})
        start = time.perf_counter()
        with urllib.request.urlopen(request, timeout=300) as answer:
            content = answer.read()
        best = min(best, time.perf_counter() - start)
    return best, len(content) / 2**20, json.loads(content)


def pages(home: Path) -> Iterator[tuple[str, float, float]]:
    """The requests of MLflow's pages: seconds and MiB of each answer."""
    with server(home) as (address, memory):
        api = f"{address}/ajax-api/2.0/mlflow"
        *cost, found = ask(f"{api}/experiments/search?max_results=25")
        yield "list of experiments", cost[0], cost[1]
        (experiment,) = [e["experiment_id"] for e in found["experiments"] if e["name"].startswith("many")]
        search = {"experiment_ids": [experiment], "run_view_type": "ACTIVE_ONLY", "max_results": PAGE}
        search |= {"filter": "tags.role = 'run'"}
        *cost, _ = ask(f"{api}/runs/search", search)
        yield f"{PAGE} runs, newest first", cost[0], cost[1]
        best = search | {"order_by": ["metrics.`final/return` DESC"]}
        *cost, found = ask(f"{api}/runs/search", best)
        yield f"{PAGE} runs, best first (our views)", cost[0], cost[1]
        *cost, _ = ask(f"{api}/runs/search", best | {"page_token": found["next_page_token"]})
        yield f"the next {PAGE}", cost[0], cost[1]
        some = search | {"filter": "tags.role = 'run' and params.`algo.gamma` = '0.95'"}
        *cost, _ = ask(f"{api}/runs/search", some)
        yield "a filter by a param", cost[0], cost[1]
        runs = [("run_ids", run["info"]["run_id"]) for run in found["runs"]]
        query = urllib.parse.urlencode([*runs, ("metric_key", "return"), ("max_results", "320")])
        *cost, _ = ask(f"{api}/metrics/get-history-bulk-interval?{query}")
        yield f"a chart: one metric of {PAGE} runs", cost[0], cost[1]
        *cost, _ = ask(f"{api}/runs/get?run_id={runs[0][1]}")
        yield "the page of one run", cost[0], cost[1]
        yield "memory of the server, MiB", memory(), 0.0


# Tables

PER_RUN = ("begin a run", "log its points", "register its policy", "finish it")
Column = dict[str, str]  # what -> figures


def seconds(cost: Cost) -> str:
    """Of a command."""
    return f"{cost.cpu:.1f} ({cost.wall:.1f}), {cost.memory:,.0f} MiB"


def of_launch(cost: Cost, name: str) -> Column:
    """The output of a launch."""
    assert cost.report is not None
    report, column = cost.report, {f"{name}: whole": seconds(cost)}
    wall, cpu = report["marks"]["first trial"]
    column[f"{name}: until the first trial"] = f"{cpu:.1f} ({wall:.1f})"
    for label in ("plan", "open the log", "read what is there", "start Ray", "summary"):
        times, wall, cpu = report["parts"].get(label, (0, 0.0, 0.0))
        column[f"{name}: {label}"] = f"{cpu:.1f} ({wall:.1f})"
    ends = report["ends"]
    cpu = (ends[-1][1] - ends[0][1]) / max(1, len(ends) - 1)
    column[f"{name}: a run, whole"] = f"{1e3 * cpu:.0f} ms"
    for label in PER_RUN:
        column[f"{name}: a run, {label}"] = f"{1e3 * report['parts'][label][2] / len(ends):.0f} ms"
    times, wall, cpu = report["parts"]["overview"]
    column[f"{name}: overview, each (at most one in 30 s)"] = f"{1e3 * cpu / times:.0f} ms"
    return column


def measure(runs: int, points: int, until: int, home: Path) -> Column:
    """Everything for one number of runs."""
    file = write_study(home, runs, points)
    column = {"`study check`": seconds(rhmc(home, "study", "check", str(file)))}
    column |= of_launch(launch(file, home, until), "first launch")
    filled = fill(file, home, leave=until)
    column["runs copied into the database"] = f"{filled:,}"
    column["database"] = f"{(home / 'mlflow.db').stat().st_size / 2**20:,.0f} MiB"
    column["`study status`"] = seconds(rhmc(home, "study", "status", str(file)))
    column |= of_launch(launch(file, home, 0), "last launch")
    column["`rhmc export`"] = seconds(rhmc(home, "export", str(file), "--out", str(home / "out")))
    for what, spent, size in pages(home):
        column[f"page: {what}"] = f"{spent:.2f} s, {size:.1f} MiB" if size else f"{spent:,.0f}"
    return column


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, nargs="+", default=[1000, 10_000], help="thousands (default: 1000 10000)")
    parser.add_argument("--points", type=int, default=10, help="of each curve after the first (default: 10)")
    parser.add_argument("--until", type=int, default=20, help="runs that each launch finishes (default: 20)")
    parser.add_argument("--drive", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.drive:
        drive(args.drive, args.until, args.out)
        return
    columns = []
    for runs in args.runs:
        with tempfile.TemporaryDirectory() as folder:
            columns.append(measure(runs, args.points, args.until, Path(folder)))
    print(f"{env_speed.machine()} {os.cpu_count()} cores. {args.points + 1} points of {len(MADE_UP)} metrics a run.\n")
    print("Processor seconds (seconds on the clock), peak memory of the process.\n")
    print(f"| | {' | '.join(f'{runs:,} runs' for runs in args.runs)} |\n|---|{'---:|' * len(args.runs)}")
    for what in columns[0]:
        print(f"| {what} | {' | '.join(column[what] for column in columns)} |")


if __name__ == "__main__":
    main()
