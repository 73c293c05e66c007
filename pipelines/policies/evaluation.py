"""Trained policies in evaluation episodes, also with other numbers of agents and targets than in training."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import torch

from pipelines.specs.document import Node, Place, validate
from pipelines.specs.study import Study
from pipelines.tracking.plan import Item, chosen, study_card
from pipelines.tracking.policy import CONFIG, FILE, Actor, NoPolicyError, Saved, load, settings
from pipelines.tracking.policy_address import is_stored, saved_at
from pipelines.tracking.tracker import Recorded, Tracker
from pipelines.workspace.errors import InputError
from pipelines.workspace.leftovers import scratch
from pipelines.workspace.work_folder import Home
from rhmc.envs import ENVS, EnvConfig
from rhmc.training.evaluation import evaluate
from rhmc.types import Metrics

FINAL = 5_000_000  # from the seed of a curve's evaluation episodes to that of the final ones, as in the trainer


class Policy(NamedTuple):
    """A policy with the arm whose run made it."""

    arm: str
    saved: Saved


class EvaluationEpisodes(NamedTuple):
    """The episodes to play; None stands for the value of the run's own final evaluation."""

    episodes: int | None = None
    seed: int | None = None
    agents: int | None = None
    targets: int | None = None


class Score(NamedTuple):
    """Means over the episodes; `values["return_sem"]` is the standard error of the return."""

    arm: str
    seed: int
    source: str
    episodes: int
    values: Metrics
    eval_seed: int
    task: dict[str, Any]  # every setting of the task that was played
    changed: dict[str, Any]  # what was not as in the run's own final evaluation


def score(policy: Policy, wanted: EvaluationEpisodes) -> Score:
    """Play the evaluation episodes greedily.

    Raises:
        InputError: no such task, or the policy cannot act in it.
    """
    spec, reached = policy.saved.spec, policy.saved.reached
    trainer = spec.trainer
    torch.set_num_threads(trainer.threads)
    env = task(spec.env, wanted)
    episodes = wanted.episodes or trainer.final_episodes
    seed = trainer.eval_seed + FINAL if wanted.seed is None else wanted.seed
    device = trainer.device if torch.cuda.is_available() else "cpu"  # a policy from elsewhere acts here as well
    played = evaluate(acting(policy, env, device).algorithm, env, episodes, seed, device)
    values = {name.removeprefix("final/"): value for name, value in played.means("final").items()}
    own, played_in = (one.model_dump(mode="json") for one in (spec.env, env))
    changed = {name: value for name, value in played_in.items() if value != own[name]}
    changed |= {"episodes": episodes} if episodes != trainer.final_episodes else {}
    changed |= {"eval_seed": seed} if seed != trainer.eval_seed + FINAL else {}
    return Score(policy.arm, spec.seed, reached, episodes, values, seed, played_in, changed)


def task(env: EnvConfig, episodes: EvaluationEpisodes) -> EnvConfig:
    """The task with other numbers of agents and targets.

    Raises:
        InputError: there is no such task; the option is named.
    """
    wanted = {name: n for name, n in (("agents", episodes.agents), ("targets", episodes.targets)) if n is not None}
    if not wanted:
        return env
    fields = {name: _option(value, name) for name, value in (env.model_dump(mode="json") | wanted).items()}
    if "targets" in wanted and "targets" not in type(env).model_fields:
        raise InputError(f"--targets: in {env.kind} their number is not a setting of its own; give --agents")
    found, faults = validate(ENVS[env.kind].config, _option(fields, env.kind))
    if found is None:
        raise InputError(*map(str, faults))
    return found


def _option(value: Any, name: str) -> Node:
    if isinstance(value, list):
        value = [_option(one, name) for one in value]
    return Node(value, Place(f"--{name}"), Place(f"--{name}"), "")


def acting(policy: Policy, env: EnvConfig, device: str = "cpu") -> Actor:
    """The policy as it acts in a task.

    Raises:
        InputError: it cannot act there.
    """
    spec = policy.saved.spec
    try:
        return Actor(policy.saved, env, device)
    except ValueError as error:
        if env != spec.env:
            sizes = f"--agents or --targets: {spec.algo.kind} with encoder '{spec.algo.encoder}'"
            text = f"{sizes} acts only with the numbers that it was trained with; 'pairwise' acts with any"
            raise InputError(text) from error
        raise InputError(f"{policy.arm} s{spec.seed}: {error}") from error


# Where policies come from


def of_address(address: str, config: Path | None, home: Path) -> Policy:
    """The policy in a file or a folder, of a run in the log, or in MLflow's registry.

    Raises:
        InputError: there is none, or `config`, which says of which run a file is, is given with another address.
    """
    if not is_stored(address):
        return of_file(Path(address), config)
    if config is not None:
        raise InputError(f"--config: belongs to a file, and {address} says itself which run it is of")
    saved = saved_at(address, Home(home))
    return Policy(saved.spec.algo.kind, saved)


def of_study(study: Study, home: Path, arms: Sequence[str] = (), seeds: Sequence[int] = ()) -> Iterator[Policy]:
    """The policies of a study's runs: kept ones of the finished, the newest checkpoint of the others.

    Raises:
        InputError: there is no such arm, no policy at all, or a finished run has lost its own.
    """
    plan = chosen(study, arms, seeds)
    from pipelines.tracking.mlflow_tracker import open_existing

    place = Home(home)
    tracker = open_existing(study_card(study), place)
    done = {(r.arm, r.key): r for r in tracker.recorded() if r.status == "finished"} if tracker else {}
    found = False
    for item in plan:
        run = done.get((item.card.arm, item.key))
        saved = _kept(tracker, run, item) if tracker and run else _begun(place, item)
        if saved is not None:
            found = True
            yield Policy(item.card.arm, saved)
    if not found:
        without = sum((item.card.arm, item.key) in done for item in plan)
        reason = "no such run has a policy yet; `rhmc study run` trains it"
        if without:
            reason = f"the {without} finished runs came without policies, by `rhmc study export --values-only`"
        raise InputError(f"{study.name} ({study.profile}): {reason}")


def _kept(tracker: Tracker, run: Recorded, item: Item) -> Saved | None:
    """The policy of a finished run; None if it came without one."""
    with scratch() as folder:
        file = tracker.file(run.ref, FILE, folder)
        if file is None:
            if run.values_only:
                return None
            raise InputError(f"{item.name}: its run {run.ref} keeps no {FILE} in {tracker.files_of(run.ref)}")
        try:
            return load(file, item.spec)
        except NoPolicyError as error:
            raise InputError(f"{item.name}: the {FILE} that its run {run.ref} keeps is damaged") from error


def _begun(home: Home, item: Item) -> Saved | None:
    """The policy of a run under way, which may be training meanwhile."""
    with suppress(NoPolicyError):
        return load(home.checkpoints(item.key), item.spec)
    return None


def of_file(file: Path, config: Path | None) -> Policy:
    """The policy in a file, a kept `policy.pt` or a checkpoint, or in a folder that has one.

    Args:
        file: says itself which run it is of, or the `config.yaml` beside it does.
        config: says it instead.

    Raises:
        InputError: one of them is missing, or is not what it should be.
    """
    if config is not None:
        spec, arm = settings(config)
        return Policy(arm, load(file, spec))
    saved = load(file)
    with suppress(InputError):
        spec, arm = settings(file / CONFIG if file.is_dir() else file.with_name(CONFIG))
        if spec == saved.spec:
            return Policy(arm, saved)
    return Policy(saved.spec.algo.kind, saved)
