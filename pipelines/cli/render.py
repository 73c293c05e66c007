"""The command `rhmc render`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli.common import Profile, Variant, tell
from pipelines.specs.limits import SEED

if TYPE_CHECKING:
    from pipelines.tracking.policy import Saved

SUFFIX = ".yaml"
WHAT = (
    "A finished run, by its id in MLflow; or policy.pt, a checkpoint, or a folder with one; or a study, of which the "
    "first run that --arm and --seed leave is drawn."
)
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
    profile: Profile = "quick",
    variant: Variant = None,
    arm: Annotated[str | None, typer.Option(help="Arm of the study.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, max=SEED, help="Seed of the run.")] = None,
) -> None:
    """Draw one episode of a trained policy as an animation."""
    from pipelines.policies.render import render as draw
    from pipelines.workspace.errors import InputError
    from pipelines.workspace.work_folder import Home, work_folder

    if out.suffix.lower() != ".gif":
        raise InputError(f"--out: {out} must end in .gif")
    saved = _of_study(Path(what), profile, variant, arm, seed) if what.endswith(SUFFIX) else None
    tell(f"wrote {draw(saved or what, out, Home(work_folder()), episode, beside, frames)}")


def _of_study(file: Path, profile: str, variant: str | None, arm: str | None, seed: int | None) -> "Saved":
    """The policy of a study's first run that the options leave."""
    from pipelines.cli.common import load_study
    from pipelines.policies.evaluation import of_study
    from pipelines.workspace.errors import InputError
    from pipelines.workspace.work_folder import StoreError, work_folder

    study = load_study(file, profile, None, variant)
    try:
        first = next(of_study(study, work_folder(), [arm] if arm else [], [] if seed is None else [seed]))
    except StoreError as error:
        raise InputError(str(error)) from error
    return first.saved
