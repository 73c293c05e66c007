"""A run's name: another one exactly where its settings or the code that decides it may be other."""

import json
import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any, get_args, get_origin

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic.fields import FieldInfo

from pipelines.conformance.blocks import nested
from pipelines.specs import identity
from pipelines.specs.document import settings as of_config
from pipelines.specs.identity import TRAINER, code_id, combined, fingerprint, folder_of, modules
from pipelines.specs.plugins import configs
from pipelines.specs.study import RunSpec
from pipelines.specs.syntax import Code
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS
from rhmc.hierarchy.coordinator import COORDINATORS
from rhmc.training.trainer import Config as TrainerConfig
from tests.depth import DEEP

ROOT = Path(__file__).parents[3]
PLACES = [(method, task) for method in ALGORITHMS for task in ENVS]
SHAPES = '''"""About the module."""

import math  # for the root

SIDE = 3
"""About the constant."""


def area(x: float) -> float:
    """About the function."""
    return math.sqrt(x) * SIDE
'''


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    """A package: `use` takes `area` from `shapes` through `inner`."""
    folder = tmp_path / "toy"
    (folder / "inner").mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    (folder / "inner" / "__init__.py").write_text('"""Offers."""\n\nfrom toy.inner.shapes import area\n')
    (folder / "inner" / "shapes.py").write_text(SHAPES)
    (folder / "other.py").write_text(SHAPES.replace("3", "4"))
    (folder / "use.py").write_text("from toy.inner import area\n\nprint(area(2.0))\n")
    return folder


def digests(folder: Path, *roots: str) -> dict[str, str]:
    return Code({"toy": folder}).closure(roots or ["toy.use"])


def name(folder: Path, *roots: str) -> str:
    return combined(digests(folder, *roots).values())


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


# What counts in a module


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("  # for the root", ""),
        ('    """About the function."""\n', ""),
        ("About the function.", "Something\n\n    else."),
        ('"""About the module."""', ""),
        ("About the constant.", "More about the constant."),
        ("SIDE = 3", "SIDE = (\n    3\n)"),
        ("\n\n\ndef", "\n\ndef"),
        ("import math", "import os\nimport math"),
        ("import math", "import math\n\n__all__ = ['area']\n"),
        (
            "import math",
            "import math\nfrom typing import TYPE_CHECKING\n\nif TYPE_CHECKING:\n    from toy import other\n",
        ),
    ],
)
def test_words_layout_and_unused_imports_do_not_count(toy: Path, old: str, new: str) -> None:
    before = name(toy)
    edit(toy / "inner" / "shapes.py", old, new)
    assert name(toy) == before


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("SIDE = 3", "SIDE = 4"),
        ("* SIDE", "+ SIDE"),
        ("x: float", "y: float"),
        ("math.sqrt(x)", '"x"'),
        ("3", "3.0"),
        ("3", "True"),
        ("3", '"3"'),
        ("3", 'b"3"'),
        ("return", "yield"),
        ("def area", "async def area"),
        ("import math", "import cmath as math"),
        ("import math", "from toy import other as math"),
    ],
)
def test_behaviour_counts(toy: Path, old: str, new: str) -> None:
    before = name(toy)
    edit(toy / "inner" / "shapes.py", old, new)
    assert name(toy) != before


def test_the_last_digit_of_a_number_counts(toy: Path) -> None:
    edit(toy / "inner" / "shapes.py", "SIDE = 3", "SIDE = 0.1")
    before = name(toy)
    edit(toy / "inner" / "shapes.py", "SIDE = 0.1", "SIDE = 0.10000000000000002")
    assert name(toy) != before


def test_files_and_folders_may_move(toy: Path, tmp_path: Path) -> None:
    before = name(toy)
    (toy / "deep").mkdir()
    (toy / "deep" / "__init__.py").write_text('"""A room."""\n')
    (toy / "inner" / "shapes.py").rename(toy / "deep" / "forms.py")
    edit(toy / "inner" / "__init__.py", "toy.inner.shapes", "toy.deep.forms")
    assert name(toy) == before
    edit(toy / "use.py", "from toy.inner import area", "from toy.deep.forms import area")
    assert name(toy) == before
    shutil.move(toy, tmp_path / "elsewhere")
    assert name(tmp_path / "elsewhere") == before


def test_what_an_imported_name_stands_for_counts(toy: Path) -> None:
    """The two closures hold the same modules, and the two modules differ in their import lines alone."""
    lines = ["from toy.inner.shapes import area", "from toy.other import area as more", "print(area, more)"]
    (toy / "use.py").write_text("\n".join(lines))
    before = digests(toy)
    lines[:2] = ["from toy.other import area", "from toy.inner.shapes import area as more"]
    (toy / "use.py").write_text("\n".join(lines))
    assert digests(toy).keys() == before.keys()
    assert digests(toy) != before


def test_what_a_package_runs_when_it_is_imported_counts(toy: Path) -> None:
    before = name(toy)
    edit(toy / "inner" / "__init__.py", "import area\n", "import area\n\nTABLE = {'area': area}\n")
    assert name(toy) != before


def test_a_page_that_only_an_init_imports_is_nobody_elses_business(toy: Path) -> None:
    before = name(toy)
    (toy / "page.py").write_text("KIND = 'page'\n")
    edit(toy / "inner" / "__init__.py", "import area", "import area\nfrom toy import page")
    assert name(toy) == before
    assert "toy.page" in digests(toy, "toy.use", "toy.page")


def test_relative_and_starred_imports_are_followed(toy: Path) -> None:
    edit(toy / "use.py", "from toy.inner import area", "from .inner.shapes import *")
    assert {"toy.inner.shapes", "toy.use"} == set(digests(toy))
    edit(toy / "use.py", "from .inner.shapes import *", "import toy.other\nfrom .inner import area")
    edit(toy / "use.py", "print(", "print(toy.other.SIDE, ")
    assert {"toy.inner.shapes", "toy.other", "toy.use"} == set(digests(toy))


def test_a_name_that_stands_in_a_quoted_annotation_alone_is_followed(toy: Path) -> None:
    """pydantic reads annotations when a class is made."""
    (toy / "use.py").write_text("from toy.other import area\n\n\ndef f(x: 'area') -> None: ...\n")
    assert "toy.other" in digests(toy)


def test_an_import_inside_a_function_is_followed(toy: Path) -> None:
    edit(toy / "use.py", "from toy.inner import area\n", "def f():\n    from toy.other import area\n    return area\n")
    assert "toy.other" in digests(toy)


def test_a_module_that_does_not_parse_is_an_error(toy: Path) -> None:
    (toy / "other.py").write_text("def\n")
    with pytest.raises(SyntaxError):
        digests(toy)


def other_pythons() -> list[str]:
    """One of each other version that works here."""
    found = [str(one) for one in Path(os.environ.get("PYENV_ROOT", "/nowhere")).glob("versions/3.1[123].*/bin/python")]
    found += [f"python3.{minor}" for minor in (11, 12, 13)]
    ask, works = "import sys; print(sys.version_info[:2])", {f"{sys.version_info[:2]}": sys.executable}
    for one in filter(shutil.which, found):
        said = subprocess.run([one, "-c", ask], capture_output=True, text=True, check=False)
        if said.returncode == 0:
            works.setdefault(said.stdout.strip(), one)
    return list(works.values())[1:]


def test_every_python_names_the_code_alike() -> None:
    """All that is installed with the project, and in `make deep` its tests; only versions that are here can say."""
    packages = ("rhmc", "pipelines", "reports", *(("tests",) if DEEP else ()))
    code = Code({name: ROOT / name for name in packages})
    here = {name: code.digest(name) for name in code.sources}
    assert len(here) > 100
    program = (
        "import json, sys, pathlib; sys.path.insert(0, 'pipelines/specs'); import syntax\n"
        f"code = syntax.Code({{name: pathlib.Path(name) for name in {packages}}})\n"
        "print(json.dumps({name: code.digest(name) for name in code.sources}))"
    )
    for python in other_pythons():
        assert json.loads(subprocess.check_output([python, "-c", program], cwd=ROOT, text=True)) == here, python


# The code of a run


def test_the_code_of_a_run_is_its_method_its_task_and_the_trainer() -> None:
    found = modules("qmix", "coverage")
    assert {TRAINER, "rhmc.algorithms.qmix", "rhmc.algorithms.qlearning", "rhmc.envs.coverage", "rhmc.portable"} <= set(
        found
    )
    others = {f"rhmc.algorithms.{kind}" for kind in ALGORITHMS if kind != "qmix"}
    assert not {
        *others,
        "rhmc.envs.navigation",
        "rhmc.algorithms.ppo",
        "rhmc.hierarchy.executor",
        "rhmc.yardsticks.scores",
    } & set(found)
    assert len({code_id(*place) for place in PLACES}) == len(PLACES)


def copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The science in a folder where it can be edited, and names are given by it."""
    folder = tmp_path / "rhmc"
    shutil.copytree(ROOT / "rhmc", folder, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(identity, "folder_of", lambda package: folder)
    return folder


def names(monkeypatch: pytest.MonkeyPatch) -> dict[tuple[str, str], str]:
    """The code of every method in every task, read anew."""
    identity._code.cache_clear()
    return {place: code_id(*place) for place in PLACES}


@cache
def unedited() -> dict[tuple[str, str], str]:
    """The same where nothing is edited, read once: it is the same in every copy. Not to be changed."""
    identity._code.cache_clear()
    return {place: code_id(*place) for place in PLACES}


@pytest.fixture(autouse=True)
def _read_anew() -> Any:
    yield
    identity._code.cache_clear()


EDITS = {
    "one method": ("algorithms/coma.py", "register_method(", "EXTRA = 1\nregister_method(", {"coma"}, set(ENVS)),
    "a field of a method's settings": (
        "algorithms/qmix.py",
        '    kind: Literal["qmix"] = "qmix"\n',
        '    kind: Literal["qmix"] = "qmix"\n    extra: int = 0\n',
        {"qmix"},
        set(ENVS),
    ),
    "what two methods share": (
        "algorithms/ppo.py",
        "import torch\n",
        "import torch\n\nEXTRA = 1\n",
        {"mappo", "ippo"},
        set(ENVS),
    ),
    "what four methods share": (
        "learning/returns.py",
        "import torch\n",
        "import torch\n\nEXTRA = 1\n",
        {"mappo", "ippo", "hitmac", "coma"},
        set(ENVS),
    ),
    "a task": ("envs/navigation.py", "DT = 0.1", "DT = 0.2", set(ALGORITHMS), {"navigation"}),
    "a field of the trainer's settings": (
        "training/trainer.py",
        "    threads: int = ",
        "    extra: int = 0\n    threads: int = ",
        set(ALGORITHMS),
        set(ENVS),
    ),
    "arithmetic": ("portable.py", '"MKL_CBWR": "COMPATIBLE"', '"MKL_CBWR": "AVX2"', set(ALGORITHMS), set(ENVS)),
    "an init that fills a table": (
        "algorithms/__init__.py",
        "# isort: off\n",
        'TABLE = {"x": 1}\n# isort: off\n',
        set(ALGORITHMS),
        set(ENVS),
    ),
    "a comment": ("algorithms/coma.py", "register_method(", "# why\nregister_method(", set(), set()),
    "a yardstick": ("yardsticks/coverage.py", "import math\n", "import math\n\nEXTRA = 1\n", set(), set()),
}


@pytest.mark.parametrize("edited", EDITS)
def test_an_edit_ages_the_runs_that_it_concerns_and_no_others(
    edited: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, old, new, methods, tasks = EDITS[edited]
    folder = copied(tmp_path, monkeypatch)
    before = unedited()
    edit(folder / file, old, new)
    after = names(monkeypatch)
    assert {p for p in PLACES if before[p] != after[p]} == {p for p in PLACES if p[0] in methods and p[1] in tasks}


def test_a_new_method_ages_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = copied(tmp_path, monkeypatch)
    before = unedited()
    shutil.copy(folder / "algorithms" / "iql.py", folder / "algorithms" / "mine.py")
    edit(folder / "algorithms" / "mine.py", 'register_method("iql"', 'register_method("mine"')
    edit(folder / "algorithms" / "__init__.py", "ippo, hitmac", "ippo, hitmac, mine")
    assert names(monkeypatch) == before


def test_a_module_in_another_folder_ages_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = copied(tmp_path, monkeypatch)
    before = unedited()
    (folder / "deep").mkdir()
    (folder / "deep" / "__init__.py").write_text('"""A room."""\n')
    (folder / "learning" / "learner.py").rename(folder / "deep" / "learner.py")
    for file in folder.rglob("*.py"):
        file.write_text(file.read_text().replace("from rhmc.learning.learner import", "from rhmc.deep.learner import"))
    assert names(monkeypatch) == before
    assert "rhmc.deep.learner" in modules("qmix", "coverage")


def test_all_of_a_package_outside_the_project_counts_for_its_own_runs(
    toy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = code_id("iql", "coverage")
    real = identity.folder_of
    monkeypatch.setattr(identity, "folder_of", lambda package: toy if package == "toy" else real(package))
    page = type("Config", (), {"__module__": "toy.use"})
    monkeypatch.setitem(ALGORITHMS, "toy", ALGORITHMS["iql"]._replace(config=page))
    with_toy = code_id("toy", "coverage")
    edit(toy / "other.py", "SIDE = 4", "SIDE = 5")  # not imported by anything
    identity._code.cache_clear()
    assert len({before, with_toy, code_id("toy", "coverage")}) == 3
    assert code_id("iql", "coverage") == before


def test_the_library_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    before, whole = code_id("iql", "coverage"), fingerprint()
    monkeypatch.setattr(identity, "version", lambda name: "2.13.1")
    assert (code_id("iql", "coverage") == before, fingerprint() == whole) == (False, False)
    monkeypatch.setattr(identity, "version", lambda name: f"{torch.__version__.partition('+')[0]}+cu130")
    assert code_id("iql", "coverage") == before


def test_it_is_read_where_it_would_be_imported_from() -> None:
    assert folder_of("rhmc") == ROOT / "rhmc"
    with pytest.raises(ModuleNotFoundError, match="no_such"):
        folder_of("no_such")


def test_nothing_imports_by_a_name_that_cannot_be_read() -> None:
    """A closure sees import statements alone."""
    for file in (ROOT / "rhmc").rglob("*.py"):
        assert not {"importlib", "__import__", "exec(", "eval("} & set(file.read_text().replace("(", "( ").split())


# Settings

CONFIGS = [
    *(("env", kind, config) for kind, config in configs("env").items()),
    *(("algo", kind, config) for kind, config in configs("algo").items()),
    ("trainer", "", TrainerConfig),
]
FIELDS = [(section, kind, field) for section, kind, config in CONFIGS for field in of_config(config) if field != "kind"]


def other(field: FieldInfo) -> list[Any]:
    """Values that may be allowed beside the default."""
    kind, default = field.annotation, field.default
    if get_origin(kind) is not None and str in map(type, get_args(kind)):
        return [value for value in get_args(kind) if value != default]
    if isinstance(default, bool):
        return [not default]
    if isinstance(default, int):
        return [default + 1, default + 2]
    if isinstance(default, float):
        return [default / 2, default + 0.25]
    if isinstance(default, str):
        return ["cuda", "another"]
    if any(getattr(one, "pattern", None) for one in field.metadata):
        return ["0" * 16, "f" * 16]  # a digest
    if isinstance(default, tuple):
        return [default[::-1]]
    return [1, 2, 0.5]


def spec(section: str = "trainer", kind: str = "", **changed: Any) -> RunSpec:
    """A run with defaults but for the fields given."""
    parts: dict[str, Any] = {"env": {"kind": "coverage"}, "algo": {"kind": "iql"}, "trainer": {}}
    parts[section] = ({"kind": kind} if kind else {}) | nested(changed)
    return RunSpec.model_validate(parts | {"seed": 0})


BESIDE = {  # what a value needs
    "regulator": {"coordinator.reward": "assigned"},
    "coordinator.reward": {"regulator": "none"},
}


@pytest.mark.parametrize(("section", "kind", "field"), FIELDS)
def test_another_value_of_any_field_is_another_run(
    section: str, kind: str, field: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(COORDINATORS, "another", COORDINATORS["learned"])
    config = next(c for s, k, c in CONFIGS if (s, k) == (section, kind))
    beside = {} if section != "algo" or kind != "rhmc" else BESIDE.get(field, {})
    tried = []
    for value in other(of_config(config)[field]):
        try:
            tried.append(spec(section, kind, **beside, **{field: value}).id)
        except ValueError:
            continue
    assert tried, "no other value is allowed"
    assert spec(section, kind, **beside).id not in tried
    assert len(set(tried)) == len(tried)


def test_a_new_field_with_a_default_changes_no_name() -> None:
    class More(TrainerConfig):
        extra: int = 3

    old = spec()
    new = old.model_copy(update={"trainer": More()})
    assert new.id == old.id
    assert old.model_copy(update={"trainer": More(extra=4)}).id != old.id


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6 - 1), lr=st.floats(1e-6, 1.0))
def test_a_name_survives_json(seed: int, lr: float) -> None:
    one = RunSpec.model_validate(
        {"env": {"kind": "navigation"}, "algo": {"kind": "coma", "lr": lr}, "trainer": {}, "seed": seed}
    )
    assert RunSpec.model_validate_json(one.canonical()).id == one.id


def test_a_default_that_is_written_out_changes_no_name() -> None:
    assert spec("algo", "iql", gamma=0.99).id == spec("algo", "iql").id != spec("algo", "iql", gamma=0.98).id
    assert spec("algo", "iql").id != spec("algo", "vdn").id
