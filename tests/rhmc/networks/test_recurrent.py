"""Encoders with memory: the cell against torch's, a whole sequence against one step after the other."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

from pipelines.conformance.checks import reordered
from rhmc.networks.nets import ENCODERS, Sizes, Unshared, team
from rhmc.networks.recurrent import Cell, Recurrent, encoder, remembers, stepped, unrolled
from rhmc.types import Obs, Spec
from tests.support import observation

SPEC = Spec(3, 2, agent_features=1, pair_features=4, peer_features=2, actions=5, continuous=False, episode=9)
SIZES = Sizes.of(SPEC)
T, B, N, H, OUT = 6, 4, SPEC.agents, 8, 5
NAMES = [f"{name}_gru" for name in ENCODERS]
SHAPES = ("local", "central")


def net(name: str = "pairwise_gru", shape: str = "local", *, share: bool = True) -> nn.Module:
    make: Callable[..., nn.Module] = getattr(encoder(name), shape)
    return team(lambda: make(SIZES, H, OUT), N, share=share)


def at(obs: Obs, t: int, first: Tensor) -> Obs:
    """Step t of observations (T B, ...)."""
    rows = slice(t * B, (t + 1) * B)
    return Obs(obs.agents[rows], obs.pairs[rows], obs.peers[rows], first)


def begins() -> Tensor:
    """Where episodes begin, (T, B): nowhere, at the start, twice in the middle, and at every step."""
    first = torch.zeros(T, B, dtype=torch.bool)
    first[0, 1] = first[2, 2] = first[4, 2] = True
    first[:, 3] = True
    return first


def by_hand(network: nn.Module, obs: Obs, state: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
    """Output and state of every step, by one call for each and a state that is put to zero where an episode begins."""
    outputs, states = [], []
    for t in range(T):
        state = state.clone()
        state[first[t]] = 0.0
        output, state = unrolled(network, at(obs, t, first[t]), state, torch.zeros(1, B, dtype=torch.bool))
        output, state = output[0], state[0]
        outputs.append(output)
        states.append(state)
    return torch.stack(outputs), torch.stack(states)


def test_the_cell_is_torchs_in_value_and_slope() -> None:
    ours, theirs = Cell(3, H), nn.GRUCell(3, H)
    theirs.load_state_dict(
        {
            "weight_ih": ours.inputs.weight,
            "bias_ih": ours.inputs.bias,
            "weight_hh": ours.hidden.weight,
            "bias_hh": ours.hidden.bias,
        }
    )
    x, state = torch.randn(7, 3, requires_grad=True), torch.randn(7, H, requires_grad=True)
    found, known = ours(ours.inputs(x), state), theirs(x, state)
    assert_close(found, known, atol=1e-6, rtol=0)
    weights = torch.randn_like(known)
    for a, b in zip(*(torch.autograd.grad((y * weights).sum(), (x, state)) for y in (found, known)), strict=True):
        assert_close(a, b, atol=1e-6, rtol=0)


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", NAMES)
def test_a_sequence_is_its_steps_in_value_and_slope(name: str, shape: str, share: bool) -> None:
    network, obs, state, first = net(name, shape, share=share), observation(SPEC, T * B), torch.randn(B, N, H), begins()
    weights, params = torch.randn(T, B, N, OUT), list(network.parameters())
    both = unrolled(network, obs, state, first), by_hand(network, obs, state, first)
    assert both[0][0].shape == (T, B, N, OUT)
    assert both[0][1].shape == (T, B, N, H)
    assert_close(both[0], both[1], atol=1e-6, rtol=0)
    slopes = [torch.autograd.grad((output * weights).sum(), params) for output, _ in both]
    assert all(bool(slope.any()) for slope in slopes[1])
    assert_close(slopes[0], slopes[1], atol=1e-5, rtol=1e-5)
    one, after = stepped(network, at(obs, 0, first[0]), state)
    assert_close((one, after), (both[0][0][0].detach(), both[0][1][0].detach()), atol=1e-6, rtol=0)
    assert not one.requires_grad
    assert not after.requires_grad


def test_nothing_goes_past_the_begin_of_an_episode() -> None:
    network, first = net(), begins()
    obs = observation(SPEC, T * B)
    obs.pairs.requires_grad_()
    state = torch.randn(B, N, H, requires_grad=True)
    output, _ = unrolled(network, obs, state, first)
    by_pairs, by_state = torch.autograd.grad(output[3].sum(), (obs.pairs, state))
    reached = by_pairs.unflatten(0, (T, B)).flatten(2).any(-1)
    assert reached.T.tolist() == [
        [True] * 4 + [False] * 2,
        [True] * 4 + [False] * 2,
        [False, False, True, True, False, False],
        [False, False, False, True, False, False],
    ]
    assert by_state.flatten(1).any(-1).tolist() == [True, False, False, False]


def test_memory_makes_a_difference() -> None:
    network, obs = net(), observation(SPEC, B)
    none, some = torch.zeros(B, N, H), torch.randn(B, N, H)
    assert not torch.allclose(stepped(network, obs, none)[0], stepped(network, obs, some)[0])


@pytest.mark.parametrize("shape", SHAPES)
def test_agents_in_another_order_remember_the_same(shape: str) -> None:
    network, obs, state, order = net("pairwise_gru", shape), observation(SPEC, B), torch.randn(B, N, H), [2, 0, 1]
    here, there = stepped(network, obs, state), stepped(network, reordered(obs, order), state[:, order])
    for one, moved in zip(here, there, strict=True):
        assert_close(moved, one[:, order], atol=1e-6, rtol=0)
        assert not torch.allclose(one, one[:, order], atol=1e-3)


def test_every_agent_of_its_own_has_its_own_memory() -> None:
    network, obs, state = net(share=False), observation(SPEC, B), torch.randn(B, N, H)
    assert isinstance(network, Unshared)
    for i, own in enumerate(network.nets):
        assert isinstance(own, Recurrent)
        for one, of_team in zip(stepped(own, obs, state), stepped(network, obs, state), strict=True):
            assert torch.equal(one[:, i], of_team[:, i])
    other = state.clone()
    other[:, 0] += 1
    changed = stepped(network, obs, state)[0] != stepped(network, obs, other)[0]
    assert changed.any(-1).any(0).tolist() == [True, False, False]


def test_an_encoder_without_memory_is_itself() -> None:
    for name, plain in ENCODERS.items():
        assert encoder(name) is plain
        assert not remembers(name)
        assert remembers(f"{name}_gru")
        assert encoder(f"{name}_gru").mixer is plain.mixer
