"""The file from which a study or a search was launched.

Two files of one stem, `a/one.yaml` and `b/one.yaml`, have one experiment, one lock and one table. That is how a study
goes on that was moved, so a launch does not refuse it: it says so once, and so do `check` and `export`.
"""

import os
from contextlib import suppress
from pathlib import Path

from pipelines.workspace.work_folder import Home


def another(home: Home, name: str, profile: str, file: str) -> str:
    """A remark if the last launch of this name was from another file, which is still there; nothing otherwise."""
    with suppress(OSError):
        before = Path(os.fsdecode(_note(home, name, profile).read_bytes()))
        if file and before.name and before.is_file() and not before.samefile(file):
            return (
                f"{name} ({profile}): launched from {before} before and {file} now; files of one name share their "
                "experiment and their table: rename one, or go on if it is the same study"
            )
    return ""


def remember(home: Home, name: str, profile: str, file: str) -> None:
    """Keep where a launch is from."""
    note = _note(home, name, profile)
    with suppress(OSError):  # no launch fails for it
        note.parent.mkdir(parents=True, exist_ok=True)
        note.write_bytes(os.fsencode(Path(file).resolve()) if file else b"")


def _note(home: Home, name: str, profile: str) -> Path:
    return home.root / "locks" / f"{name}-{profile}.from"
