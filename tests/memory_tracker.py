"""A log of runs in memory, held to the same tests as the one in MLflow (`tests/pipelines/tracking/test_tracker.py`)."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pipelines.tracking.tracker import ADOPTED, VALUES_ONLY, Card, Recorded, Row, Status, StudyCard, unseen
from rhmc.types import Metrics


@dataclass
class MemoryRun:
    """A run in memory, see `RunLog`."""

    ref: str
    study: StudyCard
    card: Card
    status: Status = "running"
    values: list[Row] = field(default_factory=list)
    seen: set[tuple[str, int]] = field(default_factory=set)
    tags: dict[str, str] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    models: list[bytes] = field(default_factory=list)

    def log(self, points: Sequence[Metrics]) -> None:
        self.values += [Row(self.ref, step, metric, value) for metric, step, value in unseen(points, self.seen)]

    def artifact(self, path: Path) -> None:
        self.files[path.name] = path.read_bytes()

    def text(self, name: str, content: str) -> None:
        self.files[name] = content.encode()

    def tag(self, name: str, value: str) -> None:
        self.tags[name] = value

    def model(self, policy: Path) -> None:
        self.models = self.models or [policy.read_bytes()]

    def finish(self, status: Status) -> None:
        self.status = status


class MemoryTracker:
    """A log in memory, see `Tracker`: what several share is `shelf`, as trackers of MLflow share a database."""

    def __init__(self, study: StudyCard, shelf: list[MemoryRun]) -> None:
        self.study, self.shelf = study, shelf
        self.note, self.files = study.note, dict[str, bytes]()
        self._interrupt_running()

    def _mine(self) -> list[MemoryRun]:
        return [run for run in self.shelf if run.study[:2] == self.study[:2]]

    def _interrupt_running(self) -> None:
        for run in self._mine():
            if run.status == "running":
                run.finish("interrupted")

    def recorded(self) -> list[Recorded]:
        return [
            Recorded(
                *(r.ref, r.card.arm, r.card.key, r.status, r.card.commit, "stale" in r.tags, r.card.host),
                *(r.tags.get("error", ""), VALUES_ONLY in r.tags, r.card.modules, r.tags.get(ADOPTED, "")),
            )
            for r in self._mine()
        ]

    def mark(self, ref: str, *, stale: bool) -> None:
        (run,) = (run for run in self.shelf if run.ref == ref)
        if stale:
            run.tags["stale"] = "yes"
        else:
            run.tags.pop("stale", None)

    def finished_anywhere(self, keys: Collection[str]) -> dict[str, str]:
        done = [r for r in self.shelf if r.status == "finished" and r.card.key in keys]
        return {r.card.key: r.ref for r in reversed(done)}

    def start(self, card: Card) -> MemoryRun:
        for run in self._mine():
            if (run.card.arm, run.card.key) == (card.arm, card.key):
                if run.card.imported != card.imported:
                    self.drop(run.ref)
                    continue
                run.status = "running"
                return run
        number = 1 + max((int(run.ref.removeprefix("run-")) for run in self.shelf), default=-1)
        run = MemoryRun(f"run-{number}", self.study, card)
        self.shelf.append(run)
        return run

    def drop(self, ref: str) -> None:
        self.shelf[:] = [run for run in self.shelf if run.ref != ref]

    def rows(self, refs: Sequence[str], metrics: Collection[str] | None = None) -> list[Row]:
        found = (row for run in self.shelf if run.ref in refs for row in run.values)
        return sorted(row for row in found if metrics is None or row.metric in metrics)

    def file(self, ref: str, name: str, folder: Path) -> Path | None:
        (run,) = [run for run in self.shelf if run.ref == ref]
        if name not in run.files:
            return None
        (folder / name).write_bytes(run.files[name])
        return folder / name

    def files_of(self, ref: str) -> str:
        return f"memory of {ref}"

    def publish(self, note: str, files: Mapping[str, bytes]) -> None:
        self.note, self.files = note, self.files | dict(files)

    def close(self, status: Status) -> None:
        self._interrupt_running()
