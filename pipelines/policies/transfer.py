"""Trained policies on tasks with other numbers of agents and targets than they were trained with, as a table."""

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from pipelines.export.tables import write_parquet
from pipelines.policies.evaluation import EvaluationEpisodes, Policy, score
from pipelines.tracking.policy import acting
from pipelines.workspace.errors import InputError
from pipelines.workspace.process_pool import side_by_side
from reports.data.schema import TRANSFER

FILE = "transfer.parquet"

Row = tuple[object, ...]


class Size(NamedTuple):
    """Numbers of agents and targets to play with."""

    agents: int
    targets: int


def sizes(policy: Policy, agents: Sequence[int], targets: Sequence[int]) -> list[Size]:
    """Sizes to play: the trained numbers, and those with another number of agents, or of targets."""
    env = policy.saved.spec.env
    own = Size(env.agents, getattr(env, "targets", env.agents))
    changed = [Size(n, own.targets) for n in agents] + [Size(own.agents, m) for m in targets]
    return sorted({own, *changed})


def transfer(
    study: str,
    policies: Iterable[Policy],
    agents: Sequence[int],
    targets: Sequence[int],
    episodes: int,
    jobs: int = 1,
) -> Iterator[Row]:
    """Play every policy on every size; rows of the schema `TRANSFER`. Every policy meets the same episodes of a size.

    Args:
        study: that trained them.
        policies: to play.
        agents: numbers of agents, see `sizes`.
        targets: numbers of targets.
        episodes: of each size of the task.
        jobs: policies at a time, each in a process of its own; the rows do not depend on it.

    Raises:
        InputError: no such task, or a policy acts only with the numbers that it was trained with.
        StoreError: one of the processes was killed.
    """
    play = partial(_play, study=study, agents=agents, targets=targets, episodes=episodes)
    for rows in side_by_side(play, map(_light, policies), jobs):
        yield from rows


def _light(policy: Policy) -> Policy:
    """A policy without the replay that a run under way has, which is too much to hand to another process."""
    saved = policy.saved
    return policy._replace(saved=saved._replace(algorithm=acting(saved.spec.algo.kind, saved.algorithm)))


def _play(policy: Policy, study: str, agents: Sequence[int], targets: Sequence[int], episodes: int) -> list[Row]:
    """The rows of one policy."""
    env: Any = policy.saved.spec.env
    if "targets" not in type(env).model_fields:
        raise InputError(f"{policy.arm}: transfer is of tasks where agents and targets have numbers, not of {env.kind}")
    task = " ".join([env.kind, *([env.preset] if "preset" in type(env).model_fields else [])])
    rows: list[Row] = []
    for size in sizes(policy, agents, targets):
        found = score(policy, EvaluationEpisodes(episodes=episodes, agents=size.agents, targets=size.targets))
        place = (study, policy.arm, policy.saved.spec.seed, policy.saved.spec.id, task)
        values = (found.values["return"], found.values["return_sem"])
        rows.append((*place, *size, env.agents, env.targets, episodes, *values))
    return rows


def export_transfer(rows: Iterable[Row], out: Path) -> Path:
    """Write `transfer.parquet` in a folder.

    Raises:
        StoreError: the folder cannot be written to.
    """
    write_parquet(out / FILE, TRANSFER, sorted(rows, key=lambda row: row[:7]))
    return out / FILE
