"""Trained policies looked at again: in evaluation episodes, with other numbers of agents, and what they assign."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

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
    say,
    say_json,
    studies,
    table,
    tell,
)
from pipelines.specs.limits import BOUNDS, EPISODES, JOBS, SEED
from pipelines.workspace.errors import InputError

if TYPE_CHECKING:
    from pipelines.policies.evaluation import Policy, Score

WHAT = (
    "A study, whose finished runs (or newest checkpoints) are meant; or a policy: a .pt file that a run keeps, a "
    "folder with one, runs:/ID of a finished run in MLflow, models:/NAME/VERSION."
)
What = Annotated[str, typer.Argument(metavar="FILE|POLICY", help=WHAT, autocompletion=studies)]
Agents = Annotated[int | None, typer.Option(help="Other than the policy was trained with.")]
Targets = Annotated[int | None, typer.Option(help="Other than the policy was trained with.")]
Config = Annotated[Path | None, typer.Option(help="Settings of a .pt file, other than it names itself: a config.yaml.")]
COUNTS, QUOTE = ("agents", "targets"), "'"
Seeds = Annotated[list[int] | None, typer.Option(min=0, max=SEED, help="Only this seed. Can be given several times.")]
Out = Annotated[Path, typer.Option(help="Folder of the tables that the report reads; made if it is not there.")]


class Asked(NamedTuple):
    """The options that choose policies."""

    profile: str
    variant: str | None
    arms: Sequence[str]
    seeds: Sequence[int]
    overrides: Sequence[str]
    config: Path | None


def policies(what: str, asked: Asked) -> "Iterator[Policy]":
    """The policies of a study's runs, or the one at an address.

    Raises:
        InputError: there is none, or an option belongs to the other of both.
    """
    from pipelines.policies.evaluation import of_address, of_study
    from pipelines.tracking.policy_address import is_policy
    from pipelines.workspace.work_folder import StoreError, work_folder

    try:
        if is_policy(what):
            of_studies = {
                "--variant": asked.variant,
                "--arm": asked.arms,
                "--seed": asked.seeds,
                "--set": asked.overrides,
            }
            if given := [option for option, value in of_studies.items() if value]:
                raise InputError(f"{given[0]}: belongs to a study, and {what} is one policy")
            yield of_address(what, asked.config, work_folder())
            return
        if asked.config is not None:
            raise InputError(f"--config: belongs to a .pt file, and {what} is a study")
        study = load_study(Path(what), asked.profile, asked.overrides, asked.variant)
        yield from of_study(study, work_folder(), asked.arms, asked.seeds)
    except StoreError as error:
        raise InputError(str(error)) from error


def evaluate(
    what: What,
    profile: Profile = "quick",
    variant: Variant = None,
    arm: Arms = None,
    seed: Seeds = None,
    agents: Agents = None,
    targets: Targets = None,
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
    config: Config = None,
    as_json: Json = False,
    overrides: Sets = None,
) -> None:
    """Play trained policies greedily: the return with its standard error over the episodes, and the task's metrics.

    Says in which task they played, and in what that differs from the runs' own final evaluation.
    """
    from pipelines.policies.evaluation import EvaluationEpisodes, score

    wanted = EvaluationEpisodes(episodes, eval_seed, agents, targets)
    asked = Asked(profile, variant, arm or [], seed or [], overrides or [], config)
    scores = [score(policy, wanted) for policy in policies(what, asked)]
    if as_json:
        say_json([one._asdict() for one in scores])
        return
    _say_played(scores)
    columns = list(dict.fromkeys(name for one in scores for name in one.values if name not in ("return", "return_sem")))
    rows = [
        [one.arm, str(one.seed), one.source, str(one.episodes), _with_error(one.values)]
        + [_number(one.values.get(name)) for name in columns]
        for one in scores
    ]
    numbers = ["seed", "episodes", "return", *columns]
    table(["arm", "seed", "policy", "episodes", "return", *columns], rows, numbers=numbers)


def _say_played(scores: "Sequence[Score]") -> None:
    """The tasks that were played, each once, with the arms where they differ."""
    played: dict[str, dict[str, None]] = {}
    for one in scores:
        played.setdefault(_played(one), {})[one.arm] = None
    for text, arms in played.items():
        say(text if len(played) == 1 else f"{', '.join(arms)}: {text}")


def _played(one: "Score") -> str:
    from pipelines.specs.document import show
    from rhmc.envs import ENVS

    usual = ENVS[one.task["kind"]].config().model_dump(mode="json")
    told = {name: value for name, value in one.task.items() if value != usual[name] or name in COUNTS}
    settings = ", ".join(f"{name}={show(value).strip(QUOTE)}" for name, value in told.items())
    changed = ", ".join(f"{name}={show(value).strip(QUOTE)}" for name, value in one.changed.items())
    return f"{one.task['kind']} ({settings}); other than in the run's own evaluation: {changed or 'nothing'}"


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
