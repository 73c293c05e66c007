"""Action values and their mixers against values worked out by hand."""

from math import exp
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from pipelines.conformance.checks import seeded
from rhmc.algorithms import ALGORITHMS
from rhmc.algorithms.qlearning import QLearning
from rhmc.learning.schedules import linear
from rhmc.networks.nets import ENCODERS, Sizes, Unshared, mix, team
from rhmc.types import Batch, Obs, Spec
from tests.doubles import Known
from tests.support import observation, observed

SPEC = Spec(2, 3, agent_features=1, pair_features=4, peer_features=2, actions=3, continuous=False, episode=9)
SIZES = Sizes.of(SPEC)
KINDS = ("iql", "vdn", "qmix")
KEPT = 0.999  # of the running statistics


def rows(reward: list[float], terminated: list[bool], action: list[list[int]]) -> Batch:
    """A batch to learn from."""
    count = len(reward)
    known = {"reward": torch.tensor(reward), "terminated": torch.tensor(terminated), "action": torch.tensor(action)}
    return known | observed(SPEC, count)


NET = [[0.0, 1.0, 2.0], [3.0, 0.5, 0.0]]  # chooses actions 2 and 0
SLOW = [[50.0, 40.0, 30.0], [7.0, 8.0, 9.0]]  # would choose 0 and 2


def learner(kind: str, **changes: Any) -> QLearning:
    """A method with known values in place of its networks; QMIX's mixer makes 2 a + b + 1 of values a and b."""
    method = ALGORITHMS[kind]
    settings = {"gamma": 0.5, "standardise": "none", "lr": 1e-9, "mixing_embed_dim": 1, "hidden_dim": 4} | changes
    cfg = method.config(**{key: value for key, value in settings.items() if key in method.config.model_fields})
    built = method.build(cfg, SPEC, 1, seeded())
    assert isinstance(built, QLearning)
    for net, values in ((built.q.net, NET), (built.q.target_net, SLOW)):
        net.agents = Known(values)
        if kind == "qmix":
            net.mixer = Doubling()
    return built


class Doubling(nn.Module):
    def forward(self, obs: Obs, values: Tensor) -> Tensor:
        count = len(values)
        first = torch.tensor([[-2.0], [1.0]]).expand(count, -1, -1)
        return mix(values, first, torch.zeros(count, 1), torch.full((count, 1), -1.0)) + 1


def mixed(kind: str, a: float, b: float) -> list[float]:
    """Two agents' values as each method mixes them, for values that are not negative."""
    return {"iql": [a, b], "vdn": [a + b], "qmix": [2 * a + b + 1]}[kind]


def loss(q: QLearning, data: Batch) -> float:
    return q._loss(data)[0].item()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("double", [True, False])
def test_targets_by_hand(kind: str, double: bool) -> None:
    """Double Q: the network chooses (2, 0), the target network values that (30, 7); else its own best (50, 9)."""
    later = mixed(kind, 30, 7) if double else mixed(kind, 50, 9)
    expected = []
    for reward, live, now in ((0.25, 1, mixed(kind, 1, 3)), (-4, 0, mixed(kind, 2, 0.5))):
        expected += [(q - (reward + 0.5 * live * v)) ** 2 for q, v in zip(now, later, strict=True)]
    data = rows([0.25, -4.0], [False, True], [[1, 0], [2, 1]])
    assert loss(learner(kind, double_q=double), data) == pytest.approx(sum(expected) / len(expected), rel=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_standardised_rewards_by_hand(kind: str) -> None:
    """Mean 2 and deviation 1 of the two rewards met: the learner is paid (reward - 2) / 1."""
    q = learner(kind, standardise="reward")
    q.standardiser.update_rewards(torch.tensor([1.0, 3.0]))
    pay, now = (4.0 - 2) / 1, mixed(kind, 1, 3)
    expected = [(a - (pay + 0.5 * b)) ** 2 for a, b in zip(now, mixed(kind, 30, 7), strict=True)]
    data = rows([4.0], [False], [[1, 0]])
    assert loss(q, data) == pytest.approx(sum(expected) / len(expected), rel=1e-4)
    before = q.standardiser.sums.clone()
    loss(q, data)
    assert torch.equal(q.standardiser.sums, before)  # rewards are counted once, as they are met


@pytest.mark.parametrize("kind", KINDS)
def test_standardised_returns_by_hand(kind: str) -> None:
    """The target network's output means a return by the statistics so far; a target counts in them before it is one."""
    q = learner(kind, standardise="return")
    q.standardiser.update_returns(torch.tensor([4.0, 8.0]))  # mean 6, deviation 2
    target = [0.25 + 0.5 * (v * 2 + 6) for v in mixed(kind, 30, 7)]
    old, new = 1 - KEPT, 1 - KEPT  # weights of the first batch after the second, and of the second
    shares = (old * KEPT / (old * KEPT + new), new / (old * KEPT + new))
    means = (6.0, sum(target) / len(target))
    squares = ((16 + 64) / 2, sum(x * x for x in target) / len(target))
    mean, square = (sum(s * x for s, x in zip(shares, xs, strict=True)) for xs in (means, squares))
    deviation = (square - mean**2) ** 0.5
    expected = [(a - (t - mean) / deviation) ** 2 for a, t in zip(mixed(kind, 1, 3), target, strict=True)]
    assert loss(q, rows([0.25], [False], [[1, 0]])) == pytest.approx(sum(expected) / len(expected), rel=1e-3)


def test_epsilon_falls_in_a_line_and_stays() -> None:
    assert [linear(1.0, 0.1, 100, at) for at in (0, 50, 100, 1000)] == pytest.approx([1.0, 0.55, 0.1, 0.1])


@pytest.mark.parametrize(("steps", "epsilon"), [(0, 1.0), (500, 0.6), (1000, 0.2), (5000, 0.2)])
def test_exploring_is_by_the_epsilon_of_the_steps_taken(steps: int, epsilon: float) -> None:
    q = learner("vdn", epsilon_end=0.2, epsilon_steps=1000)
    q.experience.steps = steps
    action, _, _ = q.act(observation(SPEC, 20_000), {}, seeded(), explore=True)
    greedy = torch.tensor([2, 0])
    share = (action == greedy).float().mean(0)
    assert share.tolist() == pytest.approx([1 - epsilon * 2 / 3] * 2, abs=0.015)
    still, _, _ = q.act(observation(SPEC, 9), {}, seeded(), explore=False)
    assert (still == greedy).all()


# Mixers


def test_mix_by_hand() -> None:
    """Weights without their sign; ELU between: of 2 x 1 + 3 x 2 - 9 = -1 it is 1/e - 1, of 1 + 2 + 0.5 itself."""
    values = torch.tensor([[1.0, 2.0]])
    first, second = torch.tensor([[[-2.0, 1.0], [3.0, -1.0]]]), torch.tensor([[4.0, -5.0]])
    out = mix(values, first, torch.tensor([[-9.0, 0.5]]), second)
    assert out.shape == (1, 1)
    assert out.item() == pytest.approx(4 * (exp(-1) - 1) + 5 * 3.5)


@settings(deadline=None, max_examples=60)
@given(
    encoder=st.sampled_from(sorted(ENCODERS)),
    agents=st.integers(1, 4),
    raised=st.integers(0, 3),
    by=st.floats(0.01, 50),
    seed=st.integers(0, 999),
)
def test_no_value_counts_against_the_mix(encoder: str, agents: int, raised: int, by: float, seed: int) -> None:
    """Raising any agent's value never lowers the mixed one, whatever the weights; some raise it."""
    torch.manual_seed(seed)
    mixer = ENCODERS[encoder].mixer(SIZES._replace(agents=agents), 8, 4)
    with torch.no_grad():
        for p in mixer.parameters():
            p.add_(torch.randn_like(p))
        obs, values = observation(SPEC._replace(agents=agents), 16), 5 * torch.randn(16, agents)
        higher = values.clone()
        higher[:, raised % agents] += by
        low, high = mixer(obs, values), mixer(obs, higher)
    assert low.shape == (16, 1)
    assert (high >= low - 1e-4 * low.abs()).all()
    assert (high > low).any()


def test_the_flat_mixer_is_the_mix_of_its_own_weights() -> None:
    mixer = ENCODERS["mlp"].mixer(SIZES, 8, 4)
    obs, values = observation(SPEC, 5), torch.randn(5, 2)
    state = torch.cat((obs.agents, obs.pairs.flatten(2), obs.peers.flatten(2)), -1).flatten(1)
    parts: list[Any] = [mixer.get_submodule(name)(state) for name in ("first", "bias", "second", "value")]
    first, bias, second, value = parts
    expected = mix(values, first.view(5, 2, 4), bias, second) + value
    assert torch.allclose(mixer(obs, values), expected)


def test_the_pairwise_mixer_does_not_mind_the_order_or_the_number_of_agents() -> None:
    mixer = ENCODERS["pairwise"].mixer(SIZES, 8, 4)
    obs, values, order = observation(SPEC._replace(agents=4, targets=5), 6), torch.randn(6, 4), [2, 0, 3, 1]
    moved = Obs(obs.agents[:, order], obs.pairs[:, order], obs.peers[:, order][:, :, order], obs.first)
    assert torch.allclose(mixer(moved, values[:, order]), mixer(obs, values), atol=1e-5)
    assert not torch.allclose(mixer(obs, values[:, order]), mixer(obs, values), atol=1e-5)


# Parameters of one's own


@pytest.mark.parametrize("encoder", ENCODERS)
def test_row_i_of_unshared_networks_comes_from_network_i(encoder: str) -> None:
    nets = team(lambda: ENCODERS[encoder].local(SIZES, 8, 3), 2, share=False)
    obs = observation(SPEC, 7)
    assert isinstance(nets, Unshared)
    out = nets(obs)
    for i, net in enumerate(nets.nets):
        assert torch.equal(out[:, i], net(obs)[:, i])
        assert not torch.allclose(out[:, 1 - i], net(obs)[:, 1 - i])


@pytest.mark.parametrize("encoder", ENCODERS)
def test_unshared_networks_are_handed_actions_too(encoder: str) -> None:
    nets = team(lambda: ENCODERS[encoder].central(SIZES, 8, 1, own=3, joint=3), 2, share=False)
    obs, own, joint = observation(SPEC, 7), torch.randn(7, 2, 3), torch.randn(7, 2, 3)
    assert isinstance(nets, Unshared)
    each = [net(obs, own=own, joint=joint)[:, i] for i, net in enumerate(nets.nets)]
    assert torch.equal(nets(obs, own=own, joint=joint), torch.stack(each, 1))


def test_a_shared_team_is_one_network() -> None:
    made = []

    def make() -> nn.Module:
        made.append(ENCODERS["mlp"].local(SIZES, 8, 3))
        return made[-1]

    assert team(make, 2, share=True) is made[0]
    assert len(made) == 1
    assert isinstance(team(make, 2, share=False), Unshared)
    assert len(made) == 3
