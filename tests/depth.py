"""How far the random campaigns and properties go: `make test` takes some examples of each, `make deep` many."""

import os

DEEP = os.environ.get("DEEP") == "1"


def often(some: int, many: int) -> int:
    """How often something random is tried."""
    return many if DEEP else some
