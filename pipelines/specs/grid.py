"""A study's grid: lists of values for dotted keys, and the layer that each combination of them is."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from functools import reduce
from itertools import product
from math import prod
from typing import NamedTuple

from pipelines.specs.document import Fault, Node, Unreadable, join, merge, nearest, show

MOST = 1000  # arms of a study


class Point(NamedTuple):
    """One combination of values: a name such as `alpha=0.1, horizon=6`, and what it changes."""

    name: str
    layer: Node


def points(grid: Node | None, fields: Collection[str], arms: int) -> tuple[list[Point], list[Fault]]:
    """Every combination, the last key's values changing fastest; none without a grid or with a faulty one.

    Args:
        grid: the mapping of dotted keys to lists. That they are lists is checked elsewhere.
        fields: dotted names that there are, to find the nearest of them.
        arms: how many arms are taken to every point.
    """
    lists = {key: node for key, node in (grid.children if grid else {}).items() if isinstance(node.value, list)}
    if not grid or not lists:
        return [], []
    faults = [fault for key, node in lists.items() for fault in faults_of(key, node, fields)]
    count = prod(len(values(node)) for node in lists.values()) * max(arms, 1)
    if count > MOST:
        faults.append(Fault(grid.key, grid.path, f"{count:,} arms in all; at most {MOST:,}"))
    if faults:
        return [], faults
    names = _short(lists)
    choices = [[(names[key], key, value, i) for i, value in enumerate(values(node))] for key, node in lists.items()]
    return [_point(chosen) for chosen in product(*choices)], []


def values(node: Node) -> list[Node]:
    """The values of one key; each says of itself that it stands under the key."""
    inner = node.value if isinstance(node.value, list) else []
    return [value._replace(key=node.key, path=node.path) for value in inner]


def replaced(grid: Node | None, by: Node | None) -> tuple[Node | None, list[Fault]]:
    """The grid with the values that a profile has instead."""
    if not by or not by.children:
        return grid, []
    known = grid.children if grid else {}
    faults = [
        Fault(node.key, node.path, f"{show(key)} is no key of the grid" + nearest(key, known))
        for key, node in by.children.items()
        if key not in known
    ]
    instead = by._replace(value={key: node for key, node in by.children.items() if key in known})
    return (merge(grid, instead) if grid else None), faults


def faults_of(key: str, node: Node, fields: Collection[str]) -> list[Fault]:
    """Faults of a dotted key or its list of values. fields: as in `points`."""
    section, _, field = key.partition(".")
    if not field or section not in {name.partition(".")[0] for name in fields}:
        same = [name for name in fields if name.endswith(f".{key}")]
        near = f"; did you mean '{min(same, key=len)}'?" if same else nearest(key, fields)
        text = f"{show(key)} is no key of a run; a dotted name such as algo.alpha{near}"
        return [Fault(node.key, node.path, text)]
    texts = [text_of(value, i) for i, value in enumerate(values(node))]
    faults = []
    for i, value in enumerate(values(node)):
        if texts[i] in texts[:i]:
            faults.append(Fault(value.place, node.path, f"{show(value.value)} is there twice"))
        if not texts[i] or "/" in texts[i] or not texts[i].isprintable():
            faults.append(Fault(value.place, node.path, f"{show(value.value)} cannot be part of an arm's name"))
    return faults


def text_of(value: Node, place: int) -> str:
    """A value in a name; lists and mappings go by their place among the values, from 1."""
    if isinstance(value.value, dict | list | Unreadable):
        return f"no. {place + 1}"
    return value.value if isinstance(value.value, str) else show(value.value)


def _short(keys: Mapping[str, Node]) -> dict[str, str]:
    """The last part of each key, or all of it where two end alike."""
    last = {key: key.rpartition(".")[2] for key in keys}
    count = Counter(last.values())
    return {key: name if count[name] == 1 else key for key, name in last.items()}


def _point(chosen: Sequence[tuple[str, str, Node, int]]) -> Point:
    name = ", ".join(f"{short}={text_of(value, i)}" for short, _, value, i in chosen)
    return Point(name, reduce(merge, [nested(key.split("."), value) for _, key, value, _ in chosen]))


def nested(parts: Sequence[str], node: Node) -> Node:
    """A tree of mappings that holds only the node, under these keys."""
    for i in reversed(range(len(parts))):
        node = Node({parts[i]: node}, node.place, node.place, reduce(join, parts[:i], ""))
    return node
