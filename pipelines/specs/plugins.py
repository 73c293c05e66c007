"""Methods, tasks and coordinators of packages outside this project: who names them, and which runs need them.

A module is imported because a user names it: in a study's or a search's `imports`, as an entry point (`rhmc.methods`,
`rhmc.tasks`, `rhmc.coordinators`) of a package that is installed, or in the variable `RHMC_IMPORTS`. A record, as of a
run, a policy or a bundle, says which modules it needs. It is no user: what it names and nobody else does is not
imported.
"""

import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import cache
from importlib.metadata import entry_points
from inspect import isclass, isfunction
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from pipelines.specs.document import Fault, Node, choices, nearest, show
from pipelines.specs.safe_names import simple
from pipelines.workspace.errors import InputError
from pipelines.workspace.own_packages import NotImportedError, bring, load, load_taken, names, top_of
from rhmc.algorithms import ALGORITHMS, Method
from rhmc.envs import ENVS, EnvConfig, Task
from rhmc.hierarchy import coordinator
from rhmc.hierarchy.coordinator import COORDINATORS, Coordination
from rhmc.learning.acting import ACTS_ON
from rhmc.yardsticks import BOUNDS, OFFERS, POLICIES

PROJECT = "rhmc"  # whose kinds are always there
GROUPS = ("rhmc.methods", "rhmc.tasks", "rhmc.coordinators")  # of entry points
VARIABLE = "RHMC_IMPORTS"  # names of modules, with commas between
COORDINATOR = "coordinator"  # what the setting `coordinator.method` of a method chooses, if it has this setting
TABLES: dict[str, dict[str, Any]] = {"env": ENVS, "algo": ALGORITHMS, COORDINATOR: COORDINATORS}  # sections first
WORDS = {"env": "task", "algo": "method", COORDINATOR: "coordinator"}
ENTRIES: dict[str, tuple[type[Any], str]] = {
    "env": (Task, "rhmc.envs.Task"),
    "algo": (Method, "rhmc.algorithms.Method"),
    COORDINATOR: (Coordination, "rhmc.hierarchy.coordinator.Coordination"),
}
FILLED: list[dict[str, Any]] = [*TABLES.values(), ACTS_ON, OFFERS, POLICIES, BOUNDS]  # what a module may register in


class UnnamedError(InputError):
    """A record needs a package that nobody has named, or another one than is here."""


# What is registered


def configs(section: str) -> dict[str, type[Any]]:
    """The configuration of every kind that is registered now, in the order of the table."""
    return {kind: entry.config for kind, entry in TABLES[section].items()}


def unknown(section: str, kind: Any) -> str:
    """The fault of a kind that is not registered."""
    unusable = "".join(f"; not imported: {why}" for why in discover())
    return f"{show(kind)} is not allowed; {choices(kind, configs(section))}{unusable}"


def kinds_of(parts: Mapping[str, Any]) -> dict[str, Any]:
    """The kinds of a setting's task and method, and its coordinator where the method is registered and chooses one.

    Args:
        parts: by section, as configurations or as a record has them. Not trusted.
    """
    kinds = {section: _value(part, "kind") for section, part in parts.items()}
    if chooses(kinds.get("algo")) and (name := _value(_value(parts["algo"], COORDINATOR), "method")):
        kinds[COORDINATOR] = name
    return kinds


def _value(part: Any, name: str) -> Any:
    return part.get(name) if isinstance(part, dict) else getattr(part, name, None)


def chooses(kind: Any) -> bool:
    """True of a method whose settings name a coordinator of the table."""
    return isinstance(kind, str) and kind in ALGORITHMS and issubclass(ALGORITHMS[kind].config, coordinator.Config)


def page(entry: Any) -> str:
    """The module that defines an entry of a table."""
    return str((entry.build if isinstance(entry, Coordination) else entry.config).__module__)


def pages(kinds: Mapping[str, Any]) -> tuple[str, ...]:
    """The modules outside this project that define what runs of these kinds (see `kinds_of`) are."""
    known = [(section, kind) for section, kind in kinds.items() if isinstance(kind, str) and kind in TABLES[section]]
    found = {page(TABLES[section][kind]) for section, kind in known}
    return tuple(sorted(module for module in found if top_of(module) != PROJECT))


def finals() -> dict[str, str]:
    """The final values that come first, as metrics and in words: of every task that is registered now."""
    names = dict.fromkeys(name for offers in OFFERS.values() for name in offers.measures)
    return {f"final/{name}": name.replace("_", " ") for name in names}


# Who names a module: a study


def imported(node: Node | None, folder: Path) -> list[Fault]:
    """Import what a study's `imports` names, and say what is wrong with it.

    Args:
        node: the value of the key, if it is there. What is no list of words is left to the check of the file's shape.
        folder: that of the study; a package is found if it is installed, or lies there or in the current directory.
    """
    if node is None or not isinstance(node.value, list):
        return []
    if not node.value:
        return [Fault(node.place, node.path, "names no module; name one, or leave the key out")]
    places = list(dict.fromkeys([folder, Path()]))
    faults = [(one, _brought(one.value, places)) for one in node.value if isinstance(one.value, str)]
    return [Fault(one.place, one.path, f"{show(one.value)}: {text}") for one, text in faults if text]


def _brought(module: str, folders: Iterable[Path]) -> str:
    """Import a module that is to register something; what is wrong, or nothing."""
    if top_of(module) == PROJECT:
        return "is of this project, whose methods and tasks are always there"
    return _all_or_nothing(lambda: bring(module, folders), module)


def _all_or_nothing(act: Callable[[], None], module: str) -> str:
    """Let a module register what it has; the tables are as they were where something is wrong with it."""
    before = [dict(table) for table in FILLED]
    known = {section: set(table) for section, table in TABLES.items()}
    try:
        act()
        text = next(_unfit(known, module), "")
    except NotImportedError as error:
        text = f"{error}{nearest(module, error.near)}"
    if text:
        for table, old in zip(FILLED, before, strict=True):
            table.clear()
            table.update(old)
    return text


def _unfit(known: Mapping[str, Collection[str]], module: str) -> Iterator[str]:
    """The faults of what was registered since; a module that was imported earlier has registered it then."""
    new = [(s, kind, entry) for s, table in TABLES.items() for kind, entry in table.items() if kind not in known[s]]
    for section, kind, entry in new:
        what, (shape, named) = f"registers the {WORDS[section]} {show(kind)}", ENTRIES[section]
        fields = getattr(getattr(entry, "config", None), "model_fields", {})
        if not isinstance(entry, shape):
            yield f"{what}, which is no {named}"
        elif not simple(kind):
            yield f"{what}; a kind is named with letters, digits, '-' and '_' only"
        elif section == COORDINATOR:
            if not (isclass(entry.build) or isfunction(entry.build)):
                yield f"{what}, whose `build` must be a class or a function: its module is part of what names a run"
        elif not issubclass(entry.config, EnvConfig if section == "env" else BaseModel):
            yield f"{what}, whose configuration is no {'rhmc.envs.EnvConfig' if section == 'env' else 'pydantic model'}"
        elif "kind" not in fields or fields["kind"].default != kind:
            yield f'{what}, whose configuration must have the field `kind: Literal["{kind}"] = "{kind}"`'
    there = {top_of(page(entry)) for table in TABLES.values() for entry in table.values()}
    if not new and top_of(module) not in there:
        yield "registers no method, no task and no coordinator"


# Who names a module: what is installed, and the environment


def discover() -> list[str]:
    """Import what entry points and `RHMC_IMPORTS` name, once in a process.

    Returns:
        Entry points that cannot be used, a line each: those who do not need them are not kept from their work.

    Raises:
        InputError: a module of the variable cannot be imported.
    """
    load_taken()
    faults = _of_variable(os.environ.get(VARIABLE, ""), Path.cwd())
    if faults:
        raise InputError(*faults)
    return _of_entry_points()


@cache
def _of_variable(text: str, folder: Path) -> list[str]:
    modules = [word.strip() for word in text.split(",") if word.strip()]
    found = {module: _brought(module, [folder]) for module in modules}
    return [f"{VARIABLE}: {show(module)}: {fault}" for module, fault in found.items() if fault]


@cache
def _of_entry_points() -> list[str]:
    found = {one.value.partition(":")[0].strip(): one for group in GROUPS for one in entry_points(group=group)}
    faults = {module: _brought(module, ()) for module in found}
    return [f"entry point {show(found[m].name)} ({m}): {fault}" for m, fault in faults.items() if fault]


# What a record needs


def _load(module: str) -> None:
    try:
        load(module)
    except NotImportedError as error:
        raise UnnamedError(f"needs the module {module}: {error}") from error


def require(parts: Mapping[str, Any], stated: Any) -> None:
    """See that the kinds of a record are registered, and by the packages that it was made with.

    Args:
        parts: as `kinds_of` takes them; a kind that is no word is passed over.
        stated: the modules that the record says it needs, if it says any. Not trusted.

    Raises:
        UnnamedError: it needs a package that nobody has named here, or another one than is here.
        InputError: one that was named cannot be imported.
    """
    wanted = [one for one in stated if isinstance(one, str)] if isinstance(stated, list | tuple) else []
    if _unregistered(parts):
        discover()
        for module in wanted:
            if names(module):
                _load(module)
    if _unregistered(parts):
        if text := unnamed(wanted):
            raise UnnamedError(text)
        return  # that a kind is unknown is said where the kinds are listed
    here = {top_of(module) for module in pages(kinds_of(parts))}
    if wanted and {top_of(module) for module in wanted} != here:
        raise UnnamedError(
            f"made with {', '.join(map(show, wanted))}, and its method and task are here of "
            f"{', '.join(sorted(here)) or PROJECT}"
        )


def _unregistered(parts: Mapping[str, Any]) -> bool:
    return any(isinstance(kind, str) and kind not in TABLES[section] for section, kind in kinds_of(parts).items())


def unnamed(wanted: Iterable[str]) -> str:
    """Advice about the first of these modules that nobody has named here; nothing where all are named."""
    strangers = [module for module in wanted if not names(module)]
    if not strangers:
        return ""
    return (
        f"needs the module {show(strangers[0])}, which nobody has named here: if you trust its code, put its package "
        f"{show(top_of(strangers[0]))} into the variable {VARIABLE}"
    )
