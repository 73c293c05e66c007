"""VDN, value decomposition: the team's value is the sum of the agents' values.

Source: Sunehag et al. 2018; defaults after EPyMARL's benchmark (Papoudakis et al. 2021) and the RHMC text, section 5.1.
Departures: as in `iql` (feed-forward, replay of steps, double Q, target network moved by a share (`tau`),
truncation bootstraps).
"""

from typing import Literal

from torch import Generator, Tensor, nn

from rhmc.algorithms import qlearning, recurrent_qlearning
from rhmc.algorithms.base import About, Method, register_method
from rhmc.types import Obs, Spec

ABOUT = About(
    name="VDN",
    source="Sunehag et al. 2018",
    family="value-based",
    training="centralised",
    execution="decentralised",
    critic="none: the sum of the agents' action values",
    coordination="credit by an additive value",
)


class Config(qlearning.Config):
    """Settings; lr and gamma are the paper's."""

    kind: Literal["vdn"] = "vdn"


class Sum(nn.Module):
    """(B, N) -> (B, 1)."""

    def forward(self, obs: Obs, values: Tensor) -> Tensor:
        return values.sum(-1, keepdim=True)


def build(cfg: Config, spec: Spec, num_envs: int, rng: Generator) -> qlearning.QLearning:
    """The learner."""
    return recurrent_qlearning.learner(cfg, spec, rng, Sum())


register_method("vdn", Method(Config, build, ABOUT))
