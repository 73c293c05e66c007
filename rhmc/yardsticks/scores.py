"""Scores of the yardsticks of a task, policies and bounds, all on the same evaluation episodes."""

import math
from collections.abc import Iterator, Sequence
from functools import partial

import torch
from torch import Generator, Tensor

from rhmc.envs import ENVS, EnvConfig, coverage
from rhmc.envs.base import Outcome
from rhmc.yardsticks import BOUNDS, POLICIES, offered

CHUNK = 200  # episodes at once; bounds the planner's memory. Another value draws other episodes
SLOW = ("planner",)  # left out unless asked for


def names(kind: str) -> list[str]:
    """All yardsticks of a task; none of one that offers none."""
    return [*POLICIES.get(kind, {}), *BOUNDS.get(kind, {})]


def play_yardsticks(
    env_cfg: EnvConfig, policies: Sequence[str] | None = None, episodes: int = 1000, seed: int = 0
) -> dict[str, dict[str, float]]:
    """Score policies and bounds by name. Starts and target motion are the same for all of them.

    Args:
        env_cfg: the task.
        policies: of `names(env_cfg.kind)`; all but `SLOW` if None.
        episodes: 2 or more, as a standard error is taken over them.
        seed: of the episodes; the policies' own draws have a generator of their own.

    Returns:
        For coverage, in percent: `coverage`, its standard error `sem` over episodes, `return` (mean reward per step).
        A bound has no `return` where the reward is local. For navigation: `return` (sum over an episode), its `sem`,
        `landmarks_covered` (share at the end of an episode) and `collisions` (ordered pairs, sum over an episode).
        For another task: the means of its `summary`, and the `sem` of the measure that it offers as its score.

    Raises:
        ValueError: an unknown name, or fewer than two episodes.
    """
    kind = env_cfg.kind
    chosen = [n for n in names(kind) if n not in SLOW] if policies is None else list(policies)
    unknown = [n for n in chosen if n not in names(kind)]
    if unknown:
        raise ValueError(f"policies: {kind} has no {', '.join(unknown)}; there are {', '.join(names(kind))}")
    if episodes < 2:
        raise ValueError(f"episodes: at least 2 are needed for a standard error, not {episodes}")
    summary = {"coverage": _coverage, "navigation": _navigation}.get(kind, partial(_summarised, env_cfg))
    return {name: summary(_episodes(env_cfg, name, episodes, seed)) for name in chosen}


def _coverage(logs: dict[str, Tensor]) -> dict[str, float]:
    coverage = 100 * logs["coverage"].mean(1)
    score = {"coverage": coverage.mean().item(), "sem": _sem(coverage)}
    if "reward" in logs:
        score["return"] = 100 * logs["reward"].mean().item()
    return score


def _navigation(logs: dict[str, Tensor]) -> dict[str, float]:
    total = logs["reward"].sum(1)
    return {
        "return": total.mean().item(),
        "sem": _sem(total),
        "landmarks_covered": logs["landmarks_covered"][:, -1].mean().item(),
        "collisions": logs["collisions"].sum(1).mean().item(),
    }


def _summarised(cfg: EnvConfig, logs: dict[str, Tensor]) -> dict[str, float]:
    """The task's own summary of each episode, as training logs it."""
    info = {name: values.T for name, values in logs.items() if name != "reward"}
    found = ENVS[cfg.kind].physics.summary(cfg, logs["reward"].T, info)
    return {name: values.mean().item() for name, values in found.items()} | {
        "sem": _sem(found[offered(cfg.kind).score])
    }


def _sem(values: Tensor) -> float:
    return values.std().item() / math.sqrt(len(values))


def _episodes(cfg: EnvConfig, name: str, episodes: int, seed: int) -> dict[str, Tensor]:
    """Logs of a yardstick over the episodes: (episodes, steps) each."""
    world = Generator().manual_seed(seed)
    own = Generator().manual_seed(seed)
    run = _bound if name in BOUNDS.get(cfg.kind, {}) else _policy
    chunks = []
    for start in range(0, episodes, CHUNK):
        steps = list(run(cfg, name, min(CHUNK, episodes - start), world, own))
        chunks.append({key: torch.stack([s[key] for s in steps], 1) for key in steps[0]})
    return {key: torch.cat([c[key] for c in chunks]) for key in chunks[0]}


def _policy(cfg: EnvConfig, name: str, batch: int, world: Generator, own: Generator) -> Iterator[dict[str, Tensor]]:
    """The logged values of each step, one episode per row."""
    physics, act = ENVS[cfg.kind].physics, POLICIES[cfg.kind][name]
    state = physics.initial(cfg, batch, world)
    for _ in range(physics.spec(cfg).episode):
        action = act(cfg, state, own)
        state = physics.transition(cfg, state, action, world)
        out: Outcome = physics.outcome(cfg, state, action, None)
        yield {"reward": out.reward, **out.info}


def _bound(cfg: EnvConfig, name: str, batch: int, world: Generator, own: Generator) -> Iterator[dict[str, Tensor]]:
    """The same for a bound: its value in each state on the way (which no action of the sensors' changes)."""
    physics, score = ENVS[cfg.kind].physics, BOUNDS[cfg.kind][name]
    state = physics.initial(cfg, batch, world)
    hold = POLICIES[cfg.kind]["hold"](cfg, state, own)
    for _ in range(physics.spec(cfg).episode):
        state = physics.transition(cfg, state, hold, world)
        seen = score(cfg, state)
        yield {"coverage": seen, **_global_reward(cfg, seen)}


def _global_reward(cfg: EnvConfig, seen: Tensor) -> dict[str, Tensor]:
    if not isinstance(cfg, coverage.Config) or cfg.preset == "executor":
        return {}
    return {"reward": torch.where(seen > 0, seen, -cfg.penalty)}
