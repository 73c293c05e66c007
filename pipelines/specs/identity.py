"""A name for the code that decides a run: it changes when that run's behaviour may change, and with nothing else.

The code of a run is what its method's page, its task's page and the trainer import, directly or not, as
`pipelines.specs.syntax` reads it. A page is used by nobody but its own runs, since it registers itself. Where a page,
or the coordinator that a method's settings choose, is of a package outside this project, all modules of that package
count: nothing says how they find each other.
"""

import importlib.util
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path

from pipelines.specs.plugins import chooses, page
from pipelines.specs.syntax import Code, digest
from pipelines.workspace.own_packages import top_of
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS
from rhmc.hierarchy.coordinator import COORDINATORS

PACKAGE, TRAINER = "rhmc", "rhmc.training.trainer"
LIBRARY = "torch"  # decides results beside the code


def code_id(method: str, task: str, imports: Iterable[str] = ()) -> str:
    """12 hex digits over all code that decides the runs of a method in a task.

    Args:
        method: its kind.
        task: its kind.
        imports: modules outside this project that a setting needs (`Setting.imports`).

    Raises:
        SyntaxError: a module does not parse.
        ModuleNotFoundError: there is no such package.
    """
    return combined(modules(method, task, imports).values())


def modules(method: str, task: str, imports: Iterable[str] = ()) -> Mapping[str, str]:
    """The digest of each module in the code of a method's runs in a task, by dotted name; arguments as of `code_id`."""
    pages = [ALGORITHMS[method].config.__module__, ENVS[task].config.__module__, *imports]
    others = {top_of(page) for page in pages} - {PACKAGE}
    code = _code(frozenset({PACKAGE, *others}))
    return code.closure([TRAINER, *pages, *(name for name in code.sources if top_of(name) in others)])


def present() -> frozenset[str]:
    """The code ids that are possible here: of every method in every task, with every coordinator that it may have."""
    own = [(page(one),) for one in COORDINATORS.values() if top_of(page(one)) != PACKAGE]
    more = {method: own if chooses(method) else [] for method in ALGORITHMS}
    return frozenset(code_id(m, task, imports) for m in ALGORITHMS for task in ENVS for imports in [(), *more[m]])


def fingerprint() -> str:
    """12 hex digits over all of `rhmc`: what a pipeline's stages and the nodes of a cluster have to agree on."""
    code = _code(frozenset({PACKAGE}))
    return combined(code.digest(name) for name in code.sources)


@cache
def _code(packages: frozenset[str]) -> Code:
    """As it was when this process first asked: an edit while a study runs concerns the next launch."""
    return Code({name: folder_of(name) for name in packages})


def combined(digests: Iterable[str]) -> str:
    """One digest of many, in no order, and of the library's version without the name of its build."""
    library = f"{LIBRARY} {version(LIBRARY).partition('+')[0]}"
    return digest("\n".join([*sorted(set(digests)), library]))


def folder_of(package: str) -> Path:
    """The folder that a package would be imported from; of a single module, its file.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    spec = importlib.util.find_spec(package)
    if spec is None or not (spec.submodule_search_locations or spec.origin):
        raise ModuleNotFoundError(f"the package {package} is not installed")
    return Path(next(iter(spec.submodule_search_locations or []), spec.origin or ""))
