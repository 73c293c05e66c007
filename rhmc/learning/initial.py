"""Start of a run from a trained policy: its networks and its running statistics, by the names that states give them.

Taken over: of every `Learner` the network and its target network, of every `RunningMeanStd` the sums, wherever they
stand in a method's state. The run's own: optimisers, replay, rollouts, half-done periods, counters (hence schedules of
exploration) and generators.
"""

from typing import Any

from torch import Tensor

from rhmc.types import State

NET, TARGET, OPTIMISER = "net", "target_net", "optimiser"  # of a `Learner`
STATISTICS = {"sums"}  # of a `RunningMeanStd`


def learned(state: State) -> State:
    """The networks and statistics in a method's state, under the same names; nothing where it has none.

    A network without its target network, as a policy may keep it, is its own.
    """
    if _of_learner(state):
        return {NET: state[NET], TARGET: state.get(TARGET, state[NET])}
    if state.keys() == STATISTICS:
        return dict(state)
    found = {name: learned(part) for name, part in state.items() if isinstance(part, dict)}
    return {name: part for name, part in found.items() if part}


def started(state: State, policy: State) -> State:
    """A method's state with what `learned` gives of a policy's state in its place.

    Raises:
        ValueError: a part of the policy is none of this method, or has another shape; or it has no part at all.
    """
    given = learned(policy)
    if not given:
        raise ValueError("it keeps no networks as `rhmc.learning.learner.Learner` does")
    return _over(state, given, "")


def _of_learner(state: State) -> bool:
    parts = {NET, TARGET, OPTIMISER}
    return NET in state and state.keys() <= parts and _tensors(state[NET])


def _tensors(part: Any) -> bool:
    return isinstance(part, dict) and all(isinstance(value, Tensor) for value in part.values())


def _over(own: Any, given: State, at: str) -> State:
    if not isinstance(own, dict):
        raise ValueError(f"{at.removesuffix('.')}: a part of another kind in this run")
    if strangers := sorted(given.keys() - own.keys()):
        raise ValueError(f"{at}{strangers[0]}: not in this run")
    if _tensors(given):
        for name, value in own.items():
            _same_shape(value, given.get(name), at + name)
        return given
    return {key: _over(value, given[key], f"{at}{key}.") if key in given else value for key, value in own.items()}


def _same_shape(own: Tensor, given: Tensor | None, name: str) -> None:
    if given is None:
        raise ValueError(f"{name}: not in the policy")
    if own.shape != given.shape:
        raise ValueError(f"{name}: {tuple(given.shape)} in the policy, {tuple(own.shape)} in this run")
