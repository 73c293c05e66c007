"""The checks hold for this project's own, and each finds the fault that it is for."""

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from pipelines.conformance import toy
from pipelines.conformance.checks import Outcome
from pipelines.conformance.methods import SMALL_TASKS, check_method
from pipelines.conformance.tasks import check_task
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS, Task
from rhmc.envs.base import Outcome as Reward

METHOD = "iql"
QUICK = 1  # steps of the run that is to learn, where that is not the question


def faults(found: Iterator[Outcome]) -> dict[str, str]:
    """By check; the same fault in both tasks once."""
    return {one.check: one.fault for one in found if one.fault}


def spoiled(monkeypatch: pytest.MonkeyPatch, spoil: Callable[[Any], None]) -> None:
    """The method builds algorithms that `spoil` has changed."""
    entry = ALGORITHMS[METHOD]

    def build(*args: Any) -> Any:
        made = entry.build(*args)
        spoil(made)
        return made

    monkeypatch.setitem(ALGORITHMS, METHOD, entry._replace(build=build))


def test_a_method_and_a_task_of_the_project_hold() -> None:
    found = [*check_method("vdn", {}, 12_000), *check_task("navigation", {})]
    assert [one for one in found if one.fault] == []
    assert len(found) == 2 * 7 + 2 + 8 + len(ALGORITHMS)
    assert "toy" not in ENVS


def test_what_does_not_apply_says_why() -> None:
    left = {one.check: one.left_out for one in check_task("navigation", {"continuous": True}) if one.left_out}
    assert set(left) == {
        f"{kind} trains in it" for kind, m in ALGORITHMS.items() if "continuous" not in m.about.actions
    }
    assert all("discrete" in text for text in left.values())


def leaks(made: Any) -> None:
    """Acting greedily counts, and the count decides what is learned."""
    act, update = made.act, made.update
    made.seen = 0

    def counting(*args: Any, explore: bool) -> Any:
        made.seen += not explore
        return act(*args, explore=explore)

    def learning() -> Any:
        for learner in made.learners():
            for weight in learner.net.parameters():
                weight.data.add_(1e-4 * made.seen)
        return update()

    made.act, made.update = counting, learning


def forgets(made: Any) -> None:
    """A part of what it is does not come back from a checkpoint."""
    load = made.load_state_dict
    made.load_state_dict = lambda state: load(state | {"rng": torch.Generator().manual_seed(0).get_state()})


def remembers_beside_its_carry(made: Any) -> None:
    """What acting remembers from step to step is in no checkpoint, so that a resume loses it."""
    act = made.act
    made.acted = 0

    def remembering(*args: Any, explore: bool) -> Any:
        action, carry, extra = act(*args, explore=explore)
        made.acted += explore
        return (action + explore * made.acted) % 3, carry, extra

    made.act = remembering


def ignores_its_generator(made: Any) -> None:
    act = made.act
    made.act = lambda obs, carry, rng, *, explore: act(obs, carry, torch.Generator().manual_seed(0), explore=explore)


def draws_when_greedy(made: Any) -> None:
    act = made.act

    def drawing(obs: Any, carry: Any, rng: Any, *, explore: bool) -> Any:
        torch.rand(1, generator=rng)
        return act(obs, carry, rng, explore=explore)

    made.act = drawing


def acts_outside(made: Any) -> None:
    act = made.act

    def outside(*args: Any, explore: bool) -> Any:
        action, carry, extra = act(*args, explore=explore)
        return action + 7, carry, extra

    made.act = outside


def names_too_few(made: Any) -> None:
    """An untouched network among those that are said to learn."""
    own = made.learners()
    still = SimpleNamespace(state_dict=lambda: {"net": torch.zeros(2)}, anneal=lambda left: None)
    made.learners = lambda: [*own, still]


def is_not_finite(made: Any) -> None:
    update = made.update
    made.update = lambda: update() | {"loss": torch.tensor(float("nan"))}


@pytest.mark.parametrize(
    ("spoil", "check", "said"),
    [
        (leaks, "evaluation leaves no trace", "algorithm"),
        (forgets, "continues from any point bit for bit", "algorithm.rng: "),
        (remembers_beside_its_carry, "continues from any point bit for bit", "after a resume"),
        (ignores_its_generator, "exploring is decided by the generator", "nothing explores"),
        (draws_when_greedy, "acts within the task", "greedy acting draws from the generator"),
        (acts_outside, "acts within the task", "an action is outside 0 to"),
        (names_too_few, "every learner is named", "learner 1 has learned nothing"),
        (is_not_finite, "values stay finite at cut and ended episodes", "train/loss: not finite"),
    ],
)
def test_a_fault_of_a_method_is_found(
    spoil: Callable[[Any], None], check: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipelines.conformance.methods.SMALL_TASKS", SMALL_TASKS[1:])
    spoiled(monkeypatch, spoil)
    found = faults(check_method(METHOD, {}, QUICK))
    assert said in found[check]
    assert "\n" not in found[check]


def test_agents_that_act_by_their_number_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def by_number(made: Any) -> None:
        act = made.act

        def numbered(*args: Any, explore: bool) -> Any:
            action, carry, extra = act(*args, explore=explore)
            return (action + torch.arange(action.shape[1])) % 3, carry, extra

        made.act = numbered

    monkeypatch.setattr("pipelines.conformance.methods.SMALL_TASKS", ())
    spoiled(monkeypatch, by_number)
    found = faults(check_method(METHOD, {}, QUICK))
    assert found["agents in another order do the same"] == "agents in another order do something else"
    assert found["learns the tiny task"].startswith("0.")
    assert "at best within 1 steps" in found["learns the tiny task"]


class Physics:
    """The tiny task with one function in another's place."""

    def __init__(self, **changed: Any) -> None:
        self.changed = changed

    def __getattr__(self, name: str) -> Any:
        return self.changed[name] if name in self.changed else getattr(toy, name)


def changing_in_place(cfg: Any, state: Any, action: Any, rng: Any) -> Any:
    state.steps.add_(1)
    return toy.transition(cfg, state._replace(steps=state.steps - 1), action, rng)


def drawing_from_nowhere(cfg: Any, batch: int, rng: Any) -> Any:
    return toy.initial(cfg, batch, torch.Generator().manual_seed(torch.seed() % 1000))


def always_alike(cfg: Any, batch: int, rng: Any) -> Any:
    return toy.initial(cfg, batch, torch.Generator().manual_seed(0))


def touching(cfg: Any, state: Any, action: Any, assignment: Any) -> Reward:
    out = toy.outcome(cfg, state, action, assignment)
    return out._replace(reward=out.reward + action.sum())


def whole_numbers(cfg: Any, state: Any, action: Any, assignment: Any) -> Reward:
    out = toy.outcome(cfg, state, action, assignment)
    return out._replace(completed=out.completed.float())


@pytest.mark.parametrize(
    ("changed", "check", "said"),
    [
        ({"transition": changing_in_place}, "a step changes no state in place", "the state before the step.steps"),
        ({"initial": drawing_from_nowhere}, "repeats with the same seed alone", "the second episode of one seed"),
        ({"initial": always_alike}, "repeats with the same seed alone", "does it use its generator?"),
        ({"outcome": touching}, "copies do not touch each other", "reward: "),
        ({"outcome": whole_numbers}, "shapes are those of its spec", "completed is torch.float32, not bool"),
        (
            {"options": lambda cfg, state, horizon: toy.options(cfg, state, 0) & False},
            "what is completed was an option",
            "in no option of horizon 1",
        ),
        (
            {"summary": lambda cfg, reward, info: {"score": reward.mean(0)}},
            "its summary has a return",
            "a summary has `return`; here there are score",
        ),
        (
            {"observe": lambda cfg, state: toy.observe(cfg, state)._replace(first=state.steps < 0)},
            "an episode ends where it says",
            "step 6: `first` is [False",
        ),
    ],
)
def test_a_fault_of_a_task_is_found(
    changed: dict[str, Any], check: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipelines.conformance.tasks.ALGORITHMS", {})
    monkeypatch.setitem(ENVS, "toy", Task(toy.Config, toy))
    assert faults(check_task("toy", {})) == {}
    monkeypatch.setitem(ENVS, "toy", Task(toy.Config, Physics(**changed)))  # type: ignore[arg-type]
    found = faults(check_task("toy", {}))
    assert said in found[check]


def test_settings_of_the_task_are_taken() -> None:
    with pytest.raises(ValueError, match="agents"):
        list(check_task("navigation", {"agents": 0}))
