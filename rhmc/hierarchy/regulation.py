"""The regulation mechanism (section 4.4): what an assignment could earn at best, whatever the executors do now.

Pure functions of boolean tensors. Shape letters as in `rhmc.types`; D counts the options of an agent, and
options[b, i, d, j] says whether agent i completes target j under its option d. Assignments are 0 or 1 in any dtype.
Only the targets assigned to an agent count for it ("the states of assigned target"), so options are masked first.

Readings of the text where it is silent or slips:

- Eq. 6: p_j is 1 where an agent assigned to j completes it, q_j where j is assigned and not completed; a target
  assigned to nobody counts nothing or, with `unassigned: charged`, as one that is not completed.
- Algorithm 1, line 11: `dp[i][j] = dp[i-1][k] OR mask`. Line 17: the maximum goes over the options of the last agent.
- The maximum with the executed reward is the caller's: `torch.maximum(executed(...), REGULATORS[name](...))`.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

MOST_TARGETS = 12  # the exact table has 2^M entries per environment


class Charges(NamedTuple):
    """The penalties of Eq. 6: alpha_1, in [0, 1], and whether it is also due for a target assigned to nobody."""

    alpha: float
    unassigned: Literal["free", "charged"] = "free"


Regulator = Callable[[Tensor, Tensor, Charges], Tensor]


class Path(NamedTuple):
    """One joint option of one instance."""

    choices: tuple[int, ...]  # option of each agent
    completed: tuple[bool, ...]  # per target, by an agent assigned to it
    reward: float  # Eq. 6


def high_level_reward(completed: Tensor, assignment: Tensor, charges: Charges) -> Tensor:
    """Eq. 6: the sum over targets of 1/k_j where completed and -alpha where not; k_j agents are assigned to j.

    Args:
        completed: (B, M) bool, by an agent assigned to it.
        assignment: (B, N, M).
        charges: for targets that are not completed.

    Returns:
        (B,) float32.
    """
    return _reward(completed, (assignment > 0.5).sum(1), charges)


def executed(completed: Tensor, assignment: Tensor, charges: Charges) -> Tensor:
    """Eq. 6 as earned: a target is completed where at least one agent assigned to it completes it.

    Args:
        completed: (B, N, M) bool, agent i completes target j (`Step.completed`).
        assignment: (B, N, M).
        charges: as in `high_level_reward`.

    Returns:
        (B,) float32.
    """
    return high_level_reward((completed & (assignment > 0.5)).any(1), assignment, charges)


def none(options: Tensor, assignment: Tensor, charges: Charges) -> Tensor:
    """No regulation: minus infinity, so that the maximum with the executed reward is the executed reward. (B,)."""
    return torch.full(options.shape[:1], -torch.inf, device=options.device)


def paper(options: Tensor, assignment: Tensor, charges: Charges) -> Tensor:
    """Algorithm 1 as printed. It can fall short of the optimum (`rhmc.hierarchy.theorem`).

    Args:
        options: (B, N, D, M) bool.
        assignment: (B, N, M).
        charges: as in `high_level_reward`.

    Returns:
        (B,) float32, the largest reward among the masks of the last agent.
    """
    masks, _ = _most_targets(_assigned(options, assignment))
    return _reward(masks, (assignment > 0.5).sum(1, keepdim=True), charges).amax(-1)


def exact(options: Tensor, assignment: Tensor, charges: Charges) -> Tensor:
    """The largest Eq. 6 reward over all D^N joint options, in N M 2^M operations per environment.

    Args:
        options: (B, N, D, M) bool.
        assignment: (B, N, M).
        charges: as in `high_level_reward`.

    Returns:
        (B,) float32.

    Raises:
        ValueError: more than `MOST_TARGETS` targets.
    """
    tables = _reachable(_assigned(options, assignment))
    return high_level_reward(_best_subset(tables[-1], assignment, charges.alpha), assignment, charges)


REGULATORS: dict[str, Regulator] = {"none": none, "paper": paper, "exact": exact}


def algorithm1_path(options: Tensor, assignment: Tensor, charges: Charges) -> Path:
    """The joint option that Algorithm 1 settles on. options: (N, D, M) bool, assignment: (N, M), one instance."""
    masks, parents = _most_targets(_assigned(options, assignment).unsqueeze(0))
    rewards = _reward(masks, (assignment > 0.5).sum(0), charges)[0]
    choices = [int(rewards.argmax())]
    completed = masks[0, choices[0]]
    for parent in reversed(parents):
        choices.append(int(parent[0, choices[-1]]))
    return Path(tuple(reversed(choices)), tuple(completed.tolist()), float(rewards.amax()))


def optimal_path(options: Tensor, assignment: Tensor, charges: Charges) -> Path:
    """A joint option of the largest reward. options: (N, D, M) bool, assignment: (N, M), one instance.

    Raises:
        ValueError: more than `MOST_TARGETS` targets.
    """
    held = _assigned(options, assignment)
    tables = _reachable(held.unsqueeze(0))
    completed = _best_subset(tables[-1], assignment.unsqueeze(0), charges.alpha)
    reward = float(high_level_reward(completed, assignment.unsqueeze(0), charges))
    subset, masks = int(_numbers(completed)), _numbers(held).tolist()
    choices = []
    for row, before in zip(masks[:0:-1], tables[-2::-1], strict=True):
        earlier = before[0].nonzero()[:, 0].tolist()
        option, subset = next((d, e) for d, mask in enumerate(row) for e in earlier if e | mask == subset)
        choices.append(option)
    choices.append(masks[0].index(subset))
    return Path(tuple(reversed(choices)), tuple(completed[0].tolist()), reward)


def _assigned(options: Tensor, assignment: Tensor) -> Tensor:
    """Options without the targets that are not assigned to the agent: (..., N, D, M) and (..., N, M)."""
    return options & (assignment > 0.5).unsqueeze(-2)


def _reward(completed: Tensor, agents: Tensor, charges: Charges) -> Tensor:
    """Eq. 6 from the number of agents assigned to each target; both (..., M), broadcast."""
    gain = torch.where(completed, 1 / agents.clamp(min=1), -charges.alpha)
    counted = agents > 0 if charges.unassigned == "free" else (agents > 0) | ~completed
    return (gain * counted).sum(-1)


def _most_targets(options: Tensor) -> tuple[Tensor, list[Tensor]]:
    """The table of Algorithm 1: per option of the last agent, the union with the most targets, first among equals.

    |a OR b| = |a| + |b| - a.b, so the counts of all pairs of options are one matrix product. A maximum is much faster
    than an argmax over short rows, so the order of the options travels in the score.

    Returns:
        masks (B, D, M) of the last agent, and for each agent after the first the option before it (B, D).
    """
    first, *rest = options.unbind(1)
    masks, parents, d = first, [], options.shape[2]
    order = torch.arange(d, device=options.device)
    for own in rest:
        before = masks.float()
        rank = (d * before.sum(-1) - order).unsqueeze(1)
        best = torch.baddbmm(rank, own.float(), before.mT, alpha=-d).amax(-1)
        parents.append(best.long().neg() % d)
        masks = own | masks.gather(1, parents[-1].unsqueeze(-1).expand_as(own))
    return masks, parents


def _reachable(options: Tensor) -> list[Tensor]:
    """For each agent, which sets of targets are the union of some options of the agents up to it.

    The union of independent choices is a product once a set is described by how many choices lie inside it
    (`_inside`); the inverse gives the number of ways to get exactly that set.

    Returns:
        N tables (B, 2^M) bool; set number s holds target j where bit j of s is 1.
    """
    batch, _, _, m = options.shape
    if m > MOST_TARGETS:
        raise ValueError(f"the exact regulator takes at most {MOST_TARGETS} targets, and there are {m}: use 'paper'")
    sets = torch.zeros(batch, options.shape[1], 2**m, dtype=torch.int32, device=options.device)
    sets.scatter_(-1, _numbers(options), 1)
    own = _inside(sets.clone()).unbind(1)
    tables = [sets[:, 0] > 0]
    for inside in own[1:]:
        tables.append(_exactly(_inside(tables[-1].int()) * inside) > 0)
    return tables


def _inside(table: Tensor) -> Tensor:
    """Sum over all subsets of each set, in place. (..., 2^M)."""
    for j in range(table.shape[-1].bit_length() - 1):
        halves = table.view(*table.shape[:-1], -1, 2, 2**j)
        halves[..., 1, :] += halves[..., 0, :]
    return table


def _exactly(table: Tensor) -> Tensor:
    """Inverse of `_inside`, in place."""
    for j in range(table.shape[-1].bit_length() - 1):
        halves = table.view(*table.shape[:-1], -1, 2, 2**j)
        halves[..., 1, :] -= halves[..., 0, :]
    return table


def _best_subset(reachable: Tensor, assignment: Tensor, alpha: float) -> Tensor:
    """The reachable set of the largest reward. reachable: (B, 2^M) bool. Returns (B, M) bool.

    What unassigned targets cost is the same for all sets.
    """
    agents = (assignment > 0.5).sum(1)
    gain = torch.where(agents > 0, 1 / agents.clamp(min=1) + alpha, 0.0)
    members = _members(agents.shape[-1], reachable.device)
    value = (gain @ members.float().T).masked_fill(~reachable, -torch.inf)
    return members[value.argmax(-1)]


def _members(m: int, device: torch.device) -> Tensor:
    """The targets of each set number: (2^M, M) bool."""
    numbers = torch.arange(2**m, device=device).unsqueeze(-1)
    return (numbers >> torch.arange(m, device=device)) & 1 > 0


def _numbers(members: Tensor) -> Tensor:
    """Set numbers of rows of members: (..., M) bool -> (...) int64; exact in float32 up to 24 targets."""
    m = members.shape[-1]
    return (members.float() @ (2.0 ** torch.arange(m, device=members.device))).long()
