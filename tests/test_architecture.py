"""The arrows between the parts, read from the syntax trees: what may import what, and that the tables are complete."""

import ast
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from ruamel.yaml import YAML

from pipelines.specs.include import closure
from pipelines.specs.study import Study
from rhmc.algorithms import ALGORITHMS
from tests.conftest import LONGEST

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
        *("markupsafe", "statsmodels", "tabulate", "PIL"),
    },
}
# The rooms of each package, top first, and those that each imports: a room imports only rooms above it. A module that
# stands beside the rooms is a room of its own.
ROOMS: dict[str, dict[str, tuple[str, ...]]] = {
    "rhmc": {
        "portable": (),
        "types": (),
        "registry": (),
        "envs": ("types", "registry"),
        "yardsticks": ("registry", "envs"),
        "networks": ("types", "portable"),
        "learning": ("types", "networks"),
        "hierarchy": ("types", "registry", "networks", "learning"),
        "algorithms": ("types", "registry", "networks", "learning", "hierarchy"),
        "training": ("types", "envs", "learning", "algorithms"),
    },
    "pipelines": {
        "workspace": (),
        "specs": ("workspace",),
        "conformance": ("workspace", "specs"),
        "tracking": ("workspace", "specs"),
        "export": ("workspace", "specs", "tracking"),
        "policies": ("workspace", "specs", "tracking", "export"),
        "execution": ("workspace", "specs", "tracking", "policies"),
        "bundles": ("workspace", "specs", "tracking", "export", "execution"),
        "tuning": ("workspace", "specs", "tracking", "export", "execution"),
        "cli": (
            "workspace",
            "specs",
            "conformance",
            "tracking",
            "export",
            "policies",
            "execution",
            "bundles",
            "tuning",
        ),
    },
    "reports": {
        "data": (),
        "render": ("data",),
        "analyses": ("data", "render"),
        "claims": ("data", "render", "analyses"),
        "pages": ("data", "render", "analyses", "claims"),
    },
}
FULL = 16  # modules of a room
VERBS = (
    *("common", "conformance", "doctor", "evaluate", "main", "new", "reference", "render", "science", "search"),
    *("status", "study", "ui", "verify", "yardsticks"),
)
# What writes words of users where they are read: these take `reports.data.escaping` and `reports.render.glyphs` alone.
WRITERS = tuple(
    f"pipelines/{name}.py"
    for name in ("tracking/overview", "tracking/plan", "tuning/search_run", "tuning/search_plots")
)
# What reads or writes exported tables: these take `reports.data.schema` alone.
TABLES = tuple(
    f"pipelines/{name}.py"
    for name in (
        *(f"export/{name}" for name in ("marl_eval", "pace", "published", "tables", "theorem", "yardsticks")),
        *("policies/assignments", "policies/transfer", "tuning/search_export"),
    )
)
# What only these files may import.
ONLY = {
    "pettingzoo": {"rhmc/envs/pettingzoo.py"},
    "gymnasium": {"rhmc/envs/pettingzoo.py"},
    "pydoe": {"pipelines/specs/design.py"},
    "mlflow": {
        "pipelines/tracking/histories.py",
        "pipelines/tracking/mlflow_tracker.py",
        "pipelines/tracking/registry.py",
        "pipelines/tracking/mlflow_model.py",
    },
    "optuna": {"pipelines/tuning/trials.py", "pipelines/tuning/search_plots.py"},
    "sqlalchemy": {
        "pipelines/tracking/mlflow_tracker.py",
        "pipelines/tuning/trials.py",
        "pipelines/workspace/relocation.py",
        "pipelines/workspace/sqlite.py",
    },
    "matplotlib": {"pipelines/tuning/search_plots.py", "pipelines/tracking/overview.py"},
    "ray": {
        *(f"pipelines/execution/{name}.py" for name in ("cluster", "private_node", "ray_driver", "trainable")),
        "pipelines/tuning/ray_workers.py",
    },
    "typer": {f"pipelines/cli/{name}.py" for name in VERBS},
    "reports": {"pipelines/cli/science.py", "pipelines/cli/verify.py", *WRITERS, *TABLES},
}
# What these must not import beside what their rooms do not: a regulator knows neither task nor network.
BARRED = {
    "rhmc/hierarchy/regulation.py": ("rhmc.networks", "rhmc.learning"),
    "rhmc/hierarchy/filters.py": ("rhmc.networks", "rhmc.learning"),
}
# What loading these must not load: help has to answer at once, a check of a study in seconds.
HEAVY = {
    *("pydoe", "torch", "ray", "mlflow", "numpy", "pandas", "scipy", "statsmodels", "matplotlib", "pyarrow", "pydantic")
}
LIGHT = {
    "pipelines.cli.main": HEAVY,
    "pipelines.execution.standing": HEAVY,
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
        if (arrow := crossing(path, item)) and arrow.to not in ROOMS[own].get(arrow.of, ROOMS[own]):
            found.add(f"{path}:{item.line}: the room {arrow.of} may not import {item.module}")
    return sorted(found)


class Arrow(NamedTuple):
    """A room imports another one of its package."""

    of: str
    to: str


def crossing(path: str, item: Import) -> Arrow | None:
    """The arrow that an import is, if it is one; the package's own `__init__` is in no room."""
    own, of = path.removesuffix(".py").split("/")[:2]
    parts = item.module.split(".")
    if parts[0] != own or len(parts) == 1 or parts[1] not in ROOMS[own] or parts[1] == of:
        return None
    return Arrow(of, parts[1])


def arrows(package: str) -> dict[str, set[str]]:
    """The rooms that each room of a package imports, as its files have it."""
    found: dict[str, set[str]] = {room: set() for room in rooms(package)}
    for path in files():
        for item in imports(path, (ROOT / path).read_text(encoding="utf-8")) if path.startswith(f"{package}/") else ():
            if (arrow := crossing(path, item)) and arrow.of in found:
                found[arrow.of].add(arrow.to)
    return found


def rooms(package: str) -> list[str]:
    """Folders and modules of a package."""
    return sorted(
        {path.removesuffix(".py").split("/")[1] for path in files() if path.startswith(f"{package}/")} - {"__init__"}
    )


def cycle(arrows: dict[str, set[str]]) -> list[str]:
    """The rooms of one cycle, if there is one."""
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def unsaid(text: str) -> bool:
    """True if a room's docstring fails to say, in one sentence, what lives there and what does not."""
    sentence = text.partition("\n\n")[0]
    return not re.fullmatch(r"[^.;]+; no[^.;]+\.", " ".join(sentence.split()))


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


@pytest.mark.parametrize("path", WRITERS)
def test_what_writes_takes_the_escapes_alone(path: str) -> None:
    source = (ROOT / path).read_text(encoding="utf-8")
    taken = {i.module for i in imports(path, source) if i.top == "reports"}
    leaves = ("reports.data.escaping", "reports.render.glyphs")
    assert {module for module in taken if not module.startswith(leaves)} <= {"reports.data", "reports.render"}
    assert loaded("reports.data.escaping", modules()) <= {"reports", "re", "hashlib"}


@pytest.mark.parametrize("path", TABLES)
def test_what_makes_tables_takes_their_schema_alone(path: str) -> None:
    source = (ROOT / path).read_text(encoding="utf-8")
    taken = {i.module for i in imports(path, source) if i.top == "reports"}
    assert {module for module in taken if not module.startswith("reports.data.schema")} <= {"reports", "reports.data"}
    assert loaded("reports.data.schema", modules()) <= {"reports", "pyarrow"}


@pytest.mark.parametrize("package", ROOMS)
def test_the_rooms_are_those_of_the_table(package: str) -> None:
    assert arrows(package) == {room: set(above) for room, above in ROOMS[package].items()}


@pytest.mark.parametrize("package", ROOMS)
def test_a_room_imports_only_rooms_above_it(package: str) -> None:
    order = list(ROOMS[package])
    assert [(room, up) for room in order for up in ROOMS[package][room] if order.index(up) >= order.index(room)] == []
    assert cycle(arrows(package)) == []


def test_a_cycle_is_found() -> None:
    assert cycle({"a": {"b"}, "b": {"c"}, "c": set()}) == []
    assert set(cycle({"a": {"b"}, "b": {"c"}, "c": {"a"}})) == {"a", "b", "c"}


HOUSE = sorted(
    (ROOT / package / room) for package in ROOMS for room in ROOMS[package] if (ROOT / package / room).is_dir()
)


@pytest.mark.parametrize("room", HOUSE, ids=lambda room: room.relative_to(ROOT).as_posix())
def test_a_room_says_what_lives_there_and_what_does_not(room: Path) -> None:
    source = (room / "__init__.py").read_text(encoding="utf-8")
    assert not unsaid(ast.get_docstring(ast.parse(source)) or "")
    assert len(list(room.glob("*.py"))) - 1 <= FULL


def test_a_room_that_does_not_is_found() -> None:
    assert not unsaid("Files and locks; nothing about runs.")
    assert all(map(unsaid, ["", "Files and locks.", "Files; locks.", "Files; no runs. And more.", "Files. No runs."]))


def drawn(package: str) -> list[str]:
    """The rooms of a package as a part of a Mermaid graph; an arrow that follows from others is left out."""
    table = ROOMS[package]
    lines = [f"  subgraph {package}", *(f"    {package}_{room}[{room}]" for room in table)]
    for room, above in table.items():
        through = {further for near in above for further in reached(table, near)}
        lines += [f"    {package}_{room} --> {package}_{up}" for up in above if up not in through]
    return [*lines, "  end"]


def reached(table: Mapping[str, Iterable[str]], room: str) -> set[str]:
    """The rooms that a room imports, directly or not."""
    return {far for near in table[room] for far in (near, *reached(table, near))}


def house() -> str:
    """The text of `docs/architecture.md` on the rooms: the drawing, and a sentence for each."""
    lines = ["```mermaid", "graph BT", *(line for package in ROOMS for line in drawn(package))]
    lines += ["  pipelines --> rhmc", "  pipelines --> reports", "```", ""]
    for package, table in ROOMS.items():
        lines += ["", f"| `{package}/` | |", "|---|---|", *(f"| `{room}` | {said(package, room)} |" for room in table)]
    return "\n".join(lines)


def said(package: str, room: str) -> str:
    """The sentence that a room opens with."""
    text = ast.get_docstring(ast.parse(modules()[f"{package}.{room}"])) or ""
    return " ".join(text.split()).partition(". ")[0].rstrip(".") + "."


PAGE_OF_THE_HOUSE = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")


def test_the_page_draws_the_house_as_it_is() -> None:
    """`python -m tests.test_architecture` prints what the page has to hold."""
    assert house() in PAGE_OF_THE_HOUSE


def test_an_arrow_that_follows_from_others_is_not_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ROOMS, "x", {"a": (), "b": ("a",), "c": ("b",), "d": ("a", "c")})
    assert [line.strip() for line in drawn("x") if "-->" in line] == ["x_b --> x_a", "x_c --> x_b", "x_d --> x_c"]


def missing(stop: str) -> bool:
    """True if no `module:name` is there."""
    module, _, name = stop.partition(":")
    try:
        attrgetter(name)(import_module(module))
    except (ImportError, AttributeError):
        return True
    return False


JOURNEYS = re.findall(r"^## .*?, (\d+) stops$(.*?)(?=^## |\Z)", PAGE_OF_THE_HOUSE, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize(("count", "text"), JOURNEYS)
def test_a_journey_goes_by_what_is_there(count: str, text: str) -> None:
    stops = re.findall(r"^\d+\. `([\w.]+:[\w.]+)`", text, re.MULTILINE)
    assert len(stops) == len(re.findall(r"^\d+\. ", text, re.MULTILINE)) == int(count)
    assert [stop for stop in stops if missing(stop)] == []


def test_there_are_two_journeys_and_a_stop_that_is_gone_is_found() -> None:
    assert len(JOURNEYS) == 2
    assert not missing("rhmc.training.trainer:Trainer.state_dict")
    assert all(map(missing, ["rhmc.trainer:Trainer", "rhmc.training.trainer:Trainer.gone", "rhmc.training.trainer:x"]))


def test_the_tests_stand_in_the_rooms_that_they_test() -> None:
    found = {path.parent for package in ROOMS for path in (ROOT / "tests" / package).glob("*/test_*.py")}
    assert sorted(ROOT / folder.relative_to(ROOT / "tests") for folder in found) == HOUSE


def test_the_longest_files_of_tests_are_there() -> None:
    there = {f"{path.parent.name}/{path.stem}" for path in (ROOT / "tests").rglob("test_*.py")}
    assert sorted({*LONGEST} - there) == []


@pytest.mark.parametrize("path", files())
def test_imports_follow_the_arrows(path: str) -> None:
    assert faults(path, (ROOT / path).read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("path", "source", "named"),
    [
        ("rhmc/networks/nets.py", "import numpy", "numpy"),
        ("rhmc/networks/nets.py", "import torch, pandas as pd", "pandas"),
        ("rhmc/training/trainer.py", "def f():\n    from pipelines.specs import study", "pipelines"),
        ("rhmc/training/trainer.py", "from importlib import import_module\nimport_module('mlflow')", "mlflow"),
        ("rhmc/envs/coverage.py", "from rhmc.algorithms import ALGORITHMS", "rhmc.algorithms"),
        ("rhmc/envs/coverage.py", "from rhmc.training import trainer", "rhmc.training"),
        ("rhmc/envs/coverage.py", "from rhmc import training", "rhmc.training"),
        ("rhmc/envs/coverage.py", "from ..networks import nets", "rhmc.networks"),
        ("rhmc/hierarchy/regulation.py", "import rhmc.envs.coverage", "rhmc.envs"),
        ("rhmc/hierarchy/regulation.py", "from rhmc.networks import nets", "rhmc.networks"),
        ("rhmc/learning/learner.py", "def f():\n    from rhmc.hierarchy import executor", "rhmc.hierarchy"),
        ("pipelines/specs/study.py", "from pipelines.tracking.plan import commit", "pipelines.tracking"),
        ("pipelines/workspace/errors.py", "import pipelines.cli.main", "pipelines.cli"),
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
        ("pipelines/bundles/bundle.py", "import reports.pages.build", "reports"),
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
    assert faults("pipelines/cli/science.py", "def report():\n    from reports.pages import build") == []


@pytest.mark.parametrize("module", LIGHT)
def test_light_modules_load_nothing_heavy(module: str) -> None:
    sources = modules()
    assert module in sources
    assert loaded(module, sources) & LIGHT[module] == set()


def test_a_heavy_import_is_found_at_any_depth() -> None:
    study = "class A:\n    try:\n        from pipelines.execution import run\n    finally:\n        pass"
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


# Docstrings

QUESTIONS = ("What", "Which", "Who", "Whose", "Whether", "How", "Where", "When", "Why")
SAID = sorted(path for name in ("rhmc", "pipelines", "reports") for path in (ROOT / name).rglob("*.py"))


def asking(source: str) -> list[str]:
    """The docstrings that begin with a question word instead of their subject, by their first lines."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    texts = [ast.get_docstring(node) or "" for node in ast.walk(ast.parse(source)) if isinstance(node, kinds)]
    return [text.partition("\n")[0] for text in texts if text.partition(" ")[0] in QUESTIONS]


def test_a_docstring_begins_with_its_subject() -> None:
    found = [f"{path.relative_to(ROOT)}: {line}" for path in SAID for line in asking(path.read_text(encoding="utf-8"))]
    assert not found


def test_a_docstring_that_asks_is_found() -> None:
    assert asking('"""How far it is."""\ndef f():\n    """Whatever."""\n') == ["How far it is."]


# Tables


FAMILIES = {"ppo", "qlearning", "recurrent_ppo", "recurrent_qlearning"}  # what the pages of a family share: no methods
PAGES = sorted(p for p in (ROOT / "rhmc/algorithms").glob("*.py") if p.stem not in {"__init__", "base", *FAMILIES})


def test_every_method_is_in_the_table() -> None:
    pages = {page.stem for page in PAGES}
    listed = {method.config.__module__.rpartition(".")[2] for method in ALGORITHMS.values()}
    assert unmatched("ALGORITHMS", pages, listed) == []


@pytest.mark.parametrize("page", [*PAGES, ROOT / "rhmc/algorithms/base.py"], ids=lambda page: page.stem)
def test_a_method_is_a_page(page: Path) -> None:
    assert len(page.read_text(encoding="utf-8").splitlines()) <= PAGE


def unstated(page: str) -> list[str]:
    """The omissions in the opening of a method's page: where it is from, and where it departs from that."""
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


SETTINGS = "studies/settings"
FOR_COPYING = "template"  # answers no question of the report


def test_every_study_is_in_the_pipeline(stages: dict) -> None:
    """A search is run by hand: what it finds is kept in `studies/best_params`, and a study that includes it is here."""
    studies = {p.stem for p in (ROOT / "studies").glob("*.yaml") if not is_search(p)} - {FOR_COPYING}
    stage, queue = stages["studies"], stages["vars"]["queue"].split()
    check, *commands = stage["cmd"]
    assert check == "rhmc profile"
    assert [command.split()[-3:] for command in commands] == [["${queue}", "--profile", "${profile}"]] * 2
    assert unmatched("dvc.yaml", {f"studies/{name}.yaml" for name in studies}, queue) == []
    tables = {f"results/${{profile}}/runs/{name}{kind}.parquet" for name in studies for kind in ("", ".runs")}
    read = {name for name in studies if Study.load(ROOT / "studies" / f"{name}.yaml").readings}
    tables |= {f"results/${{profile}}/runs/{name}.readings.parquet" for name in read}
    assert unmatched("dvc.yaml", tables, [next(iter(out)) for out in stage["outs"]]) == []


def test_a_stage_that_depends_on_a_study_depends_on_what_it_includes(stages: dict) -> None:
    """And on no other: a file that is laid beside them makes nothing anew."""
    for name, stage in ((name, stage) for name, stage in stages.items() if name != "vars"):
        deps = {dep for dep in stage.get("deps", ()) if dep.startswith("studies")}
        roots = stages["vars"]["queue"].split() if name == "studies" else [dep for dep in deps if dep.count("/") == 1]
        files = {path.relative_to(ROOT).as_posix() for study in roots for path in closure(ROOT / study)}
        if SETTINGS in deps:  # as a whole
            files = {SETTINGS if file.startswith(f"{SETTINGS}/") else file for file in files}
        assert unmatched(f"dvc.yaml, {name}", files, deps) == []


QUICK = 5_200_000  # environment steps: some ten minutes of two processors


def test_the_quick_profile_stays_quick(stages: dict) -> None:
    runs = [run.spec for file in stages["vars"]["queue"].split() for run in Study.load(ROOT / file).runs()]
    steps = {spec.id: spec.trainer.steps for spec in runs}  # what studies share is trained once
    assert sum(steps.values()) <= QUICK
    assert {spec.algo.kind for spec in runs} == set(ALGORITHMS)


def is_search(path: Path) -> bool:
    """True if the file is named as a search; the contents have to agree."""
    document = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    spaces = ["space" in (arm or {}) for arm in document.get("arms", {}).values()]
    assert spaces == [path.stem.startswith("search_")] * len(spaces), path
    return path.stem.startswith("search_")


def test_the_report_depends_on_all_its_modules(stages: dict) -> None:
    assert "reports" in stages["report"]["deps"]


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


def test_the_version_is_one_everywhere() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    cited = YAML(typ="safe", pure=True).load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["version"] == project["version"]
    assert cited["license"] == project["license"]
    assert f"\n## {project['version']} - " in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_commits_are_checked_by_what_make_check_runs() -> None:
    config = YAML(typ="safe", pure=True).load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    entries = [hook["entry"].split() for hook in config["repos"][0]["hooks"]]
    recipe = (ROOT / "Makefile").read_text(encoding="utf-8").partition("\ncheck:")[2].partition("\n\n")[0]
    assert [Path(words[0]).name for words in entries] == re.findall(r"@(ruff|mypy) ", recipe)
    assert all(words[0].startswith(".venv/bin/") for words in entries)


if __name__ == "__main__":
    print(house())
