"""The command `rhmc render`."""

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.common import Arms, Profile, Sets, Variant, tell
from pipelines.cli.evaluate import Agents, Asked, Config, Seeds, Targets, What, policies

BESIDE = (
    "Also policies without learning in the same episode, with commas between: best_window, planner, nearest, matching, "
    "...; free_heading_bound shows what any headings could see."
)


def render(
    what: What,
    out: Annotated[Path, typer.Option(metavar="FILE.gif", help="The animation to write.")],
    episode: Annotated[int, typer.Option(min=0, max=2**31, help="Names the start and the target motion.")] = 0,
    beside: Annotated[str | None, typer.Option(metavar="POLICY", help=BESIDE)] = None,
    frames: Annotated[int, typer.Option(min=2, max=1000, help="At most so many; the steps between are left out.")] = 40,
    profile: Profile = "quick",
    variant: Variant = None,
    arm: Arms = None,
    seed: Seeds = None,
    agents: Agents = None,
    targets: Targets = None,
    config: Config = None,
    overrides: Sets = None,
) -> None:
    """Draw one episode of a trained policy as an animation.

    Of a study, the first run that the options leave is drawn.
    """
    from pipelines.policies.evaluation import EvaluationEpisodes
    from pipelines.policies.render import render as draw
    from pipelines.workspace.errors import InputError
    from pipelines.workspace.work_folder import Home, work_folder

    if out.suffix.lower() != ".gif":
        raise InputError(f"--out: {out} must end in .gif")
    first = next(policies(what, Asked(profile, variant, arm or [], seed or [], overrides or [], config)))
    wanted = EvaluationEpisodes(agents=agents, targets=targets)
    tell(f"wrote {draw(first.saved, out, Home(work_folder()), episode, beside, frames, wanted)}")
