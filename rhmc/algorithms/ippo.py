"""IPPO: MAPPO with a critic that sees what its agent sees; parameters shared.

Source: de Witt et al. 2020; defaults as in `mappo`.
Departures: as in `mappo`; every agent learns from the team's reward.
"""

from typing import Literal

from torch import Generator

from rhmc.algorithms import ppo, recurrent_ppo
from rhmc.algorithms.base import About, Method, register_method
from rhmc.types import Spec

ABOUT = About(
    name="IPPO",
    source="de Witt et al. 2020",
    family="policy gradient",
    training="decentralised",
    execution="decentralised",
    critic="value of the own observation",
    coordination="none: every agent learns from the team's reward alone",
)


class Config(ppo.Config):
    """Settings; gamma is the paper's, the rest as in `mappo`."""

    kind: Literal["ippo"] = "ippo"


def build(cfg: Config, spec: Spec, num_envs: int, rng: Generator) -> ppo.PPO:
    """The learner."""
    return recurrent_ppo.learner(cfg, spec, rng, "local")


register_method("ippo", Method(Config, build, ABOUT))
