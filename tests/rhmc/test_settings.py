"""Settings: the defaults on which results depend, and the bounds of numbers, in one table."""

from collections.abc import Iterator
from typing import Any

from annotated_types import Ge, Gt, Le
from pydantic import BaseModel

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
executor.epsilon >= 0 <= 1: 0.05 (rhmc, hitmac)
executor.gamma >= 0 <= 1: 0.99 (rhmc, hitmac)
executor.logit_penalty >= 0: 0.001 (rhmc, hitmac)
executor.method: 'expected' (hitmac)
executor.method: 'gumbel' (rhmc)
executor.reward: 'local' (rhmc, hitmac)
executor.standardise: 'none' (rhmc, hitmac)
filter: 'on' (rhmc, hitmac)
final_episodes >= 1: 500 (trainer)
final_lr_fraction >= 0 <= 1: 1.0 (trainer)
gae_lambda >= 0 <= 1: 0.95 (mappo, ippo)
gamma >= 0 <= 1: 0.95 (coma)
gamma >= 0 <= 1: 0.99 (qmix, vdn, iql, maddpg, mappo, ippo)
hidden_dim >= 1: 64 (rhmc, qmix, vdn, iql, maddpg, coma, mappo, ippo, hitmac)
horizon >= 1: 1 (rhmc)
huber > 0: 10.0 (mappo, ippo)
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
    raise AssertionError(one)


def test_defaults_and_bounds_are_those_of_the_published_results() -> None:
    owners: dict[tuple[str, str, str], list[str]] = {}
    for owner, model in MODELS.items():
        for setting in settings(model):
            owners.setdefault(setting, []).append(owner)
    rows = [f"{name} {bounds}: {default} ({', '.join(of)})" for (name, bounds, default), of in owners.items()]
    assert sorted(row.replace(" :", ":") for row in rows) == TABLE.splitlines()
