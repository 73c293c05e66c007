"""Exact choice of one option per agent, so that together they take in the most items at the least cost.

A table over the 2^M subsets of items is carried from agent to agent: for each subset the least cost of choices whose
union is exactly that subset. Work grows as N K 2^M for K options each instead of K^N.
"""

import torch
from torch import Tensor

MOST_ITEMS = 16  # a table of 2^16 per row is the limit of what is sensible


def subset_code(member: Tensor) -> Tensor:
    """A subset of M items as a number with bit j for item j. (..., M) bool -> (...) int64.

    Raises:
        ValueError: M is above `MOST_ITEMS`.
    """
    if member.shape[-1] > MOST_ITEMS:
        raise ValueError(
            f"exact search is over subsets of at most {MOST_ITEMS} targets, and there are {member.shape[-1]}"
        )
    return (member.long() << torch.arange(member.shape[-1], device=member.device)).sum(-1)


def subset_sizes(items: int, device: torch.device) -> Tensor:
    """Number of items in each subset, by code: (2^items,) int64."""
    codes = torch.arange(2**items, device=device)
    return sum(((codes >> j) & 1 for j in range(items)), torch.zeros_like(codes))


def largest_union(member: Tensor) -> Tensor:
    """Most items that one option per agent can take in. member: (B, N, K, M) bool -> (B,) int64."""
    codes = subset_code(member)
    tables = _tables(codes, torch.zeros(codes.shape, device=codes.device), member.shape[-1])
    sizes = subset_sizes(member.shape[-1], member.device)
    return torch.where(tables[-1].isfinite(), sizes, 0).amax(-1)


def best_choice(member: Tensor, cost: Tensor) -> Tensor:
    """The option of each agent whose union is largest; among equals the least total cost, then the first.

    Args:
        member: (B, N, K, M) bool, the items in each agent's options.
        cost: (B, N, K), finite.

    Returns:
        (B, N) int64 in 0..K-1.
    """
    agents, options, items = member.shape[1:]
    codes = subset_code(member)
    tables = _tables(codes, cost, items)
    sizes = torch.where(tables[-1].isfinite(), subset_sizes(items, member.device), -1)
    union = torch.where(sizes == sizes.amax(-1, keepdim=True), tables[-1], torch.inf).argmin(-1)
    chosen = []
    for i in reversed(
        range(agents)
    ):  # which subset before agent i, and which option of its, led to `union` so cheaply?
        reached, total = _extend(tables[i], codes[:, i], cost[:, i])
        step = torch.where(reached == union.unsqueeze(-1), total, torch.inf).argmin(-1)
        chosen.append(step % options)
        union = step // options
    return torch.stack(chosen[::-1], -1)


def _tables(codes: Tensor, cost: Tensor, items: int) -> list[Tensor]:
    """Least cost of each union before the first agent, after it, ..., after the last: N + 1 times (B, 2^M)."""
    blank = torch.full((len(codes), 2**items), torch.inf, dtype=cost.dtype, device=cost.device)
    table = blank.clone()
    table[:, 0] = 0
    tables = [table]
    for i in range(codes.shape[1]):
        reached, total = _extend(tables[-1], codes[:, i], cost[:, i])
        tables.append(blank.scatter_reduce(1, reached, total, "amin"))
    return tables


def _extend(table: Tensor, codes: Tensor, cost: Tensor) -> tuple[Tensor, Tensor]:
    """Every subset of the table with every option added: resulting subset and cost, (B, 2^M K) each."""
    subsets = torch.arange(table.shape[-1], device=table.device).view(1, -1, 1)
    return (subsets | codes.unsqueeze(1)).flatten(1), (table.unsqueeze(-1) + cost.unsqueeze(1)).flatten(1)
