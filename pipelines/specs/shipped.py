"""The studies that this package brings along: `pipelines/studies` is a link to `studies/`, and a folder in a wheel."""

from pathlib import Path

from pipelines.specs.document import choices
from pipelines.specs.include import SHIPPED, closure
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import whole


def names() -> list[str]:
    """The files that can be copied."""
    return sorted(path.stem for path in SHIPPED.glob("*.yaml"))


def copy(name: str, out: Path) -> list[Path]:
    """Write a study and the files that it includes into a folder, and return where they are.

    Raises:
        InputError: there is no such study, or another file has the place; nothing is written.
        StoreError: the folder cannot be written to.
    """
    if name not in names():
        raise InputError(f"'{name}' is no study of this package; {choices(name, names())}")
    wanted = {out / path.relative_to(SHIPPED): path.read_bytes() for path in closure(SHIPPED / f"{name}.yaml")}
    for path, text in wanted.items():
        if path.exists() and (not path.is_file() or path.read_bytes() != text):
            raise InputError(f"{path}: something else is there; move it away, or name another folder with --out")
    for path, text in wanted.items():
        if not path.exists():
            with whole(path) as part:
                part.write_bytes(text)
    return list(wanted)
