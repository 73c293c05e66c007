"""A product of matrices as one reads it: a chain of fused multiply-adds in the order of the inner dimension."""

import numpy as np
import numpy.typing as npt

Matrix = npt.NDArray[np.float32]
BLOCK = 512  # terms; a longer sum is that of its blocks


def product(a: Matrix, b: Matrix) -> Matrix:
    """a b^T of (m, k) and (n, k). A double holds the exact product of two floats, so only the sum is rounded."""
    parts = [_chain(a[:, i : i + BLOCK], b[:, i : i + BLOCK]) for i in range(0, a.shape[1], BLOCK)]
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


def _chain(a: Matrix, b: Matrix) -> Matrix:
    total = np.zeros((len(a), len(b)), np.float32)
    for x, y in zip(a.T.astype(np.float64), b.T.astype(np.float64), strict=True):
        total = (total.astype(np.float64) + np.outer(x, y)).astype(np.float32)
    return total
