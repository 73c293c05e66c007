"""`include` in a section of a study: the section starts from that of another file, such as the winner of a search.

    arms:
      RHMC: {algo: {include: best_params/search_rhmc.rhmc.paper.yaml, horizon: 2}}

The path is relative to the folder of the file that includes. What stands beside `include` goes before what is included.
Every value keeps the place where it was written, so that a fault points into the included file.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

from pipelines.specs.document import Fault, Node, join, merge, nearest, read, show
from pipelines.workspace.files import ABSENT, fault_of

KEY = "include"


def included(root: Node, folder: Path, sections: Sequence[str]) -> tuple[Node, list[Fault]]:
    """The tree of a study with every `include` replaced by what it names, and the faults found on the way.

    Args:
        root: the file, or an override as a tree of the same shape.
        folder: where paths start.
        sections: the parts of a layer that may include.
    """
    faults: list[Fault] = []
    for way in _layers(root):
        for section in sections:
            node = _at(root, (*way, section))
            if node is not None and KEY in node.children:
                whole, found = _resolve(node, folder, section)
                root, faults = _replaced(root, (*way, section), whole), faults + found
    return root, faults


def _layers(root: Node) -> Iterator[tuple[str, ...]]:
    """The way to each layer that is written."""
    yield ("base",)
    for group in ("profiles", "arms", "variants"):
        if group in root.children:
            yield from ((group, name) for name in root.children[group].children)


def _at(node: Node, way: Sequence[str]) -> Node | None:
    for key in way:
        if key not in node.children:
            return None
        node = node.children[key]
    return node


def _replaced(root: Node, way: Sequence[str], node: Node) -> Node:
    if not way:
        return node
    inner = _replaced(root.children[way[0]], way[1:], node)
    return root._replace(value=root.children | {way[0]: inner})


def _resolve(node: Node, folder: Path, section: str) -> tuple[Node, list[Fault]]:
    """The included section under what stands beside `include`; without it where that cannot be had."""
    link = node.children[KEY]
    beside = node._replace(value={key: child for key, child in node.children.items() if key != KEY})
    source, faults = _source(link, folder, section)
    if source is None:
        return beside, faults
    kinds = [part.children["kind"] for part in (source, beside) if "kind" in part.children]
    if len(kinds) == 2 and kinds[0].value != kinds[1].value:
        text = f"{show(kinds[1].value)} is not allowed; what is included here is of kind {show(kinds[0].value)}"
        return beside, [Fault(kinds[1].place, kinds[1].path, text)]
    return node._replace(value=merge(source, beside).children), []


def _source(link: Node, folder: Path, section: str) -> tuple[Node | None, list[Fault]]:
    if not isinstance(link.value, str):
        return None, [Fault(link.place, link.path, f"{show(link.value)} is not allowed; must be the path of a file")]
    path = folder / link.value
    if (fault := fault_of(path)) == ABSENT:
        near = [p.relative_to(folder).as_posix() for p in sorted(folder.glob("*/*.yaml"))]
        return None, [Fault(link.place, link.path, f"{path}: {fault}{nearest(link.value, near)}")]
    if fault:
        return None, [Fault(link.place, link.path, f"{path}: {fault}")]
    root, faults = read(path)
    if root is None or faults:
        return None, faults or [_empty(link, path, section)]
    found = root.children.get(section)
    if found is None or not isinstance(found.value, dict):
        text = f"{path} has no mapping '{section}'; it has: {', '.join(root.children) or 'nothing'}"
        return None, [Fault(link.place, link.path, text)]
    if KEY in found.children:
        again = found.children[KEY]
        return None, [Fault(again.key, join(section, KEY), "an included file may not include another; write it out")]
    return found, []


def _empty(link: Node, path: Path, section: str) -> Fault:
    return Fault(link.place, link.path, f"{path}: empty; a file to be included has a mapping '{section}'")
