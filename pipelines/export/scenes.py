"""Figures 4, 5 and 8: states of both tasks as they were played, and an instance of the regulator met on the way;
beside them the smallest instances that Theorem 1 is false on.

What an episode shows is decided by scripted policies and fixed seeds, so the same code draws the same pictures.
"""

from typing import Any, Literal, NamedTuple

import torch
from torch import Generator, Tensor

from rhmc.envs import coverage, navigation
from rhmc.hierarchy.regulation import Charges, Path, algorithm1_path, exact, optimal_path, paper
from rhmc.hierarchy.theorem import smallest_counterexample
from rhmc.yardsticks import POLICIES

Record = dict[str, Any]

SEED = 0
SENSORS = (2, 3, 4, 5, 6)  # Figures 8 and 9
TARGETS = 5
TURNED = 50  # steps before a picture of coverage: sensors have turned to what they found
ALPHA = 0.1
CHARGES = Charges(ALPHA)
HORIZON = 6  # steps that an agent may act: at one step Algorithm 1 has too few options to go wrong
EPISODES, EVERY, LENGTH = 400, 5, 60  # of the search for an instance: how many, a state every so many steps, until then
TOLERANCE = 1e-5  # above rounding; a true gap is a sum of differences of 1/k


class Met(NamedTuple):
    """States of the task with a drawn assignment: (K, N, D, M) and (K, N, M) bool, and Algorithm 1's loss (K,)."""

    options: Tensor
    assignment: Tensor
    gap: Tensor


def describe_scenes() -> Record:
    """`navigation` (an episode), `coverage` (a state per number of sensors), `regulation` and `counterexamples`."""
    return {
        "navigation": _navigation(),
        "coverage": [_coverage(agents) for agents in SENSORS],
        "regulation": _regulation(),
        "counterexamples": [_counterexample("reward"), _counterexample("count")],
    }


def _navigation(policy: str = "matching") -> Record:
    """One episode: positions (T + 1, N, 2) and landmarks (M, 2), radius of an agent and of a landmark's disc."""
    cfg, rng = navigation.Config(agents=3), Generator().manual_seed(SEED)
    state = navigation.initial(cfg, 1, rng)
    positions = [state.position[0]]
    for _ in range(cfg.episode):
        state = navigation.transition(cfg, state, POLICIES[cfg.kind][policy](cfg, state, rng), rng)
        positions.append(state.position[0])
    return {
        "policy": policy,
        "positions": _plain(torch.stack(positions)),
        "landmarks": _plain(state.landmarks[0]),
        "radius": navigation.CONTACT / 2,
        "near": navigation.NEAR,
    }


def _coverage(agents: int, policy: str = "best_window") -> Record:
    """One state: sensors (N, 2), heading in degrees (N,), targets (M, 2), who sees which (N, M)."""
    cfg, rng = coverage.Config(agents=agents, targets=TARGETS), Generator().manual_seed(SEED)
    state = coverage.initial(cfg, 1, rng)
    for _ in range(TURNED):
        state = coverage.transition(cfg, state, POLICIES[cfg.kind][policy](cfg, state, rng), rng)
    return {
        "agents": agents,
        "policy": policy,
        "step": TURNED,
        "sensors": _plain(state.sensors[0]),
        "heading": _plain(state.heading[0]),
        "targets": _plain(state.targets[0]),
        "seen": coverage.visible(*coverage.relation(state))[0].tolist(),
        "range": coverage.RANGE,
        "half_view": coverage.HALF_VIEW,
        "half_area": coverage.HALF_AREA,
    }


def _regulation() -> Record:
    """The clearest loss among the states met: most agents with a choice, then the largest gap, then fewest options.

    Beside it how often there was one, for horizons of one step and of `HORIZON`.
    """
    met = {horizon: _met(horizon) for horizon in (1, HORIZON)}
    most = met[HORIZON]
    lost = (most.gap > TOLERANCE).nonzero()[:, 0].tolist()
    index = min(lost, key=lambda k: _clarity(most, k))
    held = most.assignment[index]
    kept = _distinct(most, index)
    return _instance(kept, held) | {
        "horizon": HORIZON,
        "met": [
            {"horizon": horizon, "states": len(m.gap), "lost": int((m.gap > TOLERANCE).sum()), "max_gap": _gap(m)}
            for horizon, m in met.items()
        ],
    }


def _counterexample(by: Literal["reward", "count"]) -> Record:
    """The smallest instance on which Algorithm 1 misses the largest reward, or even the largest count of targets."""
    found = smallest_counterexample(ALPHA, by)
    return {"by": by} | _instance(list(found.options), found.assignment)


def _instance(kept: list[Tensor], held: Tensor) -> Record:
    """The targets that each agent's options complete, N times (D_i, M), the assignment (N, M), and both paths."""
    options = _padded(kept)
    paths = {"algorithm_1": algorithm1_path(options, held, CHARGES), "optimum": optimal_path(options, held, CHARGES)}
    return {
        "alpha": ALPHA,
        "assignment": held.int().tolist(),
        "options": [agent.int().tolist() for agent in kept],
        "paths": {name: _path(path, kept) for name, path in paths.items()},
    }


def _clarity(met: Met, index: int) -> tuple[float, ...]:
    """Less is clearer."""
    sizes = [len(agent) for agent in _distinct(met, index)]
    return (-sum(size > 1 for size in sizes), -round(float(met.gap[index]), 4), sum(sizes), index)


def _met(horizon: int, policy: str = "nearest") -> Met:
    """States of the paper's task on the way of a scripted policy, each with an assignment of every pair by a coin."""
    cfg, rng = coverage.Config(agents=4, targets=TARGETS), Generator().manual_seed(SEED)
    state = coverage.initial(cfg, EPISODES, rng)
    options, assignments = [], []
    for step in range(1, LENGTH + 1):
        state = coverage.transition(cfg, state, POLICIES[cfg.kind][policy](cfg, state, rng), rng)
        if step % EVERY == 0:
            options.append(coverage.options(cfg, state, horizon))
            assignments.append(torch.rand(EPISODES, cfg.agents, cfg.targets, generator=rng) < 0.5)
    all_options, assignment = torch.cat(options), torch.cat(assignments)
    gap = exact(all_options, assignment, CHARGES) - paper(all_options, assignment, CHARGES)
    return Met(all_options, assignment, gap)


def _distinct(met: Met, index: int) -> list[Tensor]:
    """The sets of its own targets that each agent can complete, in the order of its options: N times (D_i, M)."""
    held = met.options[index] & met.assignment[index].unsqueeze(1)
    rows = [list(dict.fromkeys(tuple(row) for row in agent.tolist())) for agent in held]
    return [torch.tensor(row) for row in rows]


def _padded(kept: list[Tensor]) -> Tensor:
    """The same as one table (N, D, M): an agent with fewer options has its last one several times."""
    most = max(map(len, kept))
    return torch.stack([torch.cat((agent, agent[-1:].expand(most - len(agent), -1))) for agent in kept])


def _path(path: Path, kept: list[Tensor]) -> Record:
    choices = [min(choice, len(agent) - 1) for choice, agent in zip(path.choices, kept, strict=True)]
    return {"choices": choices, "completed": list(path.completed), "reward": round(path.reward, 6)}


def _gap(met: Met) -> float:
    return round(float(met.gap.max()), 6)


def _plain(x: Tensor) -> Any:
    """Numbers without the noise of the last digits."""
    return x.double().mul(1e4).round().div(1e4).tolist()
