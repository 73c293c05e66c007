"""Yardsticks: against slow searches on small instances, and against each other in the same episodes."""

import itertools
import math
from collections.abc import Iterable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from pipelines.conformance.checks import seeded
from rhmc.envs import coverage, make_env, navigation
from rhmc.yardsticks import BOUNDS, POLICIES, joint, scores
from rhmc.yardsticks import coverage as sensors
from rhmc.yardsticks import navigation as steering
from rhmc.yardsticks.scores import play_yardsticks
from tests.oracles import coverage as oracle

quick = settings(deadline=None, max_examples=25)
seeds = st.integers(0, 2**31)
COVERAGE = POLICIES["coverage"]
FLAT = {  # mean coverage in %, 4 sensors and 5 targets
    "random": 32.1,
    "hold": 32.0,
    "nearest": 60.7,
    "mean_all": 47.7,
    "best_window": 65.4,
    "joint_one_step": 62.6,
    "set_point": 63.9,
    "free_heading_bound": 86.4,
    "range_bound": 91.9,
}
NAVIGATION = {  # return under the `mpe2` reward, under the `paper` reward, landmarks covered
    "random": (-78.5, -59.6, 0.01),
    "hold": (-71.7, -50.8, 0.02),
    "nearest": (-51.2, -35.1, 0.39),
    "matching": (-26.3, -19.8, 0.76),
}


def drawn(cfg: coverage.Config, batch: int, seed: int, steps: int = 10) -> coverage.State:
    """A batch some steps into its episodes."""
    rng = seeded(seed)
    state = coverage.initial(cfg, batch, rng)
    for _ in range(steps):
        state = coverage.transition(cfg, state, torch.randint(3, (batch, cfg.agents), generator=rng), rng)
    return state


def settled(cfg: coverage.Config, state: coverage.State, policy: Any, steps: int = 60) -> coverage.State:
    """The state where the policy ends while the targets stand still."""
    for _ in range(steps):
        turn = torch.tensor(coverage.TURNS)[policy(cfg, state, seeded(0))]
        state = state._replace(heading=coverage.wrap(state.heading + turn), last=state.targets)
    return state


def sets_in_view(state: coverage.State, b: int, i: int) -> set[frozenset[int]]:
    """Targets that sensor i of row b sees under all headings: each degree, and just before one enters or leaves."""
    world = oracle.World(
        [(float(x), float(y)) for x, y in state.sensors[b]],
        [0.0] * state.sensors.shape[1],
        [oracle.Target((float(x), float(y)), (0.0, 0.0), 60.0) for x, y in state.targets[b]],
    )
    m = len(world.targets)
    edges = [world.bearing(i, j) + side * 44.999 for j in range(m) for side in (1, -1)]
    found = set()
    for heading in [*range(-180, 180), *edges]:
        world.headings[i] = heading
        found.add(frozenset(j for j in range(m) if world.sees(i, j)))
    return found


def union_size(sets: Iterable[frozenset[int]]) -> int:
    return len(frozenset().union(*sets))


# --- the exact search ------------------------------------------------------------------------------------------------


@given(st.integers(1, 4), st.integers(1, 4), st.integers(1, 6), seeds)
@quick
def test_best_choice_is_the_best_of_all_joint_choices(n: int, k: int, m: int, seed: int) -> None:
    rng = seeded(seed)
    member = torch.rand(3, n, k, m, generator=rng) < 0.3
    cost = torch.randint(0, 4, (3, n, k), generator=rng).float()
    choice, largest = joint.best_choice(member, cost), joint.largest_union(member)
    for b in range(3):

        def score(options: Iterable[int], b: int = b) -> tuple[int, float]:
            rows = list(enumerate(options))
            seen = torch.stack([member[b, i, o] for i, o in rows]).any(0).sum()
            return int(seen), -float(sum(cost[b, i, o] for i, o in rows))

        best = max(score(options) for options in itertools.product(range(k), repeat=n))
        assert score(choice[b].tolist()) == best
        assert largest[b] == best[0]


def test_too_many_targets_for_an_exact_search_are_refused() -> None:
    with pytest.raises(ValueError, match="at most 16"):
        joint.largest_union(torch.ones(1, 1, 1, 17, dtype=torch.bool))


# --- coverage, against slow searches ---------------------------------------------------------------------------------


@given(seeds, st.integers(1, 6), st.integers(1, 6))
@settings(deadline=None, max_examples=10)
def test_a_window_holds_as_many_targets_as_any_heading_shows(seed: int, n: int, m: int) -> None:
    state = drawn(coverage.Config(agents=n, targets=m), 2, seed)
    bearing, distance = coverage.relation(state)
    member, turn = sensors.windows(bearing, distance <= coverage.RANGE)
    ahead = coverage.visible(coverage.wrap(bearing.unsqueeze(2) - turn.unsqueeze(3)), distance.unsqueeze(2))
    assert (ahead | ~member).all(), "the middle of a window shows all of it"
    for b, i in itertools.product(range(2), range(n)):
        rows = [frozenset(row.nonzero().flatten().tolist()) for row in member[b, i]]
        for seen in sets_in_view(state, b, i):
            assert any(seen <= row for row in rows), "a set that can be seen is part of a window"


@given(seeds, st.integers(1, 3), st.integers(1, 6))
@settings(deadline=None, max_examples=10)
def test_free_heading_bound_is_that_of_a_scan_over_headings(seed: int, n: int, m: int) -> None:
    cfg = coverage.Config(agents=n, targets=m)
    state = drawn(cfg, 2, seed)
    bound = sensors.free_heading_bound(cfg, state)
    for b in range(2):
        views = [sets_in_view(state, b, i) for i in range(n)]
        best = max(union_size(choice) for choice in itertools.product(*views))
        assert float(bound[b]) == pytest.approx(best / m)


@given(seeds, st.integers(1, 6), st.integers(1, 6))
@settings(deadline=None, max_examples=10)
def test_best_window_comes_to_see_as_much_as_a_sensor_can(seed: int, n: int, m: int) -> None:
    cfg = coverage.Config(agents=n, targets=m)
    state = roomy(drawn(cfg, 30, seed))
    after = coverage.visible(*coverage.relation(settled(cfg, state, sensors.best_window)))
    for b, i in itertools.product(range(min(3, len(state.steps))), range(n)):
        assert after[b, i].sum() == max(len(seen) for seen in sets_in_view(state, b, i))


@given(seeds, st.integers(1, 6), st.integers(1, 6))
@settings(deadline=None, max_examples=10)
def test_set_point_comes_to_the_free_heading_bound(seed: int, n: int, m: int) -> None:
    cfg = coverage.Config(agents=n, targets=m)
    state = roomy(drawn(cfg, 30, seed))
    seen = coverage.visible(*coverage.relation(settled(cfg, state, sensors.set_point)))
    assert torch.allclose(seen.any(1).float().mean(-1), sensors.free_heading_bound(cfg, state))


def roomy(state: coverage.State) -> coverage.State:
    """Rows in which no window is so full that a heading 2.5 degrees off its middle would lose a target."""
    bearing, _ = coverage.relation(state)
    gap = torch.remainder(bearing.unsqueeze(-2) - bearing.unsqueeze(-1), 360)
    keep = ~((gap > 84) & (gap < 90)).flatten(1).any(-1)
    return coverage.State(*(x[keep] for x in state))


@given(seeds, st.integers(1, 4), st.integers(1, 6))
@settings(deadline=None, max_examples=10)
def test_joint_one_step_is_the_best_of_all_joint_actions(seed: int, n: int, m: int) -> None:
    cfg = coverage.Config(agents=n, targets=m)
    state = drawn(cfg, 3, seed)
    action = sensors.joint_one_step(cfg, state, seeded(0))
    _, distance = coverage.relation(state)
    closest = distance.argmin(1)

    def score(joint_action: Tensor) -> tuple[Tensor, Tensor]:
        turned = state._replace(heading=state.heading + torch.tensor(coverage.TURNS)[joint_action])
        bearing, _ = coverage.relation(turned)
        off_axis = bearing.abs().gather(1, closest.unsqueeze(1)).sum((1, 2))
        return coverage.visible(bearing, distance).any(1).sum(-1), off_axis

    rivals = [score(torch.tensor(a).expand(3, n)) for a in itertools.product(range(3), repeat=n)]
    seen, off_axis = (torch.stack(x) for x in zip(*rivals, strict=True))
    mine_seen, mine_off = score(action)
    best = seen.amax(0)
    assert torch.equal(mine_seen, best)
    assert torch.allclose(mine_off, torch.where(seen == best, off_axis, math.inf).amin(0), atol=1e-2)


@given(seeds, st.integers(1, 6), st.integers(1, 6))
@settings(deadline=None, max_examples=10)
def test_nearest_and_mean_all_end_turned_to_their_point(seed: int, n: int, m: int) -> None:
    cfg = coverage.Config(agents=n, targets=m)
    state = drawn(cfg, 20, seed)
    bearing, distance = coverage.relation(settled(cfg, state, sensors.nearest))
    assert bearing.gather(-1, distance.argmin(-1, keepdim=True)).abs().max() <= 2.51
    end = settled(cfg, state, sensors.mean_all)
    away = end.targets.mean(1, keepdim=True) - end.sensors
    direction = torch.rad2deg(torch.atan2(away[..., 1], away[..., 0]))
    assert coverage.wrap(direction - end.heading).abs().max() <= 2.51


@given(seeds, st.integers(1, 6))
@quick
def test_best_path_is_the_best_of_all_walks(seed: int, times: int) -> None:
    gain = torch.randint(0, 3, (4, times, 2 * times + 1), generator=seeded(seed)).float()
    path = sensors._best_path(gain)
    assert (path.diff(dim=1, prepend=torch.full((4, 1), times)).abs() <= 1).all()
    mine = gain.gather(2, path.unsqueeze(-1)).sum((1, 2))
    walks = [torch.tensor(w).cumsum(0) + times for w in itertools.product((-1, 0, 1), repeat=times)]
    rivals = torch.stack([gain[:, torch.arange(times), walk].sum(-1) for walk in walks])
    assert torch.equal(mine, rivals.amax(0))


@pytest.mark.parametrize(("velocity", "action"), [(30.0, 1), (-30.0, 2), (0.0, 0)])
def test_planner_turns_ahead_of_a_target_that_will_leave_its_view(velocity: float, action: int) -> None:
    """The target is seen now, and crosses the field of view upwards, downwards or not at all."""
    cfg = coverage.Config(agents=1, targets=1)
    state = drawn(cfg, 1, 0)
    target, move = torch.tensor([[[300.0, 0.0]]]), torch.tensor([0.0, velocity])
    zero = torch.zeros(1, 1)
    state = state._replace(sensors=torch.zeros(1, 1, 2), heading=zero, targets=target, last=target - move)
    actions = []
    for _ in range(24):  # then it is out of range
        chosen = sensors.planner(cfg, state, seeded(0))
        actions.append(int(chosen))
        heading = state.heading + torch.tensor(coverage.TURNS)[chosen]
        state = state._replace(heading=heading, targets=state.targets + move, last=state.targets)
        assert coverage.visible(*coverage.relation(state)).all()
    assert set(actions) == ({0, action} if action else {0})


def test_planner_sends_two_like_sensors_to_different_targets() -> None:
    cfg = coverage.Config(agents=2, targets=2)
    state = drawn(cfg, 1, 0)
    targets = torch.tensor([[[-50.0, 300.0], [-50.0, -300.0]]])
    state = state._replace(sensors=torch.zeros(1, 2, 2), heading=torch.zeros(1, 2), targets=targets, last=targets)
    assert coverage.visible(*coverage.relation(settled(cfg, state, sensors.planner, 25))).any(1).all()


@pytest.mark.parametrize("name", sorted(COVERAGE))
@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6])
def test_a_policy_acts_for_any_number_of_sensors_without_knowing_goals(name: str, n: int) -> None:
    cfg = coverage.Config(agents=n, targets=4)
    state = drawn(cfg, 5, n)
    hidden = state._replace(goal=-state.goal, speed=state.speed + 10, trip=state.trip + 50, before_last=state.last + 1)
    action = COVERAGE[name](cfg, state, seeded(0))
    assert action.shape == (5, n)
    assert action.dtype == torch.int64
    assert set(action.flatten().tolist()) <= {0, 1, 2}
    assert torch.equal(action, COVERAGE[name](cfg, hidden, seeded(0)))
    make_env(cfg, 5, seeded(0)).reset()


@pytest.mark.parametrize("name", ["best_window", "set_point", "hold"])
def test_a_sensor_with_nothing_in_range_holds(name: str) -> None:
    cfg = coverage.Config(agents=2)
    state = drawn(cfg, 4, 0)
    far = state._replace(targets=torch.full_like(state.targets, 1250), sensors=torch.full_like(state.sensors, -750))
    assert not COVERAGE[name](cfg, far, seeded(0)).any()
    assert not sensors.free_heading_bound(cfg, far).any()
    assert not sensors.range_bound(cfg, far).any()


def test_random_takes_every_action_alike() -> None:
    state = drawn(coverage.Config(), 1000, 0, steps=0)
    counts = COVERAGE["random"](coverage.Config(), state, seeded(0)).flatten().bincount()
    assert (counts / 4000 - 1 / 3).abs().max() < 0.03


# --- navigation ------------------------------------------------------------------------------------------------------


@given(seeds, st.integers(1, 6))
@quick
def test_match_is_the_optimal_assignment(seed: int, n: int) -> None:
    cost = torch.rand(5, n, n, generator=seeded(seed))
    columns = steering.match(cost)
    for matrix, mine in zip(cost, columns, strict=True):
        assert sorted(mine.tolist()) == list(range(n))
        rows, best = linear_sum_assignment(matrix.numpy())
        assert float(matrix[torch.arange(n), mine].sum()) == pytest.approx(float(matrix[rows, best].sum()), abs=1e-5)


@pytest.mark.parametrize("order", ["mpe2", "mpe1"])
@pytest.mark.parametrize("continuous", [False, True])
def test_steering_comes_to_rest_at_the_landmark(order: Any, continuous: bool) -> None:
    cfg = navigation.Config(agents=1, order=order, continuous=continuous)
    rng = seeded(0)
    state = navigation.initial(cfg, 200, rng)
    state = state._replace(velocity=torch.rand(200, 1, 2, generator=rng) * 2 - 1)
    own = torch.zeros(200, 1, dtype=torch.int64)
    for _ in range(50):
        state = navigation.transition(cfg, state, steering.steer(cfg, state, own), rng)
    assert state.velocity.abs().max() < 1e-3
    assert steering.distances(state).max() < (0.01 if continuous else 0.15)


@given(seeds, st.sampled_from(("mpe2", "mpe1")))
@quick
def test_steering_takes_the_force_that_coasts_nearest(seed: int, order: Any) -> None:
    cfg, rng = navigation.Config(agents=1, order=order), seeded(seed)
    state = navigation.initial(cfg, 8, rng)
    state = state._replace(velocity=torch.rand(8, 1, 2, generator=rng) * 2 - 1)
    chosen = steering.steer(cfg, state, torch.zeros(8, 1, dtype=torch.int64))
    ends = []
    for action in range(5):
        after = navigation.transition(cfg, state, torch.full((8, 1), action), rng)
        for _ in range(60):
            after = navigation.transition(cfg, after, torch.zeros(8, 1, dtype=torch.int64), rng)
        ends.append(steering.distances(after).flatten())
    distance = torch.stack(ends, -1)
    assert torch.allclose(distance.gather(1, chosen).squeeze(1), distance.amin(-1), atol=1e-4)


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("name", sorted(POLICIES["navigation"]))
def test_a_policy_steers_any_number_of_agents(name: str, continuous: bool) -> None:
    for n in range(1, 7):
        cfg = navigation.Config(agents=n, continuous=continuous)
        env = make_env(cfg, 3, seeded(n))
        env.reset()
        action = POLICIES["navigation"][name](cfg, env.state, seeded(0))
        assert action.shape == ((3, n, 2) if continuous else (3, n))
        assert action.is_floating_point() is continuous
        assert action.abs().max() <= (1 if continuous else 4)
        env.step(action)


# --- in the same episodes --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flat() -> dict[str, dict[str, float]]:
    return play_yardsticks(coverage.Config(), episodes=400)


def test_flat_coverage_has_the_known_levels(flat: dict[str, dict[str, float]]) -> None:
    assert list(flat) == list(FLAT)
    for name, score in flat.items():
        assert score["coverage"] == pytest.approx(FLAT[name], abs=2), name
        assert 0.2 < score["sem"] < 0.8
        assert score["coverage"] - 2.5 < score["return"] < score["coverage"] + 1e-3
    assert flat["random"]["return"] == pytest.approx(30.4, abs=2)


def test_yardsticks_are_in_order(flat: dict[str, dict[str, float]]) -> None:
    level = {name: score["coverage"] for name, score in flat.items()}
    assert abs(level["random"] - level["hold"]) < 2
    rising = ["hold", "mean_all", "nearest", "best_window", "free_heading_bound", "range_bound"]
    for low, high in itertools.pairwise(rising):
        assert level[low] + 1.5 < level[high]
    for name in ("joint_one_step", "set_point"):
        assert level["mean_all"] + 10 < level[name] < level["free_heading_bound"] - 10


def test_planning_ahead_beats_seeking_the_best_window() -> None:
    level = play_yardsticks(coverage.Config(), ["best_window", "planner", "free_heading_bound"], episodes=16, seed=1)
    assert level["best_window"]["coverage"] + 3 < level["planner"]["coverage"]
    assert level["planner"]["coverage"] + 4 < level["free_heading_bound"]["coverage"]


def test_more_sensors_see_more() -> None:
    levels = [
        play_yardsticks(coverage.Config(agents=n), ["best_window", "range_bound"], episodes=100) for n in (1, 2, 4, 6)
    ]
    for name in ("best_window", "range_bound"):
        series = [level[name]["coverage"] for level in levels]
        assert all(a + 2 < b for a, b in itertools.pairwise(series))


def test_executor_has_a_local_return_and_bounds_have_none() -> None:
    level = play_yardsticks(coverage.Config(preset="executor"), ["best_window", "range_bound"], episodes=100)
    assert level["best_window"]["coverage"] == pytest.approx(72.3, abs=3)
    assert level["range_bound"]["coverage"] == pytest.approx(92.3, abs=3)
    assert -70 < level["best_window"]["return"] < -40
    assert "return" not in level["range_bound"]


@pytest.mark.parametrize(("reward", "column"), [("mpe2", 0), ("paper", 1)])
def test_navigation_has_the_known_levels(reward: Any, column: int) -> None:
    level = play_yardsticks(navigation.Config(reward=reward))
    assert list(level) == list(NAVIGATION)
    for name, score in level.items():
        assert abs(score["return"] - NAVIGATION[name][column]) < 4 * score["sem"], name
        assert score["landmarks_covered"] == pytest.approx(NAVIGATION[name][2], abs=0.04), name
    assert level["matching"]["collisions"] < level["nearest"]["collisions"]


def test_the_episodes_depend_on_the_seed_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scores, "CHUNK", 4)
    cfg = navigation.Config()
    both = play_yardsticks(cfg, ["random", "nearest"], episodes=10, seed=3)
    assert play_yardsticks(cfg, ["nearest"], episodes=10, seed=3)["nearest"] == both["nearest"]
    assert play_yardsticks(cfg, ["nearest"], episodes=10, seed=4)["nearest"] != both["nearest"]


def test_numbers_are_means_over_whole_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The score of `hold` in three chunks, recomputed with the environment itself."""
    monkeypatch.setattr(scores, "CHUNK", 4)
    cfg, rng = coverage.Config(), seeded(3)
    cover, reward = [], []
    for batch in (4, 4, 2):
        env = make_env(cfg, batch, rng)
        env.state = coverage.initial(cfg, batch, rng)
        for _ in range(99):
            step = env.step(torch.zeros(batch, 4, dtype=torch.int64))
            cover.append(step.info["coverage"])
            reward.append(step.reward)
        env.state = coverage.transition(cfg, env.state, torch.zeros(batch, 4, dtype=torch.int64), rng)
        out = coverage.outcome(cfg, env.state, torch.zeros(batch, 4, dtype=torch.int64), None)
        cover.append(out.info["coverage"])
        reward.append(out.reward)
    episodes = torch.cat([torch.stack(cover[s : s + 100]).mean(0) for s in (0, 100, 200)]) * 100
    score = play_yardsticks(cfg, ["hold"], episodes=10, seed=3)["hold"]
    assert score["coverage"] == pytest.approx(float(episodes.mean()), abs=1e-4)
    assert score["sem"] == pytest.approx(float(episodes.std()) / 10**0.5, abs=1e-4)
    assert score["return"] == pytest.approx(float(torch.cat(reward).mean()) * 100, abs=1e-4)


def test_the_bounds_hold_step_by_step_for_every_policy() -> None:
    cfg = coverage.Config()
    for policy in COVERAGE.values():
        rng = seeded(0)
        state = coverage.initial(cfg, 20, rng)
        for _ in range(5):
            action = policy(cfg, state, seeded(1))
            state = coverage.transition(cfg, state, action, rng)
            seen = coverage.outcome(cfg, state, action, None).info["coverage"]
            free, in_range = (bound(cfg, state) for bound in BOUNDS["coverage"].values())
            assert (seen <= free + 1e-6).all()
            assert (free <= in_range + 1e-6).all()


def test_requests_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match=r"no plannr; there are random, hold.*range_bound"):
        play_yardsticks(coverage.Config(), ["plannr"])
    with pytest.raises(ValueError, match="at least 2"):
        play_yardsticks(coverage.Config(), episodes=1)
