"""`rhmc evaluate`: trained policies on a bank of episodes."""

from pathlib import Path
from typing import Annotated, Any

import typer

from pipelines.commands.common import File, Json, Profile, Sets, Variant, load_study, say_json, table
from pipelines.errors import InputError

CHECKPOINT = ".pt"


def evaluate(
    file: File,
    profile: Profile = "quick",
    variant: Variant = None,
    arm: Annotated[list[str] | None, typer.Option(help="Only this arm. Can be given several times.")] = None,
    seed: Annotated[list[int] | None, typer.Option(help="Only this seed. Can be given several times.")] = None,
    agents: Annotated[int | None, typer.Option(help="Other than the policy was trained with.")] = None,
    targets: Annotated[int | None, typer.Option(help="Other than the policy was trained with.")] = None,
    episodes: Annotated[int | None, typer.Option(min=2, help="Of the bank; the run's final bank if not given.")] = None,
    bank: Annotated[
        int | None, typer.Option(min=0, help="Seed of the bank; the run's final bank if not given.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="Settings of a .pt file, other than it names itself: a config.yaml.")
    ] = None,
    as_json: Json = False,
    overrides: Sets = None,
) -> None:
    """Play trained policies greedily: the return with its standard error over the episodes, and the task's metrics.

    FILE is a study, whose finished runs (or newest checkpoints) are played, or a policy: a .pt file that a run keeps.
    """
    from pipelines.evaluation import Bank, of_file, of_study, score
    from pipelines.store import StoreError, work_folder

    wanted = Bank(episodes, bank, agents, targets)
    try:
        if file.suffix == CHECKPOINT:
            policies = iter([of_file(file, config)])
        else:
            study = load_study(file, profile, overrides, variant)
            policies = of_study(study, work_folder(), arm or [], seed or [])
        scores = [score(policy, wanted) for policy in policies]
    except StoreError as error:
        raise InputError(str(error)) from error
    if as_json:
        say_json([one._asdict() for one in scores])
        return
    columns = list(dict.fromkeys(name for one in scores for name in one.values if name not in ("return", "return_sem")))
    rows = [
        [one.arm, str(one.seed), one.source, str(one.episodes), _with_error(one.values)]
        + [_number(one.values.get(name)) for name in columns]
        for one in scores
    ]
    numbers = ["seed", "episodes", "return", *columns]
    table(["arm", "seed", "policy", "episodes", "return", *columns], rows, numbers=numbers)


def _with_error(values: dict[str, float]) -> str:
    return f"{values['return']:.2f} ± {values['return_sem']:.2f}"


def _number(value: Any) -> str:
    return "" if value is None else f"{value:.2f}"
