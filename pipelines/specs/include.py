"""`include` in a section of a study: the section starts from that of another file, such as settings that are tuned.

    base:
      env: {include: settings/coverage}
      algo: {include: settings/coverage/rhmc, horizon: 2}

The path is relative to the file that includes, else to the study, else to `studies/` where the command is called, else
to the studies of this package. It may leave out `.yaml`. An included file may include others. What stands beside
`include` goes before what is included. Every value keeps the place where it was written: a fault points into its file.

`preset: tuned` at the top of a study does this for every run by itself: under all that is stated for it lies what
`settings/<task>` and `settings/<task>/<method>` have. Under `preset: paper` lie the paper's networks and observation.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

from pydantic.fields import FieldInfo

from pipelines.specs.document import STUDIES, Fault, Node, Place, choices, join, merge, nearest, plain, read, show
from pipelines.workspace.errors import InputError
from pipelines.workspace.files import ABSENT, fault_of

KEY, SUFFIX = "include", ".yaml"
PRESET, TUNED = "preset", "tuned"
# What a preset states for all tasks and methods; the paper's other settings are the defaults.
PRESETS: dict[str, dict[str, dict[str, str]]] = {
    TUNED: {},
    "paper": {"env": {"observation": "paper"}, "algo": {"encoder": "mlp"}},
}
PROJECT = Path(STUDIES)
DEPTHS = ("*/*.yaml", "*/*/*.yaml")  # where files to be included lie, from a folder of studies
SHIPPED = Path(__file__).parents[1] / "studies"  # a link to `studies/`, and a folder in a wheel


def included(root: Node, folder: Path, sections: Sequence[str]) -> tuple[Node, list[Fault]]:
    """The tree of a study with every `include` replaced by what it names, and the faults found on the way.

    Args:
        root: the file, or an override as a tree of the same shape.
        folder: that of the study.
        sections: the parts of a layer that may include.
    """
    faults: list[Fault] = []
    for way in _layers(root):
        for section in sections:
            node = _at(root, (*way, section))
            if node is not None and KEY in node.children:
                whole, found = _resolve(node, section, _Way(folder))
                root, faults = _replaced(root, (*way, section), whole), faults + found
    return root, faults


def closure(study: Path) -> list[Path]:
    """The file of a study, then all that it or its preset includes, directly or not; without what cannot be read."""
    found: dict[Path, Path] = {}  # by what it is, as one file may be named in several ways
    roots: list[Node | None] = []
    waiting = [study]
    while waiting:
        file = waiting.pop(0)
        if not fault_of(file) and found.setdefault(file.resolve(), file) is file:
            roots.append(read(file)[0])
            way = _Way(study.parent, (file,))
            waiting += [way.file(link.value) for link in _links(roots[-1]) if isinstance(link.value, str)]
        if not waiting:
            preset = [_Way(study.parent).file(name) for name in _of_preset(roots)]
            waiting = [path for path in preset if not fault_of(path) and path.resolve() not in found]
    return list(found.values())


def _of_preset(roots: Sequence[Node | None]) -> list[str]:
    """The names of what a tuned study takes, by the kinds in it and in what it includes."""
    if not roots or roots[0] is None or plain(roots[0].children.get(PRESET)) != TUNED:
        return []
    tasks, methods = ([kind for root in roots for kind in _kinds(root, section)] for section in ("env", "algo"))
    return [_tuned(task) for task in tasks] + [_tuned(task, method) for task in tasks for method in methods]


def _kinds(node: Node | None, section: str) -> Iterator[str]:
    for key, child in (node.children if node else {}).items():
        kind = child.children.get("kind") if key == section else None
        yield from [kind.value] if kind and isinstance(kind.value, str) else _kinds(child, section)


def _tuned(task: str, method: str = "") -> str:
    return f"settings/{task}/{method}" if method else f"settings/{task}"


def _takes(field: FieldInfo, value: str) -> bool:
    """True if a value is one of those that a field lists, or it lists none."""
    listed = get_args(field.annotation)
    return not listed or value in listed


class _Way(NamedTuple):
    """From a study to the file that is read: each includes the next."""

    study: Path  # its folder
    files: tuple[Path, ...] = ()

    def file(self, name: str) -> Path:
        """The file that a name stands for here, or, if there is none, the first place that was searched."""
        found = [folder / (name if name.endswith(SUFFIX) else name + SUFFIX) for folder in self.folders()]
        return next((path for path in found if fault_of(path) != ABSENT), found[0])

    def folders(self) -> list[Path]:
        """The folders in which names start, in this order."""
        return list(dict.fromkeys([*(file.parent for file in self.files[-1:]), self.study, PROJECT, SHIPPED]))


def _links(node: Node | None) -> Iterator[Node]:
    """Every `include` in a tree."""
    for key, child in (node.children if node else {}).items():
        yield from [child] if key == KEY else _links(child)


def _layers(root: Node) -> Iterator[tuple[str, ...]]:
    """The way to each layer that is written."""
    yield ("base",)
    for group in ("profiles", "arms", "variants"):
        if group in root.children:
            yield from ((group, name) for name in root.children[group].children)
    readings = root.children.get("readings")
    factors = readings.children.get("factors") if readings else None
    for name, factor in (factors.children if factors else {}).items():
        yield from (("readings", "factors", name, level) for level in factor.children)


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


def _resolve(node: Node, section: str, way: _Way) -> tuple[Node, list[Fault]]:
    """The included section under what stands beside `include`; without it where that cannot be had."""
    link = node.children[KEY]
    beside = node._replace(value={key: child for key, child in node.children.items() if key != KEY})
    source, faults = _source(link, section, way)
    if source is None:
        return beside, faults
    kinds = [part.children["kind"] for part in (source, beside) if "kind" in part.children]
    if len(kinds) == 2 and kinds[0].value != kinds[1].value:
        text = f"{show(kinds[1].value)} is not allowed; what is included here is of kind {show(kinds[0].value)}"
        return beside, [*faults, Fault(kinds[1].place, kinds[1].path, text)]
    return node._replace(value=merge(source, beside).children), faults


def _source(link: Node, section: str, way: _Way) -> tuple[Node | None, list[Fault]]:
    """The section of the file that a link names, with all that this includes in turn."""
    path, faults = _named(link, way)
    if path is None:
        return None, faults
    root, faults = read(path)
    if root is None or faults:
        return None, faults or [_empty(link, path, section)]
    found = root.children.get(section)
    if found is None or not isinstance(found.value, dict):
        text = f"{path} has no mapping '{section}'; it has: {', '.join(root.children) or 'nothing'}"
        return None, [Fault(link.place, link.path, text)]
    return _resolve(found, section, way._replace(files=(*way.files, path))) if KEY in found.children else (found, [])


def _named(link: Node, way: _Way) -> tuple[Path | None, list[Fault]]:
    """The file that a link names, if it can be read."""
    if not isinstance(link.value, str):
        return None, [Fault(link.place, link.path, f"{show(link.value)} is not allowed; must be the path of a file")]
    path = way.file(link.value)
    if (fault := fault_of(path)) == ABSENT:
        fault += nearest(link.value, _offered(way, link.value))
    elif not fault and any(path.samefile(file) for file in way.files):
        fault = f"includes itself, by way of {way.files[-1]}"
    return (None, [Fault(link.place, link.path, f"{path}: {fault}")]) if fault else (path, [])


def _offered(way: _Way, name: str) -> list[str]:
    """The files that can be included, spelled as the name is: with `.yaml` or without."""
    files = [p.relative_to(folder) for folder in way.folders() for at in DEPTHS for p in sorted(folder.glob(at))]
    return [(file if name.endswith(SUFFIX) else file.with_suffix("")).as_posix() for file in files]


def _empty(link: Node, path: Path, section: str) -> Fault:
    return Fault(link.place, link.path, f"{path}: empty; a file to be included has a mapping '{section}'")


# Presets: the lowest layer of every run


class Preset:
    """The settings that lie under all that a study states, by task and method.

    Attributes:
        without: methods and tasks for which there are no tuned settings, in the words of a remark.
    """

    def __init__(self, node: Node | None, folder: Path) -> None:
        self.node = node if node is not None and node.value in PRESETS else None  # else its fault is said elsewhere
        self.way = _Way(folder)
        self.without: dict[Fault, None] = {}
        self._read: dict[tuple[str, str], tuple[Node | None, list[Fault]]] = {}  # by name and section

    def under(
        self, stated: Node, section: str, task: str, method: str, fields: Mapping[str, FieldInfo]
    ) -> tuple[Node, list[Fault]]:
        """A section over what the preset has for it.

        Args:
            stated: the section as the layers of the study have it.
            section: env, algo or trainer.
            task: the kind of the task.
            method: the kind of the method.
            fields: of the section's configuration; a package's own may lack one, or have other values for it.
        """
        if self.node is None:
            return stated, []
        values = PRESETS[str(self.node.value)].get(section, {})
        taken = {key: value for key, value in values.items() if key in fields and _takes(fields[key], value)}
        layer: Node | None = _written(taken, self.node)
        faults: list[Fault] = []
        if self.node.value == TUNED:
            name = _tuned(task, method if section == "algo" else "")
            if (name, section) not in self._read:
                self._read[name, section] = self._file(self.node, name, section)
            layer, faults = self._read[name, section]
        if layer is None and section == "algo" and not faults:
            text = f"no tuned settings for {show(method)} in {show(task)}: what is not stated has its default"
            self.without[Fault(self.node.place, self.node.path, text)] = None
        return (stated._replace(value=merge(layer, stated).value) if layer else stated), faults

    def _file(self, node: Node, name: str, section: str) -> tuple[Node | None, list[Fault]]:
        link, path = node._replace(value=name), self.way.file(name)
        if fault_of(path) == ABSENT:
            return None, []
        root, _ = read(path)
        if root is not None and root.children and section not in root.children:
            return None, []  # a task without settings of the trainer
        return _source(link, section, self.way)


def _written(values: dict[str, str], at: Node) -> Node:
    children = {key: Node(value, at.place, at.key, join(at.path, key)) for key, value in values.items()}
    return at._replace(value=children)


def tuned(section: str, task: str, method: str = "") -> dict[str, Any]:
    """The tuned settings of a method in a task, or of the task itself, as a study here would get them."""
    place = Place("")
    stated, _ = Preset(Node(TUNED, place, place, ""), PROJECT).under(
        Node({}, place, place, ""), section, task, method, {}
    )
    values: dict[str, Any] = plain(stated)
    return values


# Studies that this package brings along


def shipped() -> list[str]:
    """The files that can be copied."""
    return sorted(path.stem for path in SHIPPED.glob("*.yaml"))


def copy(name: str, out: Path) -> list[Path]:
    """Write a study and the files that it includes into a folder, and return where they are.

    Raises:
        InputError: there is no such study, or another file has the place; nothing is written.
        StoreError: the folder cannot be written to.
    """
    from pipelines.workspace.work_folder import whole  # which brings torch along

    if name not in shipped():
        raise InputError(f"'{name}' is no study of this package; {choices(name, shipped())}")
    wanted = {out / path.relative_to(SHIPPED): path.read_bytes() for path in closure(SHIPPED / f"{name}.yaml")}
    for path, text in wanted.items():
        if path.exists() and (not path.is_file() or path.read_bytes() != text):
            raise InputError(f"{path}: something else is there; move it away, or name another folder with --out")
    for path, text in wanted.items():
        if not path.exists():
            with whole(path) as part:
                part.write_bytes(text)
    return list(wanted)
