"""Checks of a task: its physics as `rhmc.envs.base.Physics` has it, and that every method that fits trains in it."""

from collections.abc import Iterator
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor

from pipelines.conformance.blocks import fitted, nested
from pipelines.conformance.checks import (
    RUN,
    SMALL,
    Outcome,
    at_random,
    finite,
    need,
    need_difference,
    outcomes,
    seeded,
    through_a_file,
)
from pipelines.conformance.same import assert_same
from pipelines.specs import limits
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS, make_env
from rhmc.envs.base import Env
from rhmc.training.trainer import Trainer

BATCH = 5


def check_task(kind: str, changes: dict[str, Any]) -> Iterator[Outcome]:
    """Every check of a task.

    Args:
        kind: a registered task.
        changes: settings by dotted name, on top of the defaults.

    Raises:
        pydantic.ValidationError: a change that the task does not have.
    """
    env = ENVS[kind].config.model_validate(nested(changes))
    yield from outcomes(kind, env, CHECKS)
    for method in ALGORITHMS:
        config = ALGORITHMS[method].config
        algo = config.model_validate(nested(fitted(config, SMALL)))
        if fault := limits.misfit(env, algo):
            yield Outcome(kind, f"{method} trains in it", left_out=fault)
            continue
        for one in outcomes(kind, (env, algo), [_trains]):
            yield one._replace(check=f"{method} trains in it")


def _made(env: Any, seed: int = 0) -> Env:
    made = make_env(env, BATCH, seeded(seed))
    made.reset()
    return made


def shapes_are_those_of_its_spec(env: Any) -> None:
    """Observations, rewards and options as `rhmc.types` has them, and finite."""
    made = make_env(env, BATCH, seeded(0))
    s, b = made.spec, BATCH
    n, m = s.agents, s.targets
    obs = made.reset()
    seen = {
        "agents": (b, n, s.agent_features),
        "pairs": (b, n, m, s.pair_features),
        "peers": (b, n, n, s.peer_features),
        "first": (b,),
    }
    _shaped(obs._asdict(), seen)
    need(bool(obs.first.all()), "`first` is not true at the start")
    table = made.options()(2)
    need(
        table.dtype == torch.bool and tuple(table.shape[i] for i in (0, 1, 3)) == (b, n, m),
        f"options are {table.dtype} {tuple(table.shape)}, not bool (B, N, D, M)",
    )
    step = made.step(at_random(made, seeded(1)))
    _shaped(step.obs._asdict(), seen)
    parts = {"reward": step.reward, "local.pairs": step.local.pairs, "local.agents": step.local.agents}
    parts |= {"completed": step.completed, "truncated": step.truncated, **step.info}
    _shaped(parts, {"reward": (b,), "local.pairs": (b, n, m), "local.agents": (b, n), "completed": (b, n, m)})
    finite(parts)
    need(step.completed.dtype == torch.bool, f"completed is {step.completed.dtype}, not bool")
    need(all(len(value) == b for value in step.info.values()), "info leads with B")


def _shaped(parts: dict[str, Tensor], wanted: dict[str, tuple[int, ...]]) -> None:
    wrong = {name: tuple(parts[name].shape) for name, shape in wanted.items() if tuple(parts[name].shape) != shape}
    need(not wrong, "; ".join(f"{name} has the shape {shape}, not {wanted[name]}" for name, shape in wrong.items()))


def an_episode_ends_where_it_says(env: Any) -> None:
    """By truncation at `spec.episode`; the next one begins in the same step; `final_obs` is of the one that ended."""
    made = _made(env)
    acting = seeded(1)
    for t in range(1, 2 * made.spec.episode + 1):
        step = made.step(at_random(made, acting))
        end = t % made.spec.episode == 0
        need(bool((step.truncated == end).all()), f"step {t}: truncated is {step.truncated.tolist()}")
        need(bool((step.obs.first == end).all()), f"step {t}: `first` is {step.obs.first.tolist()}")
        need(not bool(step.final_obs.first.any()), f"step {t}: `first` of the last observation is true")
        if not end:
            assert_same(step.obs._asdict(), step.final_obs._asdict(), f"step {t}: final_obs")


def repeats_with_the_same_seed_alone(env: Any) -> None:
    """The same generator and actions give the same episode; another generator another one."""
    logs = [_played(_made(env, seed)) for seed in (0, 0, 1)]
    assert_same(logs[0], logs[1], "the second episode of one seed")
    need_difference(logs[0], logs[2], "another seed gives the same episode: does it use its generator?")


def _played(made: Env) -> list[Any]:
    acting = seeded(5)
    steps = [made.step(at_random(made, acting)) for _ in range(made.spec.episode + 2)]
    return [{"obs": step.obs._asdict(), "reward": step.reward, "completed": step.completed} for step in steps]


def continues_from_its_state_bit_for_bit(env: Any) -> None:
    """From the middle of an episode, in an environment of another seed."""
    made = _made(env)
    for _ in range(max(1, made.spec.episode // 2)):
        made.step(at_random(made, seeded(2)))
    state = through_a_file(made.state_dict())
    other = _made(env, seed=9)
    other.load_state_dict(state)
    assert_same(other.state_dict(), made.state_dict(), "loaded state")
    assert_same(_played(other), _played(made), "steps after loading")


def a_step_changes_no_state_in_place(env: Any) -> None:
    """States are frozen: checkpoints and the regulator's table hold on to them."""
    made = _made(env)
    before = made.state
    kept = deepcopy(before._asdict())
    made.step(at_random(made, seeded(3)))
    assert_same(before._asdict(), kept, "the state before the step")


def copies_do_not_touch_each_other(env: Any) -> None:
    """Actions in the first copy change nothing in the others."""
    one, other = _made(env), _made(env)
    action = at_random(one, seeded(4))
    changed = action.clone()
    changed[0] = -action[0] if one.spec.continuous else (action[0] + 1) % one.spec.actions
    steps = [one.step(action), other.step(changed)]
    seen = [{"obs": step.obs.pairs[1:], "reward": step.reward[1:], "completed": step.completed[1:]} for step in steps]
    assert_same(seen[0], seen[1], "copies 1 to 4 after another action of copy 0")


def what_is_completed_was_an_option(env: Any) -> None:
    """The regulator's table is an upper bound: what an agent completes in a step is in its options of one step."""
    made = _made(env)
    acting = seeded(6)
    for t in range(1, made.spec.episode + 1):
        table = made.options()(1).any(2)
        step = made.step(at_random(made, acting))
        missed = int((step.completed & ~table).sum())
        need(not missed, f"step {t}: {missed} completed targets are in no option of horizon 1")


def its_summary_has_a_return(env: Any) -> None:
    """Of each episode: (B,) each, with `return` among them."""
    made = _made(env)
    acting = seeded(7)
    steps = [made.step(at_random(made, acting)) for _ in range(made.spec.episode)]
    info = {name: torch.stack([step.info[name] for step in steps]) for name in steps[0].info}
    found = ENVS[env.kind].physics.summary(env, torch.stack([step.reward for step in steps]), info)
    need("return" in found, f"a summary has `return`; here there are {', '.join(found) or 'none'}")
    _shaped(found, dict.fromkeys(found, (BATCH,)))
    finite(found)


def _trains(given: tuple[Any, Any]) -> None:
    env, algo = given
    for item in Trainer(env, algo, RUN, 0):
        finite({name: torch.tensor(value) for name, value in item.items()})


CHECKS = (
    shapes_are_those_of_its_spec,
    an_episode_ends_where_it_says,
    repeats_with_the_same_seed_alone,
    continues_from_its_state_bit_for_bit,
    a_step_changes_no_state_in_place,
    copies_do_not_touch_each_other,
    what_is_completed_was_an_option,
    its_summary_has_a_return,
)
