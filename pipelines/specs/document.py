"""A YAML document as a tree that knows where each value was written, so that every fault can name its place.

Plain YAML 1.2 (`off` is text, `5e-4` a number) without aliases and tags. Overrides from the command line are small
trees of the same kind. Nothing here knows what a study is.
"""

import difflib
import enum
import json
import math
import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails
from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer, MaxDepthExceededError
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode
from ruamel.yaml.nodes import Node as YamlNode

from pipelines.specs import limits, renamed
from pipelines.workspace.errors import seen
from pipelines.workspace.files import ABSENT, fault_of
from pipelines.workspace.root import project

STUDIES = "studies"  # where a project has them
LIMIT = 1_000_000  # bytes; larger is no study
EXACT = 2**53  # floats below it that are whole numbers are read as integers: 5e6 is a number of steps
DEEPEST = 30  # mappings and lists inside each other
NODES = 10_000  # keys and values; a thousand arms have fewer, and more takes the reader many seconds
KEY = 200  # characters of a key
SHOWN = 60  # characters of an offending value
LISTED = 50  # names that are offered
BY_PROFILE = ("quick", "paper")  # keys of a mapping that holds a number for each profile
PLAIN_TAGS = ("tag:yaml.org,2002:map", "tag:yaml.org,2002:seq")

M = TypeVar("M", bound=BaseModel)


class Unreadable(enum.Enum):
    """Stands for a value that is a fault already, so that nothing else is said about it."""

    VALUE = enum.auto()


class Place(NamedTuple):
    """The place where something was written: a file with line and column (from 1), or the override itself."""

    source: str
    line: int = 0
    column: int = 0

    def __str__(self) -> str:
        return f"{self.source}:{self.line}:{self.column}" if self.line else self.source


class Fault(NamedTuple):
    """One thing that is wrong."""

    place: Place
    path: str
    text: str

    def __str__(self) -> str:
        return ": ".join(part for part in (str(self.place), self.path, self.text) if part)


class Node(NamedTuple):
    """A value, where it and its key were written, and its dotted path there (an override's: in the file's terms)."""

    value: "str | int | float | bool | dict[str, Node] | list[Node] | Unreadable | None"
    place: Place
    key: Place
    path: str

    @property
    def children(self) -> "dict[str, Node]":
        """Children by key; empty for anything but a mapping."""
        return self.value if isinstance(self.value, dict) else {}


# Reading


def read(path: Path) -> tuple[Node | None, list[Fault]]:
    """The document in a file, and what is wrong with it as YAML. No document means that nothing could be read."""
    source = str(path)
    if fault := fault_of(path):
        return None, [Fault(Place(source), "", _unreadable(path, fault))]
    try:
        with path.open("rb") as file:
            data = file.read(LIMIT + 1)
    except OSError as error:
        return None, [Fault(Place(source), "", error.strerror or str(error))]
    if len(data) > LIMIT:
        return None, [Fault(Place(source), "", f"larger than {LIMIT} bytes; a study is a short text")]
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = data[: error.start].split(b"\n")
        place = Place(source, len(before), len(before[-1].decode("utf-8", "replace")) + 1)
        return None, [Fault(place, "", f"byte 0x{data[error.start]:02x} is not UTF-8; save the file as UTF-8")]
    return _Reader(source, marks=True).read(text, "")


def override(text: str, path: str, value: str) -> tuple[Node | None, list[Fault]]:
    """The value of an override, read as YAML. `text` is how the override is named in faults."""
    return _Reader(text, marks=False).read(value, path)


def _unreadable(path: Path, fault: str) -> str:
    """The fault of a path, with the nearest existing name."""
    with suppress(OSError):
        if path.is_dir():
            found = sorted(p.name for p in path.glob("*.yaml"))
            return "a directory; give one study" + (f" of it: {', '.join(found)}" if found else "")
        if fault == ABSENT:
            folders = (path.parent, Path(STUDIES), Path(os.path.relpath(project() / STUDIES)))
            near = [str(p) for folder in folders for p in sorted(folder.glob("*.yaml"))]
            same = [name for name in near if Path(name).stem == path.stem]  # `alpha` for `studies/alpha.yaml`
            return fault + (f"; did you mean '{same[0]}'?" if same else nearest(str(path), near))
    return fault


class _Reader:
    """Builds the tree from YAML nodes and collects the faults."""

    def __init__(self, source: str, *, marks: bool) -> None:
        self.source, self.marks = source, marks
        self.faults: list[Fault] = []
        self.seen: set[int] = set()
        self.aliased: list[Fault] = []
        self.yaml = YAML(typ="safe", pure=True)
        self.yaml.Composer = _Composer
        self.yaml.max_depth = DEEPEST

    def read(self, text: str, path: str) -> tuple[Node | None, list[Fault]]:
        try:
            node = self.yaml.compose(text)
            root = self._build(node, path, self._place(node)) if node is not None else None
            if self.aliased:
                return None, self.aliased
        except (MaxDepthExceededError, _TooManyError) as error:
            text = f"more than {NODES:,} keys and values" if isinstance(error, _TooManyError) else "nested too deeply"
            return None, [*self.faults, Fault(self._place(error), path, f"{text}; this is not a study")]
        except MarkedYAMLError as error:
            return None, [*self.faults, Fault(self._place(error), path, _syntax(error))]
        except YAMLError as error:
            return None, [*self.faults, Fault(Place(self.source), path, f"not YAML: {str(error).splitlines()[0]}")]
        return root, self.faults

    def _place(self, node: Any) -> Place:
        mark = getattr(node, "problem_mark", None) or getattr(node, "start_mark", None)
        return Place(self.source, mark.line + 1, mark.column + 1) if mark and self.marks else Place(self.source)

    def _fault(self, node: YamlNode, path: str, text: str) -> None:
        self.faults.append(Fault(self._place(node), path, text))

    def _build(self, node: YamlNode, path: str, key: Place) -> Node:
        value: Any = Unreadable.VALUE
        alias = id(node) in self.seen
        self.seen.add(id(node))
        if self.aliased or alias:  # one is told, and nothing else: a file may have a bomb of them
            text = "used again by an alias; aliases are not read here, write the value out"
            self.aliased = self.aliased or [Fault(key, path, text)]  # the node's own place is that of its first use
        elif isinstance(node, ScalarNode):
            value = self._scalar(node, path)
        elif str(node.tag) not in PLAIN_TAGS:
            self._fault(node, path, f"the tag {node.tag} is not read here")
        else:
            value = self._mapping(node, path) if isinstance(node, MappingNode) else self._sequence(node, path)
        return Node(value, self._place(node), key, path)

    def _mapping(self, node: MappingNode, path: str) -> dict[str, Node] | Unreadable:
        children: dict[str, Node] = {}
        whole = True
        for key, child in node.value:
            if not isinstance(key, ScalarNode):
                self._fault(key, path, "a key must be a word, not a list or a mapping")
                continue
            name, place = str(key.value), self._place(key)
            if fault := _key_fault(name):
                self._fault(key, path, fault)
                whole = False
                continue
            built = self._build(child, join(path, name), place)
            if name in children:
                first = children[name].key
                where = f"first in line {first.line}" if first.line else "already given"
                self._fault(key, built.path, f"duplicate key {show(name)}, {where}")
            else:
                children[name] = built
        return children if whole else Unreadable.VALUE

    def _sequence(self, node: YamlNode, path: str) -> list[Node]:
        return [self._build(child, join(path, str(i)), self._place(child)) for i, child in enumerate(node.value)]

    def _scalar(self, node: ScalarNode, path: str) -> str | int | float | bool | Unreadable | None:
        try:
            value = self.yaml.constructor.construct_object(node)
        except (YAMLError, ValueError):
            self._fault(node, path, f"{show(node.value)} cannot be read as {str(node.tag).rsplit(':', 1)[-1]}")
            return Unreadable.VALUE
        if isinstance(value, float) and not math.isfinite(value):
            self._fault(node, path, f"{node.value} is not allowed; must be a finite number")
            return Unreadable.VALUE
        if isinstance(value, float) and value.is_integer() and abs(value) < EXACT:
            return int(value)
        if isinstance(value, str) and not value.isprintable():
            return "".join(c if seen(c) or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in value)
        if value is not None and not isinstance(value, str | int | float):
            self._fault(node, path, f"{node.value} is read as a {type(value).__name__}; in quotes it is text")
            return Unreadable.VALUE
        return value


class _TooManyError(MarkedYAMLError):
    """A file of more nodes than `NODES`."""


class _Composer(Composer):
    """Ends the reading of a file that is too large to be read quickly."""

    def __init__(self, loader: Any = None) -> None:
        super().__init__(loader)
        self.nodes, self.warn_double_anchors = 0, False

    def compose_node(self, parent: Any, index: Any) -> Any:
        self.nodes += 1
        if self.nodes > NODES:
            raise _TooManyError(problem_mark=self.parser.peek_event().start_mark)
        return super().compose_node(parent, index)


def _key_fault(name: str) -> str:
    if len(name) > KEY:
        return f"a key of {len(name):,} characters, {show(name)}; at most {KEY}"
    return "" if name.isprintable() else f"the key {show(name)} has characters that cannot be seen; leave them out"


def _syntax(error: MarkedYAMLError) -> str:
    problem = (error.problem or "cannot be read").replace("\\t", "TAB")
    if "TAB" in problem:
        return "not YAML: a TAB; indent with spaces"
    return f"not YAML: {problem}" + (f" ({error.context})" if error.context else "")


# Trees


def join(path: str, name: str) -> str:
    """Dotted path of a child."""
    return f"{path}.{name}" if path else name


def plain(value: Any) -> Any:
    """A node or a value without places."""
    if isinstance(value, Node):
        return plain(value.value)
    if isinstance(value, dict):
        return {key: plain(child) for key, child in value.items()}
    if isinstance(value, list):
        return [plain(child) for child in value]
    return None if isinstance(value, Unreadable) else value


def merge(base: Node, patch: Node) -> Node:
    """`patch` over `base`: mappings key by key, anything else is replaced.

    A mapping whose `kind` differs from the base's replaces it whole: the base's other fields belong to another thing.
    """
    if not isinstance(base.value, dict) or not isinstance(patch.value, dict) or _other_kind(base, patch):
        return patch
    value = dict(base.value)
    for key, child in patch.value.items():
        value[key] = merge(value[key], child) if key in value else child
    return base._replace(value=value)


def _other_kind(base: Node, patch: Node) -> bool:
    kinds = [node.children["kind"].value for node in (base, patch) if "kind" in node.children]
    return len(kinds) == 2 and kinds[0] != kinds[1]


def locate(node: Node, loc: Iterable[str | int]) -> tuple[Node, list[str]]:
    """The deepest written node on the way along `loc`, and the part of the way that is not written."""
    rest = [str(part) for part in loc]
    while rest and (child := _at(node, rest[0])) is not None:
        node = child
        rest.pop(0)
    return node, rest


def _at(node: Node, key: str) -> Node | None:
    """The child of a mapping or a list at the text of its key or index."""
    if isinstance(node.value, list):
        return node.value[int(key)] if key.isdecimal() and int(key) < len(node.value) else None
    return node.children.get(key)


# Validation


def validate(model: type[M], node: Node, hidden: tuple[str, ...] = ()) -> tuple[M | None, list[Fault]]:
    """The tree as a model, or every fault. Fields in `hidden` are not offered to the user.

    Strict: no text for a number, no `true` for 1.
    """
    try:
        found, faults = model.model_validate_json(json.dumps(plain(node)), strict=True), list[Fault]()
    except ValidationError as error:
        found, faults = None, [f for detail in error.errors() if (f := _fault(model, node, detail, hidden))]
    known = {fault.path for fault in faults}
    beyond = [fault for fault in _beyond(model, node) if fault.path not in known]
    return (None if beyond else found), faults + beyond


def _beyond(model: type[BaseModel], node: Node, name: str = "") -> Iterator[Fault]:
    """Values that no field may have (`limits`); `name` is that of a mapping whose keys are no names of fields."""
    for key, child in node.children.items():
        if key not in model.model_fields:
            continue
        inner, field = _inner(model.model_fields[key].annotation), name or key
        if inner is not None:
            yield from _beyond(inner, child, "" if set(inner.model_fields) - set(BY_PROFILE) else key)
            continue
        for value in _leaves(child):
            if rule := limits.beyond(field, value.value):
                yield Fault(value.place, value.path, f"{show(value.value)} is not allowed; {rule}")


def _leaves(node: Node) -> Iterator[Node]:
    """A value, or those in a list."""
    if isinstance(node.value, list):
        for child in node.value:
            yield from _leaves(child)
    elif not isinstance(node.value, dict):
        yield node


def _fault(model: type[BaseModel], root: Node, error: ErrorDetails, hidden: tuple[str, ...]) -> Fault | None:
    loc, kind, context = [str(part) for part in error["loc"]], error["type"], error.get("ctx", {})
    text = str(context.get("error", ""))
    if kind == "value_error":  # a rule across fields: 'field: text' names the field it is about
        field, colon, tail = text.partition(": ")
        loc, text = ([*loc, field], tail) if colon and field in model.model_fields else (loc, text)
    node, rest = locate(root, loc)
    path = ".".join(part for part in (node.path, *rest) if part)
    if isinstance(node.value, Unreadable):
        return None
    if kind == "value_error":
        return Fault(node.place, path, text)
    if kind == "missing":
        return Fault(node.key, path, "missing")
    if kind == "extra_forbidden":
        return Fault(node.key, path, _unknown(loc[-1], _model(model, error["loc"][:-1]), hidden))
    if isinstance(node.value, str) and loc and not rest:
        block = renamed.block_hint(loc[-1], node.value, settings(_model(model, error["loc"][:-1])))
        if block:
            return Fault(node.place, path, block)
    return Fault(node.place, path, f"{show(node.value)} is not allowed; {_rule(node, error)}")


def _rule(node: Node, error: ErrorDetails) -> str:
    """The values that are allowed instead of the node's value."""
    context = error.get("ctx", {})
    if error["type"] == "literal_error":
        allowed = context["expected"].replace(" or ", ", ").split(",")
        return choices(node.value, [name.strip().strip("'") for name in allowed])
    if context.get("min_length") == 1:
        return "must not be empty"
    rule = error["msg"].replace("Input should be", "must be").replace("an object", "a mapping").replace("array", "list")
    return rule[0].lower() + rule[1:]


def _unknown(key: str, model: type[BaseModel], hidden: tuple[str, ...]) -> str:
    """The fault of a key that a model has not: its new name, or the fields that there are."""
    allowed = [name for name in model.model_fields if name not in hidden]
    return renamed.hint(key, settings(model)) or f"unknown key {show(key)}; {choices(key, allowed)}"


def _model(model: type[BaseModel], loc: tuple[str | int, ...]) -> type[BaseModel]:
    """The model at `loc` inside `model`; names of free keys are passed over."""
    for part in loc:
        if str(part) in model.model_fields:
            model = _inner(model.model_fields[str(part)].annotation) or model
    return model


def settings(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """The fields of a model by dotted name, those of its blocks in place of each block."""
    found: dict[str, FieldInfo] = {}
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            found |= {join(name, inner): value for inner, value in settings(field.annotation).items()}
        else:
            found[name] = field
    return found


def _inner(annotation: Any) -> type[BaseModel] | None:
    """The model in an annotation such as `Layer`, `Layer | None` or `dict[str, Layer]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    found = [_inner(part) for part in getattr(annotation, "__args__", ())]
    return next((model for model in found if model), None)


# Words


def show(value: Any) -> str:
    """A value as a person would write it in YAML, or else its type; cut to `SHOWN` characters."""
    if isinstance(value, str):
        text = f"'{value}'" if value.isprintable() else repr(value)
    elif value is None or isinstance(value, int | float | dict | list):
        text = json.dumps(plain(value), ensure_ascii=False, skipkeys=True, default=lambda inner: type(inner).__name__)
    else:
        text = f"a {type(value).__name__}"
    return text if len(text) <= SHOWN else text[: SHOWN - 1] + "…"


def choices(value: Any, allowed: Iterable[str]) -> str:
    """The values that are allowed instead, and the nearest of it."""
    names = list(allowed)
    more = f" and {len(names) - LISTED:,} more" if len(names) > LISTED else ""
    return f"allowed: {', '.join(names[:LISTED])}{more}{nearest(str(value), names)}"


def nearest(word: str, names: Iterable[str]) -> str:
    """'; did you mean ...?' where something is near, else nothing."""
    by_lower = {name.lower(): name for name in names}
    found = difflib.get_close_matches(word.lower(), by_lower, n=1, cutoff=0.5)
    return f"; did you mean '{by_lower[found[0]]}'?" if found else ""
