"""A name for the code that decides results: it changes when behaviour may change, not when a comment does."""

import ast
import hashlib
import importlib.util
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from pathlib import Path

PACKAGE = "rhmc"
LIBRARIES = ("torch", "numpy")
DIGITS = 12


def fingerprint(folder: Path | None = None, libraries: Iterable[str] = LIBRARIES) -> str:
    """12 hex digits over every module's syntax tree, docstrings and comments left out, and the libraries' versions.

    Args:
        folder: the package; the one that would be imported if None. It is read, not imported.
        libraries: names of installed distributions.

    Raises:
        SyntaxError: a module does not parse.
    """
    digest = hashlib.sha256()
    for part in _parts(folder or package_folder(), libraries):
        digest.update(part.encode("utf-8", "surrogatepass") + b"\0")
    return digest.hexdigest()[:DIGITS]


def package_folder() -> Path:
    """Where `rhmc` would be imported from."""
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError(f"the package {PACKAGE} is not installed")
    return Path(next(iter(spec.submodule_search_locations)))


def _parts(folder: Path, libraries: Iterable[str]) -> Iterator[str]:
    for library in libraries:
        yield f"{library} {version(library)}"
    for name, path in sorted((path.relative_to(folder).as_posix(), path) for path in folder.rglob("*.py")):
        yield name
        yield ast.dump(_WithoutText().visit(ast.parse(path.read_bytes(), filename=str(path))))


class _WithoutText(ast.NodeTransformer):
    """Drops every statement that is only a text: docstrings, also those of fields."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if text else node
