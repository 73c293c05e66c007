"""MAPPO: policies from the own observation, improved by proximal updates under a critic that sees everything.

Source: Yu et al. 2022 (objective, value normalisation, Huber loss, orthogonal weights, wide rollouts) after Schulman et
al. 2017; the RHMC text, section 5.1, has its adaptive KL penalty in place of the clip: `objective: kl_adaptive`.
Departures: ReLU, without layer normalisation; feed-forward networks unless `encoder` has a GRU; no clipped value loss;
4 minibatches and lr 2e-3 instead of 1 and 7e-4; the statistics of returns count each rollout once; the critic sees what
all agents observe and, with `mlp`, the agent's id; truncation bootstraps (`trainer.bootstrap_on_truncation`).
"""

from typing import Literal

from torch import Generator

from rhmc.algorithms import ppo, recurrent_ppo
from rhmc.algorithms.base import About, Method, register_method
from rhmc.types import Spec

ABOUT = About(
    name="MAPPO",
    source="Yu et al. 2022",
    family="policy gradient",
    training="centralised",
    execution="decentralised",
    critic="value of all observations",
    coordination="one advantage of the team, judged from everything",
)


class Config(ppo.Config):
    """Settings; gamma is the paper's, most of the rest the source's (`rhmc.algorithms.ppo`)."""

    kind: Literal["mappo"] = "mappo"


def build(cfg: Config, spec: Spec, num_envs: int, rng: Generator) -> ppo.PPO:
    """The learner."""
    return recurrent_ppo.learner(cfg, spec, rng, "central")


register_method("mappo", Method(Config, build, ABOUT))
