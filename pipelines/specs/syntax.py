"""The modules of packages by their content: what decides behaviour in each, and what they need of each other.

A module counts by its syntax, without comments, docstrings, import lines and the names of files and folders, in a form
that is the same under every version of Python. What an imported name stands for counts: the name that the module uses,
and the content of the module that defines it. An import whose name is not used is no dependency. Files are read, not
imported; nothing but the standard library is needed, so any Python can compute a digest.
"""

import ast
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

DIGITS = 12
IMPORTS = (ast.Import, ast.ImportFrom)
NAMED = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
HOW = {"ctx", "kind", "type_comment"}  # fields that only say how something was written


def digest(text: str) -> str:
    """12 hex digits of an ASCII text."""
    return hashlib.sha256(text.encode("ascii")).hexdigest()[:DIGITS]


class Binding(NamedTuple):
    """A name that an import brings into a module: `name` of `module`, or the module itself where that is empty."""

    local: str
    module: str
    name: str


class Target(NamedTuple):
    """The object that a name stands for; `module` is empty outside the packages that are looked at."""

    module: str
    name: str


class Code:
    """The modules of some packages and what they need of each other.

    Args:
        packages: folder, or file of a single module, by name.

    Raises:
        SyntaxError: a module does not parse.
    """

    def __init__(self, packages: Mapping[str, Path]) -> None:
        self.sources = {name: Source(name, path) for name, path in _files(packages)}

    def closure(self, roots: Iterable[str]) -> dict[str, str]:
        """Digests of the modules that the roots need, by name; modules without any code left out."""
        found: set[str] = set()
        waiting = list(roots)
        while waiting:
            name = waiting.pop()
            if name in found or name not in self.sources:
                continue
            found.add(name)
            waiting += [target.module for _, target in self._targets(name)]
            waiting += _parents(name)  # Python runs them first
        return {name: self.digest(name) for name in sorted(found) if self.sources[name].syntax}

    def digest(self, name: str) -> str:
        """Of a module's syntax and what its imported names stand for."""
        bound = {f"{local} {self._shown(target)}" for local, target in self._targets(name)}
        return digest("\n".join([self.sources[name].syntax, *sorted(bound)]))

    def _shown(self, target: Target) -> str:
        """By content, not by file name."""
        return f"{self.sources[target.module].content} {target.name}" if target.module else target.name

    def _targets(self, name: str) -> Iterator[tuple[str, Target]]:
        """Each imported name that a module uses, and what it stands for."""
        source = self.sources[name]
        for one in source.bindings:
            if one.local in source.used:
                yield one.local, self._resolve(one.module, one.name)

    def _resolve(self, module: str, name: str, seen: frozenset[str] = frozenset()) -> Target:
        """Follow a name to the module that defines it, through those that only hand it on."""
        if module not in self.sources:
            return Target("", ".".join(part for part in (module, name) if part))
        source = self.sources[module]
        if not name or name in source.defined or module in seen:
            return Target(module, name)
        if f"{module}.{name}" in self.sources:
            return Target(f"{module}.{name}", "")
        handed = next((one for one in source.bindings if one.local == name), None)
        return self._resolve(handed.module, handed.name, seen | {module}) if handed else Target(module, name)


def _files(packages: Mapping[str, Path]) -> Iterator[tuple[str, Path]]:
    for package, place in packages.items():
        if place.is_file():
            yield package, place
            continue
        for path in place.rglob("*.py"):
            parts = path.relative_to(place).with_suffix("").parts
            yield ".".join([package, *(parts[:-1] if parts[-1] == "__init__" else parts)]), path


def _parents(name: str) -> list[str]:
    parts = name.split(".")
    return [".".join(parts[:i]) for i in range(1, len(parts))]


class Source:
    """One module, parsed.

    Args:
        name: dotted.
        path: its file.
    """

    def __init__(self, name: str, path: Path) -> None:
        tree = ast.parse(path.read_bytes(), filename=str(path))
        base = name if path.stem == "__init__" else name.rpartition(".")[0]
        nodes: list[ast.AST] = []
        _gather(tree, nodes)
        self.bindings = [one for node in nodes if isinstance(node, IMPORTS) for one in _bindings(node, base)]
        self.syntax = canonical(tree) if any(_counts(node) for node in tree.body) else ""
        self.used = {node.id for node in nodes if isinstance(node, ast.Name)} | {"*"}
        self.used |= {str(node.value) for node in nodes if isinstance(node, ast.Constant)}  # quoted annotations
        self.defined = set(_defined(tree.body))

    @cached_property
    def content(self) -> str:
        """Digest of the syntax alone."""
        return digest(self.syntax)


def _counts(node: ast.AST) -> bool:
    """True if a statement is more than a text, an import, a list of names to be offered, or for type checkers alone."""
    if not isinstance(node, ast.stmt):
        return True
    if isinstance(node, IMPORTS):
        return False
    if isinstance(node, ast.Expr):
        return not (isinstance(node.value, ast.Constant) and isinstance(node.value.value, str))
    if isinstance(node, ast.Assign):
        return not any(isinstance(target, ast.Name) and target.id == "__all__" for target in node.targets)
    return not (isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"))


def _gather(node: ast.AST, found: list[ast.AST]) -> None:
    """Append the node and all below it, imports included, other statements that do not count left out."""
    found.append(node)
    for child in ast.iter_child_nodes(node):
        if _counts(child) or isinstance(child, IMPORTS):
            _gather(child, found)


def _bindings(node: ast.AST, base: str) -> Iterator[Binding]:
    """The names that an import binds; `base` is the package that relative imports start from."""
    if isinstance(node, ast.Import):
        for alias in node.names:
            yield Binding(alias.asname or alias.name.partition(".")[0], alias.name, "")
    elif isinstance(node, ast.ImportFrom):
        folder = base.split(".")[: len(base.split(".")) - node.level + 1] if node.level else []
        module = ".".join([*folder, *([node.module] if node.module else [])])
        for alias in node.names:
            yield Binding(alias.asname or alias.name, module, "" if alias.name == "*" else alias.name)


def _defined(body: Iterable[ast.AST]) -> Iterator[str]:
    """Names that a module's own statements define, those inside functions and classes left out."""
    for node in body:
        if isinstance(node, NAMED):
            yield node.name
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        else:
            yield from _defined(ast.iter_child_nodes(node))


def canonical(tree: ast.AST) -> str:
    """The syntax as ASCII text, the same under every Python: fields that are empty or only say how are left out."""
    words: list[str] = []
    _say(tree, words)
    return "".join(words)


def _say(node: ast.AST, words: list[str]) -> None:
    if isinstance(node, ast.Constant):
        words.append(_constant(node.value))
        return
    words.append(f"({type(node).__name__}")
    for field in sorted(node._fields):
        value = getattr(node, field, None)
        if field in HOW or value is None or value == []:
            continue
        words.append(f" {field}=")
        for part in value if isinstance(value, list) else [value]:
            if not isinstance(part, ast.AST):
                words.append(json.dumps(part))
            elif _counts(part) and not _nothing(node, part):
                _say(part, words)
    words.append(")")


def _nothing(node: ast.AST, part: ast.AST) -> bool:
    """True of an empty text in an f-string, which Python 3.12 puts behind a format that is computed."""
    return isinstance(node, ast.JoinedStr) and isinstance(part, ast.Constant) and part.value == ""


def _constant(value: object) -> str:
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, bytes):
        return f"b{value.hex()}"
    return value.hex() if isinstance(value, float) else f"{type(value).__name__} {value}"
