"""The two encoders: shapes, what each output may depend on, and that `pairwise` does not care about N, M or order."""

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from pipelines.conformance.checks import reordered
from rhmc.envs import coverage, make_env, navigation
from rhmc.networks.linear import Linear
from rhmc.networks.nets import ENCODERS, Sizes, append, mlp
from rhmc.types import Obs

HIDDEN, OUT = 8, 3
Make = Callable[[Sizes], nn.Module]
SHAPES: dict[str, Make] = {
    f"{name} {shape}": partial(getattr(encoder, shape), hidden=HIDDEN, out=OUT)
    for name, encoder in ENCODERS.items()
    for shape in ("local", "central", "pairs")
}
TASKS = {  # features: with and without an agent's own and peers
    "all": Sizes(agents=3, targets=4, agent=2, pair=5, peer=2),
    "pairs only": Sizes(agents=3, targets=4, agent=0, pair=5, peer=0),
    "square": Sizes(agents=3, targets=3, agent=2, pair=5, peer=2),
    "one agent": Sizes(agents=1, targets=4, agent=2, pair=5, peer=2),
    "one target": Sizes(agents=3, targets=1, agent=0, pair=5, peer=2),
}


def draw(s: Sizes, batch: int = 2) -> Obs:
    first = torch.zeros(batch, dtype=torch.bool)
    peers = torch.randn(batch, s.agents, s.agents, s.peer)
    return Obs(torch.randn(batch, s.agents, s.agent), torch.randn(batch, s.agents, s.targets, s.pair), peers, first)


def reorder_targets(obs: Obs, order: list[int]) -> Obs:
    return obs._replace(pairs=obs.pairs[:, :, order])


def close(a: Tensor, b: Tensor) -> bool:
    return torch.allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("task", TASKS)
def test_output_shapes_and_that_all_weights_matter(shape: str, task: str) -> None:
    s = TASKS[task]
    net, obs = SHAPES[shape](s), draw(s, batch=7)
    out = net(obs)
    per = (s.agents, s.targets) if shape.endswith("pairs") else (s.agents,)
    assert out.shape == (7, *per, OUT)
    out.square().sum().backward()
    for name, p in net.named_parameters():
        alone = "central" in shape and s.agents == 1 and name.startswith("other")
        assert p.grad is not None, name
        assert alone or bool(p.grad.abs().sum() > 0), name


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("task", TASKS)
def test_environments_of_a_batch_do_not_mix(shape: str, task: str) -> None:
    net, obs = SHAPES[shape](TASKS[task]), draw(TASKS[task], batch=4)
    alone = torch.cat([net(Obs(*(x[b : b + 1] for x in obs))) for b in range(4)])
    assert close(net(obs), alone)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("task", ["all", "square", "pairs only"])
def test_what_each_agent_depends_on(shape: str, task: str) -> None:
    """A local output on its own row alone; central ones and pairs on everybody's."""
    net, obs = SHAPES[shape](TASKS[task]), draw(TASKS[task])
    for i, k in product(range(3), range(3)):
        inputs = [x.clone().requires_grad_() for x in obs[:3]]
        agents, pairs, peers = inputs
        net(Obs(agents, pairs, peers, obs.first))[:, i].square().sum().backward()
        looked_at = inputs[:2] if shape == "pairwise pairs" else inputs  # that one leaves peers out
        for x in (x for x in looked_at if x.numel()):
            assert x.grad is not None
            seen = bool(x.grad[:, k].abs().sum() > 0)
            assert seen == (i == k or not shape.endswith("local")), (i, k)


@pytest.mark.parametrize("shape", [s for s in SHAPES if s.startswith("pairwise")])
@pytest.mark.parametrize("task", TASKS)
def test_pairwise_follows_a_reordering_of_agents_and_of_targets(shape: str, task: str) -> None:
    s = TASKS[task]
    net, obs = SHAPES[shape](s), draw(s)
    out = net(obs)
    agents, targets = torch.randperm(s.agents).tolist(), torch.randperm(s.targets).tolist()
    assert close(net(reordered(obs, agents)), out[:, agents])
    expected = out[:, :, targets] if shape.endswith("pairs") else out
    assert close(net(reorder_targets(obs, targets)), expected)


@pytest.mark.parametrize("shape", [s for s in SHAPES if s.startswith("mlp") and not s.endswith("pairs")])
def test_mlp_tells_agents_apart(shape: str) -> None:
    """Two agents with the same row are not the same agent."""
    s = TASKS["pairs only"]
    obs = draw(s)
    obs = obs._replace(pairs=obs.pairs[:, :1].expand(-1, 3, -1, -1))
    out = SHAPES[shape](s)(obs)
    assert not close(out[:, 0], out[:, 1])


@pytest.mark.parametrize("shape", [s for s in SHAPES if s.startswith("pairwise")])
@pytest.mark.parametrize(("agents", "targets"), [(1, 1), (2, 6), (5, 2)])
def test_pairwise_weights_act_for_any_number_of_agents_and_targets(shape: str, agents: int, targets: int) -> None:
    s = TASKS["all"]
    net, other = SHAPES[shape](s), s._replace(agents=agents, targets=targets)
    moved = SHAPES[shape](other)
    moved.load_state_dict(net.state_dict())
    obs = draw(other)
    assert torch.equal(moved(obs), net(obs))
    twice = obs._replace(pairs=obs.pairs.repeat(1, 1, 2, 1))  # every target doubled: pools do not change
    again = net(twice)
    assert close(again[:, :, :targets] if shape.endswith("pairs") else again, net(obs))


def test_a_pair_meets_its_own_row_and_column() -> None:
    """Pools go over an agent's targets and over a target's agents, not over other pairs."""
    s = Sizes(agents=3, targets=3, agent=0, pair=5, peer=0)
    net = ENCODERS["pairwise"].pairs(s, 64, 1)
    for i, j in product(range(3), range(3)):
        obs = draw(s, batch=8)
        pairs = obs.pairs.requires_grad_()
        net(obs)[:, i, j].sum().backward()
        assert pairs.grad is not None
        met = pairs.grad.abs().sum((0, -1)) > 0
        expected = torch.zeros(3, 3, dtype=torch.bool)
        expected[i, :] = expected[:, j] = True
        assert torch.equal(met, expected)


@pytest.mark.parametrize("encoder", ENCODERS)
def test_a_central_output_sees_the_actions_of_the_others_and_its_own_only_as_own(encoder: str) -> None:
    s = TASKS["all"]
    net, obs = ENCODERS[encoder].central(s, 32, OUT, own=2, joint=4), draw(s)
    for i in range(3):
        own, joint = torch.randn(2, 3, 2, requires_grad=True), torch.randn(2, 3, 4, requires_grad=True)
        net(obs, own, joint)[:, i].square().sum().backward()
        assert own.grad is not None
        assert joint.grad is not None
        assert (own.grad.abs().sum((0, 2)) > 0).tolist() == [k == i for k in range(3)]
        assert (joint.grad.abs().sum((0, 2)) > 0).tolist() == [k != i for k in range(3)]


def test_pairwise_central_reorders_actions_with_agents() -> None:
    s = TASKS["all"]
    net, obs = ENCODERS["pairwise"].central(s, HIDDEN, OUT, own=2, joint=4), draw(s)
    own, joint, order = torch.randn(2, 3, 2), torch.randn(2, 3, 4), [2, 0, 1]
    out = net(reordered(obs, order), own[:, order], joint[:, order])
    assert close(out, net(obs, own, joint)[:, order])


def test_sizes_of_a_task_fit_its_observations() -> None:
    configs: list[Any] = [
        coverage.Config(),
        coverage.Config(observation="extended", agents=2, targets=6),
        navigation.Config(),
        navigation.Config(observation="extended", agents=4),
    ]
    for cfg in configs:
        env = make_env(cfg, 2, torch.Generator())
        sizes = Sizes.of(env.spec, agent=1, pair=2)
        obs = append(
            env.reset(), agent=torch.zeros(2, cfg.agents, 1), pair=torch.zeros(2, cfg.agents, sizes.targets, 2)
        )
        for encoder, shape in product(ENCODERS.values(), ("local", "central", "pairs")):
            assert getattr(encoder, shape)(sizes, HIDDEN, OUT)(obs).isfinite().all()


def test_append_puts_features_last_and_leaves_the_rest() -> None:
    obs = draw(TASKS["all"])
    more = append(obs, pair=torch.full((2, 3, 4, 1), 7.0))
    assert torch.equal(more.pairs[..., :5], obs.pairs)
    assert (more.pairs[..., 5:] == 7).all()
    assert more.agents is obs.agents
    more = append(obs, agent=torch.full((2, 3, 2), 7.0))
    assert torch.equal(more.agents, torch.cat((obs.agents, torch.full((2, 3, 2), 7.0)), -1))
    assert more.pairs is obs.pairs


def test_mlp_is_linear_at_its_end_and_rectified_between() -> None:
    net = mlp(2, 5, 1)
    assert [type(layer) for layer in net] == [Linear, nn.ReLU, Linear]
    x = torch.randn(4, 2)
    first, _, last = net
    assert torch.equal(net(x), last(first(x).clamp(min=0)))
    assert len(mlp(2, 1)) == 1
