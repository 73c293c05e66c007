"""The policies and checkpoints of a bundle, each loaded and tried in its run before anything is written."""

import math
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from pipelines.bundles.files import BundleError, Files
from pipelines.bundles.rows import Entry, metric_fault, on_grid
from pipelines.execution.finite import astray
from pipelines.specs.document import show
from pipelines.tracking.plan import resolved_yaml
from pipelines.tracking.policy import CONFIG, FILE, Actor, Saved, load
from pipelines.tracking.tracker import StudyCard
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import load_whole, one_line
from rhmc.training.trainer import grid_step

VALUES = 1_000_000  # dicts, lists, tensors, numbers and texts in a state
DEEP = 30  # of them inside each other
PLAIN = (list, tuple, bool, int, float, str, bytes, type(None))
TRAINER = {"env", "act_rng", "algorithm", "obs", "carry", "step", "point"}


def check_states(files: Files, entries: Sequence[Entry], study: StudyCard, desk: Path) -> dict[str, str]:
    """Load every policy and checkpoint of a bundle, one at a time.

    Args:
        files: of the bundle.
        entries: its runs.
        study: theirs.
        desk: a folder of our own; empty afterwards.

    Returns:
        SHA-256 of each file by name: who reads it again sees whether it is the one that was checked.

    Raises:
        BundleError: one of them is not what it should be.
    """
    seals: dict[str, str] = {}
    for entry in entries:
        for name in states_of(files, entry):
            seals[name] = _check(files, name, entry, study, desk)
    return seals


def states_of(files: Files, entry: Entry) -> list[str]:
    """The names of a run's policy or checkpoints, the oldest first."""
    if entry.finished:
        return [entry.files] if entry.policy else []
    return sorted(name for name in files.sizes if name.startswith(entry.files))


def _check(files: Files, name: str, entry: Entry, study: StudyCard, desk: Path) -> str:
    file = desk / FILE
    seal = files.copy(name, file)
    if entry.finished and seal != entry.policy:
        raise BundleError(f"{name}: has changed since it was written")
    (desk / CONFIG).write_text(resolved_yaml(entry.item, study), encoding="utf-8")  # for one that does not say its run
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch's, of archives that are none of its own
            state = _loaded(name, file)
            if not entry.finished:
                _check_progress(name, Path(name).stem, state, entry)
            _check_fit(name, file, entry)
    finally:
        for part in (file, desk / CONFIG):
            part.unlink(missing_ok=True)
    return seal


def _loaded(name: str, file: Path) -> dict[str, Any]:
    try:
        with zipfile.ZipFile(file) as archive:  # as torch writes it: nothing in it is larger than it is here
            if sum(info.file_size for info in archive.infolist()) > file.stat().st_size:
                raise BundleError(f"{name}: packed more tightly than torch does; a checkpoint is not compressed")
        state = load_whole(file)
    except BundleError:
        raise
    except Exception as error:  # any error: nothing is deleted, and nothing taken in
        raise BundleError(f"{name}: not a checkpoint that can be read ({one_line(error)})") from error
    if not isinstance(state, dict):
        raise BundleError(f"{name}: readable, but not a checkpoint of a run")
    for count, (depth, value) in enumerate(_walk(state)):
        if count > VALUES or depth > DEEP:
            raise BundleError(f"{name}: more than {VALUES:,} values, or more than {DEEP} inside each other")
        if fault := _value_fault(value):
            raise BundleError(f"{name}: {fault}")
    return state


def _walk(state: Any) -> Iterator[tuple[int, Any]]:
    """Every value and how deep it lies; what is there in several places several times."""
    stack = [(0, state)]
    while stack:
        depth, value = stack.pop()
        yield depth, value
        inner = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list | tuple) else ()
        stack += [(depth + 1, one) for one in inner]


def _value_fault(value: Any) -> str:
    if isinstance(value, dict):
        odd = [key for key in value if not isinstance(key, str | int)]
        return f"a key of kind {type(odd[0]).__name__} is not allowed; must be text or a number" if odd else ""
    if isinstance(value, torch.Tensor):
        plain = value.layout == torch.strided and not value.is_quantized
        whole = plain and value.numel() * value.element_size() <= value.untyped_storage().nbytes()
        return "" if whole else "a tensor that is larger than its content is not allowed"
    if isinstance(value, PLAIN):
        return ""
    return f"a value of kind {type(value).__name__} is not allowed; must be a tensor, a number or text"


def _check_progress(name: str, point: str, state: dict[str, Any], entry: Entry) -> None:
    """The progress that a checkpoint states."""
    trainer, history, seconds = state.get("trainer"), state.get("history"), state.get("seconds")
    if not (isinstance(trainer, dict) and trainer.keys() == TRAINER and isinstance(history, list)):
        raise BundleError(f"{name}: not a checkpoint of a run under way; it has trainer, history and seconds")
    cfg, done = entry.item.spec.trainer, int(point)
    told = _real(seconds) and _real(trainer["point"]) and trainer["point"] == done - 1
    if not told or not 0 < done == len(history) <= cfg.evaluations + 1:
        raise BundleError(f"{name}: has not the {done} points of its name")
    if not _real(trainer["step"]) or trainer["step"] != grid_step(cfg, done - 1):
        raise BundleError(f"{name}: step {show(trainer['step'])} is not allowed; must be {grid_step(cfg, done - 1):,}")
    for values in history:
        if fault := _history_fault(values, entry):
            raise BundleError(f"{name}: history: {fault}")


def _history_fault(values: Any, entry: Entry) -> str:
    if not isinstance(values, dict) or not _real(values.get("step")):
        return "must be points with a step"
    step = values["step"]
    if step < 0 or step != int(step) or not on_grid(entry.item.spec.trainer, int(step)):
        return f"step {step} is not allowed; must be on the run's grid"
    for metric, value in values.items():
        if not isinstance(metric, str) or not _real(value):
            return f"{show(metric)} at step {step:.0f} must be a finite number"
        if metric != "step" and (fault := metric_fault(metric)):
            return f"{show(metric)} is not allowed; {fault}"
    return ""


def _real(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _check_fit(name: str, file: Path, entry: Entry) -> None:
    """See that the state is one of its run, and that a team can act with it."""
    try:
        saved = load(file)
        if saved.spec != entry.item.spec:
            raise BundleError(f"{name}: of another run ({saved.spec.id}); must be of {entry.item.spec.id}")
        Actor(Saved(saved.spec, saved.algorithm))
    except BundleError:
        raise
    except InputError as error:
        raise BundleError(f"{name}: {one_line(error).removeprefix(f'{file}: ')}") from error
    except Exception as error:  # a state of other code fails anywhere in ours
        raise BundleError(f"{name}: does not fit its run: {one_line(error)}; --values-only leaves it behind") from error
    if entry.finished:
        for place, _ in astray(saved.algorithm):
            raise BundleError(f"{name}: {show(place)}: a weight is not a finite number")
