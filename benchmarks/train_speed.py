"""Training steps per CPU second of every method at its default settings, one torch thread. Prints Markdown.

Beside them, in the same run, `mpe2`'s simple_spread_v3 with three agents and nothing that learns.

`--study FILE` measures the arms of a study instead.

A step is one environment step of one of the parallel copies; acting, storing and learning are timed, evaluation is not:
point 0 of the training grid only evaluates, and its time is taken off the others'. `--profile` then shows where the
time goes, by function of `rhmc` (cProfile) and by tensor operation (torch.profiler).
"""

import argparse
import cProfile
import pstats
import time
from pathlib import Path

import env_speed
from torch.profiler import ProfilerActivity, profile

import rhmc
from pipelines.specs.study import Setting, Study
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import EnvConfig, coverage, navigation
from rhmc.training.trainer import Config, Trainer

SETTINGS = (("paper", "mlp"), ("extended", "pairwise"))  # observation, encoder
TASKS = ("coverage", "navigation")
PACKAGE = Path(rhmc.__file__).parent
PEER_SECONDS = 2.0  # of each of three spans
TOP = 15  # rows of a profile


def task(name: str, observation: str) -> EnvConfig:
    """Four sensors and five targets, or three agents and landmarks."""
    module = {"coverage": coverage, "navigation": navigation}[name]
    return module.Config.model_validate({"observation": observation})


def trainer(name: str, observation: str, encoder: str, kind: str, steps: int) -> Trainer:
    """A method on a grid with `steps` environment steps between points, evaluated on a single episode."""
    algo = ALGORITHMS[kind].config.model_validate({"encoder": encoder})
    cfg = Config(steps=4 * steps, evaluations=4, eval_episodes=1, final_episodes=1)
    return Trainer(task(name, observation), algo, cfg, seed=0)


def arm_trainer(setting: Setting, steps: int) -> Trainer:
    """An arm of a study on the grid of `trainer`."""
    cfg = setting.trainer.model_copy(
        update={"steps": 4 * steps, "evaluations": 4, "eval_episodes": 1, "final_episodes": 1}
    )
    return Trainer(setting.env, setting.algo, cfg, seed=0)


def study_table(file: Path, steps: int, profiled: bool) -> None:
    """Print the rate of every arm, and where the first arm's time goes."""
    arms = Study.load(file).arms
    print("| arm | steps/s |\n|---|---:|")
    for name, setting in arms.items():
        print(f"| {name} | {rate(arm_trainer(setting, steps)):,.0f} |", flush=True)
    if profiled:
        run = arm_trainer(next(iter(arms.values())), steps // 4)
        next(run), next(run)
        print("", functions(run), operations(run), sep="\n\n", flush=True)


def seconds(run: Trainer) -> float:
    """CPU seconds of this process to the next point of the grid."""
    start = time.process_time()
    next(run)
    return time.process_time() - start


def rate(run: Trainer) -> float:
    """Steps per CPU second from the first point of the grid to the second; up to the first is warm-up."""
    evaluation = seconds(run)
    next(run)
    before = run.step
    training = seconds(run) - evaluation
    return (run.step - before) / training


def functions(run: Trainer) -> str:
    """Which functions of `rhmc` the time to the next point went to, callees included."""
    with cProfile.Profile() as profiler:
        next(run)
    table: dict[tuple[str, int, str], tuple[int, int, float, float, object]] = pstats.Stats(profiler).stats  # type: ignore[attr-defined]
    whole = sum(own for _, _, own, _, _ in table.values())
    rows = [
        (total / whole, calls, f"{Path(file).relative_to(PACKAGE)}:{line} {name}")
        for (file, line, name), (_, calls, _, total, _) in table.items()
        if PACKAGE in Path(file).parents
    ]
    lines = [f"| {name} | {calls:,} | {share:.0%} |" for share, calls, name in sorted(rows, reverse=True)[:TOP]]
    return "\n".join(["| function, callees included | calls | share |", "|---|---:|---:|", *lines])


def operations(run: Trainer) -> str:
    """Which tensor operations the time to the next point went to, callees left out."""
    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        next(run)
    events = sorted(profiler.key_averages(), key=lambda e: e.self_cpu_time_total, reverse=True)
    whole = sum(e.self_cpu_time_total for e in events)
    lines = [f"| {e.key} | {e.count:,} | {e.self_cpu_time_total / whole:.0%} |" for e in events[:TOP]]
    return "\n".join(["| operation | calls | share |", "|---|---:|---:|", *lines])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=16_000, help="environment steps that are timed")
    parser.add_argument("--algorithms", nargs="+", default=list(ALGORITHMS), choices=list(ALGORITHMS))
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--study", type=Path, metavar="FILE", help="measure the arms of a study instead")
    parser.add_argument("--profile", action="store_true", help="show where the time goes, with both settings of each")
    args = parser.parse_args()
    cases = [(t, o, e, k) for t in args.tasks for k in args.algorithms for o, e in SETTINGS]
    print(f"{env_speed.machine()} Training steps per CPU second, {args.steps:,} steps after as many for warm-up.\n")
    if args.study:
        study_table(args.study, args.steps, args.profile)
        return
    alone = env_speed.rate(env_speed.peer(3), PEER_SECONDS)
    print("| task | method | observation | encoder | steps/s | times mpe2 alone |\n|---|---|---|---|---:|---:|")
    print(f"| {env_speed.PEER} | none | | | {alone:,.0f} | 1.0 |", flush=True)
    for name, observation, encoder, kind in cases:
        speed = rate(trainer(name, observation, encoder, kind, args.steps))
        print(f"| {name} | {kind} | {observation} | {encoder} | {speed:,.0f} | {speed / alone:.1f} |", flush=True)
    for name, observation, encoder, kind in cases if args.profile else ():
        run = trainer(name, observation, encoder, kind, args.steps // 4)
        next(run), next(run)
        print(f"\n{kind} on {name}, {observation} observation, {encoder} encoder:\n")
        print(functions(run), operations(run), sep="\n\n", flush=True)


if __name__ == "__main__":
    main()
