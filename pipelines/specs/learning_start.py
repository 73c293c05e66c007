"""From which step on a run learns: a budget that ends before leaves the networks as they were drawn.

Off-policy methods wait for `learning_starts`, with memory for a whole segment too, on-policy ones for a rollout,
HiT-MAC's coordinator for the end of the executors' practice. Steps are environment steps, summed over the parallel
copies as everywhere.
"""

from typing import Any, NamedTuple

from pipelines.specs.study import Setting
from rhmc.algorithms import hitmac, qlearning, rhmc
from rhmc.envs import ENVS
from rhmc.learning.settings import OffPolicy, OnPolicy


class Start(NamedTuple):
    """First update of a part of a method, and what it waits for. None: never."""

    step: int | None
    waits: str


def starts(setting: Setting) -> list[Start]:
    """Of every part of the method that learns; nothing of a method outside this project that has neither rule."""
    algo, copies = setting.algo, setting.trainer.num_envs
    if isinstance(algo, hitmac.Config):
        return _hitmac(algo, copies, _episode(setting))
    if isinstance(algo, rhmc.Config):
        return _rhmc(algo, copies, _episode(setting))
    if isinstance(algo, qlearning.Config) and algo.remembers:
        return [_segments(algo, copies)]
    if isinstance(algo, OffPolicy):
        return [_warm(algo, copies)]
    if not isinstance(algo, OnPolicy):
        return []
    return [Start(algo.n_steps * copies, f"n_steps {algo.n_steps:,} x num_envs {copies:,}")]


def shortfall(setting: Setting) -> str:
    """The parts that a budget leaves untrained, with the least budget that is enough, in one line; else nothing."""
    taken = _up(setting.trainer.steps, setting.trainer.num_envs)
    late = [one for one in starts(setting) if one.step is None or one.step > taken]
    if not late:
        return ""
    why = "; ".join(one.waits for one in late)
    never = any(one.step is None for one in late)
    need = "no budget is enough" if never else f"must be at least {max(one.step or 0 for one in late):,}"
    return f"{setting.trainer.steps:,} steps end before '{setting.algo.kind}' learns; {need} ({why})"


def _episode(setting: Setting) -> int:
    return ENVS[setting.env.kind][1].spec(setting.env).episode


def _up(steps: int, copies: int) -> int:
    """To whole steps of all copies."""
    return -(-steps // copies) * copies


def _warm(algo: Any, copies: int, updates: int = 1) -> Start:
    step = _up(algo.learning_starts + updates * algo.train_freq, copies)
    each = f"train_freq {algo.train_freq:,}" + (f" x {updates:,}" if updates > 1 else "")
    return Start(step, f"learning_starts {algo.learning_starts:,} + {each}")


def _segments(algo: qlearning.Config, copies: int) -> Start:
    """A segment has to be whole."""
    start, whole = _warm(algo, copies), copies * algo.segment_length
    if whole <= (start.step or 0):
        return start
    return Start(whole, f"segment_length {algo.segment_length:,} x num_envs {copies:,}")


def _rhmc(algo: rhmc.Config, copies: int, episode: int) -> list[Start]:
    """Executors learn once a period has ended; the coordinator with some of their updates."""
    ended = copies * min(algo.assignment_period, episode)
    low, high = _warm(algo, copies), _warm(algo, copies, algo.coordinator.update_every)
    if algo.coordinator.method != "learned":
        high = low  # nothing says that another one learns
    period = f", and assignment_period {algo.assignment_period:,}" if ended > (low.step or 0) else ""
    return [Start(max(one.step or 0, ended), one.waits + period) for one in dict.fromkeys((low, high))]


def _hitmac(algo: hitmac.Config, copies: int, episode: int) -> list[Start]:
    """Executors learn while they practise, the coordinator from what it decides afterwards."""
    practised = _up(algo.pretrain, copies)
    low = _warm(algo, copies)
    if low.step is None or low.step > practised:
        low = Start(None, f"the executors practise for pretrain {algo.pretrain:,}, and need {low.waits}")
    waited = _decided(algo.coordinator.n_steps, algo.assignment_period, episode, practised // copies % episode)
    decisions = f"coordinator.n_steps {algo.coordinator.n_steps:,} x assignment_period {algo.assignment_period:,}"
    text = f"pretrain {algo.pretrain:,} + {decisions} x num_envs {copies:,}"
    return [low, Start(practised + copies * waited, text)]


def _decided(decisions: int, period: int, episode: int, begun: int) -> int:
    """Steps of a copy until so many periods are over, when `begun` steps of the episode are; its end cuts one short."""
    rest = episode - begun
    first, each = -(-rest // period), -(-episode // period)
    if decisions <= first:
        return min(decisions * period, rest)
    whole, last = divmod(decisions - first - 1, each)
    return rest + whole * episode + min((last + 1) * period, episode)
