"""PPO of Stable-Baselines3 on the coverage task through PettingZoo, beside this project's IPPO. Prints Markdown.

Coverage `flat`, 4 x 5, `extended` observation as a vector, one policy for all agents, two hidden layers of 64 (`mlp`
here), the same discount, rollout, epochs and rows an update on both sides; what else differs is each library's own.
`--figure FILE` draws both curves. Needs `pip install stable-baselines3`, which is no dependency of the project.
"""

import argparse
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from matplotlib import pyplot as plt
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from rhmc.algorithms import ALGORITHMS
from rhmc.envs import coverage
from rhmc.envs.pettingzoo import ParallelTask, parallel_env
from rhmc.training.trainer import Config, Trainer

TASK: dict[str, Any] = {"agents": 4, "targets": 5, "preset": "flat", "observation": "extended"}
COPIES, STEPS, EPOCHS, MINIBATCHES = 16, 64, 5, 4  # of a rollout: copies, steps of each
GAMMA, LAMBDA, LR, ENTROPY = 0.95, 0.95, 1e-3, 0.01
EPISODES, EVAL_SEED = 50, 10_000_000
OURS, PEER = "IPPO of this project", "PPO of Stable-Baselines3"


class Point(NamedTuple):
    """A point of a curve: environment steps, processor seconds until then, greedy return (100 x mean reward)."""

    method: str
    seed: int
    step: int
    seconds: float
    value: float


class AgentRows(VecEnv):
    """Every agent of several parallel environments as a row of its own, as libraries without agents expect."""

    def __init__(self, copies: list[ParallelTask]) -> None:
        self.copies = copies
        agent = copies[0].possible_agents[0]
        rows = len(copies) * len(copies[0].possible_agents)
        super().__init__(rows, copies[0].observation_space(agent), copies[0].action_space(agent))

    def reset(self) -> np.ndarray:
        """(rows, F)."""
        return np.concatenate([_stacked(copy.reset()[0]) for copy in self.copies])

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions (rows,)."""
        self.kept = actions.reshape(len(self.copies), -1)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations, rewards, ends and infos of every row; what ended has begun anew."""
        seen: list[np.ndarray] = []
        rewards: list[float] = []
        ends: list[bool] = []
        infos: list[dict[str, Any]] = []
        for copy, row in zip(self.copies, self.kept, strict=True):
            obs, reward, _, truncated, _ = copy.step(dict(zip(copy.agents, row, strict=True)))
            last = _stacked(obs)
            end = any(truncated.values())
            seen.append(_stacked(copy.reset()[0]) if end else last)
            rewards += reward.values()
            ends += [end] * len(reward)
            infos += [{"TimeLimit.truncated": True, "terminal_observation": x} if end else {} for x in last]
        return np.concatenate(seen), np.array(rewards, np.float32), np.array(ends), infos

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Of every row."""
        return [getattr(self, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not offered."""
        raise NotImplementedError(attr_name)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Not offered."""
        raise NotImplementedError(method_name)

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No row is."""
        return [False] * self.num_envs


class Curve(BaseCallback):
    """Evaluates every so many environment steps; evaluation takes none of the seconds."""

    def __init__(self, seed: int, every: int) -> None:
        super().__init__()
        self.seed, self.every, self.points = seed, every, list[Point]()
        self.began, self.paused = time.process_time(), 0.0

    def _on_step(self) -> bool:
        step = self.num_timesteps // TASK["agents"]
        if step >= len(self.points) * self.every:
            self.evaluate(step)
        return True

    def _on_training_end(self) -> None:
        self.evaluate(self.num_timesteps // TASK["agents"])

    def evaluate(self, step: int) -> None:
        """Add a point."""
        start = time.process_time()
        value = played(self.model)
        self.points.append(Point(PEER, self.seed, step, start - self.began - self.paused, value))
        self.paused += time.process_time() - start


def played(model: PPO) -> float:
    """Greedy return of the peer's policy: 100 x mean reward over the evaluation episodes."""
    copies = [parallel_env("coverage", **TASK) for _ in range(EPISODES)]
    seen = [_stacked(copy.reset(seed=EVAL_SEED + i)[0]) for i, copy in enumerate(copies)]
    total = 0.0
    for _ in range(copies[0].spec.episode):
        actions, _ = model.predict(np.concatenate(seen), deterministic=True)
        for i, (copy, row) in enumerate(zip(copies, actions.reshape(EPISODES, -1), strict=True)):
            obs, rewards, _, _, _ = copy.step(dict(zip(copy.agents, row, strict=True)))
            seen[i] = _stacked(obs)
            total += rewards[copy.possible_agents[0]]
    return 100 * total / EPISODES / copies[0].spec.episode


def peer(seed: int, steps: int, points: int) -> list[Point]:
    """The peer's curve."""
    copies = [parallel_env("coverage", **TASK) for _ in range(COPIES)]
    for i, copy in enumerate(copies):
        copy.reset(seed=1000 * seed + i)
    net = {"net_arch": [64, 64], "activation_fn": torch.nn.ReLU}
    rows = COPIES * STEPS * TASK["agents"] // MINIBATCHES
    numbers = {"n_steps": STEPS, "batch_size": rows, "n_epochs": EPOCHS, "gamma": GAMMA, "gae_lambda": LAMBDA}
    model = PPO(
        "MlpPolicy", AgentRows(copies), LR, **numbers, ent_coef=ENTROPY, policy_kwargs=net, seed=seed, device="cpu"
    )
    curve = Curve(seed, steps // points)
    model.learn(steps * TASK["agents"], callback=curve)
    return curve.points


def ours(seed: int, steps: int, points: int) -> list[Point]:
    """The curve of IPPO with the same numbers."""
    block = {"gamma": GAMMA, "gae_lambda": LAMBDA, "lr": LR, "ent_coef": ENTROPY, "n_steps": STEPS}
    algo = ALGORITHMS["ippo"].config(encoder="mlp", epochs=EPOCHS, minibatches=MINIBATCHES, **block)
    cfg = Config(steps=steps, num_envs=COPIES, evaluations=points, eval_episodes=EPISODES, final_episodes=1)
    trainer, found, seconds, start = Trainer(coverage.Config(**TASK), algo, cfg, seed), [], 0.0, time.process_time()
    for metrics in trainer:
        seconds = time.process_time() - start
        found.append(Point(OURS, seed, int(metrics["step"]), seconds, metrics["eval/return"]))
    return found


def draw(table: pd.DataFrame, file: Path) -> None:
    """Both curves against steps, a line a seed."""
    figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
    for (method, colour), style in zip({OURS: "#0072B2", PEER: "#D55E00"}.items(), ("-", "--"), strict=True):
        for i, (_, one) in enumerate(table[table["method"] == method].groupby("seed")):
            axes.plot(one["step"], one["value"], style, color=colour, label=method if i == 0 else None)
    axes.set(xlabel="Environment steps", ylabel="Greedy return (100 × mean reward)")
    axes.legend(frameon=False)
    figure.savefig(file, dpi=110, metadata={"Software": None})


def _stacked(by_agent: dict[str, Any]) -> np.ndarray:
    return np.stack(list(by_agent.values()))


def main() -> None:
    """Read the options, train, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=300_000, help="environment steps of each run")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--points", type=int, default=15, help="points of each curve")
    parser.add_argument("--figure", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    runs = [curve(seed, args.steps, args.points) for seed in range(args.seeds) for curve in (ours, peer)]
    table = pd.DataFrame([point for run in runs for point in run])
    last = table.groupby(["method", "seed"], sort=False).last().reset_index()
    print("| method | seed | steps | processor seconds | return |\n|---|---:|---:|---:|---:|")
    for row in last.itertuples():
        print(f"| {row.method} | {row.seed} | {row.step:,} | {row.seconds:.0f} | {row.value:.1f} |")
    if args.figure:
        draw(table, args.figure)


if __name__ == "__main__":
    main()
