"""The arrows between the parts, read from the syntax trees: what may import what, and that the tables are complete."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from ruamel.yaml import YAML

from pipelines.specs.study import Study
from rhmc.algorithms import ALGORITHMS

ROOT = Path(__file__).parents[1]
PAGE = 200  # lines that a method may take

# Beside the standard library, each package imports these and nothing else.
ALLOWED = {
    "rhmc": {"rhmc", "torch", "pydantic"},
    "pipelines": {
        *("pipelines", "rhmc", "torch", "pydantic", "pydantic_core", "ruamel", "filelock", "rich", "pandas", "pyarrow"),
        *("numpy", "matplotlib", "PIL", "packaging"),
    },
    "reports": {
        *("reports", "numpy", "pandas", "scipy", "matplotlib", "cycler", "pyarrow", "pydantic", "ruamel", "jinja2"),
        *("markupsafe", "tabulate"),
    },
}
VERBS = ("common", "doctor", "evaluate", "render", "science", "search", "study", "ui", "verify", "yardsticks")
# What writes words of users where they are read: these take `reports.data.escaping` and `reports.render.glyphs`, and nothing else.
WRITERS = ("overview", "plan", "search_run", "search_plots")
# What only these files may import.
ONLY = {
    "mlflow": {
        "pipelines/tracking/histories.py",
        "pipelines/tracking/mlflow_tracker.py",
        "pipelines/tracking/registry.py",
        "pipelines/tracking/mlflow_model.py",
    },
    "optuna": {"pipelines/tuning/trials.py", "pipelines/tuning/search_plots.py"},
    "sqlalchemy": {
        *(
            "pipelines/tracking/mlflow_tracker.py",
            "pipelines/workspace/relocation.py",
            "pipelines/workspace/sqlite.py",
            "pipelines/tuning/trials.py",
        ),
    },
    "matplotlib": {"pipelines/tuning/search_plots.py", "pipelines/tracking/overview.py"},
    "ray": {f"pipelines/{name}.py" for name in ("cluster", "own_node", "ray_driver", "trainable", "pool")},
    "typer": {"pipelines/cli/main.py", *(f"pipelines/commands/{name}.py" for name in VERBS)},
    "reports": {
        "pipelines/cli/science.py",
        "pipelines/cli/verify.py",
        *(f"pipelines/{name}.py" for name in WRITERS),
    },
}
# What these must not import: a physics knows no learner, a regulator neither task nor network.
BARRED = {
    "rhmc/envs/": (
        "rhmc.algorithms",
        "rhmc.learning.learner",
        "rhmc.networks.nets",
        "rhmc.training.trainer",
        "rhmc.training.evaluation",
    ),
    "rhmc/hierarchy/regulation.py": (
        "rhmc.envs",
        "rhmc.algorithms",
        "rhmc.networks.nets",
        "rhmc.learning.learner",
        "rhmc.training.trainer",
    ),
    "rhmc/hierarchy/filters.py": (
        "rhmc.envs",
        "rhmc.algorithms",
        "rhmc.networks.nets",
        "rhmc.learning.learner",
        "rhmc.training.trainer",
    ),
    "rhmc/algorithms/": ("rhmc.training.trainer", "rhmc.training.evaluation", "rhmc.scripted"),
}
# What loading these must not load: help has to answer at once, a check of a study in seconds.
HEAVY = {"torch", "ray", "mlflow", "numpy", "pandas", "scipy", "matplotlib", "pyarrow", "pydantic"}
LIGHT = {
    "pipelines.cli.main": HEAVY,
    "pipelines.specs.study": HEAVY - {"torch", "numpy", "pydantic"},
    "pipelines.specs.search": HEAVY - {"torch", "numpy", "pydantic"} | {"optuna"},
}


class Import(NamedTuple):
    """One imported module; `eager` if importing the file imports it."""

    module: str
    eager: bool
    line: int

    @property
    def top(self) -> str:
        return self.module.split(".")[0]


def imports(path: str, source: str) -> Iterator[Import]:
    """Every import of a file, those inside functions and by name included; names of `from a import b` count as a.b."""
    lazy = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
    stack: list[tuple[ast.AST, bool]] = [(ast.parse(source), True)]
    while stack:
        node, eager = stack.pop()
        yield from (Import(module, eager, node.lineno) for module in _modules(path, node))  # type: ignore[attr-defined]
        typing_only = isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")
        inner = eager and not isinstance(node, lazy) and not typing_only
        stack += [(child, inner) for child in ast.iter_child_nodes(node)]


def _modules(path: str, node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        package = path.split("/")[: -node.level] if node.level else []
        base = ".".join([*package, node.module or ""]).strip(".")
        return [base, *(f"{base}.{alias.name}" for alias in node.names)]
    if isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in {"import_module", "__import__"}:
        return [ast.literal_eval(a) for a in node.args[:1] if isinstance(a, ast.Constant)]
    return []


def faults(path: str, source: str) -> list[str]:
    """Imports of the file `path` (from the root, with slashes) that break the tables above, one line each."""
    own = path.split("/")[0]
    barred = tuple(name for prefix, names in BARRED.items() if path.startswith(prefix) for name in names)
    found = set()
    for item in imports(path, source):
        allowed = ALLOWED[own] | {name for name, files in ONLY.items() if path in files}
        if item.top not in allowed and item.top not in sys.stdlib_module_names:
            found.add(f"{path}:{item.line}: {own} may not import {item.top}")
        if any(f"{item.module}.".startswith(f"{name}.") for name in barred):
            found.add(f"{path}:{item.line}: this file may not import {item.module}")
    return sorted(found)


def loaded(module: str, sources: dict[str, str]) -> set[str]:
    """Top-level names that importing `module` imports, through the modules in `sources` (by dotted name)."""
    seen: set[str] = set()
    todo = [module]
    while todo:
        name = todo.pop()
        if name not in seen:
            seen.add(name)
            path = name.replace(".", "/") + ".py"
            todo += [i.module for i in imports(path, sources.get(name, "")) if i.eager]
            todo += [name.rpartition(".")[0]] if "." in name else []
    return {name.split(".")[0] for name in seen}


def files() -> list[str]:
    return sorted(p.relative_to(ROOT).as_posix() for name in ALLOWED for p in (ROOT / name).rglob("*.py"))


def modules() -> dict[str, str]:
    return {
        path.removesuffix(".py").removesuffix("/__init__").replace("/", "."): (ROOT / path).read_text(encoding="utf-8")
        for path in files()
    }


def unmatched(what: str, wanted: Iterable[str], listed: Iterable[str]) -> list[str]:
    """Names that are on one side only, one line each."""
    wanted, listed = set(wanted), set(listed)
    return [f"{what}: {n} is not listed" for n in sorted(wanted - listed)] + [
        f"{what}: {n} is listed and is not there" for n in sorted(listed - wanted)
    ]


# Imports


@pytest.mark.parametrize("name", WRITERS)
def test_what_writes_takes_the_escapes_alone(name: str) -> None:
    source = (ROOT / "pipelines" / f"{name}.py").read_text(encoding="utf-8")
    taken = {i.module for i in imports(f"pipelines/{name}.py", source) if i.top == "reports"}
    leaves = ("reports.data.escaping", "reports.render.glyphs")
    assert {module for module in taken if not module.startswith(leaves)} <= {"reports"}
    assert loaded("reports.data.escaping", modules()) <= {"reports", "re", "hashlib"}


@pytest.mark.parametrize("path", files())
def test_imports_follow_the_arrows(path: str) -> None:
    assert faults(path, (ROOT / path).read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("path", "source", "named"),
    [
        ("rhmc/networks/nets.py", "import numpy", "numpy"),
        ("rhmc/networks/nets.py", "import torch, pandas as pd", "pandas"),
        ("rhmc/training/trainer.py", "def f():\n    from pipelines import study", "pipelines"),
        ("rhmc/training/trainer.py", "from importlib import import_module\nimport_module('mlflow')", "mlflow"),
        ("rhmc/envs/coverage.py", "from rhmc.algorithms import ALGORITHMS", "rhmc.algorithms"),
        ("rhmc/envs/coverage.py", "from rhmc import trainer", "rhmc.training.trainer"),
        ("rhmc/envs/coverage.py", "from ..nets import mlp", "rhmc.networks.nets"),
        ("rhmc/hierarchy/regulation.py", "import rhmc.envs.coverage", "rhmc.envs"),
        ("reports/render/figures.py", "from rhmc.types import Frozen", "rhmc"),
        (
            "reports/pages/build.py",
            "try:\n    import pipelines.export.tables\nexcept ImportError:\n    pass",
            "pipelines",
        ),
        ("reports/data/frame.py", "import torch", "torch"),
        ("reports/data/frame.py", "from mlflow import MlflowClient", "mlflow"),
        ("pipelines/execution/run.py", "def f():\n    import mlflow", "mlflow"),
        ("pipelines/specs/study.py", "from ray import tune", "ray"),
        ("pipelines/export/tables.py", "import reports.pages.build", "reports"),
    ],
)
def test_a_wrong_import_is_found(path: str, source: str, named: str) -> None:
    found = faults(path, source)
    assert len(found) >= 1
    assert all(named in line for line in found)


def test_right_imports_pass() -> None:
    source = "import json\nfrom typing import Any\nimport torch\nfrom rhmc.types import Obs\nfrom .base import Env"
    assert faults("rhmc/envs/coverage.py", source) == []
    assert faults("pipelines/tracking/mlflow_tracker.py", "import mlflow") == []
    assert faults("pipelines/cli/science.py", "def report():\n    from reports import build") == []


@pytest.mark.parametrize("module", LIGHT)
def test_light_modules_load_nothing_heavy(module: str) -> None:
    sources = modules()
    assert module in sources
    assert loaded(module, sources) & LIGHT[module] == set()


def test_a_heavy_import_is_found_at_any_depth() -> None:
    study = "class A:\n    try:\n        from pipelines import run\n    finally:\n        pass"
    sources = {
        "pipelines.cli.main": "import typer\nfrom pipelines.specs.study import A",
        "pipelines.specs.study": study,
    }
    lazy = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import torch\ndef f():\n    import mlflow"
    assert loaded("pipelines.cli.main", sources | {"pipelines.execution.run": lazy}) & HEAVY == set()
    assert loaded("pipelines.cli.main", sources | {"pipelines.execution.run": lazy + "\nimport ray.tune"}) & HEAVY == {
        "ray"
    }
    assert "torch" in loaded("pipelines.cli.main", sources | {"pipelines": "import torch"})


# Tables


def test_every_method_is_in_the_table() -> None:
    pages = {p.stem for p in (ROOT / "rhmc/algorithms").glob("*.py")} - {"__init__", "base"}
    listed = {cls.__module__.rpartition(".")[2] for cls, _, _ in ALGORITHMS.values()}
    assert unmatched("ALGORITHMS", pages, listed) == []


@pytest.mark.parametrize("page", sorted((ROOT / "rhmc/algorithms").glob("*.py")), ids=lambda page: page.stem)
def test_a_method_is_a_page(page: Path) -> None:
    assert len(page.read_text(encoding="utf-8").splitlines()) <= PAGE


PAGES = sorted(p for p in (ROOT / "rhmc/algorithms").glob("*.py") if p.stem not in {"__init__", "base"})


def unstated(page: str) -> list[str]:
    """What the opening of a method's page does not say: where it is from, and where it departs from that."""
    text = ast.get_docstring(ast.parse(page)) or ""
    parts = {name: re.search(rf"^{name}\b[^:]*: *\S", text, re.MULTILINE) for name in ("Source", "Departures")}
    return [name for name, found in parts.items() if not found]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_opens_with_its_source_and_its_departures(page: Path) -> None:
    assert unstated(page.read_text(encoding="utf-8")) == []


def test_a_page_that_does_not_is_found() -> None:
    assert unstated('"""X.\n\nSource: Y 1999.\nDepartures, each a field: none.\n"""') == []
    assert unstated('"""X. Source: Y.\n\nDepartures:\n"""') == ["Source", "Departures"]
    assert unstated("x = 1") == ["Source", "Departures"]


def test_every_method_has_a_row_in_the_list_of_departures() -> None:
    lines = (ROOT / "docs/deviations.md").read_text(encoding="utf-8").partition("\n## The methods\n")[2].splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    rows = {row[0]: row for row in cells[2:]}
    abouts = {method.about.name: method.about for method in ALGORITHMS.values()}
    assert unmatched("docs/deviations.md", abouts, rows) == []
    assert {name: row[1] for name, row in rows.items()} == {name: about.source for name, about in abouts.items()}
    for method in ALGORITHMS.values():
        named = re.findall(r"`(\w+)`", rows[method.about.name][3])
        assert unmatched(method.about.name, set(named) - set(method.config.model_fields), []) == []


@pytest.fixture(scope="module")
def stages() -> dict:
    """By name; under `vars` what they share."""
    pipeline = YAML(typ="safe").load((ROOT / "dvc.yaml").read_text(encoding="utf-8"))
    return pipeline["stages"] | {"vars": {name: v for one in pipeline["vars"] for name, v in one.items()}}


FOR_COPYING = "template"  # answers no question of the report


def test_every_study_is_in_the_pipeline(stages: dict) -> None:
    """A search is run by hand: what it finds is kept in `studies/found`, and a study that includes it is here."""
    studies = {p.stem for p in (ROOT / "studies").glob("*.yaml") if not is_search(p)} - {FOR_COPYING}
    stage, queue = stages["studies"], stages["vars"]["queue"].split()
    check, *commands = stage["cmd"]
    assert check == "rhmc profile"
    assert [command.split()[-3:] for command in commands] == [["${queue}", "--profile", "${profile}"]] * 2
    assert unmatched("dvc.yaml", {f"studies/{name}.yaml" for name in studies}, queue) == []
    tables = {f"reports/${{profile}}/runs/{name}{kind}.parquet" for name in studies for kind in ("", ".runs")}
    assert unmatched("dvc.yaml", tables, [next(iter(out)) for out in stage["outs"]]) == []
    assert "studies" in stage["deps"]  # the whole folder, and with it what a study includes


QUICK = 5_200_000  # environment steps: some ten minutes of two processors


def test_the_quick_profile_stays_quick(stages: dict) -> None:
    runs = [run.spec for file in stages["vars"]["queue"].split() for run in Study.load(ROOT / file).runs()]
    steps = {spec.id: spec.trainer.steps for spec in runs}  # what studies share is trained once
    assert sum(steps.values()) <= QUICK
    assert {spec.algo.kind for spec in runs} == set(ALGORITHMS)


def is_search(path: Path) -> bool:
    """Whether the file is named as a search; the contents have to agree."""
    document = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    spaces = ["space" in (arm or {}) for arm in document.get("arms", {}).values()]
    assert spaces == [path.stem.startswith("search_")] * len(spaces), path
    return path.stem.startswith("search_")


NO_PAGE = {"reports/__init__.py", "reports/analyses/equivalence.py"}  # what no page is made with


def test_the_report_depends_on_all_its_modules(stages: dict) -> None:
    found = [p for p in (ROOT / "reports").glob("*") if p.suffix in {".py", ".yaml", ".j2"}]
    parts = {p.relative_to(ROOT).as_posix() for p in found}
    listed = {d for d in stages["report"]["deps"] if "${" not in d}
    assert unmatched("dvc.yaml", parts - NO_PAGE, listed) == []


def test_every_stage_that_computes_waits_for_the_fingerprint(stages: dict) -> None:
    for name in ("studies", "yardsticks", "theorem", "methods", "drawings"):
        assert ".fingerprint" in stages[name]["deps"]
    assert ".fingerprint" in stages["fingerprint"]["outs"][0]


def test_unmatched_names_both_sides() -> None:
    assert unmatched("x", {"a", "b"}, ["b", "c"]) == ["x: a is not listed", "x: c is listed and is not there"]
    assert unmatched("x", {"a"}, ["a"]) == []


# The lock


def pins(lines: Iterable[str]) -> dict[str, str]:
    """Version by normalised name; a line that is no exact pin is an error."""
    found = {}
    for line in lines:
        match = re.fullmatch(r"([A-Za-z0-9._-]+)(?:\[\w+\])?==([\w.]+)", line)
        assert match, f"not an exact pin: {line!r}"
        found[re.sub(r"[-_.]+", "-", match[1]).lower()] = match[2]
    return found


def locked() -> dict[str, str]:
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    return pins(line for line in lines if not line.startswith("#"))


def test_the_lock_holds_every_direct_dependency_within_its_range() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    direct = list(map(Requirement, project["dependencies"] + project["optional-dependencies"]["test"]))
    lock = {canonicalize_name(name): version for name, version in locked().items()}
    outside = [str(one) for one in direct if not one.specifier.contains(lock.get(canonicalize_name(one.name), "0"))]
    assert outside == []
    assert [one.name for one in direct if not one.specifier] == []


def test_the_lock_holds_no_cuda() -> None:
    assert [name for name in locked() if re.match(r"nvidia|cuda|triton", name)] == []


@pytest.mark.parametrize("line", ["torch", "torch>=2", "torch==2.13.0+cpu", "torch @ file:///wheel", "-e ."])
def test_a_loose_pin_is_an_error(line: str) -> None:
    with pytest.raises(AssertionError, match="not an exact pin"):
        pins([line])
