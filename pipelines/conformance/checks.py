"""A check, its outcome, and the parts that checks of methods and of tasks share."""

import io
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Generator, Tensor

from pipelines.conformance.same import DifferentError, assert_same
from pipelines.workspace.work_folder import one_line
from rhmc.envs.base import Env
from rhmc.training.trainer import Config
from rhmc.types import Obs


class Unfit(Exception):  # noqa: N818  # it says of a check that it does not apply
    """The check does not concern this method or task; the message says why."""


class Outcome(NamedTuple):
    """Of one check: `fault` is empty where it holds, `left_out` where it was made."""

    subject: str
    check: str
    fault: str = ""
    left_out: str = ""


Check = Callable[[Any], None]  # raises AssertionError with what is wrong, or Unfit

RUN = Config(steps=44, num_envs=4, evaluations=5, eval_episodes=2, final_episodes=2)  # ends at steps 12 20 28 36 44
SMALL = {  # of methods that have such a setting: all that they do comes within the run
    "hidden_dim": 8,
    "pretrain": 20,
    "buffer_size": 20,
    "batch_size": 8,
    "learning_starts": 8,
    "train_freq": 4,
    "n_steps": 3,
    "epochs": 2,
    "minibatches": 2,
    "assignment_period": 3,
}


def outcomes(subject: str, given: Any, checks: Iterable[Check]) -> Iterator[Outcome]:
    """Make each check; whatever a method or a task raises is a fault of the check, in one line."""
    for check in checks:
        name = check.__name__.replace("_", " ")
        try:
            check(given)
        except Unfit as why:
            yield Outcome(subject, name, left_out=str(why))
        except Exception as error:
            kind = "" if isinstance(error, AssertionError) else f"{type(error).__name__}: "
            yield Outcome(subject, name, fault=f"{kind}{one_line(error)}")
        else:
            yield Outcome(subject, name)


def need(holds: bool, otherwise: str) -> None:
    """A requirement, also where Python leaves assertions out.

    Raises:
        AssertionError: it does not hold.
    """
    if not holds:
        raise AssertionError(otherwise)


def need_difference(a: Any, b: Any, otherwise: str) -> None:
    """A requirement that two states are not the same.

    Raises:
        AssertionError: they are.
    """
    try:
        assert_same(a, b)
    except DifferentError:
        return
    raise AssertionError(otherwise)


def through_a_file(state: Any) -> Any:
    """The content of a checkpoint after it was written and read, by the reader that runs no code."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def seeded(seed: int = 0) -> Generator:
    """A generator on the CPU that draws the same numbers each time."""
    return Generator().manual_seed(seed)


def reordered(obs: Obs, order: list[int]) -> Obs:
    """The same observation with its agents in another order."""
    return Obs(obs.agents[:, order], obs.pairs[:, order], obs.peers[:, order][:, :, order], obs.first)


def at_random(env: Env, rng: Generator) -> Tensor:
    """A joint action: (B, N) int64, or (B, N, A) in [-1, 1]."""
    shape = (env.batch, env.spec.agents)
    if env.spec.continuous:
        return torch.rand(*shape, env.spec.actions, generator=rng) * 2 - 1
    return torch.randint(env.spec.actions, shape, generator=rng)


def finite(named: Mapping[str, Tensor]) -> None:
    """See that no number is missing or endless."""
    wrong = [name for name, value in named.items() if value.is_floating_point() and not bool(value.isfinite().all())]
    need(not wrong, f"{', '.join(wrong)}: not finite")
