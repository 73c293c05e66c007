"""The data behind the drawn figures: one file of networks and one of scenes, beside the tables of runs."""

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pipelines.errors import InputError
from pipelines.modules import describe_modules
from pipelines.scenes import describe_scenes
from pipelines.store import StoreError

FILES: Mapping[str, Any] = {"modules.json": describe_modules, "scenes.json": describe_scenes}


def export_drawings(out: Path) -> list[Path]:
    """Write `modules.json` and `scenes.json` in a folder.

    Raises:
        InputError: the folder is a file.
        StoreError: the folder cannot be written to.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"--out: {out} is not a folder")
    return [_write(out / name, describe()) for name, describe in FILES.items()]


def _write(file: Path, content: Any) -> Path:
    part = file.with_suffix(f".{os.getpid()}.part")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(json.dumps(content, ensure_ascii=False) + "\n", encoding="utf-8")
        part.replace(file)
    except OSError as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise StoreError(f"{file}: cannot be written: {error.strerror or error}") from error
    return file
