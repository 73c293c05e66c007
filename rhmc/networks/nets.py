"""Networks over an observation, in two encoders with the same four shapes.

`local`: each agent from its own row. `central`: each agent from everything, with joint actions. `pairs`: each (agent,
target) pair from all pairs. `mixer`: one value from each agent's, monotone in every one (QMIX). The encoder `mlp` is
the paper's fully connected layer on padded, flattened features with a one-hot agent id; `pairwise` shares one network
over all (agent, target) pairs and pools, so that its weights act for any N and M.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import elu

from rhmc.networks.linear import MLP, Linear, stack
from rhmc.types import Obs, Spec

EncoderName = Literal["mlp", "pairwise"]
LEAST = -1e-45  # the negative number nearest to zero


class Sizes(NamedTuple):
    """Feature counts of a network's input: an observation's own, plus what the algorithm appends to it."""

    agents: int  # N
    targets: int  # M
    agent: int  # Fa
    pair: int  # Fp
    peer: int  # Fo

    @classmethod
    def of(cls, spec: Spec, *, agent: int = 0, pair: int = 0) -> "Sizes":
        """The task's sizes, with `agent` and `pair` more features."""
        return cls(
            spec.agents, spec.targets, spec.agent_features + agent, spec.pair_features + pair, spec.peer_features
        )


def mlp(*sizes: int) -> MLP:
    """Linear layers with ReLU between them; the last one is linear."""
    layers: list[nn.Module] = []
    for i, o in pairwise(sizes):
        layers += [Linear(i, o), nn.ReLU()]
    return MLP(*layers[:-1])


def append(obs: Obs, *, agent: Tensor | None = None, pair: Tensor | None = None) -> Obs:
    """The observation with features (B, N, K) or (B, N, M, K) appended."""
    agents = obs.agents if agent is None else torch.cat((obs.agents, agent), -1)
    pairs = obs.pairs if pair is None else torch.cat((obs.pairs, pair), -1)
    return obs._replace(agents=agents, pairs=pairs)


class FlatLocal(nn.Module):
    """Own row, flattened, and the agent's one-hot id -> (B, N, out)."""

    def __init__(self, sizes: Sizes, hidden: int, out: int) -> None:
        super().__init__()
        self.net = mlp(_row(sizes) + sizes.agents, hidden, hidden, out)

    def forward(self, obs: Obs) -> Tensor:
        rows = _rows(obs)
        return self.net(torch.cat((rows, _ids(rows)), -1))


class FlatCentral(nn.Module):
    """All rows, the other agents' actions (B, N, joint), the own action (B, N, own) and id -> (B, N, out)."""

    def __init__(self, sizes: Sizes, hidden: int, out: int, *, own: int = 0, joint: int = 0) -> None:
        super().__init__()
        n = sizes.agents
        self.net = mlp(n * (_row(sizes) + joint) + own + n, hidden, hidden, out)

    def forward(self, obs: Obs, own: Tensor | None = None, joint: Tensor | None = None) -> Tensor:
        rows = _rows(obs)
        b, n, _ = rows.shape
        parts = [rows.flatten(1).unsqueeze(1).expand(b, n, -1), _ids(rows)]
        if joint is not None:
            parts.append((joint.unsqueeze(1) * (1 - _ids(rows)).unsqueeze(-1)).flatten(2))
        if own is not None:
            parts.append(own)
        return self.net(torch.cat(parts, -1))


class PairNet(nn.Module):
    """A network of the third shape: features of every pair -> (B, N, M, out)."""

    def flips(self, obs: Obs) -> Tensor:
        """The output summed over pairs if one pair's last feature, 0 or 1, were the other: (B, N, M), one at a time."""
        raise NotImplementedError


class FlatPairs(PairNet):
    """All rows, flattened -> (B, N, M, out)."""

    def __init__(self, sizes: Sizes, hidden: int, out: int) -> None:
        super().__init__()
        self.shape = (sizes.agents, sizes.targets, out)
        self.net = mlp(sizes.agents * _row(sizes), hidden, hidden, sizes.agents * sizes.targets * out)

    def forward(self, obs: Obs) -> Tensor:
        return self.net(_rows(obs).flatten(1)).unflatten(1, self.shape)

    def flips(self, obs: Obs) -> Tensor:
        """See `PairNet`. A flip moves the first layer's output along one column of its weights."""
        b, n, m, f = obs.pairs.shape
        every = torch.arange(n * m, device=obs.pairs.device)
        inputs = obs.agents.shape[-1] + m * f + obs.peers.shape[2] * obs.peers.shape[3]
        column = every // m * inputs + obs.agents.shape[-1] + every % m * f + f - 1
        first, *rest = self.net
        assert isinstance(first, nn.Linear)
        change = (1 - 2 * obs.pairs[..., -1]).flatten(1)
        before = first(_rows(obs).flatten(1))
        values = before.unsqueeze(1) + change.unsqueeze(-1) * first.weight.T[column]
        for layer in rest:
            values = layer(values)
        return values.sum(-1).view(b, n, m)


class _PairBody(nn.Module):
    """One network on every pair -> embeddings (B, N, M, H)."""

    def __init__(self, sizes: Sizes, hidden: int) -> None:
        super().__init__()
        self.pair = Linear(sizes.pair, hidden)
        self.agent = Linear(sizes.agent, hidden, bias=False) if sizes.agent else None
        self.second = Linear(hidden, hidden)

    def forward(self, obs: Obs) -> Tensor:
        if self.agent is None:
            return stack(obs.pairs, (self.pair, self.second), last="relu")
        h = self.pair(obs.pairs) + self.agent(obs.agents).unsqueeze(2)
        return stack(h.relu_(), (self.second,), last="relu")


class _AgentBody(nn.Module):
    """Pair embeddings pooled over targets, peers pooled over peers, own features -> (B, N, width)."""

    def __init__(self, sizes: Sizes, hidden: int) -> None:
        super().__init__()
        self.pairs = _PairBody(sizes, hidden)
        self.peers = mlp(sizes.peer, hidden, hidden) if sizes.peer else None
        self.width = 2 * hidden + sizes.agent + (2 * hidden if sizes.peer else 0)

    def forward(self, obs: Obs) -> Tensor:
        parts = [_pool(self.pairs(obs), 2)]
        if obs.agents.shape[-1]:
            parts.append(obs.agents)
        if self.peers is not None:
            parts.append(_pool(self.peers(obs.peers).relu(), 2))
        return torch.cat(parts, -1) if len(parts) > 1 else parts[0]


class PairwiseLocal(nn.Module):
    """Own pairs, pooled over targets -> (B, N, out)."""

    def __init__(self, sizes: Sizes, hidden: int, out: int) -> None:
        super().__init__()
        self.body = _AgentBody(sizes, hidden)
        self.head = mlp(self.body.width, hidden, out)

    def forward(self, obs: Obs) -> Tensor:
        return self.head(self.body(obs))


class PairwiseCentral(nn.Module):
    """Own embedding and action (B, N, own) beside the mean of the others' with theirs (B, N, joint) -> (B, N, out)."""

    def __init__(self, sizes: Sizes, hidden: int, out: int, *, own: int = 0, joint: int = 0) -> None:
        super().__init__()
        self.body = _AgentBody(sizes, hidden)
        self.other = Linear(self.body.width + joint, hidden)
        self.head = mlp(self.body.width + own + hidden, hidden, out)

    def forward(self, obs: Obs, own: Tensor | None = None, joint: Tensor | None = None) -> Tensor:
        mine = theirs = self.body(obs)
        if joint is not None:
            theirs = torch.cat((theirs, joint), -1)
        if own is not None:
            mine = torch.cat((mine, own), -1)
        other = self.other(theirs).relu()
        n = other.shape[1]
        mean = (other.sum(1, keepdim=True) - other) / max(n - 1, 1)
        return self.head(torch.cat((mine, mean), -1))


class PairwisePairs(PairNet):
    """Each pair's embedding with its agent's pool and its target's pool -> (B, N, M, out)."""

    def __init__(self, sizes: Sizes, hidden: int, out: int) -> None:
        super().__init__()
        self.pairs = _PairBody(sizes, hidden)
        self.own = Linear(hidden, hidden)
        self.row = Linear(2 * hidden, hidden, bias=False)
        self.column = Linear(2 * hidden, hidden, bias=False)
        self.head = Linear(hidden, out)

    def forward(self, obs: Obs) -> Tensor:
        e = self.pairs(obs)
        context = self.row(_pool(e, 2)).unsqueeze(2) + self.column(_pool(e, 1)).unsqueeze(1)
        return self.head((self.own(e) + context).relu_())

    def flips(self, obs: Obs) -> Tensor:
        """See `PairNet`. A flip changes its own embedding, hence the pools of its row and its column, and no others."""
        last = obs.pairs[..., -1:]
        other = obs._replace(pairs=torch.cat((obs.pairs[..., :-1], 1 - last), -1))
        e, new = self.pairs(obs), self.pairs(other)
        own, row, column = self.own(e), self.row(_pool(e, 2)), self.column(_pool(e, 1))
        new_row, new_column = self.row(_repool(e, new, 2)), self.column(_repool(e, new, 1))  # (B, N, M, H)
        before = self._score(own + row.unsqueeze(2) + column.unsqueeze(1))
        # Of pair (i, j) when (i, k) flips, and when (k, j) does.
        in_row = self._score((own + column.unsqueeze(1)).unsqueeze(3) + new_row.unsqueeze(2))  # (B, N, M, k)
        in_column = self._score((own + row.unsqueeze(2)).unsqueeze(2) + new_column.unsqueeze(1))  # (B, N, k, M)
        at = self._score(self.own(new) + new_row + new_column)
        n, m = before.shape[1:]
        in_row = (in_row - before.unsqueeze(3)) * (1 - torch.eye(m, device=e.device)).view(1, 1, m, m)
        in_column = (in_column - before.unsqueeze(2)) * (1 - torch.eye(n, device=e.device)).view(1, n, n, 1)
        return before.sum((1, 2)).view(-1, 1, 1) + in_row.sum(2) + in_column.sum(1) + at - before

    def _score(self, hidden: Tensor) -> Tensor:
        return self.head(hidden.relu_()).squeeze(-1)


class FlatMixer(nn.Module):
    """Values of the agents (B, N), mixed by weights made from all rows -> (B, 1). Rashid et al. 2018, figure 2."""

    def __init__(self, sizes: Sizes, hidden: int, embed: int) -> None:
        super().__init__()
        state, self.embed = sizes.agents * _row(sizes), embed
        self.first, self.bias = mlp(state, hidden, sizes.agents * embed), Linear(state, embed)
        self.second, self.value = mlp(state, hidden, embed), mlp(state, embed, 1)

    def forward(self, obs: Obs, values: Tensor) -> Tensor:
        state = _rows(obs).flatten(1)
        first = self.first(state).unflatten(1, (-1, self.embed))
        return mix(values, first, self.bias(state), self.second(state)) + self.value(state)


class PairwiseMixer(nn.Module):
    """The same with an agent's weights made from its own embedding, the rest from the mean over agents -> (B, 1)."""

    def __init__(self, sizes: Sizes, hidden: int, embed: int) -> None:
        super().__init__()
        self.body = _AgentBody(sizes, hidden)
        width = self.body.width
        self.first, self.bias = mlp(width, hidden, embed), Linear(width, embed)
        self.second, self.value = mlp(width, hidden, embed), mlp(width, embed, 1)

    def forward(self, obs: Obs, values: Tensor) -> Tensor:
        each = self.body(obs)
        state = each.mean(1)
        return mix(values, self.first(each), self.bias(state), self.second(state)) + self.value(state)


def mix(values: Tensor, first: Tensor, bias: Tensor, second: Tensor) -> Tensor:
    """Two layers whose weights are taken without their sign, so that no value counts against the result.

    Args:
        values: (B, N). first: (B, N, E). bias, second: (B, E).

    Returns:
        (B, 1).
    """
    hidden = elu((values.unsqueeze(-1) * first.abs()).sum(1) + bias)
    return (hidden * second.abs()).sum(-1, keepdim=True)


class Unshared(nn.Module):
    """A network of its own for every agent: row i of the output comes from the i-th. Each is run on all rows."""

    def __init__(self, nets: list[nn.Module]) -> None:
        super().__init__()
        self.nets = nn.ModuleList(nets)

    def forward(self, obs: Obs, *args: Tensor, **kwargs: Tensor) -> Tensor:
        return torch.stack([net(obs, *args, **kwargs)[:, i] for i, net in enumerate(self.nets)], 1)


def team(make: Callable[[], nn.Module], agents: int, *, share: bool) -> nn.Module:
    """The network of all agents, or one for each of them. `make` builds a network with an output (B, N, ...)."""
    return make() if share else Unshared([make() for _ in range(agents)])


class Encoder(NamedTuple):
    """The four shapes of one encoder."""

    local: Callable[..., nn.Module]
    central: Callable[..., nn.Module]
    pairs: Callable[..., PairNet]
    mixer: Callable[..., nn.Module]


ENCODERS: dict[str, Encoder] = {
    "mlp": Encoder(FlatLocal, FlatCentral, FlatPairs, FlatMixer),
    "pairwise": Encoder(PairwiseLocal, PairwiseCentral, PairwisePairs, PairwiseMixer),
}


def _pool(h: Tensor, dim: int) -> Tensor:
    pooled: Tensor = _MeanMax.apply(h, dim)
    return pooled


class _MeanMax(torch.autograd.Function):
    """Mean and maximum over one dimension side by side, with the derivatives of `mean` and `amax`, bit for bit.

    That of `amax` compares numbers, which takes torch several times as long as arithmetic on them.
    """

    @staticmethod
    def forward(ctx: Any, h: Tensor, dim: int) -> Tensor:
        largest = h.amax(dim)
        ctx.save_for_backward(h, largest)
        ctx.dim = dim
        return torch.cat((h.mean(dim), largest), -1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        h, largest = ctx.saved_tensors
        by_mean, by_largest = grad.chunk(2, -1)
        is_largest = torch.threshold_(h - largest.unsqueeze(ctx.dim), LEAST, -1.0).add_(1.0)  # 1 or 0
        share = by_largest / is_largest.sum(ctx.dim)  # equals share
        mean = by_mean / h.shape[ctx.dim]
        return torch.addcmul(mean.unsqueeze(ctx.dim), is_largest, share.unsqueeze(ctx.dim), out=is_largest), None


def _repool(h: Tensor, new: Tensor, dim: int) -> Tensor:
    """`_pool` over `dim` with one entry replaced by its new value, for every entry: (B, N, M, H) -> (B, N, M, 2 H)."""
    mean = h.mean(dim, keepdim=True) + (new - h) / h.shape[dim]
    parts = h.unbind(dim)
    below, above = [new.select(dim, 0)], [new.select(dim, -1)]  # largest of the new entry and those before, behind it
    for k in range(1, len(parts)):
        below.append(torch.maximum(parts[k - 1], below[-1]) if k > 1 else parts[0])
        above.append(torch.maximum(parts[-k], above[-1]) if k > 1 else parts[-1])
    largest = torch.stack(below, dim).maximum(torch.stack(above[::-1], dim)).maximum(new)
    return torch.cat((mean, largest), -1)


def _row(sizes: Sizes) -> int:
    return sizes.agent + sizes.targets * sizes.pair + sizes.agents * sizes.peer


def _rows(obs: Obs) -> Tensor:
    return torch.cat((obs.agents, obs.pairs.flatten(2), obs.peers.flatten(2)), -1)


def _ids(rows: Tensor) -> Tensor:
    b, n, _ = rows.shape
    return torch.eye(n, device=rows.device).expand(b, n, n)
