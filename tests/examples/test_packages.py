"""The examples as packages: what the page says of them, what they take, and that the product does not carry them."""

import ast
import re
import subprocess
import tomllib
from fnmatch import fnmatch
from itertools import product

from tests.examples.conftest import EXAMPLES

EXAMPLE = "."
ROOT = EXAMPLES.parent
TAKEN = {"rhmc", "torch", "pydantic", "numpy", "scipy"}


def test_the_page_has_the_lines_as_they_are_counted() -> None:
    page = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
    found = re.search(r"^\$ (wc -l .*)\n([^`]*)```", page, re.MULTILINE)
    assert found
    counted = subprocess.run(found[1], shell=True, cwd=ROOT, capture_output=True, encoding="utf-8", check=True).stdout
    assert found[2].split() == counted.split()


def test_they_take_what_a_user_has() -> None:
    """The science and what it needs, no part of the platform, and nothing private."""
    for package in ("hungarian", "warehouse"):
        for path in (EXAMPLES / package / package).glob("*.py"):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            named = [one for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for one in node.names]
            tops = {str(node.module).split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
            tops |= {one.name for node in ast.walk(tree) if isinstance(node, ast.Import) for one in node.names}
            assert tops <= {*TAKEN, package, "collections", "sys", "typing"}
            assert not [one.name for one in named if one.name.startswith("_")]


def test_neither_wheel_nor_source_archive_carries_them() -> None:
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    folders = {path.relative_to(ROOT).as_posix().replace("/", ".") for path in EXAMPLES.rglob("*") if path.is_dir()}
    included = product({"examples", "hungarian", "warehouse", *folders}, setuptools["packages"]["find"]["include"])
    assert [name for name, pattern in included if fnmatch(name, pattern)] == []
    assert setuptools["py-modules"] == ["rhmc_command"]
    assert not (ROOT / "MANIFEST.in").exists()
