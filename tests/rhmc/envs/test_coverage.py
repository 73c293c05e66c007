"""Sensor coverage: beside a scalar oracle, and its own promises."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pipelines.conformance.checks import seeded
from rhmc.envs import coverage, make_env
from rhmc.envs.coverage import Config, State
from rhmc.types import Obs, Step, assigned_reward
from tests.oracles import coverage as oracle

PRESETS = ("flat", "executor", "coordinator")
WORLDS = 6  # rows in a comparison with the oracle

FEATURES = {  # by observation
    "paper": oracle.paper_features,
    "extended": oracle.extended_features,
    "extended_own": oracle.extended_own_features,
}

quick = settings(deadline=None, max_examples=15)
seeds = st.integers(0, 2**31)
presets = st.sampled_from(PRESETS)


def copy_of(rng: torch.Generator) -> torch.Generator:
    twin = torch.Generator()
    twin.set_state(rng.get_state())
    return twin


@contextmanager
def in_double() -> Iterator[None]:
    """Draw and compute in float64, so that the oracle and the batch cannot drift apart by rounding."""
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


def double(state: State) -> State:
    """The same state in float64."""
    return State(*(x.double() if x.is_floating_point() else x for x in state))


def worlds_of(state: State) -> list[oracle.World]:
    """The batch as worlds of the oracle."""
    return [
        oracle.World(
            [(x, y) for x, y in state.sensors[b].tolist()],
            state.heading[b].tolist(),
            [target_of(state, b, j) for j in range(state.speed.shape[1])],
        )
        for b in range(len(state.steps))
    ]


def target_of(state: State, b: int, j: int) -> oracle.Target:
    def point(x: Tensor) -> oracle.Point:
        return float(x[b, j, 0]), float(x[b, j, 1])

    visited = [point(state.before_last), point(state.last)] if state.moved[b, j] else []
    return oracle.Target(
        point(state.targets), point(state.goal), float(state.speed[b, j]), int(state.trip[b, j]), visited
    )


def move_worlds(worlds: list[oracle.World], dt: float, rng: torch.Generator) -> None:
    """Move all targets with the draws that the batch makes: for every target, then for those that would leave."""
    waiting = [target for world in worlds for target in world.targets]
    draws = torch.rand(len(worlds), len(worlds[0].targets), 4, generator=rng).view(-1, 4)
    while waiting:
        again = []
        for target, row in zip(waiting, draws.tolist(), strict=True):
            wish = target.decide(row, dt)
            if oracle.inside(wish):
                target.position = wish
            else:
                again.append(target)
        waiting = again
        if waiting:
            draws = torch.rand(len(waiting), 4, generator=rng)


def assert_same(state: State, worlds: list[oracle.World], atol: float) -> None:
    seen = State(*(x.double() for x in state))
    for b, world in enumerate(worlds):
        turned = torch.tensor(world.headings) - seen.heading[b]
        assert coverage.wrap(turned).abs().max() <= atol
        for j, target in enumerate(world.targets):
            assert seen.targets[b, j].tolist() == pytest.approx(target.position, abs=atol)
            assert seen.goal[b, j].tolist() == pytest.approx(target.goal, abs=1e-4)
            assert seen.last[b, j].tolist() == pytest.approx(target.visited[-1], abs=atol)
            assert seen.speed[b, j] == target.speed
            assert seen.trip[b, j] == target.counter


def per_pair(worlds: list[oracle.World], value: Any) -> Tensor:
    """value(world, i, j) for all worlds, sensors and targets."""
    return torch.tensor(
        [[[value(w, i, j) for j in range(len(w.targets))] for i in range(len(w.sensors))] for w in worlds],
        dtype=torch.float64,
    )


def still(*, sensors: list[oracle.Point], headings: list[float], targets: list[oracle.Point]) -> State:
    """One world in which nothing has moved yet."""
    t = torch.tensor(targets).unsqueeze(0)
    zero = torch.zeros(1, len(targets))
    goal = torch.zeros_like(t)
    return State(
        torch.tensor(sensors).unsqueeze(0), torch.tensor(headings).unsqueeze(0), t, goal, zero + 60, zero, t, t,
        zero.bool(), torch.zeros(1, dtype=torch.int64),
    )  # fmt: skip


# --- beside the oracle -----------------------------------------------------------------------------------------------


@given(seeds, st.sampled_from(("flat", "executor")))
@settings(deadline=None, max_examples=5)
@in_double()
def test_three_episodes_go_as_in_the_oracle(seed: int, preset: Any) -> None:
    cfg, rng = Config(preset=preset, agents=3, targets=4), seeded(seed)
    state = coverage.initial(cfg, WORLDS, rng)
    worlds = worlds_of(state)
    for _ in range(300):
        action = torch.randint(3, (WORLDS, 3), generator=seeded(seed + 1))
        twin = copy_of(rng)
        state = coverage.transition(cfg, state, action, rng)
        move_worlds(worlds, 0.3, twin)
        for world, row in zip(worlds, action.tolist(), strict=True):
            world.turn(row)
        assert torch.equal(rng.get_state(), twin.get_state())
    assert_same(state, worlds, atol=1e-4)


@given(seeds)
@settings(deadline=None, max_examples=5)
@in_double()
def test_slow_targets_move_as_in_the_oracle(seed: int) -> None:
    """At the coordinator's dt of 0.13, where many a target is redrawn for being slow."""
    rng = seeded(seed)
    state = coverage.initial(Config(preset="coordinator"), WORLDS, rng)
    worlds = worlds_of(state)
    for _ in range(300):
        twin = copy_of(rng)
        state = coverage.move_targets(0.13, state, rng)
        move_worlds(worlds, 0.13, twin)
    assert_same(state, worlds, atol=1e-4)


@given(seeds, st.integers(0, 60), presets)
@quick
def test_a_move_in_float32_is_right_to_a_centimetre(seed: int, before: int, preset: Any) -> None:
    cfg, rng = Config(preset=preset), seeded(seed)
    dt = coverage.PRESETS[cfg.preset].dt
    state = coverage.initial(cfg, WORLDS, rng)
    for _ in range(before):
        state = coverage.move_targets(dt, state, rng)
    worlds, twin = worlds_of(state), copy_of(rng)
    move_worlds(worlds, dt, twin)
    assert_same(coverage.move_targets(dt, state, rng), worlds, atol=1e-2)


@given(seeds, st.integers(1, 6), st.integers(1, 7), presets, st.booleans(), st.sampled_from((0.0, 0.1)))
@quick
def test_rewards_and_sight_are_the_oracles(
    seed: int, n: int, m: int, preset: Any, assigned: bool, penalty: float
) -> None:
    n = min(n, m)
    cfg, rng = Config(preset=preset, agents=n, targets=m, penalty=penalty), seeded(seed)
    state = double(played(cfg, WORLDS, rng, 3))
    action = torch.randint(3, (WORLDS, n), generator=rng)
    held = torch.rand(WORLDS, n, m, generator=rng) < 0.3 if assigned else torch.ones(WORLDS, n, m, dtype=torch.bool)
    out = coverage.outcome(cfg, state, action, held.long() if assigned else None)
    worlds = worlds_of(state)
    own_only = preset != "flat"
    for b, world in enumerate(worlds):
        own = held[b].tolist()
        locals_ = [oracle.local_reward(world, i, int(action[b, i]), own[i]) for i in range(n)]
        assert assigned_reward(out.local, held)[b].tolist() == pytest.approx(locals_, abs=1e-5)
        team = oracle.global_reward(world, penalty, own if own_only else [[True] * m] * n)
        expected = sum(locals_) / n if preset == "executor" else team
        assert float(out.reward[b]) == pytest.approx(expected, abs=1e-5)
        assert float(out.info["coverage"][b]) == pytest.approx(oracle.coverage(world), abs=1e-6)
    assert torch.equal(out.completed.double(), per_pair(worlds, oracle.World.sees))


@given(seeds, st.integers(1, 6), st.integers(1, 6), presets, st.integers(0, 3), st.sampled_from(tuple(FEATURES)))
@quick
def test_observations_are_the_oracles(seed: int, n: int, m: int, preset: Any, steps: int, observation: Any) -> None:
    n = min(n, m)
    cfg = Config(preset=preset, agents=n, targets=m, observation=observation)
    state = played(cfg, WORLDS, seeded(seed), steps)
    obs = coverage.observe(cfg, double(state))
    assert torch.allclose(obs.pairs.double(), per_pair(worlds_of(state), FEATURES[observation]), atol=2e-6)
    assert obs.pairs.shape == (WORLDS, n, m, coverage.spec(cfg).pair_features)
    assert (obs.agents.shape, obs.peers.shape) == ((WORLDS, n, 0), (WORLDS, n, n, 0))
    assert obs.first.tolist() == [steps == 0] * WORLDS


@given(seeds, st.integers(1, 5), st.integers(0, 12))
@quick
def test_options_are_what_turning_step_by_step_would_show(seed: int, n: int, horizon: int) -> None:
    cfg, rng = Config(agents=n), seeded(seed)
    state = double(played(cfg, WORLDS, rng, 2))
    options = coverage.options(cfg, state, horizon)
    assert options.shape == (WORLDS, n, 2 * horizon + 1, cfg.targets)
    carried_on = state.targets + horizon * (state.targets - state.last)
    ahead = state._replace(targets=carried_on.clamp(-1250, 1250))
    for action, sign in ((1, 1), (2, -1)):
        worlds = worlds_of(ahead)
        for turned in range(horizon + 1):
            expected = per_pair(worlds, oracle.World.sees)
            assert torch.equal(options[:, :, horizon + sign * turned].double(), expected)
            for world in worlds:
                world.turn([action] * n)


def played(cfg: Config, batch: int, rng: torch.Generator, steps: int) -> State:
    """A batch after some random steps."""
    state = coverage.initial(cfg, batch, rng)
    for _ in range(steps):
        state = coverage.transition(cfg, state, torch.randint(3, (batch, cfg.agents), generator=rng), rng)
    return state


# --- by hand ---------------------------------------------------------------------------------------------------------


def test_extended_features_of_a_known_scene() -> None:
    """Two sensors at one place; the target is 45 degrees off the first one's axis, which it approached along +x."""
    state = still(sensors=[(0, 0), (0, 0)], headings=[0.0, 90.0], targets=[(300.0, 300.0)])
    state = state._replace(last=torch.tensor([[[270.0, 300.0]]]), heading=torch.tensor([[0.0, 80.0]]))
    first, second = coverage.observe(Config(agents=2, targets=1, observation="extended"), state).pairs[0, :, 0]
    half = 0.5**0.5
    assert first.tolist() == pytest.approx(
        [half, half, 0.25, 0.3 * half, half, -half, 0, 1, 1, 1 - 35 / 180], abs=1e-6
    )  # turns clockwise, to the sensor's left edge; the other one sees it 35 degrees off its axis
    assert second[6:].tolist() == pytest.approx([1, 1, 0, 1 - 45 / 180], abs=1e-6)


@pytest.mark.parametrize("observation", FEATURES)
def test_what_an_observation_tells_of_other_sensors(observation: Any) -> None:
    """Nothing, but for the last two features of `extended`, which `extended_own` leaves out."""
    cfg = Config(observation=observation)
    state = played(cfg, 50, seeded(0), 3)
    turned = state._replace(heading=torch.cat((state.heading[:, :1], coverage.wrap(state.heading[:, 1:] + 90)), 1))
    before, after = (coverage.observe(cfg, one).pairs[:, 0] for one in (state, turned))
    same = (before == after).flatten(0, 1).all(0).tolist()
    assert same == [True] * 8 + [False] * 2 if observation == "extended" else all(same)
    whole = coverage.observe(Config(observation="extended"), state).pairs
    if observation == "extended_own":
        assert torch.equal(coverage.observe(cfg, state).pairs, whole[..., :8])


@pytest.mark.parametrize(
    ("heading", "target", "seen"),
    [
        (0.0, (400.0, 400.0), False),  # exactly 45 degrees: strict
        (0.0, (400.0, -400.0), False),
        (0.001, (400.0, 400.0), True),
        (-0.001, (400.0, 400.0), False),
        (0.0, (800.0, 0.0), True),  # exactly 800: inclusive
        (0.0, (800.1, 0.0), False),
        (53.0, (480.0, 640.0), True),
        (179.0, (-100.0, -1.0), True),  # across the seam of the angle
        (-180.0, (-100.0, 0.0), True),
        (0.0, (-100.0, 0.0), False),
    ],
)
def test_edges_of_sight(heading: float, target: oracle.Point, seen: bool) -> None:
    state = still(sensors=[(0.0, 0.0)], headings=[heading], targets=[target])
    out = coverage.outcome(Config(agents=1, targets=1), state, torch.zeros(1, 1, dtype=torch.int64), None)
    assert bool(out.completed.item()) is seen
    assert out.reward.item() == pytest.approx(1.0 if seen else -0.1)


@given(st.floats(-2000, 2000))
@quick
def test_wrapped_angles_are_in_the_half_open_circle(degrees: float) -> None:
    angle = coverage.wrap(torch.tensor(degrees, dtype=torch.float64))
    assert -180 <= angle < 180
    assert torch.cos(torch.deg2rad(angle - degrees)) == pytest.approx(1)


def test_actions_turn_five_degrees_left_or_right_and_wrap() -> None:
    state = still(sensors=[(0.0, 0.0)] * 4, headings=[178.0, -178.0, 10.0, 175.0], targets=[(0.0, 0.0)])
    after = coverage.transition(Config(targets=1), state, torch.tensor([[1, 2, 0, 1]]), seeded(0))
    assert after.heading[0].tolist() == pytest.approx([-177.0, 177.0, 10.0, -180.0])


@pytest.mark.parametrize(
    ("change", "redrawn"),
    [
        ({}, False),
        ({"goal": (4.9, 0.0)}, True),
        ({"goal": (5.1, 0.0)}, False),
        ({"last": (9.9, 0.0)}, True),
        ({"before_last": (0.0, 9.9)}, True),
        ({"last": (10.1, 0.0), "before_last": (0.0, 10.1)}, False),
        ({"last": (0.0, 0.0), "before_last": (0.0, 0.0), "moved": False}, False),
        ({"trip": 99.0}, False),
        ({"trip": 100.0}, True),
    ],
)
def test_when_a_target_changes_its_mind(change: dict[str, Any], redrawn: bool) -> None:
    state = still(sensors=[(0.0, 0.0)], headings=[0.0], targets=[(0.0, 0.0)])
    fields = {"goal": (500.0, 0.0), "last": (-20.0, 0.0), "before_last": (-40.0, 0.0), "moved": True, "trip": 7.0}
    state = state._replace(**{k: torch.tensor(v).expand(getattr(state, k).shape) for k, v in (fields | change).items()})
    after = coverage.move_targets(0.3, state, seeded(3))
    assert (not torch.equal(after.goal, state.goal)) is redrawn
    assert after.trip.item() == (0 if redrawn else state.trip.item() + 1)
    step = torch.linalg.vector_norm(after.targets).item()
    assert 0.3 * after.speed.item() <= step < 0.3 * 1.2 * after.speed.item()


def test_a_target_that_would_leave_decides_again_from_where_it_is() -> None:
    state = still(sensors=[(0.0, 0.0)], headings=[0.0], targets=[(1249.0, 0.0)])
    state = state._replace(goal=torch.tensor([[[1260.0, 0.0]]]), moved=torch.ones(1, 1, dtype=torch.bool))
    state = state._replace(last=state.targets - 20, before_last=state.targets - 40)
    after = coverage.move_targets(0.3, state, seeded(0))
    assert after.targets.abs().max() <= 1250
    assert after.goal[0, 0, 0] < 1249
    assert after.trip.item() == 0
    assert torch.equal(after.last, state.targets)
    assert torch.equal(after.before_last, state.targets)
    assert state.goal[0, 0].tolist() == [1260.0, 0.0], "the old state was changed in place"


# --- motion, starts --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.3, 0.13])
def test_targets_stay_in_the_area_and_keep_moving(dt: float) -> None:
    rng = seeded(1)
    state = coverage.initial(Config(targets=10), 100, rng)
    for _ in range(400):
        state = coverage.move_targets(dt, state, rng)
        assert state.targets.abs().max() <= 1250
        step = torch.linalg.vector_norm(state.targets - state.last, dim=-1)
        assert step.min() > 50 * dt * 0.999
        assert step.max() < 99 * dt * 1.2 * 1.001


@pytest.mark.parametrize(("dt", "speed"), [(0.3, 73), (0.13, 87)])
def test_base_speed_of_targets_long_under_way(dt: float, speed: float) -> None:
    """A slow target at the small dt counts as stuck at once, so that slow ones are weeded out."""
    rng = seeded(2)
    state = coverage.initial(Config(targets=10), 200, rng)
    means = []
    for move in range(600):
        state = coverage.move_targets(dt, state, rng)
        if move >= 200:
            means.append(state.speed.mean())
    assert torch.stack(means).mean().item() == pytest.approx(speed, abs=1.5)


@pytest.mark.parametrize(("preset", "moves"), [("flat", 1), ("executor", 1), ("coordinator", 2)])
def test_the_coordinators_targets_move_eleven_times_in_ten_ticks(
    preset: Any, moves: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coverage, "move_targets", lambda dt, state, rng: state._replace(targets=state.targets + 1))
    cfg = Config(preset=preset)
    state = coverage.initial(cfg, 2, seeded(0))
    state = state._replace(targets=torch.zeros_like(state.targets), steps=torch.tensor([0, 3]))
    moved = [[0.0, 0.0]]
    for _ in range(20):
        state = coverage.transition(cfg, state, torch.zeros(2, 4, dtype=torch.int64), seeded(0))
        moved.append(state.targets[:, 0, 0].tolist())
    gains = torch.tensor(moved).diff(dim=0)
    for row, first in ((0, 0), (1, 3)):
        assert gains[:, row].tolist() == [moves if (first + t) % 10 == 0 else 1 for t in range(20)]


@given(st.integers(1, 6), presets, seeds)
@quick
def test_sensors_start_in_the_first_boxes_one_each(n: int, preset: Any, seed: int) -> None:
    cfg = Config(preset=preset, agents=n, targets=6)
    state = coverage.initial(cfg, 50, seeded(seed))
    boxes = torch.tensor(coverage.BOXES[:n])
    x, y = state.sensors.unsqueeze(2).unbind(-1)
    within = (x >= boxes[:, 0]) & (x < boxes[:, 1]) & (y >= boxes[:, 2]) & (y < boxes[:, 3])
    assert (within.sum(1) == 1).all()
    assert (within.sum(2) == 1).all()
    assert torch.equal(state.sensors, state.sensors.floor())


def test_every_order_of_the_boxes_occurs_alike() -> None:
    state = coverage.initial(Config(agents=3), 6000, seeded(0))
    centres = torch.tensor([(b[0] + b[1], b[2] + b[3]) for b in coverage.BOXES[:3]]) / 2
    order = torch.cdist(state.sensors, centres.float()).argmin(-1)
    _, counts = order.unique(dim=0, return_counts=True)
    assert len(counts) == 6
    assert counts.min() > 850, "1000 expected of each, standard deviation 29"


@pytest.mark.parametrize(("preset", "half"), [("flat", 800), ("executor", 400), ("coordinator", 1000)])
def test_targets_and_headings_start_uniform_in_the_presets_square(preset: Any, half: int) -> None:
    state = coverage.initial(Config(preset=preset), 4000, seeded(0))
    for values, low, high in ((state.targets, -half, half), (state.goal, -1250, 1250), (state.speed, 50, 100)):
        assert low <= values.min() < low + 0.01 * (high - low)
        assert high - 0.02 * (high - low) <= values.max() < high
        assert values.mean() == pytest.approx((low + high) / 2, abs=0.02 * (high - low))
        assert torch.equal(values, values.floor())
    bearing, _ = coverage.relation(state)
    if preset == "executor":
        assert bearing.diagonal(dim1=1, dim2=2).abs().max() < 1e-3
    else:
        assert state.heading.mean().abs() < 3
        assert state.heading.std() == pytest.approx(360 / 12**0.5, abs=2)


# --- the environment that remembers ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("preset", "length"), [("flat", 100), ("executor", 100), ("coordinator", 1000)])
def test_episodes_have_their_length_and_start_anew(preset: Any, length: int) -> None:
    cfg = Config(preset=preset, agents=1, targets=1)
    env = make_env(cfg, 2, seeded(0))
    assert env.reset().first.all()
    hold = torch.zeros(2, 1, dtype=torch.int64)
    for t in range(1, 2 * length + 1):
        step = env.step(hold)
        ends = t % length == 0
        assert step.truncated.tolist() == step.obs.first.tolist() == [ends, ends]
        assert not step.final_obs.first.any()
        assert not step.terminated.any()


def test_a_reset_keeps_the_true_last_observation_and_leaves_other_rows_alone() -> None:
    cfg = Config(observation="extended")
    env = make_env(cfg, 3, seeded(0))
    env.reset()
    env.state = env.state._replace(steps=torch.tensor([99, 5, 98]))
    action, before, twin = torch.randint(3, (3, 4), generator=seeded(1)), env.state, copy_of(env.rng)
    step = env.step(action, torch.ones(3, 4, 5))
    state = coverage.transition(cfg, before, action, twin)
    expected = coverage.observe(cfg, state)
    assert torch.equal(step.final_obs.pairs, expected.pairs)
    assert torch.equal(step.reward, coverage.outcome(cfg, state, action, None).reward)
    assert step.truncated.tolist() == [True, False, False]
    assert torch.equal(step.obs.pairs[1:], step.final_obs.pairs[1:])
    assert not torch.equal(step.obs.pairs[0], step.final_obs.pairs[0])
    assert env.state.steps.tolist() == [0, 6, 99]
    assert not torch.equal(env.state.sensors[0], before.sensors[0])
    assert torch.equal(env.state.sensors[1:], before.sensors[1:])
    assert not torch.equal(env.state.heading[0], state.heading[0])


@pytest.mark.parametrize("preset", PRESETS)
def test_a_loaded_environment_continues_bit_by_bit(preset: Any) -> None:
    cfg = Config(preset=preset)
    env = make_env(cfg, 4, seeded(0))
    env.reset()
    env.state = env.state._replace(steps=torch.full((4,), coverage.spec(cfg).episode - 60))
    run(env, 30)
    file = io.BytesIO()
    torch.save(env.state_dict(), file)
    file.seek(0)
    other = make_env(cfg, 4, seeded(99))
    other.load_state_dict(torch.load(file, weights_only=True))
    for mine, theirs in zip(run(env, 60), run(other, 60), strict=True):  # through a reset
        assert flat(mine) == flat(theirs)
    assert torch.equal(env.rng.get_state(), other.rng.get_state())


def test_a_seed_decides_everything() -> None:
    def trace(seed: int) -> list[Tensor]:
        env = make_env(Config(), 3, seeded(seed))
        return [env.reset().pairs, *(s.obs.pairs for s in run(env, 110))]

    first = trace(5)
    assert all(torch.equal(a, b) for a, b in zip(first, trace(5), strict=True))
    assert not any(torch.equal(a, b) for a, b in zip(first, trace(6), strict=True))


@pytest.mark.parametrize("wrong", [{"agents": 7}, {"preset": "executor", "agents": 4, "targets": 3}, {"agents": 0}])
def test_a_task_that_cannot_be_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="agents"):
        Config(**wrong)


def run(env: Any, steps: int) -> list[Step]:
    """Act by a rule that depends on the state, so that a difference cannot heal."""
    out = []
    for _ in range(steps):
        left = coverage.relation(env.state)[0][..., 0] > 0
        out.append(env.step(torch.where(left, 1, 2)))
    return out


def flat(step: Step) -> list[Any]:
    """All numbers of a step."""

    def parts(x: Any) -> list[Any]:
        if isinstance(x, Tensor):
            return x.flatten().tolist()
        values = x.values() if isinstance(x, dict) else x
        return [number for part in values for number in parts(part)]

    assert isinstance(step.obs, Obs)
    return parts(step)
