"""Trained policies on tasks with other numbers of agents and targets than they were trained with, as a table."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa

from pipelines.errors import InputError
from pipelines.evaluation import Bank, Policy, score
from pipelines.export import write_parquet

FILE = "transfer.parquet"
TRANSFER = pa.schema(
    [
        ("study", pa.string()),  # that trained the policy
        ("arm", pa.string()),
        ("seed", pa.int64()),
        ("run", pa.string()),  # spec id
        ("task", pa.string()),  # kind and preset
        ("agents", pa.int64()),
        ("targets", pa.int64()),
        ("trained_agents", pa.int64()),
        ("trained_targets", pa.int64()),
        ("episodes", pa.int64()),
        ("value", pa.float64()),  # mean return
        ("sem", pa.float64()),  # its standard error over episodes
    ]
)

Row = tuple[object, ...]


class Size(NamedTuple):
    """Numbers of agents and targets to play with."""

    agents: int
    targets: int


def sizes(policy: Policy, agents: Sequence[int], targets: Sequence[int]) -> list[Size]:
    """What to play: the trained numbers, other numbers of agents with them, and other numbers of targets with them."""
    env = policy.saved.spec.env
    own = Size(env.agents, getattr(env, "targets", env.agents))
    changed = [Size(n, own.targets) for n in agents] + [Size(own.agents, m) for m in targets]
    return sorted({own, *changed})


def transfer(
    study: str, policies: Iterable[Policy], agents: Sequence[int], targets: Sequence[int], episodes: int
) -> Iterator[Row]:
    """Play every policy on every size; rows of the schema `TRANSFER`. Every policy meets the same episodes of a size.

    Raises:
        InputError: no such task, or a policy acts only with the numbers that it was trained with.
    """
    for policy in policies:
        env = policy.saved.spec.env
        if env.kind != "coverage":
            raise InputError(
                f"{policy.arm}: transfer is of coverage, where agents and targets have numbers of their own"
            )
        for size in sizes(policy, agents, targets):
            found = score(policy, Bank(episodes=episodes, agents=size.agents, targets=size.targets))
            place = (study, policy.arm, policy.saved.spec.seed, policy.saved.spec.id, f"{env.kind} {env.preset}")
            values = (found.values["return"], found.values["return_sem"])
            yield (*place, *size, env.agents, env.targets, episodes, *values)


def export_transfer(rows: Iterable[Row], out: Path) -> Path:
    """Write `transfer.parquet` in a folder.

    Raises:
        StoreError: the folder cannot be written to.
    """
    write_parquet(out / FILE, TRANSFER, sorted(rows, key=lambda row: row[:7]))
    return out / FILE
