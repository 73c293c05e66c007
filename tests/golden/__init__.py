"""Digests of results that must not change unnoticed: `python -m tests.golden` prints them, `--write` keeps them.

A digest that changes is either another arithmetic, and then `pipelines.workspace.arithmetic` names the operations, or a
change of the code that changes results, which is said in the changelog and ages the runs that it concerns.
"""

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from torch import Tensor

from pipelines.conformance.blocks import fitted, nested
from pipelines.export.tables import write_tables
from pipelines.specs.study import Setting
from pipelines.tracking.plan import flatten, items, study_card
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS
from rhmc.learning.learner import Learner
from rhmc.training.trainer import Trainer
from rhmc.yardsticks.scores import play_yardsticks
from tests.memory_tracker import MemoryTracker
from tests.pipelines.support import lasting, tiny

FILE = Path(__file__).with_name("digests.json")
DIGITS = 12
SMALL = {  # widths as in the studies, where the processor chooses its instructions; everything else small
    "encoder": "pairwise",
    "pretrain": 600,
    "buffer_size": 1000,
    "batch_size": 64,
    "learning_starts": 256,
    "train_freq": 32,
    "n_steps": 10,
    "epochs": 2,
    "minibatches": 2,
}
RUN = {"steps": 1600, "num_envs": 32, "evaluations": 2, "eval_episodes": 10, "final_episodes": 10}
VARIANTS: dict[str, dict[str, Any]] = {  # beside every method in every task
    "rhmc exact": {
        "kind": "rhmc",
        "regulator": "exact",
        "horizon": 6,
        "assignment_period": 5,
        "coordinator": {"gradient": "counterfactual", "standardise": "reward"},
        "executor": {"method": "expected"},
    },
    "rhmc qmix": {"kind": "rhmc", "executor": {"method": "qmix", "reward": "team"}},
    "qmix mlp": {"kind": "qmix", "encoder": "mlp", "standardise": "return"},
    "mappo kl": {"kind": "mappo", "objective": "kl_adaptive", "encoder": "mlp"},
}


def cases() -> dict[str, Callable[[], str]]:
    """The cases that are digested, by name; calling one takes a second or two."""
    kinds = {kind: {"kind": kind} for kind in ALGORITHMS} | VARIANTS
    found = {f"{name} in {task}": _training(task, algo) for name, algo in kinds.items() for task in ENVS}
    found["maddpg in continuous navigation"] = _training("navigation", {"kind": "maddpg"}, continuous=True)
    found["iql gru in coverage"] = _training("coverage", {"kind": "iql", "encoder": "pairwise_gru"})
    mappo = {"kind": "mappo", "encoder": "mlp_gru", "segment_length": 5}
    found["mappo gru in navigation"] = _training("navigation", mappo)
    found |= {f"yardsticks of {task}": _yardsticks(task) for task in ENVS}
    return found | {"exported table": _table}


def setting(task: str, algo: dict[str, Any], **env: Any) -> Setting:
    """A short training."""
    task_fields = {"kind": task, "observation": "extended", **env}
    small = fitted(ALGORITHMS[algo["kind"]].config, SMALL)
    return Setting.model_validate({"env": task_fields, "algo": nested(small | flatten(algo)), "trainer": RUN})


def _training(task: str, algo: dict[str, Any], **env: Any) -> Callable[[], str]:
    """Every point of the curve, the finals among them, and all that the method has learned."""

    def run() -> str:
        one = setting(task, algo, **env)
        trainer = Trainer(one.env, one.algo, one.trainer, 0)
        return digest([list(trainer), [_learned(learner) for learner in trainer.algorithm.learners()]])

    return run


def _learned(learner: Learner[Any]) -> dict[str, Any]:
    """The state under the keys with which the digests were made: they are part of a digest."""
    nets = {"net": learner.net.state_dict(), "slow": learner.target_net.state_dict()}
    return nets | {"optimiser": learner.optimiser.state_dict()}


def _yardsticks(task: str) -> Callable[[], str]:
    return lambda: digest(play_yardsticks(ENVS[task].config(), episodes=4, seed=1))


def _table() -> str:
    """The bytes of a study's exported values, as its report reads them; not of its runs, which name the code."""
    study = lasting(tiny())
    tracker = MemoryTracker(study_card(study), [])
    for item in items(study):
        log = tracker.start(item.card)
        log.log(list(Trainer(item.spec.env, item.spec.algo, item.spec.trainer, item.spec.seed)))
        log.finish("finished")
    with TemporaryDirectory() as folder:
        write_tables(study, items(study), tracker, Path(folder))
        return hashlib.sha256((Path(folder) / f"{study.name}.parquet").read_bytes()).hexdigest()[:DIGITS]


def digest(tree: Any) -> str:
    """Of numbers and tensors in dicts and lists, bit for bit."""
    whole = hashlib.sha256()
    for part in _leaves(tree):
        whole.update(part)
    return whole.hexdigest()[:DIGITS]


def _leaves(tree: Any) -> Iterator[bytes]:
    if isinstance(tree, Tensor):
        yield tree.detach().cpu().contiguous().numpy().tobytes()
    elif isinstance(tree, dict):
        for key in sorted(tree, key=str):
            yield str(key).encode()
            yield from _leaves(tree[key])
    elif isinstance(tree, list | tuple):
        for value in tree:
            yield from _leaves(value)
    else:
        yield (tree.hex() if isinstance(tree, float) else str(tree)).encode()


def kept() -> dict[str, str]:
    """The digests in the repository."""
    found: dict[str, str] = json.loads(FILE.read_text(encoding="utf-8"))
    return found
