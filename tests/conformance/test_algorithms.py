"""What every method of the table must do, on both encoders and both tasks; and RHMC in its variants."""

import io
from itertools import product
from typing import Any, NamedTuple

import pytest
import torch
from torch import Generator, Tensor
from torch.nn import functional
from torch.overrides import TorchFunctionMode

from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS, coverage, make_env, navigation
from rhmc.envs.base import Env
from rhmc.trainer import Config, Trainer
from rhmc.types import Obs, Transition
from tests import toy
from tests.conformance import DifferentError, assert_same

EPISODE = 7  # of both tasks here, so that runs of a few steps cross its end
SMALL = {"hidden": 8, "buffer": 20, "batch": 8, "batch_h": 8, "warmup": 12, "steps_per_update": 4}
RUN = Config(steps=44, num_envs=4, evaluations=5, eval_episodes=2, final_episodes=2)  # ends at steps 12 20 28 36 44
TASKS: dict[str, Any] = {
    "coverage": coverage.Config(agents=2, targets=3),
    "navigation": navigation.Config(agents=2, episode=EPISODE),
}
VARIANTS: dict[str, dict[str, Any]] = {  # of rhmc, beside its defaults
    "none": {"regulator": "none", "filter": "off"},
    "exact": {"regulator": "exact", "horizon": 2, "coordinator": "counterfactual", "executor": "expected"},
    "period 3": {"assignment_period": 3},
    "period 3 counterfactual": {"assignment_period": 3, "coordinator": "counterfactual", "regulator": "exact"},
}


class Case(NamedTuple):
    """A method with its settings on a task."""

    algo: Any
    env: Any


def settle(kind: str, **changes: Any) -> Any:
    """A small version of a method; settings that it does not have are left out."""
    config = ALGORITHMS[kind].config
    return config(**{k: v for k, v in SMALL.items() if k in config.model_fields} | changes)


BASIC = {
    f"{kind}-{encoder}-{task}": Case(settle(kind, encoder=encoder), env)
    for kind, encoder, (task, env) in product(ALGORITHMS, ("mlp", "pairwise"), TASKS.items())
}
CASES = BASIC | {
    f"rhmc {name}-{task}": Case(settle("rhmc", encoder="pairwise", **changes), env)
    for (name, changes), (task, env) in product(VARIANTS.items(), TASKS.items())
}
basic = pytest.mark.parametrize("case", BASIC.values(), ids=BASIC)
every = pytest.mark.parametrize("case", CASES.values(), ids=CASES)


@pytest.fixture(autouse=True)
def _short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(coverage.PRESETS, "flat", coverage.PRESETS["flat"]._replace(episode=EPISODE))
    monkeypatch.setitem(ENVS, "toy", (toy.Config, toy))


def trainer(case: Case, seed: int = 0) -> Trainer:
    return Trainer(case.env, case.algo, RUN, seed)


def through_a_file(state: Any) -> Any:
    """What a checkpoint is after it was written and read, by the reader that runs no code."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


# Resume


class Whole(NamedTuple):
    """A run without interruption: what it said and was at every point of its grid."""

    metrics: list[dict[str, float]]
    states: list[Any]


def whole(case: Case) -> Whole:
    run, metrics, states = trainer(case), [], []
    for item in run:
        metrics.append(item)
        states.append(through_a_file(run.state_dict()))
    return Whole(metrics, states)


@every
def test_a_run_continues_from_any_point_bit_for_bit(case: Case) -> None:
    """In a fresh trainer of another seed, so that nothing can come from anywhere but the checkpoint."""
    full = whole(case)
    for point, state in enumerate(full.states[:-1]):
        run = trainer(case, seed=99)
        run.load_state_dict(through_a_file(state))  # a copy: what training changes in place is looked at again
        assert assert_same(run.state_dict(), state) > 40
        rest = list(run)
        assert rest == full.metrics[point + 1 :]
        assert_same(run.state_dict(), full.states[-1])


@basic
def test_a_checkpoint_replaces_whatever_a_trainer_was_doing(case: Case) -> None:
    full, run = whole(case), trainer(case, seed=5)
    list(run)
    run.load_state_dict(full.states[2])
    assert list(run) == full.metrics[3:]
    assert_same(run.state_dict(), full.states[-1])


@every
def test_the_runs_that_are_resumed_go_through_what_they_should(case: Case) -> None:
    """Episodes end, replays wrap around, networks are updated, periods of several steps are cut by the grid."""
    full = whole(case)
    names = [key for key in full.states[-1]["algorithm"] if "replay" in key]
    assert names
    for key in names:
        replay = full.states[-1]["algorithm"][key]
        assert 0 < replay["size"] <= 20
    assert any(full.states[-1]["algorithm"][key]["size"] == 20 for key in names)
    assert full.states[-1]["algorithm"]["updates"] == 8  # (44 - 12) / 4
    assert not any("train/grad_norm" in m or "train/low_td" in m for m in full.metrics[:1])
    assert all(torch.isfinite(torch.tensor(list(m.values()))).all() for m in full.metrics)
    for before, after in zip(full.states, full.states[1:], strict=False):
        with pytest.raises(DifferentError):
            assert_same(before["algorithm"], after["algorithm"])
    if getattr(case.algo, "assignment_period", 1) == 3:
        ages = {int(age) for state in full.states[1:] for age in state["carry"]["age"]}
        assert {1, 2} & ages
        lengths = {float(x) for state in full.states[1:] for x in state["algorithm"]["pending"]["length"]}
        assert {1.0, 2.0} & lengths


def test_a_run_without_a_step_continues_too() -> None:
    case = next(iter(CASES.values()))
    run, other = trainer(case), trainer(case, seed=1)
    other.load_state_dict(through_a_file(run.state_dict()))
    assert list(run) == list(other)
    assert_same(run.state_dict(), other.state_dict())


# The comparison itself


@pytest.fixture
def state() -> Any:
    run = trainer(CASES["iql-mlp-navigation"])
    for _ in range(3):
        next(run)
    return through_a_file(run.state_dict())


def holders(state: Any) -> list[Any]:
    """Every dict and list inside a state, itself included."""
    inner = state.values() if isinstance(state, dict) else state
    return [state] + [h for x in inner if isinstance(x, dict | list) for h in holders(x)]


def places(state: Any) -> list[tuple[Any, Any]]:
    """Every dict or list inside a state with every key or index of it."""
    return [(h, key) for h in holders(state) for key in (list(h) if isinstance(h, dict) else range(len(h)))]


def test_the_comparison_passes_a_copy(state: Any) -> None:
    assert assert_same(state, through_a_file(state)) > 60
    small: Any = {"a": [1, torch.zeros(2)], "b": (None, "x", 2.5)}
    assert assert_same(small, {"a": [1, torch.zeros(2)], "b": (None, "x", 2.5)}) == 5
    assert assert_same(torch.tensor(torch.nan), torch.tensor(torch.nan)) == 1


def test_the_comparison_sees_the_smallest_change_of_any_value(state: Any) -> None:
    """One unit in the last place of the last element of each tensor in turn, one of each number."""
    whole, changed = through_a_file(state), 0
    other: Any
    for holder, key in places(state):
        value = holder[key]
        if isinstance(value, Tensor) and value.numel():
            other = value.clone()
            last = other.view(-1)[-1:]
            last.copy_(torch.nextafter(last, last + 1) if value.is_floating_point() else last ^ 1)
        elif isinstance(value, bool | int | float):
            other = not value if isinstance(value, bool) else value + 1e-9 if isinstance(value, float) else value + 1
        else:
            continue
        holder[key] = other
        with pytest.raises(DifferentError, match="state"):
            assert_same(whole, state)
        holder[key] = value
        changed += 1
    assert changed > 50
    assert_same(whole, state)


def test_the_comparison_misses_no_missing_key(state: Any) -> None:
    whole, missed = through_a_file(state), 0
    for holder, key in places(state):
        if isinstance(holder, dict):
            kept = dict(holder)
            del holder[key]
            for pair in ((whole, state), (state, whole)):
                with pytest.raises(DifferentError):
                    assert_same(*pair)
            holder.clear()
            holder.update(kept)
            missed += 1
    assert missed > 60
    assert_same(whole, state)


@pytest.mark.parametrize("path", [("act_rng",), ("env", "rng"), ("algorithm", "rng")], ids=".".join)
def test_the_comparison_sees_one_draw_of_a_generator(state: Any, path: tuple[str, ...]) -> None:
    whole, holder = through_a_file(state), state
    for key in path[:-1]:
        holder = holder[key]
    rng = Generator()
    rng.set_state(holder[path[-1]])
    torch.rand(1, generator=rng)
    holder[path[-1]] = rng.get_state()
    with pytest.raises(DifferentError, match=".".join(path)):
        assert_same(whole, state)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (torch.zeros(3), torch.zeros(3, dtype=torch.float64)),
        (torch.zeros(3), torch.zeros(3, 1)),
        (torch.zeros(3), torch.zeros(1)),
        (torch.tensor(0.0), torch.tensor(-0.0)),
        (torch.zeros(0), torch.zeros(0, 2)),
        (1, 1.0),
        (1, True),
        (0.0, None),
        ([1], (1,)),
        ([1, 2], [1]),
        ({"a": 1, "b": 2}, {"b": 2, "a": 1}),
    ],
    ids=str,
)
def test_the_comparison_is_strict_about_kinds(a: Any, b: Any) -> None:
    with pytest.raises(DifferentError):
        assert_same(a, b)


def test_the_comparison_refuses_what_is_no_part_of_a_checkpoint() -> None:
    with pytest.raises(TypeError, match=r"state\.rng"):
        assert_same({"rng": Generator()}, {"rng": Generator()})


# Acting


def build(algo: Any, env: Env, num_envs: int = 4) -> Any:
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return ALGORITHMS[algo.kind].build(algo, env.spec, num_envs, Generator().manual_seed(2))


def world(cfg: Any, batch: int = 4, seed: int = 0) -> tuple[Env, Obs]:
    env = make_env(cfg, batch, Generator().manual_seed(seed))
    obs = env.reset()
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        for _ in range(3):  # away from the start: velocities, moves
            obs = env.step(torch.randint(env.spec.actions, (batch, env.spec.agents))).obs
    return env, obs._replace(first=torch.ones(batch, dtype=torch.bool))


def seeded(seed: int = 3) -> Generator:
    return Generator().manual_seed(seed)


@every
@pytest.mark.parametrize("explore", [False, True])
def test_actions_are_actions_and_nothing_given_is_changed(case: Case, explore: bool) -> None:
    env, obs = world(case.env, batch=6)
    algo = build(case.algo, env)
    carry = algo.carry(6)
    given = through_a_file({"obs": obs._asdict(), "carry": carry, "algo": algo.state_dict()})
    action, after, extra = algo.act(obs, carry, seeded(), explore=explore)
    assert action.shape == (6, env.spec.agents)
    assert action.dtype == torch.int64
    assert action.min() >= 0
    assert action.max() < env.spec.actions
    assert_same(through_a_file({"obs": obs._asdict(), "carry": carry, "algo": algo.state_dict()}), given)
    assert {k: v.shape for k, v in after.items()} == {k: v.shape for k, v in carry.items()}
    assert all(len(v) == 6 and not v.requires_grad for v in (*after.values(), *extra.values()))


@every
def test_greedy_acting_is_not_random_and_exploring_is_decided_by_the_generator(case: Case) -> None:
    env, obs = world(case.env, batch=64)
    algo = build(case.algo, env)

    def act(seed: int, explore: bool) -> Tensor:
        return algo.act(obs, algo.carry(64), seeded(seed), explore=explore)[0]

    assert torch.equal(act(0, False), act(1, False))
    assert torch.equal(act(0, True), act(0, True))
    assert not torch.equal(act(0, True), act(1, True))
    assert not torch.equal(act(0, True), act(0, False))
    assert act(0, True).unique().tolist() == list(range(env.spec.actions))


def reorder(obs: Obs, order: list[int]) -> Obs:
    return Obs(obs.agents[:, order], obs.pairs[:, order], obs.peers[:, order][:, :, order], obs.first)


EXTENDED: list[Any] = [
    coverage.Config(agents=4, targets=5, observation="extended"),
    navigation.Config(agents=4, observation="extended", episode=EPISODE),
]


@pytest.mark.parametrize("kind", ALGORITHMS)
@pytest.mark.parametrize("cfg", EXTENDED, ids=lambda cfg: cfg.kind)
def test_reordering_agents_reorders_what_they_do(kind: str, cfg: Any) -> None:
    env, obs = world(cfg, batch=30)
    order, lively = [2, 0, 3, 1], 0
    for seed in range(12):  # many random networks do the same whatever they see
        algo = build(settle(kind, encoder="pairwise"), env)
        state = through_a_file(algo.state_dict())
        torch.manual_seed(seed)
        _shift(state, 1.0)
        algo.load_state_dict(state)
        (action, _, extra), (moved, _, told) = (
            algo.act(x, algo.carry(30), seeded(), explore=False) for x in (obs, reorder(obs, order))
        )
        done = [(action, moved)] + [(extra[key], told[key]) for key in extra.keys() & {"assignment"}]
        assert all(torch.equal(after, before[:, order]) for before, after in done)
        lively += all(not torch.equal(before, before[:, order]) for before, _ in done)
    assert lively


@pytest.mark.parametrize("kind", ALGORITHMS)
@pytest.mark.parametrize("cfg", EXTENDED, ids=lambda cfg: cfg.kind)
def test_pairwise_weights_act_for_another_number_of_agents_and_targets(kind: str, cfg: Any) -> None:
    sizes = {"agents": 3, "targets": 2} if cfg.kind == "coverage" else {"agents": 3}
    algo = settle(kind, encoder="pairwise")
    small, large = world(cfg.model_copy(update=sizes))[0], world(cfg)[0]
    trained, other = build(algo, small), build(algo, large)
    torch.manual_seed(0)
    state = through_a_file(trained.state_dict())
    _shift(state)
    other.load_state_dict(state)
    assert_same(through_a_file(other.state_dict()), state)
    _, obs = world(cfg)
    action, _, extra = other.act(obs, other.carry(4), seeded(), explore=False)
    assert action.shape == (4, 4)
    doubled = obs._replace(pairs=obs.pairs.repeat(1, 1, 2, 1))  # means and maxima over targets do not see this
    wide = make_env(cfg.model_copy(update={"targets": 10}), 4, seeded()) if cfg.kind == "coverage" else None
    if wide:
        widest = build(algo, wide)
        widest.load_state_dict(state)
        again, _, more = widest.act(doubled, widest.carry(4), seeded(), explore=False)
        assert torch.equal(again, action)
        for key in extra.keys() & {"assignment"}:
            assert torch.equal(more[key], extra[key].repeat(1, 1, 2))


def _shift(state: Any, size: float = 0.1) -> None:
    """Weights that no construction would draw."""
    for holder, key in places(state):
        value = holder[key]
        if isinstance(value, Tensor) and value.is_floating_point() and value.dim() > 1:
            holder[key] = value + size * torch.randn_like(value)


# Learning targets


class Targets(TorchFunctionMode):
    """Watches every squared error: whether its two sides carry a gradient, and the second side."""

    def __init__(self) -> None:
        super().__init__()
        self.sides: list[tuple[bool, bool]] = []
        self.values: list[Tensor] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is functional.mse_loss:
            prediction, target = args[:2]
            self.sides.append((prediction.requires_grad, target.requires_grad))
            self.values.append(target.detach().clone())
        return func(*args, **(kwargs or {}))


def transition(env: Env, obs: Obs, algo: Any, **changes: Any) -> Transition:
    """One acted step, with some of what came of it replaced."""
    action, _, extra = algo.act(obs, algo.carry(env.batch), seeded(), explore=True)
    options = env.options()
    s = env.step(action, extra.get("assignment"))
    t = Transition(obs, action, s.reward, s.local, s.completed, s.terminal, s.truncated, s.final_obs, options, extra)
    return t._replace(**changes)


def learn(case: Case, **changes: Any) -> tuple[Targets, Any]:
    """The targets of a first update on the rows of one step of one environment."""
    env, obs = world(case.env, batch=1)
    algo = build(case.algo.model_copy(update={"warmup": 0, "steps_per_update": 1}), env, 1)
    algo.observe(transition(env, obs, algo, **changes))
    with Targets() as watched:
        algo.update()
    assert watched.sides
    return watched, algo


FLAG = torch.tensor([True])
ONE_STEP = {name: case for name, case in CASES.items() if "period" not in name}


@pytest.mark.parametrize("case", ONE_STEP.values(), ids=ONE_STEP)
def test_targets_carry_no_gradient(case: Case) -> None:
    watched, algo = learn(case)
    assert set(watched.sides) == {(True, False)}
    slow = [p for name, p in parameters(algo) if "slow" in name]
    assert slow
    assert all(p.grad is None and not p.requires_grad for p in slow)


def parameters(algo: Any, name: str = "") -> list[tuple[str, Tensor]]:
    """Parameters of every network that hangs on a method, with the names that lead there."""
    if isinstance(algo, torch.nn.Module):
        return [(f"{name}.{key}", p) for key, p in algo.named_parameters()]
    inner = vars(algo).items() if type(algo).__module__.startswith("rhmc") and hasattr(algo, "__dict__") else ()
    return [found for key, value in inner if key != "cfg" for found in parameters(value, f"{name}.{key}")]


@pytest.mark.parametrize("case", ONE_STEP.values(), ids=ONE_STEP)
def test_truncation_bootstraps_and_termination_does_not(case: Case) -> None:
    going, cut, over = (learn(case, **flags)[0].values for flags in ({}, {"truncated": FLAG}, {"terminal": FLAG}))
    assert all(torch.equal(a, b) for a, b in zip(going, cut, strict=True))
    assert not any(torch.equal(a, b) for a, b in zip(going, over, strict=True))


@pytest.mark.parametrize("case", ONE_STEP.values(), ids=ONE_STEP)
def test_a_terminal_row_is_worth_its_reward(case: Case) -> None:
    """So the targets of a last step do not depend on what is observed after it; others do."""
    _, obs = world(case.env, batch=1)
    elsewhere = obs._replace(pairs=obs.pairs + 1)
    for flags, equal in (({"terminal": FLAG}, True), ({"truncated": FLAG}, False), ({}, False)):
        here, there = (learn(case, **flags, next_obs=after)[0].values for after in (obs, elsewhere))
        assert [torch.equal(a, b) for a, b in zip(here, there, strict=True)] == [equal] * len(here)


def constant(net: Any, out: list[float]) -> None:
    """Makes a network return `out` whatever it sees."""
    weights = list(net.parameters())
    with torch.no_grad():
        for p in weights:
            p.zero_()
        weights[-1].copy_(torch.tensor(out).expand_as(weights[-1].view(-1, len(out))).reshape(-1))


@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
@pytest.mark.parametrize("terminal", [False, True])
def test_iql_target_by_hand(encoder: str, terminal: bool) -> None:
    """Double Q: the network chooses action 2, the slow copy values it at 30."""
    algo = settle("iql", encoder=encoder, warmup=0, steps_per_update=1, gamma=0.5)
    env, obs = world(TASKS["coverage"], batch=1)
    method = build(algo, env, 1)
    constant(method.q.net, [0.0, 1.0, 2.0])
    constant(method.q.slow, [50.0, 40.0, 30.0])
    flags = {"terminal": torch.tensor([terminal]), "reward": torch.tensor([0.25]), "action": torch.tensor([[1, 0]])}
    method.observe(transition(env, obs, method, **flags))
    with Targets() as watched:
        logs = method.update()
    target = 0.25 if terminal else 0.25 + 0.5 * 30
    assert torch.allclose(watched.values[0], torch.full((8, 2), target))
    assert logs["td_loss"].item() == pytest.approx(((1 - target) ** 2 + target**2) / 2)


# Learning


LEARNING = {  # of the tiny task; the rest are a method's defaults
    "lr": 5e-3,
    "hidden": 32,
    "polyak": 0.95,
    "gamma": 0.8,
    "gamma_l": 0.8,
    "gamma_h": 0.0,
    "batch": 64,
    "batch_h": 64,
    "warmup": 300,
    "steps_per_update": 32,
    "epsilon_steps": 4000,
    "horizon": 3,
    "coordinator": "counterfactual",
    "regulator": "exact",
    "assignment_period": 1,
}


@pytest.mark.parametrize("encoder", ["mlp", "pairwise"])
@pytest.mark.parametrize("kind", ALGORITHMS)
def test_every_method_learns_the_tiny_task(kind: str, encoder: str) -> None:
    """To 85 % of what two agents earn that go for a target each; acting at random earns about a third of it."""
    config = ALGORITHMS[kind].config
    known = {k: v for k, v in LEARNING.items() if k in config.model_fields}
    run = Trainer(
        toy.Config(),  # type: ignore[arg-type]
        config(**known | {"encoder": encoder}),
        Config(steps=12_000, num_envs=32, evaluations=1, eval_episodes=300, final_episodes=1),
        seed=0,
    )
    first, last = (item["eval/return"] for item in run)
    assert first < 0.5 * toy.own_target()
    assert last > 0.85 * toy.own_target()
