"""QMIX: the team's value is a monotone function of the agents' values, with weights made from the state.

Source: Rashid et al. 2018, figure 2 and section 4; sizes and defaults after EPyMARL's benchmark (Papoudakis et al.
2021) and the RHMC text, section 5.1.
Departures: as in `iql` (feed-forward, replay of steps, double Q, target network moved by a share (`tau`), truncation
bootstraps), Adam instead of RMSprop; the state is what all agents observe; with the pairwise encoder the weights on an
agent's value come from its own embedding (`PairwiseMixer`), so that they fit any number of agents.
"""

from typing import Literal

from pydantic import Field
from torch import Generator

from rhmc.algorithms import qlearning, recurrent_qlearning
from rhmc.algorithms.base import About, Method, register_method
from rhmc.networks.nets import Sizes
from rhmc.networks.recurrent import encoder
from rhmc.types import Spec

ABOUT = About(
    name="QMIX",
    source="Rashid et al. 2018",
    family="value-based",
    training="centralised",
    execution="decentralised",
    critic="none: a monotone mixture of the agents' action values, weighted by the state",
    coordination="credit by a monotone value",
)


class Config(qlearning.Config):
    """Settings; lr and gamma are the paper's, the mixer's size its source's."""

    kind: Literal["qmix"] = "qmix"
    mixing_embed_dim: int = Field(32, ge=1, description="units of the mixer's hidden layer")


def build(cfg: Config, spec: Spec, num_envs: int, rng: Generator) -> qlearning.QLearning:
    """The learner."""
    mixer = encoder(cfg.encoder).mixer(Sizes.of(spec), cfg.hidden_dim, cfg.mixing_embed_dim)
    return recurrent_qlearning.learner(cfg, spec, rng, mixer)


register_method("qmix", Method(Config, build, ABOUT))
