"""The command `rhmc render`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

WHAT = "A finished run, by its id in MLflow; or policy.pt, a checkpoint, or a folder with one."
BESIDE = (
    "Also policies without learning in the same episode, with commas between: best_window, planner, nearest, matching, "
    "...; free_heading_bound shows what any headings could see."
)


def render(
    what: Annotated[str, typer.Argument(metavar="RUN|FILE", help=WHAT)],
    out: Annotated[Path, typer.Option(metavar="FILE.gif", help="The animation to write.")],
    episode: Annotated[int, typer.Option(min=0, max=2**31, help="Names the start and the target motion.")] = 0,
    beside: Annotated[str | None, typer.Option(metavar="POLICY", help=BESIDE)] = None,
    frames: Annotated[int, typer.Option(min=2, max=1000, help="At most so many; the steps between are left out.")] = 40,
) -> None:
    """Draw one episode of a trained policy as an animation."""
    from pipelines.errors import InputError
    from pipelines.render import render as draw
    from pipelines.store import Home, work_folder

    if out.suffix.lower() != ".gif":
        raise InputError(f"--out: {out} must end in .gif")
    print(f"wrote {draw(what, out, Home(work_folder()), episode, beside, frames)}", file=sys.stderr)
