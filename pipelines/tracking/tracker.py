"""The log of runs: the protocol that `mlflow_tracker` obeys, and in memory `tests/memory_tracker.py`.

A run in a log is named by study, profile, arm and key (spec id and code fingerprint). Starting one that is there
already continues it, unless it came from elsewhere (`Card.imported`): values of two machines do not meet in one run. A
point that is logged already is not logged again.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Literal, NamedTuple, Protocol

from pipelines.workspace.provenance import Host
from rhmc.types import Metrics

VALUES_ONLY = "values_only"  # tag of a run that came from a bundle without its policy
Status = Literal["running", "finished", "failed", "interrupted"]
ADOPTED = "adopted"  # tag of a run that other code made: which, and what was compared
FROM = "from code "  # begins the tag; the code and `:` follow


class StudyCard(NamedTuple):
    """A study as its log shows it."""

    study: str
    profile: str
    note: str  # Markdown: question, arms, seeds, budget
    params: Mapping[str, Sequence[str]] = MappingProxyType({})  # what varies, by method (arm of a search)
    arms: Sequence[str] = ()


class Card(NamedTuple):
    """A run as its log shows it."""

    arm: str
    seed: int
    spec_id: str
    fingerprint: str
    algorithm: str
    task: str
    commit: str
    params: dict[str, str]  # what varies between the runs of the study, and method and seed
    trial: int | None = None  # of a search: then the run stands for all of its seeds
    host: Host = Host()  # that starts it
    modules: Mapping[str, str] = MappingProxyType({})  # digests of the code that decides it
    imported: str = ""  # names what a bundle has of it, should it come from one
    env: Mapping[str, object] = MappingProxyType({})  # all settings of the task, where they are known

    @property
    def key(self) -> str:
        """The identity of what was trained: spec id and fingerprint."""
        return f"{self.spec_id}-{self.fingerprint}"

    @property
    def name(self) -> str:
        """The name for people."""
        return f"{self.arm} s{self.seed}" if self.trial is None else f"{self.arm} t{self.trial}"


class Recorded(NamedTuple):
    """A run found in a log."""

    ref: str  # the log's own name of it
    arm: str
    key: str
    status: Status
    commit: str
    stale: bool = False  # marked as no part of the latest plan
    host: Host = Host()
    error: str = ""  # why it failed, one line
    values_only: bool = False  # taken in from a bundle without policies
    modules: Mapping[str, str] = MappingProxyType({})  # of the code that made it, where that was kept
    adopted: str = ""  # from which code, and what was compared, if another code made it

    @property
    def spec_id(self) -> str:
        """The identity of its settings when it was made."""
        return self.key.partition("-")[0]

    @property
    def code(self) -> str:
        """The fingerprint of the code that it is logged under."""
        return self.key.rpartition("-")[2]

    @property
    def copied_from(self) -> str:
        """The code of the run that this one is an adopted copy of; empty if it is none."""
        return self.adopted.removeprefix(FROM).partition(":")[0]


class Row(NamedTuple):
    """One value of one metric."""

    ref: str
    step: int
    metric: str
    value: float


class RunLog(Protocol):
    """One run that is being logged."""

    @property
    def ref(self) -> str: ...

    def log(self, points: Sequence[Metrics]) -> None:
        """Add points (each with a key `step`); values of a metric and step that are there already are left alone."""
        ...

    def artifact(self, path: Path) -> None:
        """Keep a copy of a file under its name."""
        ...

    def text(self, name: str, content: str) -> None:
        """Keep a text under a file name."""
        ...

    def tag(self, name: str, value: str) -> None:
        """Set or replace a tag."""
        ...

    def model(self, policy: Path) -> None:
        """Offer the policy in a file as a model that can be loaded by name; once, however often it is called."""
        ...

    def finish(self, status: Status) -> None:
        """Close the run. It can be started again."""
        ...


class Tracker(Protocol):
    """The log of one study and profile."""

    def recorded(self) -> list[Recorded]:
        """The runs logged so far, oldest first."""
        ...

    def finished_anywhere(self, keys: Collection[str]) -> dict[str, str]:
        """Key -> ref of a finished run with one of these keys, of whatever study shares the log."""
        ...

    def mark(self, ref: str, *, stale: bool) -> None:
        """Say of a run whether the latest plan is without it: then it stays, and views and averages pass over it."""
        ...

    def start(self, card: Card) -> RunLog:
        """Begin a run, or continue it; one of another origin is dropped, and begun anew."""
        ...

    def drop(self, ref: str) -> None:
        """Take a run that is not finished out of the log."""
        ...

    def rows(self, refs: Sequence[str], metrics: Collection[str] | None = None) -> list[Row]:
        """All values of the runs, or those of some metrics; each metric and step once, sorted."""
        ...

    def file(self, ref: str, name: str, folder: Path) -> Path | None:
        """Write a file that a run keeps to a folder; None if it keeps none of that name."""
        ...

    def files_of(self, ref: str) -> str:
        """The place where the files of a run are looked for, for people."""
        ...

    def publish(self, note: str, files: Mapping[str, bytes]) -> None:
        """Replace the study's description (Markdown) and its files of these names."""
        ...

    def close(self, status: Status) -> None:
        """End the present launch. Runs left running become `interrupted`."""
        ...


def unseen(points: Iterable[Metrics], seen: set[tuple[str, int]]) -> list[tuple[str, int, float]]:
    """(metric, step, value) of each value that is not in `seen`, which is brought up to date."""
    new = []
    for point in points:
        step = int(point["step"])
        for metric, value in point.items():
            if metric != "step" and (metric, step) not in seen:
                seen.add((metric, step))
                new.append((metric, step, value))
    return new


def points_of(rows: Iterable[Row]) -> list[Metrics]:
    """The rows of one run as the points they came from."""
    points: dict[int, Metrics] = {}
    for row in rows:
        points.setdefault(row.step, {"step": float(row.step)})[row.metric] = row.value
    return [points[step] for step in sorted(points)]
