"""Greedy evaluation on fixed episodes, with a generator of its own."""

from typing import NamedTuple

import torch
from torch import Tensor

from rhmc.algorithms.base import Algorithm
from rhmc.envs import ENVS, EnvConfig, make_env

CHUNK = 500  # episodes stepped together: bounds memory


class Episodes(NamedTuple):
    """Per-episode results: each (episodes,)."""

    values: dict[str, Tensor]

    def means(self, prefix: str) -> dict[str, float]:
        """Mean of each value, and the standard error of the return, under `prefix`."""
        out = {f"{prefix}/{name}": float(value.mean()) for name, value in self.values.items()}
        score = self.values["return"]
        out[f"{prefix}/return_sem"] = float(score.std() / len(score) ** 0.5) if len(score) > 1 else 0.0
        return out


@torch.no_grad()
def evaluate(algorithm: Algorithm, cfg: EnvConfig, episodes: int, seed: int, device: str = "cpu") -> Episodes:
    """Play `episodes` greedy episodes, those that `seed` names.

    Starts and the task's own randomness depend on the seed alone, so every method and every point of a curve meets the
    same episodes.

    Returns:
        The task's summary of each episode (`return`, `coverage`, ...), in the units of its `summary`.
    """
    parts: list[dict[str, Tensor]] = []
    for start in range(0, episodes, CHUNK):
        batch = min(CHUNK, episodes - start)
        rng = torch.Generator(device).manual_seed(seed + start)
        parts.append(_play(algorithm, cfg, batch, rng))
    return Episodes({key: torch.cat([part[key] for part in parts]) for key in parts[0]})


def _play(algorithm: Algorithm, cfg: EnvConfig, batch: int, rng: torch.Generator) -> dict[str, Tensor]:
    env = make_env(cfg, batch, rng)
    acting = torch.Generator(rng.device).manual_seed(rng.initial_seed())
    obs, carry = env.reset(), algorithm.carry(batch)
    rewards, infos = [], []
    for _ in range(env.spec.episode):
        action, carry, extra = algorithm.act(obs, carry, acting, explore=False)
        step = env.step(action, extra.get("assignment"))
        obs = step.obs
        rewards.append(step.reward)
        infos.append(step.info)
    info = {key: torch.stack([i[key] for i in infos]) for key in infos[0]}
    return ENVS[cfg.kind].physics.summary(cfg, torch.stack(rewards), info)
