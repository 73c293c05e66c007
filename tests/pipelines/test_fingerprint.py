"""The fingerprint changes with behaviour, and with nothing else."""

import shutil
from pathlib import Path

import pytest

from pipelines import fingerprint as module
from pipelines.fingerprint import fingerprint, package_folder

CODE = '''"""About the module."""

import math  # for the root

SIDE = 3
"""About the constant."""


def area(x: float) -> float:
    """About the function."""
    return math.sqrt(x) * SIDE
'''


@pytest.fixture
def package(tmp_path: Path) -> Path:
    folder = tmp_path / "package"
    (folder / "inner").mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    (folder / "inner" / "shapes.py").write_text(CODE)
    return folder


def edited(package: Path, old: str, new: str) -> str:
    assert old in CODE
    (package / "inner" / "shapes.py").write_text(CODE.replace(old, new))
    return fingerprint(package)


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
    ],
)
def test_words_and_layout_do_not_count(package: Path, old: str, new: str) -> None:
    assert fingerprint(package) == edited(package, old, new)


@pytest.mark.parametrize(
    ("old", "new"),
    [("SIDE = 3", "SIDE = 4"), ("* SIDE", "+ SIDE"), ("x: float", "y: float"), ("math.sqrt(x)", '"x"'), ("3", "3.0")],
)
def test_behaviour_counts(package: Path, old: str, new: str) -> None:
    assert fingerprint(package) != edited(package, old, new)


def test_names_and_number_of_modules_count(package: Path) -> None:
    before = fingerprint(package)
    (package / "inner" / "shapes.py").rename(package / "inner" / "forms.py")
    renamed = fingerprint(package)
    (package / "more.py").write_text("")
    assert len({before, renamed, fingerprint(package)}) == 3


def test_other_files_and_the_place_do_not_count(package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = fingerprint(package)
    (package / "notes.txt").write_text("a note")
    moved = tmp_path / "elsewhere"
    shutil.move(package, moved)
    monkeypatch.chdir(moved)
    assert fingerprint(moved) == fingerprint(Path()) == before


def test_versions_of_libraries_count(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = fingerprint(package)
    assert before != fingerprint(package, libraries=("torch",))
    monkeypatch.setattr(module, "version", lambda name: f"{name} of tomorrow")
    assert fingerprint(package) != before


def test_it_is_taken_of_the_package_that_would_be_imported() -> None:
    assert package_folder() == Path(__file__).parents[2] / "rhmc"
    assert fingerprint() == fingerprint(package_folder())
    assert len(fingerprint()) == 12
    assert set(fingerprint()) <= set("0123456789abcdef")
