"""The console of every verb: what is printed stands there as it is."""

from rich.console import Console


def terminal(width: int | None = None) -> Console:
    """No markup, no pictures for `:words:`, no colours by guess. width: columns; None for those of the terminal."""
    return Console(width=width, markup=False, emoji=False, highlight=False)
