"""Table 1: what the table of algorithms says of every method, with its defaults and the parameters that it builds."""

import json
from pathlib import Path
from typing import Any, NamedTuple, get_args

import torch
from torch import Generator, nn
from torch.nn.modules.module import register_module_forward_hook

from pipelines.specs.plugins import discover
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import whole
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import EnvConfig, coverage, make_env, navigation
from rhmc.networks.nets import EncoderName

FILE = "methods.json"
TASKS: tuple[EnvConfig, ...] = (coverage.Config(agents=4, targets=5), navigation.Config(agents=3))  # the paper's


class Count(NamedTuple):
    """Numbers of parameters: of the networks that act greedily, and of all that learn (target networks left out)."""

    acting: int
    all: int


def describe() -> list[dict[str, Any]]:
    """Every method in the order of the table: the fields of `About`, `parameters` per task and encoder, `defaults`."""
    discover()
    rows = []
    for kind, method in ALGORITHMS.items():
        sizes = [
            {"task": env.model_dump(mode="json", exclude={"boxes"}), "encoder": encoder}
            | count(kind, encoder, env)._asdict()
            for env in TASKS
            for encoder in get_args(EncoderName)
        ]
        defaults = method.config().model_dump(mode="json")
        rows.append({"kind": kind} | method.about._asdict() | {"parameters": sizes, "defaults": defaults})
    return rows


def count(kind: str, encoder: str, env: EnvConfig) -> Count:
    """Parameters of a method with its default settings, shared by all agents, in a task."""
    method = ALGORITHMS[kind]
    task = make_env(env, 1, Generator())
    with torch.random.fork_rng(devices=[]):
        chosen = {"encoder": encoder} if "encoder" in method.config.model_fields else {}
        algorithm = method.build(method.config(**chosen), task.spec, 1, Generator())
    used: dict[int, int] = {}

    def use(module: nn.Module, inputs: Any, output: Any) -> None:
        used.update({id(p): p.numel() for p in module.parameters(recurse=False)})

    hook = register_module_forward_hook(use)
    try:
        with torch.no_grad():
            algorithm.act(task.reset(), algorithm.carry(1), Generator(), explore=False)
    finally:
        hook.remove()
    learning = [value for one in algorithm.learners() for value in one.net.state_dict().values()]
    return Count(sum(used.values()), sum(value.numel() for value in learning))


def export_methods(out: Path) -> Path:
    """Write `methods.json` in a folder: the list that `describe` gives.

    Raises:
        InputError: the folder is a file.
        StoreError: the folder cannot be written to.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"--out: {out} is not a folder")
    file, text = out / FILE, json.dumps(describe(), indent=1, ensure_ascii=False)
    with whole(file) as part:
        part.write_text(text + "\n", encoding="utf-8")
    return file
