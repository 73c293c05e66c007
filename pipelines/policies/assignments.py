"""Assignments of a coordinator while it learns: pairs, conflicts, and how far Algorithm 1 falls short in those states.

The runs' logs do not hold this, so the runs are trained again, step by step the same (watching draws nothing), and
every `EVERY`-th step of their training is looked at. The rows belong to the runs of the study, beside its table.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from pipelines.export.tables import read_parquet, write_parquet
from pipelines.specs.study import Study
from pipelines.tracking.initial import begun, keep
from pipelines.tracking.plan import Item, chosen, items
from pipelines.workspace.errors import InputError
from pipelines.workspace.process_pool import side_by_side
from pipelines.workspace.work_folder import work_folder
from reports.data.schema import METRICS
from rhmc.hierarchy.regulation import Charges, exact, paper
from rhmc.types import Metrics, Transition

SUFFIX = ".assignments.parquet"
PREFIX = "assign/"
ASSIGNING = ("rhmc", "hitmac")  # methods that assign targets
HORIZONS = (1, 6)  # steps that an agent may act, as Figure 4 has them
EVERY = 8  # steps from one look to the next: neighbouring states are much alike
ALPHA = 0.1  # penalty of Eq. 6, as in the table of random instances
CHARGES = Charges(ALPHA)
TOLERANCE = 1e-5  # above rounding

Row = tuple[object, ...]


class Watched(NamedTuple):
    """A run and what was seen of it up to each point of its curve."""

    item: Item
    points: list[tuple[int, Metrics]]


class Watch:
    """Stands before an algorithm's `observe`: passes every transition on, and counts what every `EVERY`-th assigns."""

    def __init__(self, observe: Callable[[Transition], None]) -> None:
        self.observe = observe
        self.steps = 0
        self.sums: Metrics = {}
        self.states = 0

    def __call__(self, transition: Transition) -> None:
        if self.steps % EVERY == 0:
            for name, values in counts(transition).items():
                self.sums[name] = self.sums.get(name, 0.0) + float(values.sum())
            self.states += len(transition.reward)
        self.steps += 1
        self.observe(transition)

    def take(self) -> Metrics:
        """Means over the states since the last call, as `assign/` metrics; nothing if there were none."""
        sums, states = self.sums, self.states
        self.sums, self.states = {}, 0
        if not states:
            return {}
        gaps = {f"gap_h{h}": sums.pop(f"gap_h{h}") / max(sums[f"lost_h{h}"], 1.0) for h in HORIZONS}
        means = {name: value / states for name, value in sums.items()} | gaps
        return {f"{PREFIX}{name}": value for name, value in means.items()} | {f"{PREFIX}states": float(states)}


@torch.no_grad()
def counts(t: Transition) -> dict[str, Tensor]:
    """Of each state (B,), float:

    - `pairs`: assigned pairs; `conflicts`: targets assigned to two agents or more; `free`: targets assigned to nobody;
      `idle`: agents without a target.
    - `lost_h<n>`: 1 where Algorithm 1 is below the optimum at a horizon of n steps; `gap_h<n>`: by how much, in Eq. 6.
    """
    held = t.extra["assignment"] > 0.5
    agents, targets = held.sum(1), held.sum(2)
    found = {
        "pairs": held.sum((1, 2)).float(),
        "conflicts": (agents > 1).sum(1).float(),
        "free": (agents == 0).sum(1).float(),
        "idle": (targets == 0).sum(1).float(),
    }
    for horizon in HORIZONS:
        options = t.options(horizon)
        gap = exact(options, held, CHARGES) - paper(options, held, CHARGES)
        found[f"lost_h{horizon}"] = (gap > TOLERANCE).float()
        found[f"gap_h{horizon}"] = torch.where(gap > TOLERANCE, gap, 0.0)
    return found


def watched(study: Study, arms: Sequence[str] = (), seeds: Sequence[int] = (), jobs: int = 1) -> Iterator[Watched]:
    """Train the study's runs that assign targets, and watch them.

    Args:
        study: the plan.
        arms: only these, if any are named.
        seeds: only these, if any are named.
        jobs: runs at a time, each in a process of its own; what is seen does not depend on it.

    Raises:
        InputError: there is no such arm, or none of the runs assigns targets.
        StoreError: one of the processes was killed.
    """
    found = [item for item in chosen(study, arms, seeds) if item.spec.algo.kind in ASSIGNING]
    if not found:
        raise InputError(f"{study.name} ({study.profile}): no such run assigns targets; {' and '.join(ASSIGNING)} do")
    keep(study.policies, work_folder())
    for item, points in zip(found, side_by_side(_train, found, jobs), strict=True):
        yield Watched(item, points)


def _train(item: Item) -> list[tuple[int, Metrics]]:
    trainer = begun(item.spec)
    watch = Watch(trainer.algorithm.observe)
    trainer.algorithm.observe = watch  # type: ignore[method-assign]
    points = ((int(metrics["step"]), watch.take()) for metrics in trainer)
    return [(step, seen) for step, seen in points if seen]


def rows_of(run: Watched) -> list[Row]:
    """As rows of the schema `METRICS`."""
    card = run.item.card
    place = (run.item.study, card.arm, card.seed, card.spec_id)
    return [(*place, step, name, value) for step, metrics in run.points for name, value in metrics.items()]


def export_assignments(study: Study, rows: Sequence[Row], out: Path) -> Path:
    """Write `<study>.assignments.parquet` in a folder; rows of other runs that are there already stay.

    Raises:
        InputError: there is another file under the name.
        StoreError: the folder cannot be written to.
    """
    file = out / f"{study.name}{SUFFIX}"
    new = {row[3] for row in rows}
    known = {item.card.spec_id for item in items(study)}
    there = [tuple(row[name] for name in METRICS.names) for row in read_parquet(file, METRICS, "assignments")]
    kept = [row for row in there if row[3] in known - new]
    write_parquet(file, METRICS, sorted([*kept, *rows], key=lambda row: row[:6]))
    return file
