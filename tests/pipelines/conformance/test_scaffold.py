"""A new package runs at once: its study has no fault, its method or task does what every one has to do."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipelines.conformance.methods import check_method
from pipelines.conformance.scaffold import TEMPLATES, create
from pipelines.conformance.tasks import check_task
from pipelines.specs.study import Study
from pipelines.workspace.errors import InputError
from tests.pipelines.own_package import untouched


@pytest.fixture(autouse=True)
def _alone() -> Iterator[None]:
    with untouched():
        yield


@pytest.mark.parametrize("what", ["method", "task"])
def test_a_new_package_conforms(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = create(what, "my_own", tmp_path)  # type: ignore[arg-type]
    assert files[0] == tmp_path / "my_own" / "my_own" / f"{what}.py"
    monkeypatch.chdir(tmp_path / "my_own")
    study = Study.load(Path("studies/my_own.yaml"))
    assert study.remarks == ()
    assert {run.spec.imports for run in study.runs()} <= {(), (f"my_own.{what}",)}
    found = list(check_method("my_own", {}, 12_000) if what == "method" else check_task("my_own", {}))
    assert [one for one in found if one.fault] == []
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["entry-points"][f"rhmc.{what}s"] == {"my_own": f"my_own.{what}"}


def test_nothing_of_a_template_is_left_open(tmp_path: Path) -> None:
    texts = [file.read_text(encoding="utf-8") for what in ("method", "task") for file in _made(what, tmp_path)]
    assert [found for text in texts for found in re.findall(r"\$\w+", text)] == []
    used = {f"{name}.template" for name in ("README.md", "pyproject.toml")}
    used |= {
        f"{stem}.template" for what in ("method", "task") for stem in (f"{what}.py", f"{what}.yaml", f"test_{what}.py")
    }
    assert {file.name for file in TEMPLATES.iterdir()} == used


def _made(what: str, folder: Path) -> list[Path]:
    return create(what, f"own_{what}", folder)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Mine", "'Mine' is not a name for a package"),
        ("1st", "'1st' is not a name for a package"),
        ("class", "'class' is not a name for a package"),
        ("../up", "'../up' is not a name for a package"),
        ("x" * 41, "is not a name for a package"),
        ("iql", "'iql' is a method already"),
        ("json", "'json' is an installed Python package or module already"),
    ],
)
def test_a_name_that_cannot_be_one_is_one_line(name: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        create("method", name, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_written_over(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    with pytest.raises(InputError, match="mine: is there already; nothing is written over"):
        create("task", "mine", tmp_path)
    assert list((tmp_path / "mine").iterdir()) == []
