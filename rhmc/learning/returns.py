"""Returns and advantages of time-major sequences.

The estimators take (T, B[, N]) tensors. `next_values` is the value of the true successor of each step, that of the
last observation where an episode ends there; `terminated` says that nothing follows (no bootstrap), `done` that the
next row belongs to another episode. A step truncated by a time limit is `done` but not `terminated`: it bootstraps.
"""

import torch
from torch import Tensor


def gae(
    reward: Tensor,
    value: Tensor,
    next_values: Tensor,
    terminated: Tensor,
    done: Tensor,
    gamma: float,
    gae_lambda: float,
) -> Tensor:
    """Generalised advantage estimates (Schulman et al. 2016, eq. 16)."""
    error = reward + gamma * next_values * ~terminated - value
    keep = gamma * gae_lambda * (~done).to(error.dtype)
    advantage, after = torch.empty_like(error), torch.zeros_like(error[0])
    for t in reversed(range(len(error))):
        after = advantage[t] = error[t] + keep[t] * after
    return advantage


def td_lambda(
    reward: Tensor, next_values: Tensor, terminated: Tensor, done: Tensor, gamma: float, lam: float
) -> Tensor:
    """Lambda-returns (Sutton and Barto, eq. 12.18, recursively); the end of the sequence bootstraps."""
    live = gamma * (~terminated).to(next_values.dtype)
    share = lam * (~done).to(next_values.dtype)
    target, after = torch.empty_like(next_values), next_values[-1]
    for t in reversed(range(len(reward))):
        target[t] = reward[t] + live[t] * torch.lerp(next_values[t], after, share[t])
        after = target[t]
    return target


def n_step(reward: Tensor, next_values: Tensor, terminated: Tensor, done: Tensor, gamma: float, n: int) -> Tensor:
    """Returns of up to `n` rewards and a bootstrap; fewer at the end of an episode or of the sequence."""
    live = gamma * (~terminated).to(next_values.dtype)
    target = reward + live * next_values
    for _ in range(n - 1):
        longer = reward[:-1] + live[:-1] * target[1:]
        target = torch.cat((torch.where(done[:-1], target[:-1], longer), target[-1:]))
    return target


def normalised(advantage: Tensor) -> Tensor:
    """Mean 0 and deviation 1 over the whole batch."""
    return (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-8)
