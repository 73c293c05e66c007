"""A trained policy, read from its file and ready to act as it does in evaluation."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import torch
from pydantic import ValidationError
from ruamel.yaml import YAML, YAMLError
from torch import Generator, Tensor

from pipelines.errors import InputError
from pipelines.store import one_line, save_atomically, without_replay
from pipelines.study import RunSpec
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS
from rhmc.types import Batch, Carry, Obs, Spec, State

FILE, CONFIG = "policy.pt", "config.yaml"  # what a run keeps
SPEC = "spec"  # key under which a file names its own run, as JSON


class Saved(NamedTuple):
    """What a file of a run holds."""

    spec: RunSpec
    algorithm: State


class Actor:
    """A team that acts greedily. It remembers from call to call what its method remembers within an episode.

    Args:
        saved: whose policy.

    Raises:
        ValueError: the state is not one of this method, or was saved by code that differs too much from this.
    """

    def __init__(self, saved: Saved) -> None:
        spec, state = saved
        self.env, self.sizes = spec.env, sizes(spec)
        method = ALGORITHMS[spec.algo.kind]
        rng = Generator()
        with torch.random.fork_rng(devices=[]):  # building draws weights, which are then replaced
            self.algorithm = method.build(spec.algo, self.sizes, spec.trainer.num_envs, rng)
        fresh = {"rng": rng.get_state()} if "rng" in state else {}  # of this device; acting greedily draws nothing
        try:
            self.algorithm.load_state_dict(state | fresh)
        except (KeyError, RuntimeError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"no state of '{spec.algo.kind}' as this code has it ({one_line(error)})") from error
        self.rng = Generator().manual_seed(0)
        self.carry: Carry = {}
        self.batch = 0

    @torch.no_grad()
    def act(self, obs: Obs) -> tuple[Tensor, Batch]:
        """Joint action (B, N[, A]) and what the method hands out beside it, such as an assignment (B, N, M).

        `obs.first` says where an episode begins; another B begins all of them.
        """
        if len(obs.first) != self.batch:
            self.batch = len(obs.first)
            self.carry = self.algorithm.carry(self.batch)
            obs = obs._replace(first=torch.ones_like(obs.first))
        action, self.carry, extra = self.algorithm.act(obs, self.carry, self.rng, explore=False)
        return action, extra


def sizes(spec: RunSpec) -> Spec:
    """Sizes of a run's task."""
    return ENVS[spec.env.kind][1].spec(spec.env)


def load(path: Path) -> Saved:
    """Read `policy.pt`, a training checkpoint, or the newest such file of a folder.

    A file says itself which run it is of; for one that does not (kept by an earlier version) `config.yaml` beside it
    is read.

    Raises:
        InputError: there is none, it cannot be read, or nothing says which run it is of.
    """
    file = _file(path)
    try:
        state = torch.load(file, weights_only=True, map_location="cpu")
    except Exception as error:  # cut short, or not a checkpoint: torch raises several kinds
        raise InputError(f"{file}: not a readable checkpoint ({one_line(error)})") from error
    inner = state.get("trainer", state) if isinstance(state, dict) else {}
    if not isinstance(inner, dict) or "algorithm" not in inner:
        raise InputError(f"{file}: a PyTorch file, but not a checkpoint of a run")
    return Saved(_spec(file, state.get(SPEC)), inner["algorithm"])


def save(path: Path, saved: Saved) -> None:
    """Write what is needed to act, and nothing else.

    Raises:
        StoreError: the file cannot be written.
    """
    save_atomically(path, {SPEC: saved.spec.canonical(), "algorithm": without_replay(saved.algorithm)})


def _file(path: Path) -> Path:
    if not path.is_dir():
        if not path.exists():
            raise InputError(f"{path}: no such file")
        return path
    found = [path / FILE] if (path / FILE).exists() else sorted(path.glob("[0-9]*.pt"), reverse=True)
    if not found:
        raise InputError(f"{path}: no {FILE} and no checkpoint in this folder")
    return found[0]


def _spec(file: Path, written: str | None) -> RunSpec:
    config = file.parent / CONFIG
    if written is None and not config.exists():
        raise InputError(f"{file}: does not say which run it is of, and there is no {CONFIG} beside it")
    try:
        fields: Any = json.loads(written) if written is not None else YAML(typ="safe").load(config)
        return RunSpec.model_validate({name: fields[name] for name in RunSpec.model_fields})
    except (ValidationError, YAMLError, ValueError, KeyError, TypeError, OSError) as error:
        source = file if written is not None else config
        raise InputError(f"{source}: not the settings of a run that this code knows ({one_line(error)})") from error
