"""Draws from categorical and Bernoulli logits, and their straight-through relaxations."""

import torch
from torch import Generator, Size, Tensor
from torch.nn.functional import one_hot


def mix(chance: Tensor, uniform: float, share: float) -> Tensor:
    """Probabilities moved towards `uniform` by `share`."""
    return chance + share * (uniform - chance)


def bernoulli(chance: Tensor, rng: Generator) -> Tensor:
    """0 or 1 as float, 1 with the given chance."""
    return (torch.rand(chance.shape, generator=rng, device=rng.device) < chance).float()


def gumbel(shape: Size, rng: Generator) -> Tensor:
    """Standard Gumbel noise: the largest of logits + noise is a draw from their softmax."""
    u = torch.rand(shape, generator=rng, device=rng.device).clamp(1e-10, 1 - 1e-7)
    return -(-u.log()).log()


def straight_through(logits: Tensor, rng: Generator) -> Tensor:
    """One-hot draw from logits, with the gradient of the relaxed draw (Jang et al. 2017, temperature 1)."""
    soft = (logits + gumbel(logits.shape, rng)).softmax(-1)
    return one_hot(soft.argmax(-1), logits.shape[-1]).float() + (soft - soft.detach())


def relaxed_bernoulli(logits: Tensor, rng: Generator) -> Tensor:
    """0 or 1 drawn from logits, with the gradient of the relaxed draw (Maddison et al. 2017, temperature 1)."""
    u = torch.rand(logits.shape, generator=rng, device=rng.device).clamp(1e-6, 1 - 1e-6)
    soft = (logits + u.logit()).sigmoid()
    return (soft > 0.5).float() + (soft - soft.detach())
