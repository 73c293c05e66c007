"""Policies that runs start from (`trainer.init`): looked for at their addresses, named by what is taken over of them,
and kept in the work folder under that name, where workers find them and where they stay when the address is gone.
"""

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from torch import Tensor

from pipelines.specs.initial import DIGEST, Find, Policy
from pipelines.specs.study import RunSpec
from pipelines.tracking.policy import NoPolicyError, Saved, load, save
from pipelines.tracking.policy_address import is_stored, saved_at
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import Home, StoreError, whole, work_folder
from rhmc.learning.initial import learned
from rhmc.training.trainer import Trainer
from rhmc.types import State

GONE = "not there any more: the copy in the work folder is used"


# Looking for them


def finder(home: Path) -> Find:
    """A search for the policies of a study: in its folder, in the current one, in the log.

    Args:
        home: the work folder, whose copies stand for what is gone. Nothing is written there.
    """
    place = Home(home)

    def find(address: str, folder: Path) -> Policy:
        if DIGEST.fullmatch(address):
            return _policy(_by_digest(address, place), address)
        if is_stored(address):
            return _policy(_noted(place, address) or saved_at(address, place), address)
        paths = [str((folder / address).resolve()), str(Path(address).resolve())]
        there = [path for path in paths if Path(path).exists()]
        before = [(known, path) for path in paths if (known := _noted(place, path))]
        if before and not there:
            return _policy(*before[0], GONE)
        full = [*there, *paths][0]
        return _policy(saved_at(full, place), full)

    return find


def _policy(saved: Saved, address: str, more: str = "") -> Policy:
    name, spec = digest(saved.algorithm), saved.spec
    words = f"policy {name}: {spec.algo.kind} in {spec.env.kind}, seed {spec.seed}, {saved.reached}"
    return Policy(name, address, spec, saved.algorithm, f"{words}; {more}" if more else words)


def _by_digest(name: str, home: Home) -> Saved:
    try:
        return kept(name, home.root)
    except StoreError as error:
        raise InputError(str(error)) from error


def digest(state: State) -> str:
    """16 hex digits over all that a run takes over of a method's state: equal exactly for equal bits."""
    whole = hashlib.sha256()
    for name, value in _tensors(learned(state)):
        plain = value.detach().cpu().contiguous()
        whole.update(f"{name} {plain.dtype} {tuple(plain.shape)}\n".encode())
        whole.update(plain.numpy().tobytes())
    return whole.hexdigest()[:16]


def _tensors(state: State, at: str = "") -> Iterator[tuple[str, Tensor]]:
    for key in sorted(state):
        if isinstance(state[key], Tensor):
            yield f"{at}{key}", state[key]
        else:
            yield from _tensors(state[key], f"{at}{key}/")


# Keeping them


def keep(policies: Mapping[str, str], home: Path) -> None:
    """Copy policies into a work folder, for workers and for later launches.

    Args:
        policies: addresses by digest, as a study has them.
        home: the work folder.

    Raises:
        StoreError: one has changed since it was looked for, or the folder cannot be written to.
    """
    place = Home(home)
    for name, address in policies.items():
        with suppress(StoreError):
            kept(name, place.root)
            _note(place, address, name)
            continue
        try:
            saved = saved_at(address, place)
        except InputError as error:
            raise StoreError(f"trainer.init: {error.args[0]}") from error
        if digest(saved.algorithm) != name:
            raise StoreError(f"trainer.init: {address}: has changed meanwhile; launch again")
        save(_file(place, name), saved)
        _note(place, address, name)


def kept(name: str, home: Path) -> Saved:
    """The copy of a policy in a work folder.

    Raises:
        StoreError: there is none, or it is damaged.
    """
    file = _file(Home(home), name)
    try:
        saved = load(file)
    except NoPolicyError as error:
        text = f"trainer.init: no copy of policy {name} that is whole in {file.parent}"
        raise StoreError(f"{text}; a study that gives its address brings one") from error
    except InputError as error:
        raise StoreError(f"trainer.init: {error.args[0]}") from error
    if digest(saved.algorithm) != name:
        raise StoreError(f"trainer.init: {file}: holds another policy; move it away")
    return saved


def begun(spec: RunSpec, home: Path | None = None) -> Trainer:
    """A run before its first point, with what it starts from.

    Args:
        spec: the run.
        home: the work folder that has a copy of the policy; this user's if None.

    Raises:
        StoreError: the work folder has no copy of the policy.
    """
    trainer = Trainer(spec.env, spec.algo, spec.trainer, spec.seed)
    if spec.trainer.init:
        trainer.start_from(kept(spec.trainer.init, home or work_folder()).algorithm)
    return trainer


def _file(home: Home, name: str) -> Path:
    return home.root / "policies" / f"{name}.pt"


# Addresses that were kept: which policy was there, for when it is gone


def _of_address(home: Home, address: str) -> Path:
    return home.root / "policies" / f"{hashlib.sha256(address.encode()).hexdigest()[:16]}.address"


def _note(home: Home, address: str, name: str) -> None:
    if not DIGEST.fullmatch(address):
        with whole(_of_address(home, address)) as part:
            part.write_text(f"{name}\n{address}\n", encoding="utf-8")


def _noted(home: Home, address: str) -> Saved | None:
    """The copy of the policy that was at an address."""
    with suppress(OSError, ValueError, StoreError):
        name, there = _of_address(home, address).read_text(encoding="utf-8").splitlines()
        if there == address and DIGEST.fullmatch(name):
            return kept(name, home.root)
    return None
