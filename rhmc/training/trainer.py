"""Training as an iterator of metrics on a fixed grid of steps; its state is a checkpoint."""

from typing import Any, Self

import torch
from pydantic import Field
from torch import Tensor

from rhmc.algorithms import ALGORITHMS
from rhmc.envs import EnvConfig, make_env
from rhmc.learning.initial import started
from rhmc.learning.schedules import linear
from rhmc.training.evaluation import evaluate
from rhmc.types import Batch, Frozen, Metrics, State, Transition


class Config(Frozen):
    """Budget and evaluation of a run; all steps are environment steps, summed over the parallel copies."""

    steps: int = Field(5_000_000, ge=1, description="budget: environment steps of the run")
    num_envs: int = Field(128, ge=1, description="parallel copies; part of a run's identity, trajectories depend on it")
    bootstrap_on_truncation: bool = Field(
        True, description="for every method, the time limit is a truncation (bootstrap); false: a termination"
    )
    final_lr_fraction: float = Field(
        1.0, ge=0, le=1, description="share of every step size that is left at the end of the budget (linear)"
    )
    evaluations: int = Field(100, ge=1, description="points of the curve after the one at step 0")
    eval_episodes: int = Field(100, ge=1, description="evaluation episodes of each point of the curve")
    final_episodes: int = Field(500, ge=1, description="evaluation episodes after the last point")
    eval_seed: int = Field(10_000_000, ge=0, description="names the evaluation episodes")
    device: str = Field("cpu", description="device of networks and environments: cpu, cuda or cuda:N")
    threads: int = Field(1, ge=1, description="torch threads; results of larger layers depend on it")
    init: str | None = Field(
        None,
        pattern=r"^[0-9a-f]{16}$",
        exclude_if=lambda digest: digest is None,
        description="policy whose networks the run starts from: a study gives a file, a folder, runs:/ID or "
        "models:/NAME/VERSION, a run keeps the digest of what it took over",
    )


class Trainer:
    """Iterator: each `next` trains to the next point of the grid, evaluates and returns metrics.

    The first item is the untrained policy at step 0, or that of `start_from`, which `cfg.init` asks for. The last one
    holds `final/...` from more episodes.

    Args:
        env: the task.
        algo: the method, one of the configurations in `ALGORITHMS`.
        cfg: budget and evaluation.
        seed: decides everything random in training.

    Raises:
        ValueError: the method cannot act in the task.
    """

    def __init__(self, env: EnvConfig, algo: Any, cfg: Config, seed: int) -> None:
        torch.set_num_threads(cfg.threads)
        self.cfg, self.env_cfg, device = cfg, env, cfg.device
        streams = [torch.Generator(device).manual_seed(4 * seed + k) for k in range(3)]
        env_rng, self.act_rng, learn_rng = streams
        self.env = make_env(env, cfg.num_envs, env_rng)
        if fault := misfit(env, algo):
            raise ValueError(fault)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(4 * seed + 3)
            self.algorithm = ALGORITHMS[algo.kind].build(algo, self.env.spec, cfg.num_envs, learn_rng)
        self.obs = self.env.reset()
        self.carry = self.algorithm.carry(cfg.num_envs)
        self.step = 0
        self.point = -1  # last finished point of the grid
        self.waits = cfg.init is not None  # for the policy that it starts from

    @property
    def done(self) -> bool:
        """True once the budget is spent and evaluated."""
        return self.point >= self.cfg.evaluations

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Metrics:
        if self.done:
            raise StopIteration
        if self.waits:
            raise ValueError(f"init: the run starts from policy {self.cfg.init}; give it to start_from first")
        self.point += 1
        metrics = self._train(grid_step(self.cfg, self.point))
        played = evaluate(self.algorithm, self.env_cfg, self.cfg.eval_episodes, self.cfg.eval_seed, self.cfg.device)
        metrics |= played.means("eval")
        if self.done:
            seed = self.cfg.eval_seed + 5_000_000
            played = evaluate(self.algorithm, self.env_cfg, self.cfg.final_episodes, seed, self.cfg.device)
            metrics |= played.means("final")
        return {"step": float(self.step)} | metrics

    def start_from(self, policy: State) -> None:
        """Take over the networks and statistics in a method's state (`rhmc.learning.initial`), before the first point.

        Raises:
            ValueError: the run has begun, or they do not fit.
        """
        if self.point >= 0:
            raise ValueError(f"init: the run is at step {self.step:,}; a policy is where it starts from")
        self.algorithm.load_state_dict(started(self.algorithm.state_dict(), policy))
        self.waits = False

    def _train(self, until: int) -> Metrics:
        means = Means()
        while self.step < until:
            means.add({"reward": self._act()})
            left = linear(1.0, self.cfg.final_lr_fraction, self.cfg.steps, self.step)
            for learner in self.algorithm.learners():
                learner.anneal(left)
            means.add(self.algorithm.update())
            self.step += self.cfg.num_envs
        return {f"train/{key}": value for key, value in means.result().items()}

    @torch.no_grad()
    def _act(self) -> Tensor:
        obs = self.obs
        action, self.carry, extra = self.algorithm.act(obs, self.carry, self.act_rng, explore=True)
        options = self.env.options()
        step = self.env.step(action, extra.get("assignment"))
        terminated = step.terminated if self.cfg.bootstrap_on_truncation else step.terminated | step.truncated
        self.algorithm.observe(
            Transition(
                obs,
                action,
                step.reward,
                step.local,
                step.completed,
                terminated,
                step.truncated,
                step.final_obs,
                options,
                extra,
            )
        )
        self.obs = step.obs
        return step.reward.mean()

    def state_dict(self) -> State:
        """The whole run between two points of the grid."""
        return {
            "env": self.env.state_dict(),
            "act_rng": self.act_rng.get_state(),
            "algorithm": self.algorithm.state_dict(),
            "obs": self.obs._asdict(),
            "carry": self.carry,
            "step": self.step,
            "point": self.point,
        }

    def load_state_dict(self, state: State) -> None:
        """Continue from `state_dict`, bit for bit."""
        device = self.cfg.device
        self.env.load_state_dict(state["env"])
        self.act_rng.set_state(state["act_rng"].cpu())
        self.algorithm.load_state_dict(state["algorithm"])
        self.obs = type(self.obs)(**{k: v.to(device) for k, v in state["obs"].items()})
        self.carry = {k: v.to(device) for k, v in state["carry"].items()}
        self.step, self.point = state["step"], state["point"]
        self.waits = False


class Means:
    """Running means of scalar tensors, left on their device until asked for."""

    def __init__(self) -> None:
        self.sums: Batch = {}
        self.counts: dict[str, int] = {}

    def add(self, values: Batch) -> None:
        """Count in one more value of each key."""
        for key, value in values.items():
            self.sums[key] = self.sums[key] + value.detach() if key in self.sums else value.detach()
            self.counts[key] = self.counts.get(key, 0) + 1

    def result(self) -> Metrics:
        """The mean of each key."""
        return {key: float(value) / self.counts[key] for key, value in self.sums.items()}


def misfit(env: EnvConfig, algo: Any) -> str:
    """Reason that the method cannot act in the task; empty if it can."""
    if getattr(env, "continuous", False) and "continuous" not in ALGORITHMS[algo.kind].about.actions:
        return f"continuous: '{algo.kind}' chooses among discrete actions; allowed: false"
    return ""


def grid_step(cfg: Config, point: int) -> int:
    """Environment steps at a point of the evaluation grid: 0 at point 0, at least `steps` at the last.

    Always a multiple of `num_envs`.
    """
    wanted = -(-cfg.steps * point // cfg.evaluations)
    return -(-wanted // cfg.num_envs) * cfg.num_envs
