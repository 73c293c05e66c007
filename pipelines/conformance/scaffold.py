"""A package to begin with: a method or a task that runs at once, its study, its test."""

import importlib.util
import keyword
import re
from pathlib import Path
from string import Template
from typing import Literal

from pipelines.specs.document import show
from pipelines.specs.plugins import configs, discover
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import whole

What = Literal["method", "task"]
TEMPLATES = Path(__file__).parent / "templates"
SECTION: dict[What, str] = {"method": "algo", "task": "env"}


def create(what: What, name: str, folder: Path) -> list[Path]:
    """Write the package `name` in a new folder of that name.

    Args:
        what: what it brings.
        name: of the folder, the package and the kind.
        folder: where the new folder is made.

    Returns:
        The files, the page first.

    Raises:
        InputError: the name cannot be one, is taken, or something lies there already.
        StoreError: the folder cannot be written to.
    """
    if fault := _fault(what, name):
        raise InputError(fault)
    root = folder / name
    if root.exists():
        raise InputError(f"{root}: is there already; nothing is written over")
    words = {"name": name, "what": what, "Title": name.replace("_", " ").capitalize()}
    places = {
        f"{name}/{what}.py": f"{what}.py",
        f"studies/{name}.yaml": f"{what}.yaml",
        f"tests/test_{name}.py": f"test_{what}.py",
        "pyproject.toml": "pyproject.toml",
        "README.md": "README.md",
    }
    files = {place: _filled(template, words) for place, template in places.items()}
    files[f"{name}/__init__.py"] = f'"""{words["Title"]}: a {what} for rhmc."""\n'
    for place, text in files.items():
        with whole(root / place) as part:
            part.write_text(text, encoding="utf-8")
    return [root / place for place in files]


def _filled(template: str, words: dict[str, str]) -> str:
    return Template((TEMPLATES / f"{template}.template").read_text(encoding="utf-8")).substitute(words)


def _fault(what: What, name: str) -> str:
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,39}", name) or keyword.iskeyword(name):
        return f"{show(name)} is not a name for a package; use up to 40 small letters, digits and '_', a letter first"
    discover()
    if name in configs(SECTION[what]):
        return f"{show(name)} is a {what} already; choose another name"
    if importlib.util.find_spec(name):
        return f"{show(name)} is an installed Python package or module already; choose another name"
    return ""
