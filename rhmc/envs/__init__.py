"""The tasks: each a configuration and a module of pure functions; `make_env` gives the thing that remembers."""

from typing import Any

import torch

from rhmc.envs import coverage, navigation
from rhmc.envs.base import Env, Physics

ENVS: dict[str, tuple[type[Any], Physics]] = {
    "coverage": (coverage.Config, coverage),
    "navigation": (navigation.Config, navigation),
}
EnvConfig = coverage.Config | navigation.Config


def make_env(cfg: EnvConfig, batch: int, rng: torch.Generator) -> Env:
    """B copies of the configured task on the generator's device."""
    return Env(ENVS[cfg.kind][1], cfg, batch, rng)
