"""The extent of the tests: every test function runs in `make test`, and every case of it in `make deep`.

- Random campaigns and properties: `often`; some examples of each, or many.
- Grids, which are the cross-products of factors such as method, encoder and task: `covering`; every value of every
  factor, or every combination.
- Lists in which each case is a thing of its own, such as named faults or malformed inputs, are never thinned.
"""

import os
from collections.abc import Collection
from itertools import product
from typing import Any

DEEP = os.environ.get("DEEP") == "1"


def often(some: int, many: int) -> int:
    """The number of random tries."""
    return many if DEEP else some


def covering(*factors: Collection[Any], shift: int = 0, deep: bool = DEEP) -> list[tuple[Any, ...]]:
    """Cases of a grid: all of its combinations in `make deep`, as many as its longest factor has values else.

    They go down the longest factor, the first of those that are equally long. The next one then changes from case to
    case, and each further one when those before it have been through all of their values, as the digits of a number do;
    it changes from case to case too where there are too few cases for that. So every value of every factor comes. Tests
    that share a grid begin with a `shift` each: what one of them leaves out, another one has.
    """
    if deep:
        return list(product(*factors))
    grid = [list(values) for values in factors]
    longest = max(grid, key=len)
    columns, stride = [], 1
    for values in grid:
        if values is longest:
            columns.append(values)
            continue
        step = stride if stride * len(values) <= len(longest) else 1
        columns.append([values[(case // step + shift) % len(values)] for case in range(len(longest))])
        stride *= len(values)
    return list(zip(*columns, strict=True))
