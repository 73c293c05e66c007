"""Registries of methods and tasks: each kind is registered by the page that defines it."""

from typing import NamedTuple, TypeVar

Entry = TypeVar("Entry", bound=NamedTuple)


def register(table: dict[str, Entry], kind: str, entry: Entry) -> None:
    """Put an entry into its table; registering the same one again changes nothing.

    Raises:
        ValueError: another entry has the kind.
    """
    if table.setdefault(kind, entry) != entry:
        raise ValueError(f"'{kind}' is registered already; choose another kind")
