"""Independent Q-learning: every agent its own action value, learned from the team's reward; parameters shared.

Source: Tan 1993; defaults after EPyMARL's benchmark (Papoudakis et al. 2021) and the RHMC text, section 5.1.
Departures: feed-forward network instead of a recurrent one, and a replay of steps instead of episodes (with `encoder:
mlp_gru` or `pairwise_gru` a GRU and a replay of segments); double Q; a target network moved by a share (`tau`) instead
of a hard copy; truncation bootstraps (`trainer.bootstrap_on_truncation`).
"""

from typing import Literal

from torch import Generator, Tensor, nn

from rhmc.algorithms import qlearning, recurrent_qlearning
from rhmc.algorithms.base import About, Method, register_method
from rhmc.types import Obs, Spec

ABOUT = About(
    name="IQL",
    source="Tan 1993",
    family="value-based",
    training="decentralised",
    execution="decentralised",
    critic="none: action values from the own observation",
    coordination="none: every agent learns from the team's reward alone",
)


class Config(qlearning.Config):
    """Settings; lr and gamma are the paper's."""

    kind: Literal["iql"] = "iql"


class Own(nn.Module):
    """The agents' values as they are: (B, N)."""

    def forward(self, obs: Obs, values: Tensor) -> Tensor:
        return values


def build(cfg: Config, spec: Spec, num_envs: int, rng: Generator) -> qlearning.QLearning:
    """The learner."""
    return recurrent_qlearning.learner(cfg, spec, rng, Own())


register_method("iql", Method(Config, build, ABOUT))
