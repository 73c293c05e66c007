"""Environment steps per second on one core, beside the `mpe2` package in the same run. Prints a Markdown table.

A step is one step of one copy: a batch of 256 counts 256. Actions are drawn before the clock starts; resets at the end
of an episode are part of what is timed.
"""

import argparse
import platform
import statistics
import time
from collections.abc import Callable
from itertools import cycle
from pathlib import Path

import numpy as np
import torch
from mpe2 import simple_spread_v3

from rhmc.envs import EnvConfig, coverage, make_env, navigation

BATCHES = (1, 256, 1024, 4096)
PEER = "mpe2 simple_spread_v3"
TASKS: dict[str, EnvConfig] = {
    "coverage, observation paper": coverage.Config(),
    "coverage, observation extended": coverage.Config(observation="extended"),
    "navigation, observation paper": navigation.Config(),
    "navigation, observation extended": navigation.Config(observation="extended"),
}


def rate(step: Callable[[], int], seconds: float, repeats: int = 3) -> float:
    """Median steps per CPU second of this process over `repeats` spans of `seconds`, after a warm-up of a tenth.

    `step` advances and returns how many steps that was.
    """
    _span(step, seconds / 10)
    return statistics.median(_span(step, seconds) for _ in range(repeats))


def _span(step: Callable[[], int], seconds: float) -> float:
    count, start = 0, time.process_time()
    while (spent := time.process_time() - start) < seconds or not count:
        count += step()
    return count / spent


def batched(cfg: EnvConfig, batch: int) -> Callable[[], int]:
    """Random play in `batch` copies of the project's environment."""
    rng = torch.Generator().manual_seed(0)
    env = make_env(cfg, batch, rng)
    env.reset()
    actions = cycle(list(torch.randint(env.spec.actions, (32, batch, env.spec.agents), generator=rng)))

    def step() -> int:
        env.step(next(actions))
        return batch

    return step


def peer(agents: int) -> Callable[[], int]:
    """Random play in `mpe2`'s parallel environment, reset after 25 steps as in `navigation`."""
    env = simple_spread_v3.parallel_env(N=agents, max_cycles=25)
    env.reset(seed=0)
    names = list(env.possible_agents)
    drawn = np.random.default_rng(0).integers(5, size=(32, agents))
    actions = cycle([dict(zip(names, map(int, row), strict=True)) for row in drawn])

    def step() -> int:
        env.step(next(actions))
        if not env.agents:
            env.reset()
        return 1

    return step


def machine() -> str:
    """Which machine and versions the figures belong to, one line."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    cpu = names[0] if names else platform.machine()
    return f"One core of {cpu}, Python {platform.python_version()}, torch {torch.__version__}."


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=0.5, help="CPU seconds of each of three spans")
    seconds = parser.parse_args().seconds
    torch.set_num_threads(1)
    base = rate(peer(agents=3), seconds)
    print(f"{machine()} Environment steps per CPU second, median of three, random actions.\n")
    print(f"| environment | batch | steps/s | times {PEER} |\n|---|---:|---:|---:|")
    print(f"| {PEER}, 3 agents | 1 | {base:,.0f} | 1.0 |", flush=True)
    for name, cfg in TASKS.items():
        for batch in BATCHES:
            speed = rate(batched(cfg, batch), seconds)
            print(f"| {name} | {batch} | {speed:,.0f} | {speed / base:,.1f} |", flush=True)


if __name__ == "__main__":
    main()
