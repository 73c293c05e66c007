"""`rhmc status`: how far all studies and searches are, in one table."""

from collections import Counter
from pathlib import Path
from typing import Any

import typer

from pipelines.cli.common import (
    Folder,
    Json,
    Profile,
    files_of_kind,
    load_search,
    load_study,
    profile_faults,
    say_json,
    studies_folder,
    table,
)
from pipelines.workspace.errors import InputError
from pipelines.workspace.exit_codes import Exit

COLUMNS = ("planned", "finished", "running", "failed", "stale")


def status(profile: Profile = "quick", folder: Folder = None, as_json: Json = False) -> None:
    """Say how far all studies and searches of a folder are. Exit code 3 if any run or trial is left.

    Variants are not in it: `rhmc study status FILE --variant NAME` has them.
    """
    if faults := profile_faults(profile):
        raise InputError(*faults)
    from pipelines.workspace.work_folder import Home, work_folder

    where, home = studies_folder(folder), Home(work_folder())
    found = [_study(file, profile, home) for file, *_ in files_of_kind(where, "study")]
    found += [_search(file, profile, home) for file, *_ in files_of_kind(where, "search", optional=True)]
    if as_json:
        say_json(found)
    else:
        rows = [[one["file"], one["kind"], one["state"], *(str(one.get(c, "")) for c in COLUMNS)] for one in found]
        table(["file", "kind", "state", *COLUMNS], rows, numbers=COLUMNS)
    raise typer.Exit(Exit.DONE if all(one["state"] == "finished" for one in found) else Exit.UNFINISHED)


def _study(file: Path, profile: str, home: Any) -> dict[str, Any]:
    from pipelines.execution.standing import Options, quickly

    try:
        if quick := quickly(home, Options(str(file), profile, "", ())):
            found = quick[1]
        else:
            from pipelines.execution.run import standing_of

            found = standing_of(load_study(file, profile, None, None), home)
    except InputError as error:
        return {"file": str(file), "kind": "study", "state": f"faulty: {error.args[0]}"}
    counts = sum((Counter(one) for one in found.arms.values()), Counter[str]())
    return _row(file, "study", counts)


def _search(file: Path, profile: str, home: Any) -> dict[str, Any]:
    from pipelines.tuning.search_run import standing_of

    try:
        return _row(file, "search", Counter(standing_of(load_search(file, profile, None), home)))
    except InputError as error:
        return {"file": str(file), "kind": "search", "state": f"faulty: {error.args[0]}"}


def _row(file: Path, kind: str, counts: Counter[str]) -> dict[str, Any]:
    row: dict[str, Any] = {"file": str(file), "kind": kind, "state": "unfinished"}
    row |= {column: counts[column] for column in COLUMNS}
    if counts["finished"] == counts["planned"]:
        row["state"] = "finished"
    elif counts["running"]:
        row["state"] = "running"
    elif counts["missing"] == counts["planned"]:
        row["state"] = "not begun"
    return row
