"""Share of instances in which Algorithm 1 falls short of the optimum that Theorem 1 promises: `rhmc theorem`.

Sizes are written agents x options x targets. Targets assigned to nobody are free here; what Eq. 6 may charge for them
lowers Algorithm 1 and the optimum alike.
"""

from collections.abc import Iterator, Sequence
from itertools import count, product
from typing import Literal, NamedTuple

import torch
from torch import Generator, Tensor

from rhmc.hierarchy.regulation import Charges, algorithm1_path, exact, optimal_path, paper

Size = tuple[int, int, int]

CROWDED: Size = (4, 5, 8)
SIZES: tuple[Size, ...] = ((2, 2, 3), (4, 3, 5), CROWDED, (4, 13, 5))
DENSITIES = ((0.3, 0.5), (0.3, 1.0), (0.5, 0.5), (0.5, 1.0))  # coverage, assignment
CHUNK = 5000  # instances at a time
COUNTING = 100.0  # a penalty beside which 1/k_j is small: Eq. 6 then ranks by the number of completed targets
TOLERANCE = 1e-5  # above rounding; a true gap is a sum of differences of 1/k


class Shortfall(NamedTuple):
    """Algorithm 1 against the optimum on random instances of one size."""

    size: Size
    coverage: float  # probability that an option completes a target
    assignment: float  # probability that an agent is assigned to a target
    instances: int
    lost: int  # instances where Algorithm 1 is below the optimum
    mean_gap: float  # among those, in Eq. 6 reward; 0 with none
    max_gap: float

    @property
    def share(self) -> float:
        """Share of instances lost."""
        return self.lost / self.instances


class Instance(NamedTuple):
    """One instance with both values."""

    options: Tensor  # (N, D, M) bool
    assignment: Tensor  # (N, M) bool
    alpha: float
    paper: float
    exact: float


def random_instances(
    shape: tuple[int, int, int, int], coverage: float, assignment: float, rng: Generator
) -> tuple[Tensor, Tensor]:
    """Options (B, N, D, M) and assignment (B, N, M), every bit by itself with its probability. shape: (B, N, D, M)."""
    b, n, _, m = shape
    options = torch.rand(shape, generator=rng) < coverage
    return options, torch.rand(b, n, m, generator=rng) < assignment


def shortfall_table(
    instances: int = 20_000,
    seed: int = 0,
    sizes: Sequence[Size] = SIZES,
    densities: Sequence[tuple[float, float]] = DENSITIES,
    alpha: float = 0.1,
) -> list[Shortfall]:
    """One row per size and density, each from its own generator with the same seed."""
    return [_shortfall(instances, seed, size, *density, alpha) for size in sizes for density in densities]


def smallest_counterexample(alpha: float = 0.1, by: Literal["reward", "count"] = "reward") -> Instance:
    """The smallest instance on which Algorithm 1 fails: least N D M, then fewest ones, then first in order.

    Every instance of every size is tried, but for sizes with one agent, option or target, where there is nothing to
    combine and Algorithm 1 is right. Options complete assigned targets only, as others do not count.

    Args:
        alpha: as in Eq. 6.
        by: `reward`: its Eq. 6 reward is below the optimum. `count`: it does not even complete the most targets.
    """
    for volume in count(8):
        found = [case for size in _sizes(volume) for case in _counterexamples(size, alpha, by)]
        if found:
            return min(found, key=lambda case: int(case.options.sum() + case.assignment.sum()))
    raise AssertionError("unreachable")


def markdown(rows: Sequence[Shortfall]) -> str:
    """The rows as a Markdown table."""
    head = "| size | coverage | assignment | instances | Algorithm 1 below the optimum | mean gap there | largest gap |"
    lines = [head, "|---|---|---|---|---|---|---|"]
    for row in rows:
        cells = (
            " x ".join(map(str, row.size)),
            f"{row.coverage:g}",
            f"{row.assignment:g}",
            str(row.instances),
            f"{100 * row.share:.2f} %",
            f"{row.mean_gap:.2f}",
            f"{row.max_gap:.2f}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def describe(case: Instance) -> str:
    """A counterexample in words."""
    n, d, m = case.options.shape
    lines = [f"{n} x {d} x {m}, alpha = {case.alpha:g}; one digit per target:"]
    for i in range(n):
        choices = ", ".join(f"option {j + 1} completes {_digits(case.options[i, j])}" for j in range(d))
        lines.append(f"  agent {i + 1}: assigned {_digits(case.assignment[i])}; {choices}")
    for name, path in (("Algorithm 1", algorithm1_path), ("the optimum", optimal_path)):
        taken = path(case.options, case.assignment, Charges(case.alpha))
        choices = ", ".join(str(choice + 1) for choice in taken.choices)
        lines.append(f"  {name}: options {choices} complete {_digits(taken.completed)}, reward {taken.reward:.2f}")
    return "\n".join(lines)


def summary(rows: Sequence[Shortfall], alpha: float) -> str:
    """The table and the smallest counterexamples, as Markdown."""
    return "\n".join(
        (
            markdown(rows),
            "\nSmallest instance where Algorithm 1 earns less than the optimum:\n",
            describe(smallest_counterexample(alpha)),
            "\nSmallest instance where Algorithm 1 completes fewer targets than possible:\n",
            describe(smallest_counterexample(alpha, by="count")),
        )
    )


def _shortfall(instances: int, seed: int, size: Size, coverage: float, assignment: float, alpha: float) -> Shortfall:
    rng, charges = Generator().manual_seed(seed), Charges(alpha)
    chunks = [min(CHUNK, instances - done) for done in range(0, instances, CHUNK)]
    gaps = []
    for chunk in chunks:
        case = random_instances((chunk, *size), coverage, assignment, rng)
        gaps.append(exact(*case, charges) - paper(*case, charges))
    gap = torch.cat(gaps)
    lost = gap[gap > TOLERANCE]
    mean, most = (float(lost.mean()), float(lost.max())) if len(lost) else (0.0, 0.0)
    return Shortfall(size, coverage, assignment, instances, len(lost), mean, most)


def _sizes(volume: int) -> Iterator[Size]:
    """Every (N, D, M) of at least two each with N D M = volume."""
    sides = range(2, volume // 4 + 1)
    return ((n, d, m) for n, d, m in product(sides, repeat=3) if n * d * m == volume)


def _counterexamples(size: Size, alpha: float, by: str) -> Iterator[Instance]:
    """For each assignment of a size, the failing options within it that have the fewest ones, if any fail."""
    n, d, m = size
    penalty, least = (Charges(COUNTING), COUNTING / 2) if by == "count" else (Charges(alpha), TOLERANCE)
    every_option = _every((n, d, m))
    for assignment in _every((n, m)):
        options = every_option[~(every_option & ~assignment.unsqueeze(1)).flatten(1).any(-1)]
        held = assignment.expand(len(options), n, m)
        failing = options[exact(options, held, penalty) - paper(options, held, penalty) > least]
        if len(failing):
            fewest = failing[failing.flatten(1).sum(-1).argmin()]
            paths = (path(fewest, assignment, Charges(alpha)) for path in (algorithm1_path, optimal_path))
            yield Instance(fewest, assignment, alpha, *(path.reward for path in paths))


def _every(shape: tuple[int, ...]) -> Tensor:
    """All boolean tensors of a shape, in the order of counting: (2^size, *shape)."""
    size = torch.Size(shape).numel()
    numbers = torch.arange(2**size).unsqueeze(-1) >> torch.arange(size - 1, -1, -1)
    return (numbers & 1 > 0).view(-1, *shape)


def _digits(members: Tensor | Sequence[bool]) -> str:
    return "".join(str(int(x)) for x in members)
