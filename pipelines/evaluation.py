"""Trained policies on a bank of episodes, also with other numbers of agents and targets than they were trained with."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import torch
from pydantic import ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from pipelines.document import Node, Place, choices, validate
from pipelines.errors import InputError
from pipelines.fingerprint import fingerprint
from pipelines.plan import items, study_card
from pipelines.store import Checkpoints, Home, StoreError, one_line
from pipelines.study import RunSpec, Study
from rhmc.algorithms import ALGORITHMS
from rhmc.algorithms.base import Algorithm
from rhmc.envs import ENVS, EnvConfig, make_env
from rhmc.evaluate import evaluate
from rhmc.types import Metrics, State

FINAL = 5_000_000  # from the seed of the bank of a curve to that of the final one, as the trainer has it


class Policy(NamedTuple):
    """A policy with the run that made it."""

    arm: str
    spec: RunSpec
    source: str  # 'finished', or how far the run has got
    state: State  # of the algorithm


class Bank(NamedTuple):
    """What to play: None stands for what the run itself ended with."""

    episodes: int | None = None
    seed: int | None = None
    agents: int | None = None
    targets: int | None = None


class Score(NamedTuple):
    """Means over the bank; `values["return_sem"]` is the standard error of the return."""

    arm: str
    seed: int
    source: str
    episodes: int
    values: Metrics


def score(policy: Policy, bank: Bank) -> Score:
    """Play the bank greedily.

    Raises:
        InputError: no such task, or the policy cannot act in it.
    """
    trainer = policy.spec.trainer
    torch.set_num_threads(trainer.threads)
    env = task(policy.spec.env, bank)
    episodes = bank.episodes or trainer.final_episodes
    seed = trainer.eval_seed + FINAL if bank.seed is None else bank.seed
    played = evaluate(_actor(policy, env), env, episodes, seed, trainer.device)
    values = {name.removeprefix("final/"): value for name, value in played.means("final").items()}
    return Score(policy.arm, policy.spec.seed, policy.source, episodes, values)


def task(env: EnvConfig, bank: Bank) -> EnvConfig:
    """The task with other numbers of agents and targets.

    Raises:
        InputError: there is no such task; the option is named.
    """
    wanted = {name: n for name, n in (("agents", bank.agents), ("targets", bank.targets)) if n is not None}
    if not wanted:
        return env
    fields = {name: _option(value, name) for name, value in (env.model_dump(mode="json") | wanted).items()}
    if "targets" in wanted and "targets" not in type(env).model_fields:
        raise InputError("--targets: in navigation there are as many landmarks as agents; give --agents")
    found, faults = validate(ENVS[env.kind][0], _option(fields, env.kind))
    if found is None:
        raise InputError("\n".join(str(fault) for fault in faults))
    return found


def _option(value: Any, name: str) -> Node:
    if isinstance(value, list):
        value = [_option(one, name) for one in value]
    return Node(value, Place(f"--{name}"), Place(f"--{name}"), "")


def _actor(policy: Policy, env: EnvConfig) -> Algorithm:
    spec = policy.spec
    rng = torch.Generator(spec.trainer.device)
    with torch.random.fork_rng(devices=[]):
        built = ALGORITHMS[spec.algo.kind].build(spec.algo, make_env(env, 1, rng).spec, spec.trainer.num_envs, rng)
    try:
        built.load_state_dict(policy.state)
    except (RuntimeError, KeyError, TypeError, ValueError, AttributeError) as error:
        if env != spec.env:
            sizes = f"--agents or --targets: {spec.algo.kind} with encoder '{spec.algo.encoder}'"
            text = f"{sizes} acts only with the numbers that it was trained with; 'pairwise' acts with any"
            raise InputError(text) from error
        raise InputError(f"{policy.arm} s{spec.seed}: not a policy of these settings ({one_line(error)})") from error
    return built


# Where policies come from


def of_study(study: Study, home: Path, arms: Sequence[str] = (), seeds: Sequence[int] = ()) -> Iterator[Policy]:
    """The policies of a study's runs: kept ones of the finished, the newest checkpoint of the others.

    Raises:
        InputError: there is no such arm, or no policy at all.
    """
    faults = [f"--arm: '{arm}' is not allowed; {choices(arm, study.arms)}" for arm in arms if arm not in study.arms]
    if faults:
        raise InputError("\n".join(faults))
    from pipelines.mlflow_tracker import open_existing

    place = Home(home)
    tracker = open_existing(study_card(study), place)
    done = {(r.arm, r.key): r.ref for r in tracker.recorded() if r.status == "finished"} if tracker else {}
    found = False
    for item in items(study, fingerprint(), ""):
        card, state, source = item.card, None, "finished"
        if (arms and card.arm not in arms) or (seeds and card.seed not in seeds):
            continue
        if tracker and (ref := done.get((card.arm, item.key))):
            with TemporaryDirectory() as folder:
                file = tracker.file(ref, "policy.pt", Path(folder))
                state = read_state(file) if file else None
        elif checkpoint := Checkpoints(place.checkpoints(item.key)).newest():
            state = checkpoint["trainer"]
            source = f"at step {state['step']:,}"
        if state is not None:
            found = True
            yield Policy(card.arm, item.spec, source, state["algorithm"])
    if not found:
        raise InputError(f"{study.name} ({study.profile}): no such run has a policy yet; `rhmc study run` trains it")


def of_file(file: Path, config: Path | None) -> Policy:
    """The policy in a file: a kept `policy.pt` or a checkpoint, with the run's `config.yaml` (beside it if None).

    Raises:
        InputError: one of them is missing, or is not what it should be.
    """
    about = config or file.with_name("config.yaml")
    try:
        tree = YAML(typ="safe", pure=True).load(about.read_text(encoding="utf-8"))
        spec = RunSpec.model_validate({name: tree[name] for name in ("env", "algo", "trainer", "seed")})
    except FileNotFoundError as error:
        raise InputError(f"{about}: no such file; --config names the config.yaml that the run keeps") from error
    except (OSError, UnicodeDecodeError, YAMLError, ValidationError, KeyError, TypeError) as error:
        raise InputError(f"{about}: not the config.yaml of a run ({one_line(error)})") from error
    state = read_state(file)
    arm = tree.get("arm", "policy") if isinstance(tree, Mapping) else "policy"
    source = "finished" if state["point"] >= spec.trainer.evaluations else f"at step {state['step']:,}"
    return Policy(str(arm), spec, source, state["algorithm"])


def read_state(file: Path) -> State:
    """The trainer's state in a kept policy or a checkpoint.

    Raises:
        InputError: the file is neither.
    """
    try:
        state = torch.load(file, weights_only=True, map_location="cpu")
    except FileNotFoundError as error:
        raise InputError(f"{file}: no such file") from error
    except Exception as error:  # cut short, or something else: torch raises several kinds
        raise InputError(f"{file}: not a readable checkpoint") from error
    state = state.get("trainer", state) if isinstance(state, dict) else {}
    if not {"algorithm", "step", "point"} <= state.keys():
        raise InputError(f"{file}: readable, but not a checkpoint of a run")
    return state


__all__ = ["Bank", "Policy", "Score", "StoreError", "of_file", "of_study", "score"]
