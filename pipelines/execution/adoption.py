"""Older runs under the present code: adopted where trainings of today repeat them bit for bit, refused where not.

A run is named by its settings and the code that it uses. After a change that should change no result, some of the older
runs of each arm are trained again, whole or up to a point of their curve, and every logged value is compared, the time
that it took aside. Where all are equal, the older runs of the arm are copied under their present names, and each copy
says from what it was adopted and what was compared.
"""

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from pipelines.execution.recorder import copy_run
from pipelines.specs.study import Study
from pipelines.tracking.initial import begun, keep
from pipelines.tracking.plan import Item, finished, items, study_card
from pipelines.tracking.staleness import kept_settings
from pipelines.tracking.tracker import ADOPTED, FROM, Recorded, Row, StudyCard, Tracker, points_of
from pipelines.workspace.errors import InputError
from pipelines.workspace.process_pool import side_by_side
from pipelines.workspace.work_folder import Home
from rhmc.training.trainer import grid_step
from rhmc.types import Metrics

OURS = "time/"  # metrics that say how long something took

Values = dict[tuple[int, str], float]  # by step and metric


class Older(NamedTuple):
    """A finished run of other code with the settings and seed of a planned one that is not there."""

    item: Item
    run: Recorded


class Difference(NamedTuple):
    """A value that a training of today does not repeat; None where one of both has none."""

    item: Item
    step: int
    metric: str
    before: float | None
    now: float | None

    def __str__(self) -> str:
        card = self.item.card
        values = f"{_shown(self.before)} before, {_shown(self.now)} now"
        return f"arm '{card.arm}', seed {card.seed}, step {self.step:,}, {self.metric}: {values}"


class Proof(NamedTuple):
    """The result of the trainings of an arm."""

    arm: str
    seeds: Sequence[int]  # trained again
    until: int  # step of the last compared point
    values: int  # compared
    difference: Difference | None

    def __str__(self) -> str:
        words = f"seed{'s' * (len(self.seeds) > 1)} {', '.join(map(str, self.seeds))}"
        return f"{words} trained again to step {self.until:,}, {self.values:,} values equal bit for bit"


def adopt(
    study: Study, home: Path, verify: int, until: int | None, jobs: int, say: Callable[[str], None]
) -> list[Proof]:
    """Let the older runs of a study count for the present code, arm by arm, where they are repeated bit for bit.

    Args:
        study: the plan.
        home: the work folder.
        verify: runs of each arm that are trained again.
        until: step to which; None for whole runs.
        jobs: trainings at a time.
        say: takes a line on each arm.

    Raises:
        InputError: `until` is too small.
        StoreError: the study is being driven, or the log cannot be used.
    """
    from pipelines.tracking.mlflow_tracker import MlflowTracker

    place, card, plan = Home(home), study_card(study), items(study)
    place.prepare()
    keep(study.policies, home)
    with place.lock(study.name, study.profile):
        tracker = MlflowTracker(card, place)
        try:
            found = older(plan, tracker)
            if not found:
                say("no finished run of other code has the settings of a planned one that is missing")
            proofs = []
            for proof in prove(found, tracker, verify, until, jobs, home):
                proofs.append(proof)
                _settle(proof, found[proof.arm], card, tracker, say)
            return proofs
        finally:
            tracker.close("interrupted" if _left(plan, tracker) else "finished")


def _settle(
    proof: Proof, runs: Sequence[Older], study: StudyCard, tracker: Tracker, say: Callable[[str], None]
) -> None:
    """Copy the runs of an arm under their present names, if the proof allows it."""
    if proof.difference:
        say(f"refused: {proof.difference}")
        return
    for one in runs:
        points = points_of(tracker.rows([one.run.ref]))
        card = one.item.card._replace(commit=one.run.commit, host=one.run.host)  # of what computed it
        tags = {ADOPTED: f"{FROM}{one.run.code}: {proof}"}
        copy_run(tracker, study, one.run.ref, one.item._replace(card=card), points, tags, say)
    say(f"adopted: {len(runs)} run{'s' * (len(runs) > 1)} of arm '{proof.arm}': {proof}")


def _left(plan: Iterable[Item], tracker: Tracker) -> bool:
    done = finished(tracker.recorded())
    return any((item.card.arm, item.key) not in done for item in plan)


def older(plan: Iterable[Item], tracker: Tracker) -> dict[str, list[Older]]:
    """The runs that could be adopted, by arm, in the order of the plan; of several the newest.

    Settings are compared under the present rules, whatever the run was named by when it was made.
    """
    recorded = tracker.recorded()
    done = finished(recorded)
    wanted = {(i.card.arm, i.card.spec_id): i for i in plan if (i.card.arm, i.key) not in done}
    arms = {arm for arm, _ in wanted}
    found: dict[tuple[str, str], Older] = {}
    for run in recorded:
        if run.status == "finished" and run.arm in arms:
            item = wanted.get((run.arm, run.spec_id)) or wanted.get((run.arm, _settings_id(run, tracker)))
            if item and run.key != item.key:
                found[run.arm, item.card.spec_id] = Older(item, run)
    by_arm: dict[str, list[Older]] = {}
    for place in wanted:
        if place in found:
            by_arm.setdefault(place[0], []).append(found[place])
    return by_arm


def _settings_id(run: Recorded, tracker: Tracker) -> str:
    """The present id of the settings that a run kept; empty where they cannot be read."""
    spec = kept_settings(run, tracker)
    return spec.id if spec else ""


def prove(
    runs: Mapping[str, Sequence[Older]],
    tracker: Tracker,
    verify: int,
    until: int | None,
    jobs: int,
    home: Path | None = None,
) -> Iterator[Proof]:
    """Train some runs of each arm again and compare them with what was logged.

    Args:
        runs: of each arm, those that could be adopted.
        tracker: their log.
        verify: how many of each arm are trained, by seed; all where there are fewer.
        until: step after which no point is compared; None for whole runs.
        jobs: trainings at a time.
        home: see `pipelines.tracking.initial.begun`.

    Raises:
        InputError: no point of a curve but the one before training lies within `until`.
        StoreError: the log cannot be read, or a training was killed.
    """
    tried = {arm: sorted(some, key=lambda one: one.item.card.seed)[:verify] for arm, some in runs.items()}
    queue = [one for some in tried.values() for one in some]
    points = [_points(one.item, until) for one in queue]
    trained = side_by_side(partial(_train, home), zip([one.item for one in queue], points, strict=True), jobs)
    for arm, some in tried.items():
        before = [values_of(tracker.rows([one.run.ref])) for one in some]
        now = [next(trained) for _ in some]
        yield _proof(arm, some, before, now)


def _points(item: Item, until: int | None) -> int:
    """Points of the curve after the first that are trained."""
    trainer = item.spec.trainer
    points = [p for p in range(1, trainer.evaluations + 1) if until is None or grid_step(trainer, p) <= until]
    if not points:
        text = f"must be at least {grid_step(trainer, 1):,}, the first point of the curve after training began"
        raise InputError(f"--until: {until:,} is not allowed for arm '{item.card.arm}'; {text}")
    return points[-1]


def _train(home: Path | None, job: tuple[Item, int]) -> Values:
    """The values of the present code for a run, to the given point of its curve."""
    item, points = job
    trainer = begun(item.spec, home)
    found: Values = {}
    for _, point in zip(range(points + 1), trainer, strict=False):
        found |= values_of_point(point)
    return found


def values_of_point(point: Metrics) -> Values:
    """A point of a curve by step and metric."""
    return {(int(point["step"]), name): value for name, value in point.items() if name != "step"}


def values_of(rows: Iterable[Row]) -> Values:
    """Logged values by step and metric."""
    return {(row.step, row.metric): row.value for row in rows}


def _proof(arm: str, tried: Sequence[Older], before: Sequence[Values], now: Sequence[Values]) -> Proof:
    pairs = list(zip(tried, before, now, strict=True))
    first = next((found for one, *values in pairs if (found := compare(one.item, *values))), None)
    last = max(step for values in now for step, _ in values)
    return Proof(arm, [one.item.card.seed for one in tried], last, sum(map(len, now)), first)


def compare(item: Item, before: Values, now: Values) -> Difference | None:
    """The first value, by step and name, that is not the same bit for bit, as far as the present training goes."""
    last = max(step for step, _ in now)
    places = {place for place in (*before, *now) if place[0] <= last and not place[1].startswith(OURS)}
    for step, metric in sorted(places):
        a, b = before.get((step, metric)), now.get((step, metric))
        if _bits(a) != _bits(b):
            return Difference(item, step, metric, a, b)
    return None


def _bits(value: float | None) -> bytes:
    """NaN equals itself, and 0 differs from -0."""
    return b"" if value is None else struct.pack("<d", value)


def _shown(value: float | None) -> str:
    return "nothing" if value is None else repr(value)
