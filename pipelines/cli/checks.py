"""Checks of an installation and its work folder: each check gives one line, with what to do."""

import os
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal, NamedTuple

from packaging.requirements import Requirement

from pipelines.workspace.addresses import without_password
from pipelines.workspace.work_folder import Home, StoreError, one_line

PYTHONS = ((3, 11), (3, 12), (3, 13))  # the first is that of the published results
NEEDED = 2 * 2**30  # bytes free: a study of many runs with their checkpoints
LOCK = Path(__file__).parents[2] / "requirements.lock"
LOOPBACK = "127.0.0.1"
SHOWN = 4  # libraries that a line names

Level = Literal["ok", "note", "fault"]


class Finding(NamedTuple):
    """The finding of a check; a `note` is worth knowing and nothing is wrong."""

    level: Level
    what: str
    text: str


def examine(home: Path, *, ray: bool = True) -> Iterator[Finding]:
    """Every check in turn, the quick ones first.

    Args:
        home: the work folder; it need not be there.
        ray: also start Ray, which takes seconds.
    """
    checks: list[Callable[[], Iterable[Finding]]] = [python, libraries, torch_build, arithmetic, code]
    checks += [lambda: disk(home), lambda: store(Home(home)), *([lambda: starts_ray(home)] if ray else [])]
    for check in checks:
        yield from check()


def python(found: tuple[int, int] = (sys.version_info[0], sys.version_info[1])) -> list[Finding]:
    """The interpreter's version."""
    name, *names = (".".join(map(str, one)) for one in (found, *PYTHONS))
    if found in PYTHONS:
        return [Finding("ok", "python", f"{name} ({sys.executable})")]
    text = f"{name}, and one of {', '.join(names)} is needed: make setup PYTHON=/path/to/python{names[0]}"
    return [Finding("fault", "python", text)]


def libraries(wanted: Iterable[Requirement] | None = None) -> list[Finding]:
    """Installed versions against those that are asked for."""
    asked = list(required() if wanted is None else wanted)
    other = []
    for one in asked:
        try:
            found = version(one.name).partition("+")[0]
        except PackageNotFoundError:
            found = "missing"
        if found == "missing" or not one.specifier.contains(found, prereleases=True):
            other.append(f"{one.name} {found} instead of {str(one.specifier).removeprefix('==')}")
    if not other:
        return [Finding("ok", "libraries", f"all {len(asked)} as required")]
    more = f" and {len(other) - SHOWN} more" if len(other) > SHOWN else ""
    return [Finding("fault", "libraries", f"{', '.join(other[:SHOWN])}{more}: make setup")]


def required() -> Iterator[Requirement]:
    """The exact versions of the lock in a checkout, else the ranges of the installed package."""
    lines = LOCK.read_text(encoding="utf-8").splitlines() if LOCK.exists() else requires("rhmc") or []
    for line in lines:
        if not line.startswith("#"):
            one = Requirement(line)
            if one.marker is None or one.marker.evaluate({"extra": ""}):
                yield one


def torch_build() -> list[Finding]:
    """Check that torch can compute here, and on which devices."""
    try:
        import torch

        works = float(torch.ones(2) @ torch.ones(2)) == 2.0
    except (ImportError, OSError, RuntimeError) as error:
        return [Finding("fault", "torch", f"cannot be used ({one_line(error)}): make setup")]
    if not works:
        return [Finding("fault", "torch", "computes wrongly: make setup")]
    cuda = torch.version.cuda
    if cuda and not torch.cuda.is_available():
        text = f"{torch.__version__}, built for CUDA {cuda}, and no device is here; the CPU build gives pinned results"
        return [Finding("note", "torch", text)]
    return [Finding("ok", "torch", f"{torch.__version__}, {f'CUDA {cuda}' if cuda else 'CPU build'}")]


def arithmetic() -> list[Finding]:
    """Check that torch's operations give the published bytes here."""
    try:
        from pipelines.workspace.arithmetic import differing

        found = differing()
    except (ImportError, OSError, RuntimeError) as error:
        return [Finding("fault", "arithmetic", f"cannot be tried ({one_line(error)}): make setup")]
    if not found:
        return [Finding("ok", "arithmetic", "the published bytes")]
    text = f"{', '.join(found)}: other bytes than the published ones, so results differ in their last bits at first"
    return [Finding("note", "arithmetic", f"{text} (docs/reproducibility.md)")]


def code(where: Path | None = None) -> list[Finding]:
    """Check that the commit that runs are logged with can be read. where: a folder of the code; this one if None."""
    from pipelines.tracking.plan import read_commit

    found = read_commit(where) if where else read_commit()
    if found.why:
        return [Finding("note", "code", f"runs are logged with an unknown commit: {found.why}")]
    return [Finding("ok", "code", f"commit {found.name}")]


def disk(home: Path, needed: int = NEEDED) -> list[Finding]:
    """Room for runs, and the right to write."""
    there = next(folder for folder in (home, *home.parents) if folder.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        text = f"{there} cannot be written to: change its rights, or name another folder in RHMC_HOME"
        return [Finding("fault", "work folder", text)]
    free = shutil.disk_usage(there).free
    text = f"{home}, {free / 2**30:.1f} GiB free"
    if free < needed:
        return [Finding("fault", "work folder", f"{text}, less than {needed / 2**30:.0f}: make room, or set RHMC_HOME")]
    return [Finding("ok", "work folder", text)]


def store(home: Home) -> Iterator[Finding]:
    """Check that the log can be read, and report what in it waits or is of other code."""
    from pipelines.tracking.mlflow_tracker import census, tracking_uri

    uri = tracking_uri(home)
    try:
        runs = census(home)
    except StoreError as error:
        yield Finding("fault", "store", str(error))
        return
    if runs is None:
        yield Finding("ok", "store", f"{without_password(uri)}: nothing logged yet")
        return
    from pipelines.specs.identity import present
    from pipelines.specs.plugins import discover

    for line in discover():
        yield Finding("note", "packages", line)
    here = present()
    yield Finding("ok", "store", f"{without_password(uri)}: {len(runs)} runs")
    for status in ("running", "interrupted", "failed"):
        where = Counter(run.experiment for run in runs if run.status == status and run.fingerprint in here)
        if where:
            yield Finding("note", "runs", f"{sum(where.values())} {status}: {_places(where)}: {ADVICE[status]}")
    stale = Counter(run.experiment for run in runs if run.fingerprint not in here)
    if stale:
        text = f"{sum(stale.values())} made by other code: {_places(stale)}: `rhmc study run` would train them again"
        yield Finding("note", "stale", text)


ADVICE = {
    "running": "`rhmc study run` says whether another process drives them, else continues them",
    "interrupted": "`rhmc study run` continues them",
    "failed": "their tag `error` says why (`rhmc ui`); `rhmc study run` tries again",
}


def _places(count: Mapping[str, int]) -> str:
    names = sorted(count)
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more


def starts_ray(home: Path | None = None) -> list[Finding]:
    """Check that Ray starts here, or that its cluster answers and every node can train with this work folder."""
    from pipelines.execution.ray_settings import set_up_ray

    set_up_ray()
    from pipelines.execution.cluster import address, fence
    from pipelines.execution.ray_driver import HERE, ray_session

    there = home if home and home.is_dir() else None
    try:
        with ray_session(1, home=there) as remarks:
            notes = [Finding("note", "ray", remark) for remark in remarks[1:]]
            found = fence()
    except StoreError as error:
        advice = ": mend or start that cluster, or unset RAY_ADDRESS" if address() else ""
        if str(error).startswith(HERE):
            advice = ": free memory and /tmp, then try again"
        return [Finding("fault", "ray", f"{error}{advice}")]
    able = ", and every node can train" if there else ""
    if address():
        return [Finding("ok", "ray", f"the cluster at {address()} answers{able}"), *notes]
    return [_own(*found)]


def _own(host: str, locked: bool) -> Finding:
    if locked and host == LOOPBACK:
        return Finding("ok", "ray", f"starts, listens on {host} alone and asks for a token")
    text = f"starts, but listens on {host} and asks {'' if locked else 'nobody '}for a token: make setup"
    return Finding("fault", "ray", text)
