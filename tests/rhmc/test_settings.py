"""Settings: the defaults on which results depend, and the bounds of numbers, in one table."""

import ast
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from typing import Any

from annotated_types import Ge, Gt, Le
from pydantic import BaseModel

import rhmc
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS
from rhmc.training import trainer

MODELS: dict[str, type[BaseModel]] = {name: method.config for name, method in ALGORITHMS.items()}
MODELS |= {name: task.config for name, task in ENVS.items()} | {"trainer": trainer.Config}
TABLE = """\
actor_minibatches >= 1: 4 (coma)
advantage_estimator: 'return' (coma)
agents >= 1: 3 (navigation)
agents >= 1: 4 (coverage)
alpha >= 0 <= 1: 0.1 (rhmc)
assignment_period >= 1: 1 (rhmc)
assignment_period >= 1: 10 (hitmac)
batch_size >= 1: 256 (qmix, vdn, iql, maddpg)
bootstrap_on_truncation: True (trainer)
buffer_size >= 1: 50000 (rhmc, qmix, vdn, iql, maddpg, hitmac)
clip_range > 0: 0.2 (mappo, ippo)
continuous: False (navigation)
coordinator.assignment_epsilon >= 0 <= 1: 0.05 (rhmc)
coordinator.batch_size >= 1: 256 (rhmc)
coordinator.clip_range > 0: 0.2 (hitmac)
coordinator.ent_coef >= 0: 0.01 (hitmac)
coordinator.ent_coef >= 0: 0.2 (rhmc)
coordinator.epochs >= 1: 6 (hitmac)
coordinator.gae_lambda >= 0 <= 1: 1.0 (hitmac)
coordinator.gamma >= 0 <= 1: 0.9 (hitmac)
coordinator.gamma >= 0 <= 1: 0.99 (rhmc)
coordinator.gradient: 'ddpg' (rhmc)
coordinator.lr > 0: None (rhmc, hitmac)
coordinator.method: 'learned' (rhmc)
coordinator.minibatches >= 1: 4 (hitmac)
coordinator.n_steps >= 1: 20 (hitmac)
coordinator.reward: 'assigned' (rhmc)
coordinator.standardise: 'none' (rhmc)
coordinator.standardise: 'return' (hitmac)
coordinator.update_every >= 1: 1 (rhmc)
device: 'cpu' (trainer)
double_q: True (qmix, vdn, iql)
encoder: 'mlp' (rhmc, qmix, vdn, iql, maddpg, coma, mappo, ippo, hitmac)
ent_coef >= 0: 0.01 (mappo, ippo)
ent_coef >= 0: 0.03 (coma)
episode >= 1: 25 (navigation)
epochs >= 1: 10 (mappo, ippo)
epochs >= 1: 2 (coma)
epsilon >= 0 <= 1: 0.02 (coma)
epsilon >= 0 <= 1: 0.05 (maddpg)
epsilon_end >= 0 <= 1: 0.05 (qmix, vdn, iql)
epsilon_steps >= 1: 50000 (qmix, vdn, iql)
eval_episodes >= 1: 100 (trainer)
eval_seed >= 0: 10000000 (trainer)
evaluations >= 1: 100 (trainer)
executor.batch_size >= 1: 256 (rhmc, hitmac)
executor.critic_sees: 'all' (rhmc, hitmac)
executor.epsilon >= 0 <= 1: 0.05 (rhmc, hitmac)
executor.final_lr_fraction >= 0 <= 1: None (hitmac)
executor.gamma >= 0 <= 1: 0.99 (rhmc, hitmac)
executor.logit_penalty >= 0: 0.001 (rhmc, hitmac)
executor.lr > 0: None (rhmc, hitmac)
executor.method: 'expected' (hitmac)
executor.method: 'gumbel' (rhmc)
executor.reward: 'local' (rhmc, hitmac)
executor.standardise: 'none' (rhmc, hitmac)
executor.told: 'always' (rhmc, hitmac)
filter: 'on' (rhmc, hitmac)
final_episodes >= 1: 500 (trainer)
final_lr_fraction >= 0 <= 1: 1.0 (trainer)
gae_lambda >= 0 <= 1: 0.95 (mappo, ippo)
gamma >= 0 <= 1: 0.95 (coma)
gamma >= 0 <= 1: 0.99 (qmix, vdn, iql, maddpg, mappo, ippo)
hidden_dim >= 1: 64 (rhmc, qmix, vdn, iql, maddpg, coma, mappo, ippo, hitmac)
horizon >= 1: 1 (rhmc)
huber > 0: 10.0 (mappo, ippo)
init ~ ^[0-9a-f]{16}$: None (trainer)
kl_target > 0: 0.01 (mappo, ippo)
learning_starts >= 0: 2000 (rhmc, qmix, vdn, iql, maddpg, hitmac)
lr > 0: 0.0005 (rhmc, qmix, vdn, iql, maddpg, hitmac)
lr > 0: 0.001 (coma)
lr > 0: 0.002 (mappo, ippo)
max_grad_norm > 0: 10.0 (rhmc, qmix, vdn, iql, maddpg, coma, mappo, ippo, hitmac)
minibatches >= 1: 4 (mappo, ippo)
minibatches >= 1: 8 (coma)
mixing_embed_dim >= 1: 32 (qmix)
n_steps >= 1: 10 (coma)
n_steps >= 1: 25 (mappo, ippo)
noise >= 0: 0.2 (maddpg)
num_envs >= 1: 128 (trainer)
objective: 'clip' (mappo, ippo)
observation: 'paper' (coverage, navigation)
order: 'mpe2' (navigation)
penalty >= 0: 0.001 (maddpg)
penalty >= 0: 0.1 (coverage)
preset: 'flat' (coverage)
pretrain >= 0: 500000 (hitmac)
regulator: 'paper' (rhmc)
reward: 'paper' (navigation)
scale: True (coma)
segment_length >= 1: 25 (mappo, ippo)
segment_length >= 1: 8 (qmix, vdn, iql)
share: True (rhmc, qmix, vdn, iql, maddpg, coma, mappo, ippo, hitmac)
standardise: 'return' (coma, mappo, ippo)
standardise: 'reward' (qmix, vdn, iql, maddpg)
steps >= 1: 5000000 (trainer)
targets >= 1: 5 (coverage)
tau >= 0 <= 1: 0.005 (rhmc, qmix, vdn, iql, maddpg, hitmac)
tau >= 0 <= 1: 0.02 (coma)
td_lambda >= 0 <= 1: 0.9 (coma)
threads >= 1: 1 (trainer)
train_freq >= 1: 64 (rhmc, qmix, vdn, iql, maddpg, hitmac)
unassigned: 'free' (rhmc)
"""


def settings(model: type[BaseModel], block: str = "") -> Iterator[tuple[str, str, str]]:
    """Name, bounds and default of every setting, those of blocks with the block's name before a dot."""
    for name, field in model.model_fields.items():
        if isinstance(field.default, BaseModel):
            yield from settings(type(field.default), f"{name}.")
        elif name not in ("kind", "boxes"):
            yield block + name, " ".join(map(bound, field.metadata)), repr(field.default)


def bound(one: Any) -> str:
    match one:
        case Ge(least):
            return f">= {least}"
        case Gt(less):
            return f"> {less}"
        case Le(most):
            return f"<= {most}"
    if pattern := getattr(one, "pattern", ""):
        return f"~ {pattern}"
    raise AssertionError(one)


def test_defaults_and_bounds_are_those_of_the_published_results() -> None:
    owners: dict[tuple[str, str, str], list[str]] = {}
    for owner, model in MODELS.items():
        for setting in settings(model):
            owners.setdefault(setting, []).append(owner)
    rows = [f"{name} {bounds}: {default} ({', '.join(of)})" for (name, bounds, default), of in owners.items()]
    assert sorted(row.replace(" :", ":") for row in rows) == TABLE.splitlines()


CONSTANTS = """\
algorithms.hitmac.PRACTISED = 10
algorithms.ppo.POLICY_GAIN = 0.01
envs.coverage.BOXES[0] = (250, 750, 250, 750)
envs.coverage.BOXES[1] = (250, 750, -750, -250)
envs.coverage.BOXES[2] = (-1250, -750, -250, 250)
envs.coverage.BOXES[3] = (-750, -250, 250, 750)
envs.coverage.BOXES[4] = (750, 1250, -250, 250)
envs.coverage.BOXES[5] = (-750, -250, -750, -250)
envs.coverage.FIRST_MOVE = 30.0
envs.coverage.GOAL_RADIUS = 5.0
envs.coverage.HALF_AREA = 1250.0
envs.coverage.HALF_VIEW = 45.0
envs.coverage.PATIENCE = 100
envs.coverage.RANGE = 800.0
envs.coverage.REDRAWS = 50
envs.coverage.STUCK = 10.0
envs.coverage.TURN = 5.0
envs.coverage.TURNS = (0.0, 5.0, -5.0)
envs.navigation.CONTACT = 0.3
envs.navigation.DIRECTIONS[0] = (0.0, 0.0)
envs.navigation.DIRECTIONS[1] = (-1.0, 0.0)
envs.navigation.DIRECTIONS[2] = (1.0, 0.0)
envs.navigation.DIRECTIONS[3] = (0.0, -1.0)
envs.navigation.DIRECTIONS[4] = (0.0, 1.0)
envs.navigation.DT = 0.1
envs.navigation.FAR = 2.8284271247461903
envs.navigation.FORCE = 5.0
envs.navigation.KEPT = 0.75
envs.navigation.NEAR = 0.1
envs.navigation.SOFTNESS = 0.001
envs.navigation.STIFFNESS = 100.0
hierarchy.mixing_executor.MIXING_EMBED_DIM = 32
hierarchy.regulation.MOST_TARGETS = 12
hierarchy.theorem.CHUNK = 5000
hierarchy.theorem.COUNTING = 100.0
hierarchy.theorem.CROWDED = (4, 5, 8)
hierarchy.theorem.DENSITIES[0] = (0.3, 0.5)
hierarchy.theorem.DENSITIES[1] = (0.3, 1.0)
hierarchy.theorem.DENSITIES[2] = (0.5, 0.5)
hierarchy.theorem.DENSITIES[3] = (0.5, 1.0)
hierarchy.theorem.SIZES[0] = (2, 2, 3)
hierarchy.theorem.SIZES[1] = (4, 3, 5)
hierarchy.theorem.SIZES[2] = (4, 5, 8)
hierarchy.theorem.SIZES[3] = (4, 13, 5)
hierarchy.theorem.TOLERANCE = 1e-05
learning.normalisation.KEPT = 0.999
learning.normalisation.LEAST = 0.01
networks.linear.BLOCK = 512
networks.nets.LEAST = -1e-45
training.evaluation.CHUNK = 500
yardsticks.coverage.CENTRE = 0.001
yardsticks.coverage.HORIZON = 30
yardsticks.coverage.IDLE = 0.01
yardsticks.coverage.PASSES = 2
yardsticks.joint.MOST_ITEMS = 16
yardsticks.scores.CHUNK = 200
"""


def constants() -> Iterator[str]:
    """Numbers that modules of the science name, and groups of them."""
    for found in pkgutil.walk_packages(rhmc.__path__, "rhmc."):
        if found.name == "rhmc.portable":  # how the machine is used, not what is computed
            continue
        module = importlib.import_module(found.name)
        for name in assigned(inspect.getsource(module)):
            for part, value in parts(name, getattr(module, name)):
                yield f"{found.name.removeprefix('rhmc.')}.{part} = {value}"


def assigned(source: str) -> Iterator[str]:
    """Names of constants that a module gives a value to."""
    for statement in ast.parse(source).body:
        if isinstance(statement, ast.Assign | ast.AnnAssign):
            yield from (node.id for node in ast.walk(statement) if isinstance(node, ast.Name) and node.id.isupper())


def parts(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """A number or a group of numbers; of a group of groups each."""
    if isinstance(value, tuple) and all(isinstance(one, tuple) for one in value):
        yield from ((f"{name}[{i}]", one) for i, one in enumerate(value))
    elif all(type(one) in (int, float) for one in (value if isinstance(value, tuple) else (value,))):
        yield name, value


def test_numbers_of_the_science_are_those_of_the_published_results() -> None:
    assert sorted(set(constants())) == CONSTANTS.splitlines()
