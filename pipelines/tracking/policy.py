"""A trained policy, read from its file and ready to act as it does in evaluation."""

import json
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import torch
from pydantic import ValidationError
from ruamel.yaml import YAML, YAMLError
from torch import Generator, Tensor

from pipelines.specs.plugins import UnnamedError
from pipelines.specs.study import IMPORTS, RunSpec
from pipelines.workspace.errors import InputError
from pipelines.workspace.files import regular
from pipelines.workspace.work_folder import DamagedError, load_whole, one_line, save_atomically, without_replay
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS, EnvConfig
from rhmc.learning.acting import ACTS_ON
from rhmc.types import Batch, Carry, Obs, Spec, State

FILE, CONFIG = "policy.pt", "config.yaml"  # what a run keeps
SPEC = "spec"  # key under which a file names its own run, as JSON


class NoPolicyError(InputError):
    """There is no policy, or what was one is damaged."""


class Saved(NamedTuple):
    """The content of a policy's file."""

    spec: RunSpec
    algorithm: State
    reached: str = "finished"  # or how far the run has got


class Actor:
    """A team that acts greedily. It remembers from call to call what its method remembers within an episode.

    Args:
        saved: whose policy.
        env: the task to act in, with other numbers of agents and targets maybe; the run's own if None.
        device: where to act.

    Raises:
        ValueError: the state is not one of this method in this task, or was saved by code that differs too much.
    """

    def __init__(self, saved: Saved, env: EnvConfig | None = None, device: str = "cpu") -> None:
        spec, state = saved.spec, saved.algorithm
        self.env = env or spec.env
        self.sizes = sizes(self.env)
        method = ALGORITHMS[spec.algo.kind]
        rng = Generator(device)
        with torch.random.fork_rng(devices=[]):  # building draws weights, which are then replaced
            self.algorithm = method.build(spec.algo, self.sizes, spec.trainer.num_envs, rng)
        fresh = {"rng": rng.get_state()} if "rng" in state else {}  # of this device; acting greedily draws nothing
        try:
            self.algorithm.load_state_dict(state | fresh)
        except (KeyError, RuntimeError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"no state of '{spec.algo.kind}' as this code has it ({one_line(error)})") from error
        self.rng = Generator(device).manual_seed(0)
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


def sizes(env: EnvConfig) -> Spec:
    """Sizes of a task."""
    return ENVS[env.kind].physics.spec(env)


# Files


def load(path: Path, spec: RunSpec | None = None) -> Saved:
    """Read `policy.pt`, a training checkpoint, or the policy of a folder: the newest checkpoint that is whole.

    Args:
        path: the file or folder; nothing in it is changed.
        spec: which run it is of. If None, the file says it; for a file that does not (kept by an earlier version)
            `config.yaml` beside it does.

    Raises:
        NoPolicyError: there is none, or only damaged ones.
        InputError: it cannot be read, or nothing says which run it is of.
    """
    files = _files(path)
    for file in files[:-1]:  # the newest may be damaged, or dropped meanwhile
        with suppress(NoPolicyError):
            return _read(file, spec)
    return _read(files[-1], spec)


def save(path: Path, saved: Saved) -> None:
    """Write what is needed to act, and nothing else.

    Raises:
        StoreError: the file cannot be written.
    """
    save_atomically(path, {SPEC: saved.spec.canonical(), "algorithm": acting(saved.spec.algo.kind, saved.algorithm)})


def acting(method: str, state: State) -> State:
    """The part of a method's state that acting needs, as the method says; it may lack what learning keeps."""
    says = ACTS_ON.get(method)
    return says(state) if says else without_replay(state)


def settings(config: Path) -> tuple[RunSpec, str]:
    """The run that a `config.yaml` describes, and its arm.

    Raises:
        InputError: there is none, or it is something else.
    """
    try:
        regular(config, absent=True)
        tree = YAML(typ="safe", pure=True).load(config.read_text(encoding="utf-8"))
        return _spec(tree), str(tree.get("arm", "policy"))
    except FileNotFoundError as error:
        raise InputError(f"{config}: no such file; --config names the config.yaml that the run keeps") from error
    except UnnamedError as error:
        raise InputError(f"{config}: {error}") from error
    except (OSError, YAMLError, *NO_SPEC) as error:
        raise InputError(f"{config}: not the config.yaml of a run ({one_line(error)})") from error


NO_SPEC = (ValidationError, ValueError, KeyError, TypeError, AttributeError)  # what `_spec` may raise


def _spec(fields: Any) -> RunSpec:
    if missing := [name for name in RunSpec.model_fields if name not in fields and name != IMPORTS]:
        raise ValueError(f"{missing[0]}: missing")
    return RunSpec.model_validate({name: fields[name] for name in RunSpec.model_fields if name in fields})


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    found = [path / FILE] if (path / FILE).exists() else sorted(path.glob("[0-9]*.pt"), reverse=True)
    if not found:
        raise NoPolicyError(f"{path}: no {FILE} and no checkpoint in this folder")
    return found


def _read(file: Path, spec: RunSpec | None) -> Saved:
    regular(file, absent=True)
    try:
        state = load_whole(file)
    except FileNotFoundError as error:
        raise NoPolicyError(f"{file}: no such file") from error
    except DamagedError as error:  # cut short, or not a checkpoint
        raise NoPolicyError(f"{file}: not a readable checkpoint") from error
    inner = state.get("trainer", state) if isinstance(state, dict) else {}
    if not isinstance(inner, dict) or "algorithm" not in inner:
        raise InputError(f"{file}: readable, but not a checkpoint of a run")
    spec = spec or _told(file, state.get(SPEC))
    return Saved(spec, inner["algorithm"], _reached(spec, inner))


def _told(file: Path, written: str | None) -> RunSpec:
    """The run that a file says it is of."""
    if written is None:
        if not (config := file.parent / CONFIG).exists():
            raise InputError(f"{file}: does not say which run it is of, and there is no {CONFIG} beside it")
        return settings(config)[0]
    try:
        return _spec(json.loads(written))
    except UnnamedError as error:
        raise InputError(f"{file}: {error}") from error
    except NO_SPEC as error:
        raise InputError(f"{file}: not the settings of a run that this code knows ({one_line(error)})") from error


def _reached(spec: RunSpec, inner: State) -> str:
    under_way = "point" in inner and inner["point"] < spec.trainer.evaluations
    return f"at step {inner['step']:,}" if under_way else "finished"
