"""The comparison of full states that a resume is judged by: every key, type, length and bit."""

from typing import Any

import torch
from torch import Tensor


class DifferentError(AssertionError):
    """Two states are not the same, bit for bit."""


def assert_same(a: Any, b: Any, at: str = "state") -> int:
    """Compare two checkpoints in full: keys, types, lengths and every bit of every number and tensor.

    Returns:
        How many tensors and plain values were compared.

    Raises:
        DifferentError: at the first difference, named by its path.
        TypeError: something that does not belong into a checkpoint.
    """
    if type(a) is not type(b):
        raise DifferentError(f"{at}: {type(a).__name__} and {type(b).__name__}")
    if isinstance(a, dict):
        if list(a) != list(b):
            raise DifferentError(f"{at}: keys {list(a)} and {list(b)}")
        return sum(assert_same(a[key], b[key], f"{at}.{key}") for key in a)
    if isinstance(a, list | tuple):
        if len(a) != len(b):
            raise DifferentError(f"{at}: {len(a)} and {len(b)} items")
        return sum(assert_same(x, y, f"{at}[{i}]") for i, (x, y) in enumerate(zip(a, b, strict=True)))
    if isinstance(a, Tensor):
        _same_tensor(a, b, at)
    elif isinstance(a, bool | int | float | str | None):
        if a != b and not (a != a and b != b):
            raise DifferentError(f"{at}: {a!r} and {b!r}")
    else:
        raise TypeError(f"{at}: {type(a).__name__} in a checkpoint")
    return 1


def _same_tensor(a: Tensor, b: Tensor, at: str) -> None:
    if (a.dtype, a.shape) != (b.dtype, b.shape):
        raise DifferentError(f"{at}: {a.dtype} {tuple(a.shape)} and {b.dtype} {tuple(b.shape)}")
    ours, theirs = _bits(a), _bits(b)
    if not torch.equal(ours, theirs):
        wrong = ours != theirs
        raise DifferentError(f"{at}: {int(wrong.sum())} of {wrong.numel()} bytes differ")


def _bits(t: Tensor) -> Tensor:
    """The bytes of a tensor: a NaN equals itself, and 0 differs from -0."""
    return t.detach().cpu().contiguous().flatten().view(torch.uint8)
