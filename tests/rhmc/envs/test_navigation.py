"""Cooperative navigation: against a scalar oracle, against the `mpe2` package, and its own promises."""

import io
import itertools
import math
from typing import Any, Literal

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mpe2 import simple_spread_v3
from torch import Tensor

from pipelines.conformance.checks import seeded
from rhmc.envs import make_env, navigation
from rhmc.envs.base import Env
from rhmc.types import Obs, assigned_reward
from tests.oracles import navigation as oracle

REWARDS = ("paper", "mpe2", "mpe1")
ORDERS = ("mpe2", "mpe1")
Start = Literal["spread", "crowded", "touching", "almost one point"]
HALF_SIDES: dict[Start, float] = {"spread": 1.0, "crowded": 0.2, "touching": 0.02, "almost one point": 1e-6}
LEVELS = {("random", "mpe2"): -78.5, ("hold", "mpe2"): -71.7, ("random", "paper"): -59.6, ("hold", "paper"): -50.8}
COVERED = {"random": 0.01, "hold": 0.02}  # share of landmarks at the end

starts = st.sampled_from(list(HALF_SIDES))
seeds = st.integers(0, 2**31)
counts = st.integers(3, 6)
quick = settings(deadline=None, max_examples=25)


def uniform(rng: torch.Generator, *shape: int) -> Tensor:
    """In [-1, 1), float64 with float32 values, so that both precisions can hold a start exactly."""
    return (torch.rand(*shape, generator=rng) * 2 - 1).double()


def world_state(cfg: navigation.Config, batch: int, rng: torch.Generator, start: Start) -> navigation.State:
    """A moving start in float64, the agents in a square of the given size about 0 (where no two floats coincide)."""
    n = cfg.agents
    position = (HALF_SIDES[start] * uniform(rng, batch, n, 2)).float().double()
    steps = torch.zeros(batch, dtype=torch.int64)
    return navigation.State(position, uniform(rng, batch, n, 2), uniform(rng, batch, n, 2), steps)


def random_action(cfg: navigation.Config, batch: int, rng: torch.Generator) -> Tensor:
    if cfg.continuous:
        return uniform(rng, batch, cfg.agents, 2)
    return torch.randint(5, (batch, cfg.agents), generator=rng)


def single(action: Tensor) -> Tensor:
    """The action in the precision that the environment works in."""
    return action.float() if action.is_floating_point() else action


def pushes(cfg: navigation.Config, action: Tensor) -> list[oracle.Point]:
    """An action of one world (N) or (N, 2) as the oracle takes it."""
    return [tuple(a) for a in action.tolist()] if cfg.continuous else [oracle.PUSH[a] for a in action.tolist()]


def scalar_world(state: navigation.State, row: int) -> oracle.World:
    parts = (state.position[row], state.velocity[row], state.landmarks[row])
    return oracle.World(*([tuple(p) for p in part.tolist()] for part in parts))


def as_float32(state: navigation.State) -> navigation.State:
    return navigation.State(state.position.float(), state.velocity.float(), state.landmarks.float(), state.steps)


def assert_near(got: Tensor, want: object, tol: float) -> None:
    want_tensor = torch.as_tensor(want, dtype=got.dtype)
    torch.testing.assert_close(got, want_tensor, rtol=tol, atol=tol)


# ---- against the scalar oracle


@quick
@given(seeds, counts, starts, st.sampled_from(ORDERS), st.booleans())
def test_an_episode_equals_the_oracle(seed: int, n: int, start: Start, order: Any, continuous: bool) -> None:
    cfg = navigation.Config(agents=n, order=order, continuous=continuous)
    rng, batch = seeded(seed), 2
    state = world_state(cfg, batch, rng, start)
    worlds = [scalar_world(state, row) for row in range(batch)]
    for _ in range(25):
        action = random_action(cfg, batch, rng)
        state = navigation.transition(cfg, state, action, rng)
        worlds = [oracle.step(world, pushes(cfg, action[row]), order) for row, world in enumerate(worlds)]
        assert_near(state.position, [world.position for world in worlds], 1e-7)
        assert_near(state.velocity, [world.velocity for world in worlds], 1e-7)
    assert state.steps.tolist() == [25] * batch


@quick
@given(seeds, counts, starts, st.sampled_from(ORDERS), st.booleans())
def test_a_step_in_single_precision_is_near_the_oracle(
    seed: int, n: int, start: Start, order: Any, continuous: bool
) -> None:
    cfg = navigation.Config(agents=n, order=order, continuous=continuous)
    rng, batch = seeded(seed), 4
    state = world_state(cfg, batch, rng, start)
    action = random_action(cfg, batch, rng)
    got = navigation.transition(cfg, as_float32(state), single(action), rng)
    worlds = [oracle.step(scalar_world(state, row), pushes(cfg, action[row]), order) for row in range(batch)]
    assert got.position.dtype == got.velocity.dtype == torch.float32
    assert_near(got.position, [world.position for world in worlds], 1e-4)
    assert_near(got.velocity, [world.velocity for world in worlds], 1e-4)


@quick
@given(seeds, counts, starts)
def test_rewards_and_completion_equal_the_oracle(seed: int, n: int, start: Start) -> None:
    cfg = navigation.Config(agents=n)
    rng, batch = seeded(seed), 3
    state = world_state(cfg, batch, rng, start)
    state = state._replace(landmarks=(state.landmarks - state.position).mul(0.2) + state.position)  # some are covered
    worlds = [scalar_world(state, row) for row in range(batch)]
    action = random_action(cfg, batch, rng)
    out = navigation.outcome(cfg, state, action, None)
    done = torch.tensor([oracle.completed(world) for world in worlds])
    bumps = torch.tensor([[oracle.collisions(world, i) for i in range(n)] for world in worlds])
    assert torch.equal(out.completed, done)
    assert_near(out.info["landmarks_covered"], done.any(1).double().mean(-1), 1e-12)
    assert_near(out.info["collisions"], bumps.sum(-1), 0)
    assert_near(out.local.agents, -bumps, 0)
    away = [[[-math.dist(p, q) for q in world.landmarks] for p in world.position] for world in worlds]
    assert_near(out.local.pairs, away, 1e-9)
    for name in REWARDS:
        want = [oracle.rewards(world)[name] for world in worlds]
        assert_near(out.info[f"reward_{name}"], want, 1e-9)
        chosen = navigation.outcome(cfg.model_copy(update={"reward": name}), state, action, None)
        assert_near(chosen.reward, want, 1e-9)


@quick
@given(seeds, counts, starts)
def test_extended_features_equal_the_oracle(seed: int, n: int, start: Start) -> None:
    cfg = navigation.Config(agents=n, observation="extended")
    state = world_state(cfg, 1, seeded(seed), start)
    world = scalar_world(state, 0)
    obs = navigation.observe(cfg, state)
    assert_near(obs.pairs[0], [[oracle.extended_pair(world, i, j) for j in range(n)] for i in range(n)], 1e-9)
    assert_near(obs.peers[0], [[oracle.extended_peer(world, i, k) for k in range(n)] for i in range(n)], 1e-9)
    diagonal = obs.peers[0, range(n), range(n)]
    assert not diagonal.any()


def test_a_tie_makes_both_agents_the_nearest() -> None:
    cfg = navigation.Config(agents=2, observation="extended")
    state = navigation.initial(cfg, 1, seeded(0))
    state = state._replace(position=torch.tensor([[[-1.0, 0.0], [1.0, 0.0]]]), landmarks=torch.zeros(1, 2, 2))
    assert navigation.observe(cfg, state).pairs[0, ..., 2:].eq(1).all()  # distance, the other's, nearest


def test_local_reward_is_mean_distance_to_assigned_landmarks_and_collisions() -> None:
    position = torch.tensor([[[0.0, 0.0], [0.2, 0.0], [5.0, 0.0]]])
    landmarks = torch.tensor([[[0.0, 1.0], [0.0, 3.0], [5.0, 0.5]]])
    state = navigation.State(position, torch.zeros(1, 3, 2), landmarks, torch.zeros(1, dtype=torch.int64))
    local = navigation.outcome(navigation.Config(), state, torch.zeros(1, 3, dtype=torch.int64), None).local
    assignment = torch.tensor([[[1, 1, 0], [0, 0, 0], [0, 0, 1]]])
    assert_near(assigned_reward(local, assignment), [[-2 - 1, -1, -0.5]], 1e-6)


# ---- against the published package


class Published:
    """`simple_spread_v3` put into a given state."""

    def __init__(self, state: navigation.State, *, continuous: bool) -> None:
        n = state.position.shape[1]
        self.env = simple_spread_v3.parallel_env(N=n, max_cycles=25, continuous_actions=continuous)
        self.env.reset(seed=0)
        self.raw = self.env.aec_env.unwrapped
        self.continuous = continuous
        for i, agent in enumerate(self.raw.world.agents):
            agent.state.p_pos = state.position[0, i].numpy().copy()
            agent.state.p_vel = state.velocity[0, i].numpy().copy()
        for j, landmark in enumerate(self.raw.world.landmarks):
            landmark.state.p_pos = state.landmarks[0, j].numpy().copy()

    def step(self, action: Tensor) -> tuple[float, bool, np.ndarray]:
        """Total reward over agents, whether the episode is cut, and the observations (N, 6N)."""
        chosen = [self._encode(a) for a in action[0]]
        names = self.env.possible_agents
        obs, reward, _, cut, _ = self.env.step(dict(zip(names, chosen, strict=True)))
        return sum(reward.values()), all(cut.values()), np.stack([obs[name] for name in names])

    def _encode(self, action: Tensor) -> Any:
        if not self.continuous:
            return int(action)
        x, y = action.tolist()
        return np.array([0, max(-x, 0), max(x, 0), max(-y, 0), max(y, 0)], dtype=np.float32)

    def motion(self) -> tuple[np.ndarray, np.ndarray]:
        agents = self.raw.world.agents
        return np.stack([a.state.p_pos for a in agents]), np.stack([a.state.p_vel for a in agents])

    def parts(self) -> tuple[float, float]:
        """The package's own global reward, and the collision penalty summed over agents."""
        scenario, world = self.raw.scenario, self.raw.world
        return scenario.global_reward(world), sum(scenario.reward(agent, world) for agent in world.agents)


def flat_observation(obs: Obs) -> Tensor:
    """The package's order: velocity, position, landmarks, other agents, then silent communication. (N, 6N)."""
    n = obs.agents.shape[1]
    others = [[k for k in range(n) if k != i] for i in range(n)]
    peers = torch.stack([obs.peers[0, i, others[i]] for i in range(n)])
    silence = torch.zeros(n, 2 * (n - 1), dtype=peers.dtype)
    return torch.cat((obs.agents[0], obs.pairs[0].flatten(1), peers.flatten(1), silence), -1)


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("start", HALF_SIDES)
@pytest.mark.parametrize("n", [3, 4, 5, 6])
def test_an_episode_equals_the_published_package(n: int, start: Start, continuous: bool) -> None:
    cfg = navigation.Config(agents=n, reward="mpe2", continuous=continuous)
    rng = seeded(100 * n + continuous)
    state = world_state(cfg, 1, rng, start)
    published = Published(state, continuous=continuous)
    bumped = 0.0
    for t in range(1, 26):
        action = random_action(cfg, 1, rng)
        reward, cut, obs = published.step(action)
        state = navigation.transition(cfg, state, action, rng)
        out = navigation.outcome(cfg, state, action, None)
        position, velocity = published.motion()
        assert_near(state.position[0], position, 1e-7)
        assert_near(state.velocity[0], velocity, 1e-7)
        assert_near(out.reward[0], reward, 1e-7)
        spread, penalty = published.parts()
        assert_near(out.info["reward_mpe1"][0], n * spread + penalty - n, 1e-7)
        assert_near(flat_observation(navigation.observe(cfg, state)), obs, 1e-5)
        assert cut == (t == cfg.episode)
        bumped += float(out.info["collisions"])
    assert start == "spread" or bumped > 0


# ---- the environment that remembers


@pytest.mark.parametrize("observation", ["paper", "extended"])
@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("n", [1, 2, 6])
def test_sizes_are_as_specified(n: int, continuous: bool, observation: Any) -> None:
    cfg = navigation.Config(agents=n, continuous=continuous, observation=observation)
    env, batch = make_env(cfg, 7, seeded(0)), 7
    spec = env.spec
    obs = env.reset()
    step = env.step(single(random_action(cfg, batch, env.rng)))
    for o in (obs, step.obs, step.final_obs):
        assert o.agents.shape == (batch, n, spec.agent_features)
        assert o.pairs.shape == (batch, n, n, spec.pair_features)
        assert o.peers.shape == (batch, n, n, spec.peer_features)
        assert {o.agents.dtype, o.pairs.dtype, o.peers.dtype} == {torch.float32}
        assert all(part.isfinite().all() for part in o[:3])
    assert (spec.targets, spec.actions, spec.continuous) == (n, 2 if continuous else 5, continuous)
    assert step.reward.shape == step.terminated.shape == step.truncated.shape == (batch,)
    assert step.completed.shape == step.local.pairs.shape == (batch, n, n)
    assert env.options()(3).shape == (batch, n, n + 1, n)
    assert {k: v.shape for k, v in step.info.items()} == dict.fromkeys(
        (*(f"reward_{name}" for name in REWARDS), "landmarks_covered", "collisions"), (batch,)
    )


@pytest.mark.parametrize("episode", [25, 4])
def test_episodes_have_their_length_and_keep_their_last_observation(episode: int) -> None:
    cfg = navigation.Config(episode=episode)
    env = make_env(cfg, 6, seeded(1))
    assert env.reset().first.all()
    ages = torch.arange(6) % episode
    env.state = env.state._replace(steps=ages.clone())
    for _ in range(2 * episode + 1):
        before = env.state
        action = random_action(cfg, 6, env.rng)
        step = env.step(action)
        ages = ages + 1
        done = ages == episode
        assert torch.equal(step.truncated, done)
        assert not step.terminated.any()
        true_last = navigation.observe(cfg, navigation.transition(cfg, before, action, env.rng))
        assert all(torch.equal(a, b) for a, b in zip(step.final_obs[:3], true_last[:3], strict=True))
        assert not step.final_obs.first.any()
        assert torch.equal(step.obs.first, done)
        for kept, shown in zip(step.final_obs[:3], step.obs[:3], strict=True):
            assert torch.equal((kept != shown).flatten(1).any(-1), done)
        assert not step.obs.agents[done][..., :2].any()  # at rest
        ages = torch.where(done, 0, ages)


def test_starts_fill_the_square_at_rest() -> None:
    state = navigation.initial(navigation.Config(agents=4), 2000, seeded(2))
    places = torch.cat((state.position, state.landmarks), 1)
    assert places.abs().max() <= 1
    assert places.amax((0, 1)).min() > 0.99
    assert places.amin((0, 1)).max() < -0.99
    assert places.mean((0, 1)).abs().max() < 0.03
    assert not state.velocity.any()


def rollout(env: Env, steps: int) -> list[Tensor]:
    out = []
    for _ in range(steps):
        step = env.step(single(random_action(env.cfg, env.batch, env.rng)))
        out += [*step.obs, *step.final_obs, step.reward, *step.local, step.completed, step.truncated]
    return out


def same(a: list[Tensor], b: list[Tensor]) -> bool:
    return len(a) == len(b) and all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def test_a_seed_decides_everything() -> None:
    runs = []
    for seed in (5, 5, 6):
        env = make_env(navigation.Config(), 3, seeded(seed))
        env.reset()
        runs.append(rollout(env, 30))
    assert same(runs[0], runs[1])
    assert not same(runs[0], runs[2])


@pytest.mark.parametrize("continuous", [False, True])
def test_a_checkpoint_continues_bit_for_bit(continuous: bool) -> None:
    cfg = navigation.Config(agents=4, continuous=continuous)
    env, other = make_env(cfg, 5, seeded(7)), make_env(cfg, 5, seeded(8))
    env.reset()
    other.reset()
    rollout(env, 12)
    file = io.BytesIO()
    torch.save(env.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    assert same(rollout(env, 40), rollout(other, 40))


def test_an_action_is_cut_to_full_force() -> None:
    cfg = navigation.Config(continuous=True)
    state = navigation.initial(cfg, 2, seeded(0))
    wild = torch.full((2, 3, 2), -7.0)
    got = navigation.transition(cfg, state, wild, seeded(0))
    assert_near(got.velocity, navigation.transition(cfg, state, wild / 7, seeded(0)).velocity, 0)


def test_agents_on_one_point_and_far_apart_stay_finite() -> None:
    cfg = navigation.Config(agents=4)
    position = torch.tensor([[[0.3, 0.3], [0.3, 0.3], [1e6, 0.0], [0.3, 0.35]]])
    state = navigation.initial(cfg, 1, seeded(0))._replace(position=position)
    force = navigation.contact(position)
    assert_near(force[0, 0], force[0, 1], 1e-4)  # pushed by the fourth alone, not by each other
    assert_near(force.sum(1), [[0, 0]], 1e-4)
    assert_near(force[0, 0], [0, -25], 1e-2)
    moved = navigation.transition(cfg, state, torch.zeros(1, 4, dtype=torch.int64), seeded(0))
    assert moved.position.isfinite().all()
    assert moved.velocity.isfinite().all()


@pytest.mark.parametrize("policy", ["random", "hold"])
def test_known_levels_are_met(policy: str) -> None:
    """Returns per episode at N = 3 of two policies that need no code, against levels measured elsewhere."""
    cfg = navigation.Config()
    env = make_env(cfg, 4000, seeded(3))
    env.reset()
    steps = []
    for _ in range(cfg.episode):
        action = random_action(cfg, 4000, env.rng) * (policy == "random")
        steps.append(env.step(action))
    info = {key: torch.stack([step.info[key] for step in steps]) for key in steps[0].info}
    summary = navigation.summary(cfg, torch.stack([step.reward for step in steps]), info)
    for name in ("mpe2", "paper"):
        total = summary[f"return_{name}"]
        assert abs(float(total.mean()) - LEVELS[policy, name]) < 4 * float(total.std()) / 4000**0.5
    assert torch.equal(summary["return"], summary["return_paper"])
    assert_near(summary["return_mpe1"], 2 * summary["return_mpe2"] - 75, 1e-4)
    assert_near(summary["collisions"], sum(step.info["collisions"] for step in steps), 1e-6)
    covered = steps[-1].completed.any(1).float().mean(-1)
    assert_near(summary["landmarks_covered"], covered, 1e-6)
    assert abs(float(covered.mean()) - COVERED[policy]) < 0.01


# ---- the regulator's table


def lone_state(seed: int, batch: int, *, speed: float) -> navigation.State:
    """One agent per world in float64, so that nothing bumps into it."""
    rng = seeded(seed)
    velocity, steps = speed * uniform(rng, batch, 1, 2), torch.zeros(batch, dtype=torch.int64)
    return navigation.State(uniform(rng, batch, 1, 2), velocity, uniform(rng, batch, 1, 2), steps)


def travel(cfg: navigation.Config, state: navigation.State, plan: Tensor) -> Tensor:
    """True if the lone agents of (B,) worlds cover their landmark after any step of a plan (K, ...): (B,)."""
    hit = torch.zeros(len(state.steps), dtype=torch.bool)
    for action in plan:
        state = navigation.transition(cfg, state, action.expand(len(hit), *action.shape), seeded(0))
        hit |= navigation.outcome(cfg, state, action, None).completed.flatten()
    return hit


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("horizon", [1, 2, 5])
def test_the_table_bounds_every_discrete_plan(order: Any, horizon: int) -> None:
    cfg = navigation.Config(agents=1, order=order)
    state = lone_state(11, 60, speed=2.0)
    bound = navigation.reachable(cfg, state, horizon).flatten()
    done = torch.zeros_like(bound)
    plans = torch.tensor(list(itertools.product(range(5), repeat=horizon)))
    for plan in plans[:: max(1, len(plans) // 200)]:
        done |= travel(cfg, state, plan.unsqueeze(-1))
    assert done.any()
    assert not (done & ~bound).any()


@quick
@given(seeds, st.sampled_from(ORDERS), st.integers(2, 12), st.booleans(), st.sampled_from([0.0, 2.0, 20.0]))
def test_wherever_a_plan_leads_is_reachable(
    seed: int, order: Any, horizon: int, continuous: bool, speed: float
) -> None:
    """Also at great speed, where what one step and the next can reach do not overlap."""
    cfg = navigation.Config(agents=1, order=order, continuous=continuous)
    rng, batch = seeded(seed), 200
    start = end = lone_state(seed, batch, speed=speed)
    plan = random_action(cfg, batch, rng)
    for _ in range(horizon):
        wavering = torch.rand(batch, generator=rng) < 0.3
        plan = torch.where(wavering.view(-1, *[1] * (plan.dim() - 1)), random_action(cfg, batch, rng), plan)
        end = navigation.transition(cfg, end, plan, rng)
    there = start._replace(landmarks=end.position + 0.07 * uniform(rng, batch, 1, 2))
    assert navigation.reachable(cfg, there, horizon).all()


@quick
@given(seeds, st.sampled_from(ORDERS), st.integers(1, 12), st.booleans())
def test_the_table_is_no_larger_than_what_a_steady_force_reaches(
    seed: int, order: Any, horizon: int, continuous: bool
) -> None:
    """States called reachable are reached by a steady force: any in the square, or |x| + |y| <= 1 if discrete."""
    cfg = navigation.Config(agents=1, order=order, continuous=continuous)
    free = cfg.model_copy(update={"continuous": True})
    state = lone_state(seed, 30, speed=2.0)
    bound = navigation.reachable(cfg, state, horizon).flatten()
    axis = torch.linspace(-1, 1, 41, dtype=torch.float64)
    forces = torch.cartesian_prod(axis, axis)
    forces = forces if continuous else forces[forces.abs().sum(-1) <= 1 + 1e-9]
    done = torch.zeros_like(bound)
    for row in bound.nonzero().flatten().tolist():
        lone = navigation.State(*(part[row].expand(len(forces), *part[row].shape) for part in state))
        near = torch.full((len(forces),), math.inf, dtype=torch.float64)
        for _ in range(horizon):
            lone = navigation.transition(free, lone, forces.unsqueeze(1), seeded(0))
            near = near.minimum((lone.position - lone.landmarks).norm(dim=-1).flatten())
        done[row] = near.min() < 0.1 + 0.05  # the grid of forces is coarse
    assert torch.equal(done, bound)


@quick
@given(seeds, counts, st.booleans(), st.sampled_from(ORDERS))
def test_a_longer_horizon_completes_no_less(seed: int, n: int, continuous: bool, order: Any) -> None:
    cfg = navigation.Config(agents=n, continuous=continuous, order=order)
    state = world_state(cfg, 4, seeded(seed), "spread")
    tables = [navigation.options(cfg, state, h) for h in range(8)]
    assert all((a <= b).all() for a, b in itertools.pairwise(tables))
    assert not tables[0][:, :, :-1].any()
    assert all(torch.equal(t[:, :, -1], tables[0][:, :, -1]) for t in tables)


@quick
@given(seeds, counts, starts)
def test_some_option_contains_whatever_is_completed_after_a_step(seed: int, n: int, start: Start) -> None:
    """With the agents too far apart to bump, the set that an agent covers next fits into one of its options."""
    cfg = navigation.Config(agents=n, order="mpe1")
    rng = seeded(seed)
    state = world_state(cfg, 8, rng, start)
    lanes = torch.arange(n).view(1, n, 1) * 10.0
    state = state._replace(
        position=state.position + lanes, landmarks=state.position * 0.1 + state.position + lanes[:, :1]
    )
    table = navigation.options(cfg, state, 2)
    for _ in range(2):
        action = random_action(cfg, 8, rng)
        state = navigation.transition(cfg, state, action, rng)
        done = navigation.outcome(cfg, state, action, None).completed
        assert (done.unsqueeze(2) <= table).all(-1).any(-1).all()


def test_options_by_hand() -> None:
    """Agent on landmark 0, at rest; landmark 1 close to landmark 0; landmark 2 far away."""
    cfg = navigation.Config()
    places = torch.tensor([[[0.0, 0.0], [0.15, 0.0], [1.0, 0.0]]])
    agents = torch.tensor([[[0.0, 0.0], [-3.0, 0.0], [1.0, 3.0]]])
    velocity = torch.tensor([[[0.0, 0.0], [0.0, 0.0], [0.0, -29.5]]])
    state = navigation.State(agents, velocity, places, torch.zeros(1, dtype=torch.int64))
    short = navigation.options(cfg, state, 1)[0].int().tolist()
    assert short[0] == [[1, 0, 0], [0, 0, 0], [0, 0, 0], [1, 0, 0]]  # the close pair is only reached by moving
    assert short[1] == [[0, 0, 0]] * 4
    assert short[2] == [[0, 0, 0], [0, 0, 0], [0, 0, 1], [0, 0, 0]]  # it flies in
    longer = navigation.options(cfg, state, 4)[0].int().tolist()
    assert longer[0] == [[1, 1, 0], [1, 1, 0], [0, 0, 0], [1, 0, 0]]
    assert longer[1] == [[0, 0, 0]] * 4


def test_discrete_actions_reach_a_diamond_and_continuous_ones_a_square() -> None:
    state = lone_state(0, 1, speed=0.0)
    reach = 0.1 * 0.5 * sum((1 - 0.75**t) / 0.25 for t in range(10))
    for corner, discrete, continuous in [(0.45, True, True), (0.9, False, True), (1.2, False, False)]:
        there = state._replace(landmarks=state.position + corner * reach)
        got = [
            bool(navigation.reachable(navigation.Config(agents=1, continuous=c), there, 10).any())
            for c in (False, True)
        ]
        assert got == [discrete, continuous]
