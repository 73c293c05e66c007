"""The data behind the drawn figures: one file of networks and one of scenes, beside the tables of runs."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipelines.export.network_graph import describe_modules
from pipelines.export.scenes import describe_scenes
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import whole

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
    with whole(file) as part:
        part.write_text(json.dumps(content, ensure_ascii=False) + "\n", encoding="utf-8")
    return file
