"""Packages of the user's own: imported because the user names them, from where they lie, and `sys.path` stays.

A module that is named is found where Python finds it (it is installed, or on `PYTHONPATH`), else in the folders that
the caller gives. A finder at the end of Python's list remembers the folder of its package, so it stands in for nothing
that is installed, and knows no other name. Other processes are told of it by `named`, and find it after `take`.
"""

import importlib
import pkgutil
import sys
import traceback
from collections.abc import Iterable, Mapping, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

from pipelines.workspace.errors import InputError

_named: dict[str, str] = {}  # module -> the folder of its package
_waiting: dict[str, str] = {}  # of them those that this process has not imported yet


class NotImportedError(InputError):
    """A module that cannot be imported, in one line without its name; `near` are names that may be meant."""

    def __init__(self, text: str, near: Iterable[str] = ()) -> None:
        super().__init__(text)
        self.near = list(near)


class Finder:
    """Finds the packages whose folder is known, by their own name alone; what is inside them Python finds itself."""

    def __init__(self) -> None:
        self.folders: dict[str, str] = {}

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Python's protocol."""
        folder = self.folders.get(name)
        return PathFinder.find_spec(name, [folder]) if folder is not None else None


_finder = Finder()
sys.meta_path.append(_finder)


def bring(module: str, folders: Iterable[Path] = ()) -> None:
    """Import a module that the user names.

    Args:
        module: dotted name.
        folders: where its package may lie if it is not installed, in this order.

    Raises:
        NotImportedError: there is no such module, or it raises. Nothing of it stays imported.
    """
    if not all(part.isidentifier() for part in module.split(".")):
        raise NotImportedError("not the name of a module, such as my_package or my_package.methods")
    importlib.invalidate_caches()
    top, places = top_of(module), [folder.resolve() for folder in folders]
    found = _located(top, places)
    if found is None:
        where = f"; neither installed nor in {' or '.join(map(str, places))}" if places else "; it is not installed"
        raise NotImportedError(f"no such module{where}", _nearest(module, places))
    folder = str(_folder(found))
    if (loaded := _loaded_from(top)) not in ("", folder):
        raise NotImportedError(f"{top} is loaded from {loaded}, and this one is in {folder}; rename one of them")
    _finder.folders.setdefault(top, folder)
    try:
        load(module)
    except NotImportedError:
        if not loaded:
            del _finder.folders[top]
        raise
    _named[module] = folder


def load(module: str) -> None:
    """Import a module whose package can be found.

    Raises:
        NotImportedError: as `bring`.
    """
    before = set(sys.modules)
    try:
        importlib.import_module(module)
    except (Exception, SystemExit) as error:
        missing = (error.name if isinstance(error, ModuleNotFoundError) else None) or ""
        near = _nearest_inside(missing)
        for name in set(sys.modules) - before:
            if top_of(name) == top_of(module):
                del sys.modules[name]
        if missing and f"{module}.".startswith(f"{missing}."):
            raise NotImportedError(f"no module {missing}", near) from error
        raise NotImportedError(f"cannot be imported: {_told(error, top_of(module))}") from error


def named() -> dict[str, str]:
    """The modules that were named in this process, each with the folder that its package lies in."""
    return dict(_named)


def names(module: str) -> bool:
    """True if the user has named a module, or a package that it is in."""
    return any(f"{module}.".startswith(f"{one}.") for one in _named)


def take(told: Mapping[str, str]) -> None:
    """Let what was named in another process be found here, without importing it yet."""
    for module, folder in told.items():
        if module not in _named:
            _finder.folders.setdefault(top_of(module), folder)
            _named[module] = _waiting[module] = folder


def load_taken() -> None:
    """Import all that was taken and not imported yet.

    Raises:
        InputError: one of them cannot be.
    """
    while _waiting:
        module, _ = _waiting.popitem()
        try:
            load(module)
        except InputError as error:
            raise InputError(f"{module}: {error}") from error


def top_of(module: str) -> str:
    """The package that a module is in."""
    return module.partition(".")[0]


def _located(top: str, folders: Sequence[Path]) -> ModuleSpec | None:
    for finder in sys.meta_path:
        if finder is not _finder and (spec := finder.find_spec(top, None)):
            return spec
    return PathFinder.find_spec(top, list(map(str, folders)))


def _folder(spec: ModuleSpec) -> Path:
    """The folder that holds a package, or a module that is one file."""
    inside = next(iter(spec.submodule_search_locations or []), None)
    return Path(inside or spec.origin or "").parent


def _loaded_from(top: str) -> str:
    spec = getattr(sys.modules.get(top), "__spec__", None)
    return str(_folder(spec)) if spec else ""


def _told(error: BaseException, top: str) -> str:
    """An error in one line, with the last place in the package that it came by."""
    words = " ".join(str(error).split())
    name = f"{type(error).__name__}: {words}" if words else type(error).__name__
    if isinstance(error, SyntaxError):  # it tells its own place, without the folder
        return name
    inside = [f for f in traceback.extract_tb(error.__traceback__) if top in Path(f.filename).with_suffix("").parts]
    return f"{name} ({inside[-1].filename}:{inside[-1].lineno})" if inside else name


def _nearest(module: str, folders: Sequence[Path]) -> list[str]:
    """The module in each other package that there is."""
    inside = module.removeprefix(top_of(module))
    return [one.name + inside for one in pkgutil.iter_modules([*map(str, folders), *sys.path])]


def _nearest_inside(module: str) -> list[str]:
    parent = sys.modules.get(module.rpartition(".")[0])
    return [f"{parent.__name__}.{one.name}" for one in pkgutil.iter_modules(parent.__path__)] if parent else []
