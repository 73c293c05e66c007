"""Slow, readable twins of `rhmc.hierarchy.regulation`, on nested lists: options[i][d][j], assignment[i][j], one
instance."""

from collections.abc import Iterator
from itertools import product

Options = list[list[list[bool]]]
Assignment = list[list[bool]]
Completed = list[bool]


def reward(completed: Completed, assignment: Assignment, alpha: float, unassigned: str = "free") -> float:
    """Eq. 6, term by term; targets assigned to nobody are left out (`free`), or pay like others (`charged`)."""
    total = 0.0
    for j, done in enumerate(completed):
        k = sum(row[j] for row in assignment)
        if k == 0 and unassigned == "free":
            continue
        p, q = int(done), int(not done)
        total += (p / k if k else 0) - alpha * q
    return total


def joint_options(options: Options, assignment: Assignment) -> Iterator[Completed]:
    """The targets that every joint option completes."""
    agents, targets = range(len(options)), range(len(assignment[0]))
    for joint in product(*(range(len(row)) for row in options)):
        yield [any(options[i][joint[i]][j] and assignment[i][j] for i in agents) for j in targets]


def algorithm1_masks(options: Options, assignment: Assignment) -> list[Completed]:
    """Algorithm 1, lines 3 to 16, line by line on binary sequences held as integers: the last row of dp."""
    n, d, m = len(options), len(options[0]), len(assignment[0])

    def act(i: int, j: int) -> int:
        return sum(2**t for t in range(m) if options[i][j][t] and assignment[i][t])

    def cnt(mask: int) -> int:
        return bin(mask).count("1")

    dp = [[0] * d for _ in range(n)]
    for i in range(n):
        for j in range(d):
            mask = act(i, j)
            for k in range(d):
                if i == 0:
                    dp[i][j] = mask
                elif cnt(dp[i][j]) < cnt(dp[i - 1][k] | mask):
                    dp[i][j] = dp[i - 1][k] | mask
    return [[bool(mask >> t & 1) for t in range(m)] for mask in dp[n - 1]]


def optimum(options: Options, assignment: Assignment, alpha: float, unassigned: str = "free") -> float:
    """The best reward over every joint option."""
    return max(reward(completed, assignment, alpha, unassigned) for completed in joint_options(options, assignment))


def algorithm1(options: Options, assignment: Assignment, alpha: float, unassigned: str = "free") -> float:
    """Algorithm 1, lines 17 to 20."""
    return max(reward(completed, assignment, alpha, unassigned) for completed in algorithm1_masks(options, assignment))
