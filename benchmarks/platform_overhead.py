"""The cost of Ray, MLflow and checkpoints: the same trainings in a bare loop and through `rhmc study run`.

Bare: a loop over `rhmc.training.trainer.Trainer` in plain processes, two at a time; no Ray, no log, no checkpoint. Both
sides train the arms `full` and `no filter` of studies/ablation.yaml with two seeds each, bare and platform in turn, and
must end with the same returns. Prints Markdown.

Seconds of processor time come from the processes themselves, those of Ray's own processes from looking at them once a
second. Evaluation is part of training. The parts of a launch are timed where they happen, inside one launch: where
other work disturbs the machine, they are more exact than the difference between two launches.
"""

import argparse
import json
import multiprocessing
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from statistics import median
from typing import Any

import env_speed
import psutil

import rhmc.training.evaluation
import rhmc.training.trainer
from pipelines.execution.ray_settings import set_up_ray
from pipelines.execution.trainable import RunTrainable
from pipelines.specs.study import Resources, RunSpec, Study

ROOT = Path(__file__).parents[1]
STUDY = Path("studies") / "ablation.yaml"
RUNS, CONCURRENT = 4, 2
RATE = 3_500  # environment steps that one run trains a second, evaluation included: only says how long a study to make
Spent = dict[str, list[float]]  # label -> times, wall seconds, processor seconds
WORKERS = ("training", "evaluation", "build", "checkpoint", "end of training", "animation")
PARTS = {  # label -> where it is done, and what it grows with
    "import": ("driver", "launches"),
    "make the database": ("driver", "work folders"),
    "open the log": ("driver", "launches"),
    "start Ray": ("driver", "launches"),
    "stop Ray": ("driver", "launches"),
    "overview": ("driver", "launches; at most one in 30 s"),
    "begin a run": ("driver", "runs"),
    "end a run": ("driver", "runs"),
    "register the policy": ("driver", "runs"),
    "build": ("worker", "runs"),
    "end of training": ("worker", "runs"),
    "animation": ("worker", "arms"),
    "checkpoint": ("worker", f"points / {Resources().checkpoint_every}"),
    "log a point": ("driver", "points"),
    "Tune": ("driver", "points"),
    "evaluation": ("worker, part of training", "points"),
}


class Stopwatch:
    """Times, wall seconds and processor seconds of the calling thread by label; what is timed inside is left out."""

    def __init__(self) -> None:
        self.spent: Spent = {}
        self.inside = [[0.0, 0.0]]  # wall and processor seconds of what was timed inside each open label

    @contextmanager
    def time(self, label: str) -> Iterator[None]:
        """Count what happens inside under the label."""
        self.inside.append([0.0, 0.0])
        wall, cpu = time.perf_counter(), time.thread_time()
        try:
            yield
        finally:
            whole = time.perf_counter() - wall, time.thread_time() - cpu
            inner = self.inside.pop()
            entry = self.spent.setdefault(label, [0, 0.0, 0.0])
            entry[0] += 1
            for i in range(2):
                entry[i + 1] += whole[i] - inner[i]
                self.inside[-1][i] += whole[i]

    def watch(self, owner: Any, name: str, label: str) -> None:
        """Time every call of a function from now on."""
        function: Callable[..., Any] = getattr(owner, name)

        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.time(label):
                return function(*args, **kwargs)

        setattr(owner, name, timed)


def watch_evaluation(watch: Stopwatch) -> None:
    """Time evaluations apart from the training they are part of; by this stopwatch alone."""
    rhmc.training.trainer.evaluate = rhmc.training.evaluation.evaluate
    watch.watch(rhmc.training.trainer, "evaluate", "evaluation")


# Bare


def train(spec: str) -> dict[str, Any]:
    """One training in a loop; what a worker of the pool does."""
    watch = Stopwatch()
    watch_evaluation(watch)
    run = RunSpec.model_validate_json(spec)
    trainer = rhmc.training.trainer.Trainer(run.env, run.algo, run.trainer, run.seed)
    began, last = time.time(), {}
    while not trainer.done:
        with watch.time("training"):
            last = next(trainer)
    ended = {"began": began, "ended": time.time(), "final": last["final/return"]}
    return ended | {"spent": watch.spent, "pid": os.getpid(), "cpu": time.process_time()}


def bare(changes: list[str], out: Path) -> None:
    """Every run of the study, two at a time."""
    study = Study.load(STUDY, "quick", changes)
    with ProcessPoolExecutor(CONCURRENT, multiprocessing.get_context("spawn")) as pool:
        runs = list(pool.map(train, [run.spec.canonical() for run in study.runs()]))
    out.write_text(json.dumps({"runs": runs, "driver": time.process_time(), "parts": {}}), encoding="utf-8")


# The platform


class Timed(RunTrainable):
    """A worker that says what it did with its time. Ray gets it by value, and with it the stopwatch."""

    def setup(self, config: dict[str, Any]) -> None:
        """Start the clocks of a run."""
        self.watch, self.began = Stopwatch(), 0.0
        watch_evaluation(self.watch)
        with self.watch.time("build"):
            super().setup(config)

    def _advance(self, trainer: Any) -> None:
        self.began = self.began or time.time()
        with self.watch.time("training"):
            super()._advance(trainer)

    def _save(self, trainer: Any) -> None:
        with self.watch.time("end of training" if trainer.done else "checkpoint"):
            super()._save(trainer)

    def _animate(self, kept: Any) -> None:
        with self.watch.time("animation"):
            super()._animate(kept)

    def step(self) -> dict[str, Any]:
        """The result and the clocks."""
        result = super().step()
        clocks = {"began": self.began, "ended": time.time(), "spent": self.watch.spent}
        return result | {"clocks": clocks | {"pid": os.getpid(), "cpu": time.process_time()}}


def platform(changes: list[str], out: Path) -> None:
    """`rhmc study run`, with clocks in it."""
    start = time.perf_counter()
    import ray
    from ray import tune

    from pipelines.cli import main as cli
    from pipelines.execution import ray_driver, recorder
    from pipelines.tracking import mlflow_tracker, overview

    watch, runs = Stopwatch(), dict[str, dict[str, Any]]()
    set_up_ray()
    watch.spent["import"] = [1, time.perf_counter() - start, 0.0]
    for owner, name, label in (
        (mlflow_tracker, "create_database", "make the database"),
        (mlflow_tracker.MlflowTracker, "__init__", "open the log"),
        (ray, "init", "start Ray"),
        (ray, "shutdown", "stop Ray"),
        (recorder.Recorder, "start", "begin a run"),
        (mlflow_tracker.MlflowRun, "log", "log a point"),
        (mlflow_tracker.MlflowRun, "model", "register the policy"),
        (recorder.Recorder, "_finish", "end a run"),
        (overview.Overview, "publish", "overview"),
        (tune.Tuner, "fit", "Tune"),
    ):
        watch.watch(owner, name, label)
    record = recorder.Recorder.result

    def noted(self: recorder.Recorder, key: str, result: dict[str, Any]) -> None:
        runs[key] = result["clocks"]
        runs[key]["final"] = next((p["final/return"] for p in result["points"] if "final/return" in p), None)
        record(self, key, result)

    recorder.Recorder.result = noted  # type: ignore[method-assign]
    ray_driver.RunTrainable = Timed  # type: ignore[misc]
    sys.argv = ["rhmc", *command(changes)]
    try:
        cli.main()
    finally:
        report = {"runs": list(runs.values()), "parts": watch.spent, "driver": time.process_time()}
        out.write_text(json.dumps(report), encoding="utf-8")


# Both


def changes(minutes: float) -> list[str]:
    """The overrides that make the study one of four runs of this length."""
    steps = round(60 * minutes / RUNS * RATE)
    profile = "profiles.quick.trainer={final_lr_fraction: 0.05, evaluations: 20, eval_episodes: 100}"  # and not quick's
    return ["profiles.quick.arms=[full, no filter]", profile, f"seeds={RUNS // 2}", f"steps={steps}"]


def command(changes: list[str]) -> list[str]:
    """The arguments that launch it, after `rhmc`."""
    return ["study", "run", str(STUDY), *(word for text in changes for word in ("--set", text))]


def launch(side: str, minutes: float, home: Path) -> dict[str, Any]:
    """Run one side in processes of its own; what it reports, and `wall`, `start`, and `others`: Ray's processes."""
    out = home / "report.json"
    environment = os.environ | {"RHMC_HOME": str(home), "OMP_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = f"{ROOT}{os.pathsep}{ROOT / 'benchmarks'}"
    start = time.time()
    with (home / "log").open("w", encoding="utf-8") as log:
        words = [sys.executable, "-W", "ignore", __file__, "--side", side, "--out", str(out), "--minutes", str(minutes)]
        process = subprocess.Popen(words, cwd=ROOT, env=environment, stdout=log, stderr=log, start_new_session=True)
        seen = look(process)
    if process.returncode or not out.exists():
        sys.exit(f"{side} failed:\n{(home / 'log').read_text(encoding='utf-8')[-3000:]}")
    report: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    known = {run["pid"] for run in report["runs"]} | {process.pid}
    others = sum(cpu for pid, cpu in seen.items() if pid not in known) if side == "platform" else 0.0
    return report | {"start": start, "wall": time.time() - start, "others": others}


def look(process: "subprocess.Popen[bytes]") -> dict[int, float]:
    """Processor seconds of every process of a session when it was last seen, until the first one ends."""
    seen: dict[int, float] = {}
    try:
        while True:
            with suppress(subprocess.TimeoutExpired):
                process.wait(1.0)
                return seen
            for one in session(process.pid):
                with suppress(psutil.Error):
                    times = one.cpu_times()
                    seen[one.pid] = times.user + times.system
    except KeyboardInterrupt:
        for one in session(process.pid):
            with suppress(psutil.Error):
                one.kill()
        process.wait()
        raise


def session(leader: int) -> Iterator[psutil.Process]:
    """The processes that one started, Ray's among them."""
    for one in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            if os.getsid(one.pid) == leader:
                yield one


def add(spent: list[Spent], label: str) -> list[float]:
    """Times, wall and processor seconds of a label over all runs."""
    entries = [one.get(label, [0, 0.0, 0.0]) for one in spent]
    return [sum(values) for values in zip(*entries, strict=True)] or [0, 0.0, 0.0]


class Account:
    """A launch in figures: seconds on the clock, and of processors where it says `cpu`."""

    def __init__(self, report: dict[str, Any]) -> None:
        runs, self.parts = report["runs"], dict(report["parts"])
        for label in WORKERS:
            self.parts[label] = add([run["spent"] for run in runs], label)
        self.wall, self.returns = report["wall"], sorted(run["final"] for run in runs)
        self.training, self.training_cpu = (self.parts["training"][i] + self.parts["evaluation"][i] for i in (1, 2))
        self.before = min(run["began"] for run in runs) - report["start"]
        self.after = report["start"] + report["wall"] - max(run["ended"] for run in runs)
        self.between = self.wall - self.before - self.after - self.training / CONCURRENT
        last = {run["pid"]: run["cpu"] for run in sorted(runs, key=lambda run: float(run["cpu"]))}
        self.cpus = {"the driver": report["driver"], "workers": sum(last.values()), "Ray's own": report["others"]}

    @property
    def over_cpu(self) -> float:
        """Processor seconds that were not training, as a share of training's."""
        return sum(self.cpus.values()) / self.training_cpu - 1

    @property
    def over_wall(self) -> float:
        """Seconds on the clock in which a worker did not train, as a share of those in which it did."""
        return self.wall * CONCURRENT / self.training - 1


HEAD = (
    *("launch", "training s", "of it evaluation", "wall s", "before the first point", "after the last", "between"),
    *("training, CPU s", "the driver, CPU s", "workers, CPU s", "Ray's own, CPU s", "over, wall", "over, CPU"),
)


def line(name: str, a: Account) -> str:
    """A launch as a row under `HEAD`; what is over is so beside training, as a share of it."""
    seconds = [a.training, a.parts["evaluation"][1], a.wall, a.before, a.after, a.between, a.training_cpu]
    cells = [name, *(f"{value:.1f}" for value in (*seconds, *a.cpus.values()))]
    return f"| {' | '.join([*cells, f'{a.over_wall:.1%}', f'{a.over_cpu:.1%}'])} |"


def parts(several: list[Account]) -> str:
    """A table of what the launches through the platform did, medians over them."""
    lines = ["| what | where | grows with | times | ms each | CPU ms each | CPU s in all | of training's CPU |"]
    lines.append("|---|---|---|" + "---:|" * 5)
    for label, (where, grows) in PARTS.items():
        found = [(a.parts[label], a.training_cpu) for a in several if a.parts.get(label, [0])[0]]
        if not found:
            continue
        times, wall, cpu = (median(part[i] for part, _ in found) for i in range(3))
        share = median(part[2] / training for part, training in found)
        each = f"{times:.0f} | {1e3 * wall / times:,.1f} | {1e3 * cpu / times:,.1f} | {cpu:.2f} | {share:.2%}"
        lines.append(f"| {label} | {where} | {grows} | {each} |")
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="of training, all runs together (default: 10)")
    parser.add_argument("--repeats", type=int, default=1, help="launches of each side (default: 1)")
    parser.add_argument(
        "--together", action="store_true", help="both sides at once: whether training itself costs more"
    )
    parser.add_argument("--side", choices=("bare", "platform"), help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.side:
        {"bare": bare, "platform": platform}[args.side](changes(args.minutes), args.out)
        return
    print(f"{env_speed.machine()} {os.cpu_count()} cores.\n\n`rhmc {shlex.join(command(changes(args.minutes)))}`\n")
    if args.together:
        print(together(args.minutes))
        return
    print(f"| {' | '.join(HEAD)} |\n|---{'|---:' * (len(HEAD) - 1)}|", flush=True)
    accounts: dict[str, list[Account]] = {"platform": [], "bare": []}
    with suppress(KeyboardInterrupt):  # what there is by then is shown
        for i in range(args.repeats):
            for side, several in accounts.items():
                with tempfile.TemporaryDirectory() as folder:
                    several.append(Account(launch(side, args.minutes, Path(folder))))
                print(line(f"{side} {i + 1}", several[-1]), flush=True)
    if accounts["platform"]:
        print(f"\n{parts(accounts['platform'])}\n\n{verdict(accounts)}")


def together(minutes: float) -> str:
    """Both sides at once, so that the machine's slow minutes are those of both: seconds of training alone."""

    def account(side: str) -> Account:
        with tempfile.TemporaryDirectory() as folder:
            return Account(launch(side, minutes, Path(folder)))

    os.environ.update({"RAY_worker_niceness": "0"})  # else the other side would go first
    with ThreadPoolExecutor(2) as pool:
        ours, loop = pool.map(account, ("platform", "bare"))
    spent = f"platform {ours.training_cpu:.1f} CPU s, bare {loop.training_cpu:.1f} CPU s"
    return f"Training alone, both sides at once: {spent}, {ours.training_cpu / loop.training_cpu - 1:+.1%}."


def verdict(accounts: dict[str, list[Account]]) -> str:
    """The extra cost of the platform over the loop, at the median, and a check that both learned the same."""
    spent = {side: median(a.over_cpu for a in several) for side, several in accounts.items() if several}
    texts = [f"{side}: {share:.1%} of training's processor seconds" for side, share in spent.items()]
    if len(spent) == 2:
        texts.append(f"the difference, which is the platform: {spent['platform'] - spent['bare']:.1%}")
        over = {side: median(sum(a.cpus.values()) - a.training_cpu for a in accounts[side]) for side in spent}
        texts.append(f"{over['platform']:.1f} s and {over['bare']:.1f} s")
    ends = {tuple(account.returns) for several in accounts.values() for account in several}
    return f"Beside training, {'; '.join(texts)}. Final returns: {'equal' if len(ends) == 1 else f'DIFFERENT, {ends}'}."


if __name__ == "__main__":
    main()
