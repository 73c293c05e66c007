"""Packages of the user's own: who may have them imported, what is said of faulty ones, and which runs they name."""

import json
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

from pipelines.specs import identity, plugins
from pipelines.specs.identity import code_id, modules
from pipelines.specs.search import Search
from pipelines.specs.study import RunSpec, Study, StudyError
from pipelines.workspace.errors import InputError
from pipelines.workspace.process_pool import side_by_side
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS
from tests.pipelines.own_package import STUDY, untouched, write


@pytest.fixture(autouse=True)
def _alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "studies").mkdir()
    with untouched():
        yield
    identity._code.cache_clear()


def load(text: str = STUDY) -> Study:
    Path("studies/x.yaml").write_text(text)
    return Study.load("studies/x.yaml")


def faults(text: str) -> list[str]:
    with pytest.raises(StudyError) as caught:
        load(text)
    return str(caught.value).splitlines()


def record(**changed: Any) -> dict[str, Any]:
    """What a run of the package writes down of itself."""
    parts = {"env": {"kind": "ring"}, "algo": {"kind": "bandits"}, "trainer": {}, "seed": 0}
    return parts | {"imports": ["bandits.methods", "bandits.tasks"]} | changed


# Who names a package


@pytest.mark.parametrize("folder", ["studies", "."])
def test_a_package_beside_the_study_or_in_the_current_directory_is_found(folder: str) -> None:
    write(Path(folder))
    paths = list(sys.path)
    study = load()
    assert sys.path == paths
    assert [setting.algo.kind for setting in study.arms.values()] == ["bandits", "mappo"]
    assert {"bandits"} <= set(ALGORITHMS)
    assert {"ring"} <= set(ENVS)


def test_beside_the_study_goes_before_the_current_directory_and_installed_before_both() -> None:
    write(Path("studies"))
    (Path("bandits")).mkdir()
    Path("bandits/__init__.py").write_text("raise ValueError('the other one')\n")
    Path("studies/json").mkdir()
    Path("studies/json/__init__.py").write_text("raise ValueError('not the one of Python')\n")
    load()
    assert faults(STUDY.replace("[bandits]", "[json]")) == [
        "studies/x.yaml:2:11: imports.0: 'json': registers no method, no task and no coordinator"
    ]


def test_a_grid_and_an_override_know_the_fields_of_a_package() -> None:
    write(Path("studies"))
    study = load(STUDY.replace("seeds: 1", "grid: {algo.rate: [0.1, 0.5]}\nseeds: 1").replace(MAPPO, ""))
    assert [setting.algo.rate for setting in study.arms.values()] == [0.1, 0.5]
    assert faults(STUDY.replace("{kind: bandits}", "{kind: bandits, rat: 1}"))[0].startswith(
        "studies/x.yaml:5:25: base.algo.rat: unknown key 'rat'; allowed: kind, rate, epsilon; did you mean 'rate'?"
    )


MAPPO = "  MAPPO: {algo: {kind: mappo, hidden_dim: 8, n_steps: 8, minibatches: 1}}\n"
SEARCH = (
    STUDY.replace(MAPPO, "").replace("bandits: {}", "bandits: {space: {rate: {low: 0.1, high: 0.9}}}") + "trials: 2\n"
)


def test_a_search_imports_too() -> None:
    write(Path("studies"))
    Path("studies/s.yaml").write_text(SEARCH)
    search = Search.load("studies/s.yaml")
    assert search.arms["bandits"].at({"rate": 0.5}).imports == ("bandits.methods", "bandits.tasks")
    assert search.code("bandits") == code_id("bandits", "ring")


def test_an_entry_point_does_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    write(Path("installed"))
    Path("installed/broken.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(Path("installed").resolve())
    points = [EntryPoint("mine", "bandits", "rhmc.methods"), EntryPoint("other", "broken", "rhmc.tasks")]
    monkeypatch.setattr(plugins, "entry_points", lambda group: [one for one in points if one.group == group])
    plugins._of_entry_points.cache_clear()
    try:
        assert load(STUDY.replace("imports: [bandits]\n", "")).arms["bandits"].algo.kind == "bandits"
        (said,) = faults(STUDY.replace("imports: [bandits]\n", "").replace("{kind: ring", "{kind: rin"))
        broken = Path("installed/broken.py").resolve()
        assert said.startswith("studies/x.yaml:3:15: base.env.kind: 'rin' is not allowed; allowed: coverage, nav")
        assert said.endswith(
            "ring; did you mean 'ring'?; not imported: entry point 'other' (broken): cannot be imported: "
            f"ZeroDivisionError: division by zero ({broken}:1)"
        )
    finally:
        plugins._of_entry_points.cache_clear()


# Faults


@pytest.mark.parametrize(
    ("named", "said"),
    [
        ("[bandit]", "2:11: imports.0: 'bandit': no such module; neither installed nor in {here}/studies or {here}; "
                     "did you mean 'bandits'?"),
        ("[bandits.methds]", "2:11: imports.0: 'bandits.methds': no module bandits.methds; did you mean "
                             "'bandits.methods'?"),
        ("[bandits, raising]", "2:20: imports.1: 'raising': cannot be imported: KeyError: 'x' "
                               "({here}/studies/raising.py:2)"),
        ("[lacking]", "2:11: imports.0: 'lacking': cannot be imported: ModuleNotFoundError: No module named "
                      "'no_such_library' ({here}/studies/lacking.py:1)"),
        ("[ending]", "2:11: imports.0: 'ending': cannot be imported: SystemExit: 3 ({here}/studies/ending.py:2)"),
        ("[clashing]", "2:11: imports.0: 'clashing': cannot be imported: ValueError: 'iql' is registered already; "
                       "choose another kind ({here}/studies/clashing.py:4)"),
        ("[idle]", "2:11: imports.0: 'idle': registers no method, no task and no coordinator"),
        ("[misfit]", "2:11: imports.0: 'misfit': registers the task 'misfit', whose configuration is no "
                     "rhmc.envs.EnvConfig"),
        ("[rhmc.algorithms]", "2:11: imports.0: 'rhmc.algorithms': is of this project, whose methods and tasks are "
                              "always there"),
        ("[my-pkg]", "2:11: imports.0: 'my-pkg': not the name of a module, such as my_package or my_package.methods"),
        ("[]", "2:10: imports: names no module; name one, or leave the key out"),
        ("bandits", "2:10: imports: 'bandits' is not allowed; must be a valid list"),
        ("[3]", "2:11: imports.0: 3 is not allowed; must be a valid string"),
    ],
)  # fmt: skip
def test_each_fault_is_one_line_with_its_place(named: str, said: str) -> None:
    folder = Path("studies")
    write(folder)
    (folder / "raising.py").write_text("import rhmc.algorithms\n{}['x']\n")
    (folder / "lacking.py").write_text("import no_such_library\n")
    (folder / "ending.py").write_text("import sys\nsys.exit(3)\n")
    (folder / "clashing.py").write_text(
        "from rhmc.algorithms import ALGORITHMS, register_method\n\nregister_method('mine', ALGORITHMS['iql'])\n"
        "register_method('iql', ALGORITHMS['vdn'])\n"
    )
    (folder / "idle.py").write_text("X = 1\n")
    (folder / "misfit.py").write_text(
        "from rhmc.envs import Task, register_task\nfrom rhmc.types import Frozen\n\n\nclass Config(Frozen):\n"
        "    kind: str = 'misfit'\n\n\nregister_task('misfit', Task(Config, None))\n"
    )
    kinds = list(ALGORITHMS), list(ENVS)
    found = faults(STUDY.replace("[bandits]", named))
    assert found[0] == f"studies/x.yaml:{said.format(here=Path().resolve())}"
    assert len(found) == 1 or named in ("bandits", "[3]")  # then also that its kinds are not there
    if named != "[bandits, raising]":
        assert (list(ALGORITHMS), list(ENVS)) == kinds


# What a run remembers


def test_a_run_remembers_the_pages_that_are_not_the_projects_and_its_name_does_not() -> None:
    write(Path("studies"))
    own, mappo = (run.spec for run in load().runs())
    assert own.imports == ("bandits.methods", "bandits.tasks")
    assert mappo.imports == ("bandits.tasks",)
    assert json.loads(own.canonical())["imports"] == ["bandits.methods", "bandits.tasks"]
    assert "imports" not in own.stated()
    assert RunSpec.model_validate_json(own.canonical()) == own
    plain = RunSpec.model_validate({"env": {"kind": "coverage"}, "algo": {"kind": "mappo"}, "trainer": {}, "seed": 0})
    assert plain.imports == ()
    assert "imports" not in json.loads(plain.canonical())


def test_the_code_of_a_run_has_the_whole_package_in_it_and_that_of_others_none() -> None:
    package = write(Path("studies"))
    load()
    everything = {"bandits", "bandits.methods", "bandits.tasks", "bandits.beside"}
    for place in (("bandits", "ring"), ("bandits", "navigation"), ("mappo", "ring")):
        found = {name for name in modules(*place) if name.startswith("bandits")}
        assert found == everything - {"bandits"}  # whose page is nothing but imports
    assert not [name for name in modules("mappo", "navigation") if name.startswith("bandits")]
    before = {place: code_id(*place) for place in (("bandits", "ring"), ("mappo", "ring"), ("mappo", "coverage"))}
    (package / "beside.py").write_text("SPARE = 2\n")  # not imported by anything
    identity._code.cache_clear()
    assert [code_id(*place) != before[place] for place in before] == [True, True, False]


# Who reads a record


def test_a_record_of_a_stranger_imports_nothing() -> None:
    Path("evil.py").write_text("from pathlib import Path\n\nPath('harm').touch()\n")
    strangers = [
        record(imports=["evil"]),
        record(imports=["os", "evil"]),
        record(env={"kind": "coverage"}, imports=["evil"]),
    ]
    for one in strangers:
        with pytest.raises(InputError, match="which nobody has named here: if you trust its code, put its package '"):
            RunSpec.model_validate(one)
    known = record(env={"kind": "coverage"}, algo={"kind": "iql"}, imports=["evil"])
    with pytest.raises(InputError, match="made with 'evil', and its method and task are here of rhmc"):
        RunSpec.model_validate(known)
    with pytest.raises(ValueError, match="'ring' is not allowed"):
        RunSpec.model_validate(record(imports=[]))
    assert not Path("harm").exists()
    assert "evil" not in sys.modules


def test_the_variable_names_a_package_for_every_record(monkeypatch: pytest.MonkeyPatch) -> None:
    write(Path())
    Path("bandits/__init__.py").write_text("")  # the record's modules register
    monkeypatch.setenv("RHMC_IMPORTS", "bandits")
    with pytest.raises(InputError, match=r"RHMC_IMPORTS: 'bandits': registers no method, no task and no coordinator"):
        RunSpec.model_validate(record())
    monkeypatch.setenv("RHMC_IMPORTS", "bandits.methods, bandits.tasks")
    assert RunSpec.model_validate(record()).imports == ("bandits.methods", "bandits.tasks")
    assert RunSpec.model_validate(record(imports=["bandits.moved_since"])).algo.kind == "bandits"
    monkeypatch.setenv("RHMC_IMPORTS", "bandits.nothing")
    with pytest.raises(InputError, match=r"RHMC_IMPORTS: 'bandits.nothing': no module bandits.nothing"):
        plugins.discover()


def kind_of(spec: RunSpec) -> str:
    return f"{spec.algo.kind} {sorted(ALGORITHMS)[0]}"


def test_a_process_beside_this_one_knows_what_this_one_was_told() -> None:
    """It is given settings whose class it has to import, by a finder that a fresh process does not have."""
    write(Path("studies"))
    specs = [run.spec for run in load().runs()]
    assert list(side_by_side(kind_of, specs, 2)) == ["bandits bandits", "mappo bandits"]


def test_a_kind_of_another_package_is_not_taken_for_it() -> None:
    write(Path("studies"))
    load()
    with pytest.raises(
        InputError, match=r"made with 'elsewhere\.methods', and its method and task are here of bandits"
    ):
        RunSpec.model_validate(record(imports=["elsewhere.methods"]))
