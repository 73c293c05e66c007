"""Navigation without learning: (cfg, state, generator) -> actions, (B, N), or (B, N, 2) where they are continuous."""

import torch
from torch import Generator, Tensor

from rhmc.envs.navigation import DIRECTIONS, DT, FORCE, KEPT, Config, State
from rhmc.yardsticks.joint import best_choice


def random(cfg: Config, state: State, rng: Generator) -> Tensor:
    """Every action alike."""
    shape = state.position.shape
    if cfg.continuous:
        return torch.rand(shape, generator=rng, device=rng.device) * 2 - 1
    return torch.randint(len(DIRECTIONS), shape[:2], generator=rng, device=rng.device)


def hold(cfg: Config, state: State, rng: Generator) -> Tensor:
    """No force."""
    if cfg.continuous:
        return torch.zeros_like(state.position)
    return torch.zeros(state.position.shape[:2], dtype=torch.int64, device=rng.device)


def nearest(cfg: Config, state: State, rng: Generator) -> Tensor:
    """Each agent steers for its nearest landmark."""
    return steer(cfg, state, distances(state).argmin(-1))


def matching(cfg: Config, state: State, rng: Generator) -> Tensor:
    """Each agent steers for its own landmark, chosen so that the sum of distances is least."""
    return steer(cfg, state, match(distances(state)))


def distances(state: State) -> Tensor:
    """Of each agent to each landmark: (B, N, M)."""
    return torch.linalg.vector_norm(state.landmarks.unsqueeze(1) - state.position.unsqueeze(2), dim=-1)


def match(cost: Tensor) -> Tensor:
    """The cheapest one-to-one assignment, exactly: cost (B, N, N) -> (B, N) int64.

    Options of one landmark each: their union is largest, all landmarks, only if every agent takes another one.
    """
    single = torch.eye(cost.shape[-1], dtype=torch.bool, device=cost.device)
    return best_choice(single.expand(*cost.shape, -1), cost)


def steer(cfg: Config, state: State, landmark: Tensor) -> Tensor:
    """Bang-bang control: the force after which, with no more force, an agent comes to rest nearest to its landmark.

    It pushes at full force until it can coast there, and brakes when it would coast past.

    Args:
        landmark: (B, N) int64, which landmark each agent wants.
    """
    goal = state.landmarks.gather(1, landmark.unsqueeze(-1).expand(-1, -1, 2))
    coast = DT / (1 - KEPT)  # distance covered by unit speed without force
    before = 0.0 if cfg.order == "mpe1" else DT  # the mpe2 order moves once before the velocity changes
    rest = state.position + (before + coast * KEPT) * state.velocity
    push = coast * FORCE * DT  # how far a full force moves the place of rest
    if cfg.continuous:
        return ((goal - rest) / push).clamp(-1, 1)
    shift = push * torch.tensor(DIRECTIONS, device=goal.device)
    return torch.linalg.vector_norm((goal - rest).unsqueeze(2) - shift, dim=-1).argmin(-1)
