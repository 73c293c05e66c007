"""The requirements on every method of the table, on both encoders and both tasks; and RHMC in its variants."""

from collections.abc import Iterator
from functools import cache
from itertools import islice, product
from operator import attrgetter
from typing import Any, NamedTuple

import pytest
import torch
from torch import Generator, Tensor
from torch.nn import functional
from torch.overrides import TorchFunctionMode

from pipelines.conformance import checks, toy
from pipelines.conformance.blocks import fitted, nested
from pipelines.conformance.checks import reordered, seeded, through_a_file
from pipelines.conformance.same import DifferentError, assert_same
from pipelines.specs.document import settings
from pipelines.tracking.plan import flatten
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS, Task, coverage, make_env, navigation
from rhmc.envs.base import Env
from rhmc.learning.learner import Learner, Replay
from rhmc.networks.nets import Unshared
from rhmc.training.trainer import Config, Trainer
from rhmc.types import Batch, Obs, Transition
from tests.depth import covering
from tests.support import copied

EPISODE = 7  # of both tasks here, so that runs of a few steps cross its end
SMALL = checks.SMALL | {"assignment_period": 1}
RUN = Config(steps=36, num_envs=4, evaluations=4, eval_episodes=2, final_episodes=2)  # ends at steps 12 20 28 36
LONGER = checks.RUN  # ends at steps 12 20 28 36 44: where a coordinator first learns at step 44
TASKS: dict[str, Any] = {
    "coverage": coverage.Config(agents=2, targets=3),
    "navigation": navigation.Config(agents=2, episode=EPISODE),
}
CONTINUOUS = navigation.Config(agents=2, episode=EPISODE, continuous=True)
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {  # beside the defaults, on both tasks
    "rhmc none": ("rhmc", {"regulator": "none", "filter": "off"}),
    "rhmc exact": (
        "rhmc",
        {"regulator": "exact", "horizon": 2, "coordinator.gradient": "counterfactual", "executor.method": "expected"},
    ),
    "rhmc qmix": ("rhmc", {"executor.method": "qmix", "executor.reward": "team", "executor.epsilon": 0.5}),
    "rhmc qmix, scaled": (
        "rhmc",
        {
            "executor.method": "qmix",
            "executor.epsilon": 0.5,
            "executor.standardise": "reward",
            "coordinator.standardise": "return",
        },
    ),
    "rhmc untold": (
        "rhmc",
        {"filter": "off", "executor.told": "filtered", "executor.critic_sees": "none", "unassigned": "charged"},
    ),
    "rhmc scaled": ("rhmc", {"executor.standardise": "return", "coordinator.standardise": "reward"}),
    "rhmc period 3": ("rhmc", {"assignment_period": 3}),
    "rhmc period 3 counterfactual": (
        "rhmc",
        {"assignment_period": 3, "coordinator.gradient": "counterfactual", "regulator": "exact"},
    ),
    "hitmac untold": ("hitmac", {"filter": "off", "executor.told": "filtered", "executor.critic_sees": "none"}),
    "hitmac period 3": ("hitmac", {"assignment_period": 3, "coordinator.n_steps": 2}),
    "mappo kl_adaptive": ("mappo", {"objective": "kl_adaptive"}),
    "coma critic": ("coma", {"advantage_estimator": "critic"}),
}
SCALES = ("none", "reward", "return")
ENCODERS = ("mlp", "pairwise")


class Case(NamedTuple):
    """A method with its settings on a task."""

    algo: Any
    env: Any


def settle(kind: str, **changes: Any) -> Any:
    """A small version of a method; settings that it does not have are left out."""
    config = ALGORITHMS[kind].config
    return config(**nested(fitted(config, SMALL) | changes))


BASIC = {
    f"{kind}-{encoder}-{task}": Case(settle(kind, encoder=encoder), env)
    for kind, encoder, (task, env) in covering(ALGORITHMS, ENCODERS, TASKS.items())
}
BASIC |= {
    f"{kind}-{encoder}-continuous": Case(settle(kind, encoder=encoder), CONTINUOUS)
    for kind, encoder in covering(
        [kind for kind in ALGORITHMS if "continuous" in ALGORITHMS[kind].about.actions], ENCODERS
    )
}
UNSHARED = {f"{kind} unshared": Case(settle(kind, share=False), TASKS["navigation"]) for kind in ALGORITHMS}
SCALE = {  # RHMC has one for each level, in variants of its own
    kind: name
    for kind, name in product(ALGORITHMS, ("standardise", "coordinator.standardise"))
    if kind != "rhmc" and name in settings(ALGORITHMS[kind].config)
}


def other_scales(kind: str) -> list[str]:
    """Those that are not the method's default."""
    return [scale for scale in SCALES if scale != attrgetter(SCALE[kind])(ALGORITHMS[kind].config())]


SCALED = {
    f"{kind} {scale}": Case(settle(kind, **{SCALE[kind]: scale}), TASKS["navigation"])
    for kind, scale in ((kind, other_scales(kind)[place]) for kind, place in covering(SCALE, (0, 1)))
}
CASES = BASIC | UNSHARED | SCALED
CASES |= {
    f"{name}-{task}": Case(settle(kind, encoder="pairwise", **changes), env)
    for (name, (kind, changes)), (task, env) in covering(VARIANTS.items(), TASKS.items())
}
basic = pytest.mark.parametrize("case", BASIC.values(), ids=BASIC)
every = pytest.mark.parametrize("case", CASES.values(), ids=CASES)


@pytest.fixture(autouse=True)
def _short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(coverage.PRESETS, "flat", coverage.PRESETS["flat"]._replace(episode=EPISODE))
    monkeypatch.setitem(ENVS, "toy", Task(toy.Config, toy))


def trainer(case: Case, seed: int = 0) -> Trainer:
    late = case.algo.kind == "hitmac" and case.algo.assignment_period == 3
    return Trainer(case.env, case.algo, LONGER if late else RUN, seed)


# Resume


class Whole(NamedTuple):
    """A run without interruption: what it said and was at every point of its grid."""

    metrics: list[dict[str, float]]
    states: list[Any]


@cache
def whole(case: Case) -> Whole:
    """Of seed 0. Hand its states on as copies: what is loaded may be changed in place."""
    run, metrics, states = trainer(case), [], []
    for item in run:
        metrics.append(item)
        states.append(through_a_file(run.state_dict()))
    return Whole(metrics, states)


@every
def test_a_run_continues_from_any_point_bit_for_bit(case: Case) -> None:
    """In a fresh trainer of another seed, so that nothing can come from anywhere but the checkpoint.

    From each point to the next, and from the first to the end: as whole states are compared, so is all that follows.
    """
    full = whole(case)
    last = len(full.states) - 1
    for point, state in enumerate(full.states[:-1]):
        run, end = trainer(case, seed=99), last if point == 0 else point + 1
        run.load_state_dict(copied(state))  # what training changes in place is looked at again
        assert assert_same(run.state_dict(), state) > 40
        assert list(islice(run, end - point)) == full.metrics[point + 1 : end + 1]
        assert_same(run.state_dict(), full.states[end])


@basic
def test_a_checkpoint_replaces_whatever_a_trainer_was_doing(case: Case) -> None:
    full, run = whole(case), trainer(case, seed=5)
    list(run)
    run.load_state_dict(copied(full.states[2]))
    assert list(run) == full.metrics[3:]
    assert_same(run.state_dict(), full.states[-1])


@every
def test_the_runs_that_are_resumed_go_through_what_they_should(case: Case) -> None:
    """Episodes end, replays wrap around, networks are updated, periods and rollouts are cut by the grid."""
    full = whole(case)
    algorithms = [state["algorithm"] for state in full.states]
    replays, rollouts = (having(algorithms[-1], keys) for keys in ({"rows", "next", "size"}, {"rows"}))
    assert replays or rollouts
    if replays:  # a replay that is dropped after 5 steps of 4 environments is seen after 3, and all updates are due
        most, updates = (12, 3) if "pretrain" in type(case.algo).model_fields else (20, 7)  # (20 or 36 - 8) / 4
        assert max(r["size"] for state in algorithms for r in having(state, {"rows", "next", "size"})) == most
        assert [paced["updates"] for paced in having(algorithms[-1], {"replay", "steps", "updates"})] == [updates]
    if rollouts:
        assert {len(rollout["rows"]) for state in algorithms for rollout in having(state, {"rows"})} == {0, 1, 2}
    if decided := [kept["count"].tolist() for state in algorithms for kept in having(state, {"rows", "count"})]:
        assert [] in decided
        assert [1] * 4 in decided
    nets = [having(state, {"net", "target_net", "optimiser"}) for state in algorithms]
    assert len(nets[0]) == len(learners(trainer(case).algorithm)) > 0
    for before, after in zip(nets[0], nets[-1], strict=True):
        assert not any(torch.equal(value, after["net"][key]) for key, value in before["net"].items() if value.dim() > 1)
    assert not any(key.startswith("train/") for key in full.metrics[0])
    assert all(torch.isfinite(torch.tensor(list(m.values()))).all() for m in full.metrics)
    for before, after in zip(full.states, full.states[1:], strict=False):
        with pytest.raises(DifferentError):
            assert_same(before["algorithm"], after["algorithm"])
    if getattr(case.algo, "assignment_period", 1) == 3:
        ages = {int(age) for state in full.states[1:] for age in state["carry"]["age"]}
        assert {1, 2} & ages
        begun = [state["pending"] for state in algorithms[1:] if state["pending"]]
        lengths = {float(x) for pending in begun for x in pending["length"]}
        assert {1.0, 2.0} & lengths


def having(state: Any, keys: set[str]) -> list[Any]:
    """Every dict inside a state that has these keys and no other."""
    return [holder for holder in holders(state) if isinstance(holder, dict) and set(holder) == keys]


def learners(thing: Any) -> list[Learner[Any]]:
    """Every learner that hangs on a method."""
    if isinstance(thing, Learner):
        return [thing]
    return [found for value in parts(thing).values() for found in learners(value)]


def parts(thing: Any) -> dict[str, Any]:
    """The attributes of an object of the project, its settings aside."""
    ours = type(thing).__module__.startswith("rhmc") and hasattr(thing, "__dict__")
    return {key: value for key, value in vars(thing).items() if key != "cfg"} if ours else {}


@every
def test_a_method_names_every_network_that_learns(case: Case) -> None:
    algo = build(case.algo, world(case.env, batch=4)[0])
    assert {id(one) for one in algo.learners()} == {id(one) for one in learners(algo)}
    assert algo.learners()


def test_a_run_without_a_step_continues_too() -> None:
    case = next(iter(CASES.values()))
    run, other = trainer(case), trainer(case, seed=1)
    other.load_state_dict(through_a_file(run.state_dict()))
    assert list(run) == list(other)
    assert_same(run.state_dict(), other.state_dict())


# The comparison itself


@pytest.fixture
def state() -> Any:
    run = trainer(Case(settle("iql", encoder="mlp"), TASKS["navigation"]))
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
            obs = env.step(at_random(env)).obs
    return env, obs._replace(first=torch.ones(batch, dtype=torch.bool))


def at_random(env: Env) -> Tensor:
    """A joint action."""
    shape = (env.batch, env.spec.agents)
    if env.spec.continuous:
        return torch.rand(*shape, env.spec.actions) * 2 - 1
    return torch.randint(env.spec.actions, shape)


@every
@pytest.mark.parametrize("explore", [False, True])
def test_actions_are_actions_and_nothing_given_is_changed(case: Case, explore: bool) -> None:
    env, obs = world(case.env, batch=6)
    algo = build(case.algo, env)
    carry = algo.carry(6)
    given = copied({"obs": obs._asdict(), "carry": carry, "algo": algo.state_dict()})
    rng = seeded()
    action, after, extra = algo.act(obs, carry, rng, explore=explore)
    assert explore or torch.equal(rng.get_state(), seeded().get_state())  # greedy acting draws nothing
    assert_actions(action, env, 6)
    assert_same({"obs": obs._asdict(), "carry": carry, "algo": algo.state_dict()}, given)
    assert {k: v.shape for k, v in after.items()} == {k: v.shape for k, v in carry.items()}
    assert all(len(v) == 6 and not v.requires_grad for v in (*after.values(), *extra.values()))


def assert_actions(action: Tensor, env: Env, batch: int) -> None:
    """Discrete: (B, N) int64 below the count; continuous: (B, N, A) in [-1, 1]."""
    spec = env.spec
    if spec.continuous:
        assert (action.shape, action.dtype) == ((batch, spec.agents, spec.actions), torch.float32)
        assert action.abs().max() <= 1
    else:
        assert (action.shape, action.dtype) == ((batch, spec.agents), torch.int64)
        assert action.min() >= 0
        assert action.max() < spec.actions


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
    drawn = act(0, True)
    if env.spec.continuous:
        assert (drawn.flatten(0, 1).amin(0) < 0).all()
        assert (drawn.flatten(0, 1).amax(0) > 0).all()
    else:
        assert drawn.unique().tolist() == list(range(env.spec.actions))


EXTENDED: list[Any] = [
    coverage.Config(agents=4, targets=5, observation="extended"),
    coverage.Config(agents=4, targets=5, observation="extended_own"),
    navigation.Config(agents=4, observation="extended", episode=EPISODE),
]
extended = pytest.mark.parametrize(
    ("kind", "cfg"),
    [
        pytest.param(*case, id=f"{case[1].kind}-{case[1].observation}-{case[0]}")
        for case in covering(ALGORITHMS, EXTENDED)
    ],
)


@extended
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
            algo.act(x, algo.carry(30), seeded(), explore=False) for x in (obs, reordered(obs, order))
        )
        done = [(action, moved)] + [(extra[key], told[key]) for key in extra.keys() & {"assignment"}]
        assert all(torch.equal(after, before[:, order]) for before, after in done)
        lively += all(not torch.equal(before, before[:, order]) for before, _ in done)
    assert lively


@extended
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


LOSSES = (functional.mse_loss, functional.huber_loss, functional.smooth_l1_loss, functional.l1_loss)
# Rows of one step, seen once and as they are: what a loss is handed is then known.
PLAIN = {"learning_starts": 0, "train_freq": 1, "n_steps": 1, "epochs": 1, "minibatches": 1, "standardise": "none"}
PLAIN |= {"pretrain": 0, "assignment_period": 1}
FLAG = torch.tensor([True])


class Targets(TorchFunctionMode):
    """Watches every error that is learned from: whether its two sides carry a gradient, and the second side."""

    def __init__(self) -> None:
        super().__init__()
        self.sides: list[tuple[bool, bool]] = []
        self.values: list[Tensor] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in LOSSES:
            prediction, target = args[:2]
            self.sides.append((prediction.requires_grad, target.requires_grad))
            self.values.append(target.detach().clone())
        return func(*args, **(kwargs or {}))


def plain(algo: Any, **changes: Any) -> Any:
    """A method's settings with those of `PLAIN` and `changes` that it has."""
    config = type(algo)
    return config(**nested(flatten(algo.model_dump()) | fitted(config, PLAIN | changes)))


def transition(env: Env, obs: Obs, algo: Any, **changes: Any) -> Transition:
    """One acted step, with some of what came of it replaced."""
    action, _, extra = algo.act(obs, algo.carry(env.batch), seeded(), explore=True)
    options = env.options()
    s = env.step(action, extra.get("assignment"))
    t = Transition(obs, action, s.reward, s.local, s.completed, s.terminated, s.truncated, s.final_obs, options, extra)
    return t._replace(**changes)


PRETRAINED = [kind for kind in ALGORITHMS if "pretrain" in ALGORITHMS[kind].config.model_fields]


def learn(case: Case, **changes: Any) -> tuple[Targets, Any]:
    """The targets of a first update on the rows of one step of one environment."""
    env, obs = world(case.env, batch=1)
    algo = build(case.algo, env, 1)
    with torch.no_grad():
        algo.observe(transition(env, obs, algo, **changes))
    with Targets() as watched:
        algo.update()
    assert watched.sides
    return watched, algo


ONE_STEP = {
    name: Case(plain(case.algo), case.env)
    for name, case in CASES.items()
    if "period" not in name and case not in SCALED.values()
} | {f"{kind} before the rest": Case(plain(settle(kind), pretrain=99), TASKS["coverage"]) for kind in PRETRAINED}
one_step = pytest.mark.parametrize("case", ONE_STEP.values(), ids=ONE_STEP)


@one_step
def test_targets_carry_no_gradient(case: Case) -> None:
    watched, algo = learn(case)
    assert set(watched.sides) == {(True, False)}
    assert all(p.grad is None and not p.requires_grad for p in slow_parameters(algo))


def slow_parameters(algo: Any) -> list[Tensor]:
    """Of the copies that targets come from; those of a learner that never follow are none."""
    found = [p for learner in learners(algo) for p in learner.target_net.parameters()]
    assert found
    return found


@one_step
def test_no_loss_has_a_gradient_into_what_is_observed_afterwards(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever a loss is made of: its way to the next observation would go through a target."""
    env, obs = world(case.env, batch=1)
    algo = build(case.algo, env, 1)
    with torch.no_grad():
        algo.observe(transition(env, obs, algo))
    rows: Batch = {}

    def traced(take: Any) -> Any:
        def taken(*args: Any) -> Any:
            found = take(*args)
            kept = {k: v.requires_grad_() if v.is_floating_point() else v for k, v in (found or {}).items()}
            rows.update(kept)
            return found and kept

        return taken

    update, into = Learner.update, []

    def watch(self: Learner[Any], loss: Tensor) -> Tensor:
        names = [key for key in rows if key.removeprefix("next_") in ("pairs", "agents", "peers") and rows[key].numel()]
        grads = torch.autograd.grad(loss, [rows[key] for key in names], retain_graph=True, allow_unused=True)
        into.append({key for key, grad in zip(names, grads, strict=True) if grad is not None})
        return update(self, loss)

    for kept, name in product(parts(algo).values(), ("sample", "take")):
        if hasattr(kept, name):
            monkeypatch.setattr(kept, name, traced(getattr(kept, name)))
    monkeypatch.setattr(Replay, "sample", traced(Replay.sample))
    monkeypatch.setattr(Learner, "update", watch)
    algo.update()
    assert into
    assert {"pairs", "next_pairs"} <= set(rows)
    assert not any(name.startswith("next_") for names in into for name in names)
    assert case in ON_POLICY.values() or all("pairs" in names for names in into)


@one_step
def test_truncation_bootstraps_and_termination_does_not(case: Case) -> None:
    going, cut, over = (learn(case, **flags)[0].values for flags in ({}, {"truncated": FLAG}, {"terminated": FLAG}))
    assert all(torch.equal(a, b) for a, b in zip(going, cut, strict=True))
    assert not any(torch.equal(a, b) for a, b in zip(going, over, strict=True))


@one_step
def test_a_terminal_row_is_worth_its_reward(case: Case) -> None:
    """So the targets of a last step do not depend on what is observed after it; others do."""
    _, obs = world(case.env, batch=1)
    elsewhere = obs._replace(pairs=obs.pairs + 1)
    for flags, equal in (({"terminated": FLAG}, True), ({"truncated": FLAG}, False), ({}, False)):
        here, there = (learn(case, **flags, next_obs=after)[0].values for after in (obs, elsewhere))
        assert [torch.equal(a, b) for a, b in zip(here, there, strict=True)] == [equal] * len(here)


ON_POLICY = {
    name: case
    for name, case in ONE_STEP.items()
    if {"n_steps", "coordinator.n_steps"} & set(settings(type(case.algo))) and getattr(case.algo, "pretrain", 0) == 0
}


@pytest.mark.parametrize(("name", "flag"), covering(ON_POLICY, ("terminated", "truncated", None)))
def test_a_sequence_stops_where_an_episode_ends(name: str, flag: str | None) -> None:
    """The next episode does not affect the step before; within an episode it is."""
    case = ON_POLICY[name]
    env, obs = world(case.env, batch=1)
    found = []
    for shift in (0.0, 1.0):
        algo = build(plain(case.algo, n_steps=2), env, 1)
        start = obs._replace(pairs=obs.pairs + shift)
        with torch.no_grad():
            first = transition(env, obs, algo, next_obs=obs, reward=torch.ones(1), **({flag: FLAG} if flag else {}))
            algo.observe(first)
            second = transition(env, start, algo, reward=torch.tensor([3 + shift]))
            algo.observe(second._replace(next_obs=start))
        with Targets() as watched:
            algo.update()
        found.append({tuple(row) for row in watched.values[0].view(2, -1).tolist()})
    assert len(found[0]) == 2
    assert len(found[0] & found[1]) == (0 if flag is None else 1)


# Learning


LEARNING = {  # of the tiny task; the rest are a method's defaults
    "lr": 5e-3,
    "hidden_dim": 32,
    "tau": 0.05,
    "gamma": 0.8,
    "executor.gamma": 0.8,
    "coordinator.gamma": 0.0,
    "batch_size": 64,
    "learning_starts": 300,
    "train_freq": 32,
    "epsilon_steps": 4000,
    "horizon": 3,
    "coordinator.gradient": "counterfactual",
    "regulator": "exact",
    "assignment_period": 1,
    "n_steps": 6,
}
LEARNING_OF: dict[str, dict[str, Any]] = {  # what a method needs beside or instead of that
    "maddpg": {"gamma": 0.6, "penalty": 1e-2, "batch_size": 128, "train_freq": 16},
    "coma": {"gamma": 0.6, "ent_coef": 0.05, "epsilon": 0.1, "hidden_dim": 64, "lr": 3e-3, "minibatches": 8},
    "hitmac": {"coordinator.gamma": 0.5, "hidden_dim": 64, "lr": 3e-3, "pretrain": 4000},
}
STEPS = {"coma": 18_000}  # 12 000 else


def returns(kind: str, **changes: Any) -> Iterator[float]:
    """A method's mean return in the tiny task before learning and at each 36th of its steps."""
    config = ALGORITHMS[kind].config
    wanted = LEARNING | LEARNING_OF.get(kind, {})
    known = fitted(config, wanted)
    run = Trainer(
        toy.Config(),
        config(**nested(known | changes)),
        Config(steps=STEPS.get(kind, 12_000), num_envs=32, evaluations=36, eval_episodes=300, final_episodes=1),
        seed=0,
    )
    return (item["eval/return"] for item in run)


def assert_learned(found: Iterator[float]) -> None:
    """To 85 % of what two agents earn that go for a target each; acting at random earns about a third of it.

    A run that is clearly above that before its last step need not go on.
    """
    best = toy.own_target()
    assert next(found) < 0.5 * best
    for last in found:
        if last > 0.9 * best:
            break
    assert last > 0.85 * best


@pytest.mark.parametrize(("kind", "encoder"), covering(ALGORITHMS, ENCODERS, shift=1))
def test_every_method_learns_the_tiny_task(kind: str, encoder: str) -> None:
    assert_learned(returns(kind, encoder=encoder))


@pytest.mark.parametrize(("kind", "scale"), [name.split() for name in SCALED])
def test_every_method_learns_with_every_standardisation(kind: str, scale: str) -> None:
    assert_learned(returns(kind, encoder="pairwise", **{SCALE[kind]: scale}))


@pytest.mark.parametrize(
    "changes",
    [
        {"executor.method": "qmix", "executor.reward": "team"},
        {"executor.method": "qmix", "executor.standardise": "reward", "coordinator.standardise": "reward"},
        {
            "executor.method": "qmix",
            "executor.reward": "team",
            "coordinator.reward": "team",
            "regulator": "none",
            "filter": "off",
        },
        {"executor.standardise": "reward", "coordinator.standardise": "return"},
        {"executor.standardise": "return"},
    ],
    ids=str,
)
def test_rhmc_learns_in_its_variants(changes: dict[str, Any]) -> None:
    assert_learned(returns("rhmc", encoder="pairwise", **changes))


@pytest.mark.parametrize(("kind", "encoder"), covering(ALGORITHMS, ENCODERS))
def test_unshared_agents_learn_apart_and_act_by_their_own_networks(kind: str, encoder: str) -> None:
    run = trainer(Case(settle(kind, encoder=encoder, share=False), TASKS["navigation"]))
    teams, fresh = (unshared(each.algorithm) for each in (run, trainer(Case(run.algorithm.cfg, run.env_cfg))))
    list(run)
    assert len(teams) == len(fresh) > 0
    for team, start in zip(teams, fresh, strict=True):
        assert len(team.nets) == 2
        for one, other in ((team.nets[0], team.nets[1]), *zip(team.nets, start.nets, strict=True)):
            assert not any(map(torch.equal, weights(one), weights(other)))
    before = act_greedily(run)
    with torch.no_grad():
        for p in (p for team in teams for p in team.nets[1].parameters()):
            p.add_(torch.randn(p.shape, generator=seeded()))
    changed = act_greedily(run) != before
    assert changed.any(0).tolist() == [False, True]


def weights(net: torch.nn.Module) -> list[Tensor]:
    return [p for p in net.parameters() if p.dim() > 1]


def act_greedily(run: Trainer) -> Tensor:
    """Actions (B, N) in 200 states."""
    _, obs = world(run.env_cfg, batch=200)
    return run.algorithm.act(obs, run.algorithm.carry(200), seeded(), explore=False)[0]


def unshared(algo: Any) -> list[Unshared]:
    """The networks of a method that every agent has for itself."""
    nets = [module for learner in learners(algo) for module in learner.net.modules()]
    return [module for module in nets if isinstance(module, Unshared)]


@pytest.mark.parametrize("kind", ALGORITHMS)
def test_truncation_may_be_termination_to_every_method(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    final = []
    for limit, over in ((True, False), (False, True)):
        run = Trainer(
            TASKS["navigation"], settle(kind), RUN.model_copy(update={"bootstrap_on_truncation": limit}), seed=0
        )
        met, observe = [], run.algorithm.observe
        monkeypatch.setattr(run.algorithm, "observe", lambda t, met=met, observe=observe: (met.append(t), observe(t)))
        list(run)
        assert [bool(t.truncated.all()) for t in met] == [k % EPISODE == EPISODE - 1 for k in range(9)]
        assert all(torch.equal(t.terminated, t.truncated & over) for t in met)
        final.append(torch.cat([p.flatten() for learner in learners(run.algorithm) for p in learner.params]))
    assert not torch.equal(*final)
