"""Studies of the package: copied with what they include, and nothing of a person's is written over."""

from pathlib import Path

import pytest

from pipelines.specs.include import SHIPPED, copy, shipped
from pipelines.specs.study import Study
from pipelines.workspace.errors import InputError

ROOT = Path(__file__).parents[3]


def test_the_package_brings_every_study_of_the_repository() -> None:
    assert shipped() == sorted(path.stem for path in (ROOT / "studies").glob("*.yaml"))
    assert SHIPPED.resolve() == ROOT / "studies"


@pytest.mark.parametrize("name", [name for name in shipped() if not name.startswith("search_")])
def test_a_copied_study_is_the_study(name: str, tmp_path: Path) -> None:
    file, *_ = copy(name, tmp_path / "studies")
    assert file == tmp_path / "studies" / f"{name}.yaml"
    runs = [run.spec.id for run in Study.load(file).runs()]
    assert runs == [run.spec.id for run in Study.load(ROOT / "studies" / f"{name}.yaml").runs()]


def test_what_a_study_includes_comes_with_it_and_nothing_else(tmp_path: Path) -> None:
    found = {path.relative_to(tmp_path).as_posix() for path in copy("searched", tmp_path)}
    assert found == {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.yaml")}
    assert {"searched.yaml", "best_params/search_rhmc.rhmc.quick.yaml"} <= found
    other = {path.relative_to(tmp_path / "other").as_posix() for path in copy("steadiness", tmp_path / "other")}
    assert other == {"steadiness.yaml", "settings/coverage.yaml", "settings/coverage/rhmc.yaml"}


def test_a_tuned_study_is_copied_with_the_settings_of_its_methods(tmp_path: Path) -> None:
    found = {path.relative_to(tmp_path).as_posix() for path in copy("template", tmp_path)}
    settings = {f"settings/coverage{end}.yaml" for end in ("", "/rhmc", "/iql", "/values")}
    assert found == {"template.yaml"} | settings


def test_a_copied_study_takes_what_was_copied_with_it(tmp_path: Path) -> None:
    file, *others = copy("navigation", tmp_path / "mine")
    (tuned,) = [path for path in others if path.parts[-2:] == ("coverage", "rhmc.yaml")]
    tuned.write_text(tuned.read_text(encoding="utf-8") + "  share: false\n", encoding="utf-8")
    assert Study.load(file).arms["RHMC"].algo.share is False


def test_a_file_that_is_there_is_left_alone(tmp_path: Path) -> None:
    mine = tmp_path / "best_params" / "search_rhmc.rhmc.quick.yaml"
    mine.parent.mkdir()
    mine.write_text("mine: yes\n")
    with pytest.raises(InputError, match=f"^{mine}: something else is there; move it away, or name another folder"):
        copy("searched", tmp_path)
    assert list(tmp_path.rglob("*.yaml")) == [mine]
    copied = copy("coverage", tmp_path)
    assert copy("coverage", tmp_path) == copied


def test_a_name_that_is_no_study_has_a_suggestion(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'covrage' is no study of this package; .* did you mean 'coverage'"):
        copy("covrage", tmp_path)
