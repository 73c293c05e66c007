"""Returns and advantages of time-major sequences.

The estimators take (T, B[, N]) tensors. `following` is the value of the true successor of each step, that of the
last observation where an episode ends there; `terminal` says that nothing follows (no bootstrap), `ended` that the next
row belongs to another episode. A step that is cut by a time limit is `ended` but not `terminal`: it bootstraps.
"""

import torch
from torch import Tensor


def gae(
    reward: Tensor,
    value: Tensor,
    following: Tensor,
    terminal: Tensor,
    ended: Tensor,
    gamma: float,
    lam: float,
) -> Tensor:
    """Generalised advantage estimates (Schulman et al. 2016, eq. 16)."""
    error = reward + gamma * following * ~terminal - value
    keep = gamma * lam * (~ended).to(error.dtype)
    advantage, after = torch.empty_like(error), torch.zeros_like(error[0])
    for t in reversed(range(len(error))):
        after = advantage[t] = error[t] + keep[t] * after
    return advantage


def td_lambda(reward: Tensor, following: Tensor, terminal: Tensor, ended: Tensor, gamma: float, lam: float) -> Tensor:
    """Lambda-returns (Sutton and Barto, eq. 12.18, recursively); the end of the sequence bootstraps."""
    live = gamma * (~terminal).to(following.dtype)
    share = lam * (~ended).to(following.dtype)
    target, after = torch.empty_like(following), following[-1]
    for t in reversed(range(len(reward))):
        target[t] = reward[t] + live[t] * torch.lerp(following[t], after, share[t])
        after = target[t]
    return target


def n_step(reward: Tensor, following: Tensor, terminal: Tensor, ended: Tensor, gamma: float, n: int) -> Tensor:
    """Returns of up to `n` rewards and a bootstrap; fewer at the end of an episode or of the sequence."""
    live = gamma * (~terminal).to(following.dtype)
    target = reward + live * following
    for _ in range(n - 1):
        longer = reward[:-1] + live[:-1] * target[1:]
        target = torch.cat((torch.where(ended[:-1], target[:-1], longer), target[-1:]))
    return target


def normalised(advantage: Tensor) -> Tensor:
    """Mean 0 and deviation 1 over the whole batch."""
    return (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-8)
