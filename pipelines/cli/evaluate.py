"""Trained policies looked at again: in evaluation episodes, with other numbers of agents, and what they assign."""

from pathlib import Path
from typing import Annotated, Any

import typer

from pipelines.cli.common import (
    Arms,
    File,
    Json,
    Profile,
    Sets,
    Variant,
    folder_option,
    load_study,
    say_json,
    table,
    tell,
)
from pipelines.specs.limits import BOUNDS, EPISODES, JOBS, SEED
from pipelines.workspace.errors import InputError

CHECKPOINT = ".pt"
Seeds = Annotated[list[int] | None, typer.Option(min=0, max=SEED, help="Only this seed. Can be given several times.")]
Out = Annotated[Path, typer.Option(help="Folder of the tables that the report reads; made if it is not there.")]


def evaluate(
    file: File,
    profile: Profile = "quick",
    variant: Variant = None,
    arm: Arms = None,
    seed: Seeds = None,
    agents: Annotated[int | None, typer.Option(help="Other than the policy was trained with.")] = None,
    targets: Annotated[int | None, typer.Option(help="Other than the policy was trained with.")] = None,
    episodes: Annotated[
        int | None,
        typer.Option(
            min=2, max=EPISODES, help="Evaluation episodes; as many as the run's final evaluation had if not given."
        ),
    ] = None,
    eval_seed: Annotated[
        int | None,
        typer.Option(
            min=0, max=SEED, help="Seed of the evaluation episodes; that of the run's final evaluation if not given."
        ),
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
    from pipelines.policies.evaluation import EvaluationEpisodes, of_file, of_study, score
    from pipelines.workspace.work_folder import StoreError, work_folder

    wanted = EvaluationEpisodes(episodes, eval_seed, agents, targets)
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


def transfer(
    file: File,
    out: Out,
    profile: Profile = "quick",
    agents: Annotated[str, typer.Option(metavar="N,N", help="Numbers of agents, with the trained targets.")] = "",
    targets: Annotated[str, typer.Option(metavar="M,M", help="Numbers of targets, with the trained agents.")] = "",
    arm: Arms = None,
    seed: Seeds = None,
    episodes: Annotated[int, typer.Option(min=2, max=EPISODES, help="Evaluation episodes of each task.")] = 200,
    jobs: Annotated[int, typer.Option(min=1, max=JOBS, help="Policies at a time.")] = 2,
) -> None:
    """Play a study's trained policies with other numbers of agents and targets, and write transfer.parquet.

    Policies of the pairwise encoder act with any; nothing is trained again.
    """
    from pipelines.policies.evaluation import of_study
    from pipelines.policies.transfer import export_transfer
    from pipelines.policies.transfer import transfer as play
    from pipelines.workspace.work_folder import StoreError, work_folder

    ns, ms = _counts("agents", agents), _counts("targets", targets)
    if not ns and not ms:
        raise InputError("--agents or --targets: at least one number, such as --agents 2,3,6")
    study = load_study(file, profile, None, None)
    with folder_option(out):
        try:
            policies = of_study(study, work_folder(), arm or [], seed or [])
            rows = list(play(study.name, policies, ns, ms, episodes, jobs))
        except StoreError as error:
            raise InputError(str(error)) from error
        shown = [
            [str(x) for x in row[1:3]] + [f"{row[5]} x {row[6]}", f"{row[10]:.2f} ± {row[11]:.2f}"] for row in rows
        ]
        table(["arm", "seed", "agents x targets", "return"], shown, numbers=["seed", "return"])
        tell(f"wrote {export_transfer(rows, out)}")


def assignments(
    file: File,
    out: Out,
    profile: Profile = "quick",
    variant: Variant = None,
    arm: Arms = None,
    seed: Seeds = None,
    jobs: Annotated[int, typer.Option(min=1, max=JOBS, help="Runs at a time.")] = 2,
    overrides: Sets = None,
) -> None:
    """Train a study's coordinators again and watch what they assign: <study>.assignments.parquet.

    Assigned pairs, targets that several agents are assigned to, and how often Algorithm 1 is below the optimum in the
    states met. The logs do not hold it; the training is the same step by step, and takes as long.
    """
    from pipelines.policies.assignments import PREFIX, export_assignments, rows_of, watched

    study = load_study(file, profile, overrides, variant)
    with folder_option(out):
        columns = ("pairs", "conflicts", "free", "lost_h1", "lost_h6")
        for run in watched(study, arm or [], seed or [], jobs):
            written = export_assignments(study, rows_of(run), out)
            last = run.points[-1][1]
            cells = [run.item.card.arm, str(run.item.card.seed), *(f"{last[PREFIX + name]:.4f}" for name in columns)]
            table(["arm", "seed", *columns], [cells], numbers=["seed", *columns])
            tell(f"wrote {written}")


def _counts(option: str, text: str) -> list[int]:
    """Numbers with commas between."""
    try:
        found = [int(part) for part in text.split(",")] if text.strip() else []
    except ValueError as error:
        raise InputError(f"--{option}: {text!r}: whole numbers with commas between, such as 2,3,6") from error
    if any(not 1 <= n <= BOUNDS[option] for n in found):
        raise InputError(f"--{option}: {text!r}: numbers from 1 to {BOUNDS[option]}")
    return found


def _with_error(values: dict[str, float]) -> str:
    return f"{values['return']:.2f} ± {values['return_sem']:.2f}"


def _number(value: Any) -> str:
    return "" if value is None else f"{value:.2f}"
