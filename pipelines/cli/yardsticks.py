"""`rhmc yardsticks`: scores of policies that need no learning."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.cli.common import (
    File,
    Json,
    Profile,
    Sets,
    Variant,
    folder_option,
    load_study,
    profile_faults,
    say_json,
    table,
    tell,
)
from pipelines.specs.limits import EPISODES, JOBS, SEED
from pipelines.workspace.errors import InputError

if TYPE_CHECKING:
    from pipelines.export.yardsticks import Scored

app = typer.Typer(help="Score the yardsticks: policies without learning, and bounds.", no_args_is_help=True)

Fields = dict[str, Any]
Episodes = Annotated[int, typer.Option(min=2, max=EPISODES, help="Episodes of the evaluation.")]
Policies = Annotated[str | None, typer.Option(help="Names with commas between; all but the planner if not given.")]
Seed = Annotated[int, typer.Option(min=0, max=SEED, help="Seed of the episodes.")]
Out = Annotated[Path | None, typer.Option(help="Also write yardsticks.parquet there, beside the runs' tables.")]
OutProfile = Annotated[str, typer.Option(help="The profile that --out is for.")]


@app.command()
def coverage(
    preset: Annotated[str, typer.Option(help="flat, executor or coordinator.")] = "flat",
    agents: Annotated[int, typer.Option(help="Sensors.")] = 4,
    targets: Annotated[int, typer.Option(help="Targets.")] = 5,
    episodes: Episodes = 1000,
    policies: Policies = None,
    seed: Seed = 0,
    as_json: Json = False,
    out: Out = None,
    profile: OutProfile = "quick",
) -> None:
    """Coverage: the share of targets in view, its standard error and the mean reward, in percent."""
    fields = {"preset": preset, "agents": agents, "targets": targets}
    _score("coverage", fields, episodes, policies, seed, as_json, out, profile)


@app.command()
def navigation(
    agents: Annotated[int, typer.Option(help="Agents, and as many landmarks.")] = 3,
    reward: Annotated[str, typer.Option(help="paper, mpe2 or mpe1.")] = "paper",
    order: Annotated[str, typer.Option(help="Order of integration: mpe2 or mpe1.")] = "mpe2",
    episodes: Episodes = 1000,
    policies: Policies = None,
    seed: Seed = 0,
    as_json: Json = False,
    out: Out = None,
    profile: OutProfile = "quick",
) -> None:
    """Navigation: the return and its standard error, landmarks covered at the end, collisions."""
    fields = {"agents": agents, "reward": reward, "order": order}
    _score("navigation", fields, episodes, policies, seed, as_json, out, profile)


def _score(
    kind: str,
    fields: Fields,
    episodes: int,
    policies: str | None,
    seed: int,
    as_json: bool,
    out: Path | None,
    profile: str,
) -> None:
    import torch

    from rhmc.yardsticks.scores import play_yardsticks

    env = _env(kind, fields)
    chosen = None if policies is None else [name.strip() for name in policies.split(",")]
    _check(kind, chosen or [], profile)
    torch.set_num_threads(1)
    with folder_option(out):
        scores = play_yardsticks(env, chosen, episodes=episodes, seed=seed)
        if out is not None:
            from pipelines.export.yardsticks import Evaluation, Scored, export_yardsticks

            written = export_yardsticks([Scored(Evaluation(env, tuple(scores), episodes, seed), scores)], profile, out)
            tell(f"wrote {written}")
    if as_json:
        say_json(scores)
        raise typer.Exit
    columns = list(dict.fromkeys(key for score in scores.values() for key in score))
    rows = [[name, *(f"{score[key]:.2f}" if key in score else "" for key in columns)] for name, score in scores.items()]
    table(["policy", *columns], rows, numbers=columns)


def _check(kind: str, policies: list[str], profile: str) -> None:
    from pipelines.specs.document import choices
    from rhmc.yardsticks.scores import names

    known = names(kind)
    faults = [f"--policies: '{n}' is not allowed; {choices(n, known)}" for n in policies if n not in known]
    faults += profile_faults(profile)
    if faults:
        raise InputError(*faults)


def _env(kind: str, fields: Fields) -> Any:
    """The task that options describe, their faults named as options."""
    from pipelines.specs.document import Node, Place, validate
    from rhmc.envs import ENVS

    def node(value: Any, name: str) -> Node:
        return Node(value, Place(f"--{name}"), Place(f"--{name}"), "")

    cfg, faults = validate(ENVS[kind].config, node({name: node(value, name) for name, value in fields.items()}, kind))
    if cfg is None:
        raise InputError(*map(str, faults))
    return cfg


@app.command("study")
def of_study(
    file: File,
    profile: Profile = "quick",
    variant: Variant = None,
    episodes: Episodes = 1000,
    seed: Seed = 0,
    out: Out = None,
    overrides: Sets = None,
) -> None:
    """The tasks of a study, each once, with all that they offer but the slow policies; those of other packages too."""
    from pipelines.export.yardsticks import Evaluation, Scored, evaluate_all, export_yardsticks
    from rhmc.yardsticks.scores import SLOW, names

    study = load_study(file, profile, overrides, variant)
    tasks = {setting.env.model_dump_json(): setting.env for setting in study.arms.values()}.values()
    offered = [(env, tuple(name for name in names(env.kind) if name not in SLOW)) for env in tasks]
    for kind in dict.fromkeys(env.kind for env, policies in offered if not policies):
        tell(f"the task '{kind}' offers no policy without learning, so it is left out")
    wanted = [Evaluation(env, policies, episodes, seed) for env, policies in offered if policies]
    found: list[Scored] = []
    with folder_option(out):
        found += evaluate_all(wanted, 1)
        if out is not None and found:
            tell(f"wrote {export_yardsticks(found, profile, out)}")
    if found:
        _show(found)


@app.command("all")
def everything(
    out: Annotated[Path, typer.Option(help="Folder of the tables that the report reads; made if it is not there.")],
    profile: Profile = "quick",
    jobs: Annotated[int, typer.Option(min=1, max=JOBS, help="Evaluations at a time.")] = 2,
) -> None:
    """Every task, policy and bound that the report uses: yardsticks.parquet, with .runs.parquet and .made.parquet.

    The profile decides the number of episodes. The files are written at the end, after minutes.
    """
    _check("coverage", [], profile)
    from pipelines.export.yardsticks import evaluate_all, evaluations, export_yardsticks, present

    with folder_option(out):
        present(out)  # what cannot be brought up to date is better said before the minutes than after
        wanted, found = evaluations(profile), []
        for scored in evaluate_all(wanted, jobs):
            found.append(scored)
            policies = f"{len(scored.scores)} policies" if len(scored.scores) > 1 else next(iter(scored.scores))
            tell(f"{len(found)} of {len(wanted)}: {_named(scored)}: {policies}")
        written = export_yardsticks(found, profile, out)
    _show(found)
    tell(f"wrote {written}")


def _show(found: list["Scored"]) -> None:
    """All scores, task by task."""
    from pipelines.export.yardsticks import TASKS
    from rhmc.yardsticks import offered
    from rhmc.yardsticks.scores import names

    places: list[Any] = [*TASKS, *(one.evaluation.env for one in found)]
    rows = sorted(
        (
            places.index(one.evaluation.env),
            names(one.evaluation.env.kind).index(name),
            _named(one),
            name,
            score,
            one.evaluation.env.kind,
        )
        for one in found
        for name, score in one.scores.items()
    )
    cells = [
        [task, name, f"{score[offered(kind).score]:.2f}", f"{score['sem']:.2f}"] for *_, task, name, score, kind in rows
    ]
    table(["task", "policy", "coverage or return", "sem"], cells, numbers=["coverage or return", "sem"])


def _named(scored: "Scored") -> str:
    """A task in words, with what sets it apart from the others."""
    env: Any = scored.evaluation.env
    if env.kind == "coverage":
        return f"coverage {env.preset}, {env.agents} x {env.targets}"
    if env.kind == "navigation":
        return f"navigation {env.reward}, {env.agents}"
    return f"{env.kind}, {env.agents}" + (f" x {env.targets}" if "targets" in type(env).model_fields else "")
