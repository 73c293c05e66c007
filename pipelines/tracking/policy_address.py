"""A policy by its address: a file, a folder, a finished run of the log, a version in MLflow's registry."""

import re
from pathlib import Path

from pipelines.specs.document import choices, nearest, show
from pipelines.tracking.policy import CONFIG, FILE, NoPolicyError, Saved, load
from pipelines.workspace.errors import InputError
from pipelines.workspace.leftovers import scratch
from pipelines.workspace.work_folder import Home, StoreError

RUN = re.compile(r"(?:runs:/)?([0-9a-f]{32})")  # MLflow names a run by 32 digits
MODEL = re.compile(r"models:/([^/@]+)/([0-9]{1,9})")
SCHEMES = ("runs:", "models:")
FORMS = "a file, a folder, runs:/ID with the 32 digits of a finished run, models:/NAME/VERSION"


def is_stored(address: str) -> bool:
    """True if an address is one of MLflow's: what it names never changes."""
    return bool(RUN.fullmatch(address)) or address.startswith(SCHEMES)


def is_policy(address: str) -> bool:
    """True if an address is that of a policy, for verbs that take a study as well."""
    return is_stored(address) or Path(address).suffix == ".pt" or Path(address).is_dir()


def saved_at(address: str, home: Home) -> Saved:
    """The policy at an address.

    Raises:
        InputError: there is none, or it cannot be read.
    """
    if Path(address).exists() or not is_stored(address):
        return _in_folder(Path(address))
    if found := RUN.fullmatch(address):
        return of_run(found[1], home)
    model = MODEL.fullmatch(address)
    if model is None:
        raise InputError(f"{show(address)}: no such form of an address; allowed: {FORMS}")
    return of_run(_run_of(model[1], model[2], home), home)


def _in_folder(path: Path) -> Saved:
    try:
        return load(path)
    except NoPolicyError as error:
        near = nearest(path.name, [one.name for one in sorted(path.parent.glob("*"))]) if not path.exists() else ""
        raise NoPolicyError(f"{error.args[0]}{near}") from error


def of_run(ref: str, home: Home) -> Saved:
    """The policy that a finished run of the log keeps.

    Raises:
        InputError: there is no such run, or it keeps none.
    """
    from pipelines.tracking.mlflow_tracker import fetch  # 3 s

    with scratch() as folder:
        try:
            found = fetch(ref, [FILE, CONFIG], home, Path(folder))
        except StoreError as error:
            raise InputError(str(error)) from error
        if FILE not in found:
            raise InputError(f"run {ref} keeps no {FILE}: it is not finished, or the file is gone")
        return load(Path(folder))


def _run_of(name: str, version: str, home: Home) -> str:
    """The run whose policy a version in the registry is."""
    from pipelines.tracking.mlflow_tracker import versions

    try:
        found = versions(name, home)
    except StoreError as error:
        raise InputError(str(error)) from error
    if isinstance(found, list):
        raise InputError(f"no model {show(name)} in the registry; {choices(name, found) if found else 'it is empty'}")
    if version not in found:
        raise InputError(f"model {show(name)} has no version {version}; allowed: {', '.join(found)}")
    return found[version]
