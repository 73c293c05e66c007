"""The machine and the libraries that make runs, in words for people: a report's provenance."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

CPUINFO = Path("/proc/cpuinfo")
LIBRARIES = ("torch", "numpy", "ray", "mlflow")


class Host(NamedTuple):
    """A machine and the versions on it; empty where nothing is known."""

    machine: str = ""
    versions: str = ""


def host() -> Host:
    """This one."""
    machine = f"{_processor()}, {os.cpu_count()} processors, {platform.system()}"
    versions = [
        f"Python {platform.python_version()}",
        *(f"{name} {found}" for name in LIBRARIES if (found := _of(name))),
    ]
    return Host(machine, ", ".join(versions))


def _processor() -> str:
    lines = CPUINFO.read_text(encoding="utf-8").splitlines() if CPUINFO.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _of(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return ""
