"""The extent of random campaigns and properties: `make test` takes some examples of each, `make deep` many."""

import os

DEEP = os.environ.get("DEEP") == "1"


def often(some: int, many: int) -> int:
    """The number of random tries."""
    return many if DEEP else some
