"""`rhmc doctor`: what is wrong with an installation."""

from typing import Annotated

import typer

from pipelines.cli.common import Json, say, say_json
from pipelines.workspace.exit_codes import Exit

MARK = {"ok": "ok   ", "note": "note ", "fault": "FAULT"}


def doctor(
    ray: Annotated[bool, typer.Option(help="Also start Ray, which takes seconds.")] = True,
    as_json: Json = False,
) -> None:
    """Say what is wrong with this installation and its work folder, and what to do. Exit code 4 on a fault."""
    from pipelines.cli.checks import examine
    from pipelines.workspace.work_folder import work_folder

    found = []
    for finding in examine(work_folder(), ray=ray):
        found.append(finding)
        if not as_json:
            say(f"{MARK[finding.level]}  {finding.what}: {finding.text}")
    if as_json:
        say_json([finding._asdict() for finding in found])
    raise typer.Exit(Exit.NO if any(finding.level == "fault" for finding in found) else Exit.DONE)
