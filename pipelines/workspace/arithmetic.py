"""Checks which of torch's operations give the published bytes here, for when a result differs from the published one.

Each group is a handful of operations that training and evaluation use, at the sizes that they use, on one thread.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator

import torch
from torch import Generator, Tensor, nn
from torch.nn.functional import elu, huber_loss, log_softmax, softmax, softplus

from rhmc.networks.linear import Linear, linear

DIGITS = 12
SIZES = (
    *((2560, 4, 64), (2560, 10, 64), (2560, 64, 64), (512, 128, 64), (512, 330, 64)),
    *((512, 640, 64), (512, 64, 3), (7, 5, 3)),
)
PUBLISHED = {  # under `rhmc.portable`; where this was seen: docs/reproducibility.md
    "random numbers": "535b27ddf716",
    "elementwise": "537a219d9787",
    "transcendental": "55e38ba90ed2",
    "reductions": "58d67920e16c",
    "layers": "003e003370f6",
    "products of matrices": "c2d6771b0fd6",
    "training": "afffb6fd37ac",
}


def differing() -> list[str]:
    """The groups whose bytes are not the published ones."""
    found = operations()
    return [name for name, published in PUBLISHED.items() if found[name] != published]


def operations(names: Iterable[str] = PUBLISHED) -> dict[str, str]:
    """A digest of the results of each of these groups of operations."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return {name: _digest(GROUPS[name](Generator().manual_seed(0))) for name in names}
    finally:
        torch.set_num_threads(threads)


def _digest(results: Iterable[Tensor]) -> str:
    digest = hashlib.sha256()
    for result in results:
        digest.update(result.detach().contiguous().numpy().tobytes())
    return digest.hexdigest()[:DIGITS]


def _random(rng: Generator) -> Iterator[Tensor]:
    yield torch.rand(1000, generator=rng)
    yield torch.randn(1000, generator=rng)
    yield torch.randint(7, (1000,), generator=rng)
    yield torch.randperm(1000, generator=rng)
    yield torch.multinomial(torch.rand(100, 5, generator=rng), 1, generator=rng)


def _elementwise(rng: Generator) -> Iterator[Tensor]:
    a = _uniform(rng, 2560, 64)
    yield from (a + a * 3, a.relu(), (a / 3).abs().rsqrt(), torch.lerp(a, a * 2, 0.3), a.clamp(-0.5, 0.5), a.fmod(0.3))


def _transcendental(rng: Generator) -> Iterator[Tensor]:
    a = _uniform(rng, 2560, 64)
    yield from (a.exp(), a.sin(), a.cos(), a.tanh(), a.sigmoid(), a.abs().log1p(), torch.atan2(a, a.flip(0)))
    yield from (softmax(a, -1), log_softmax(a, -1), elu(a), softplus(a), torch.hypot(a, a.flip(1)), a.abs().pow(0.7))


def _reductions(rng: Generator) -> Iterator[Tensor]:
    a = _uniform(rng, 2560, 64)
    yield from (a.sum(), a.sum(0), a.sum(1), a.mean(1), a.amax(1), a.std(), a.cumsum(0), torch.linalg.vector_norm(a))
    yield from (a.view(512, 5, 64).mean(1), a.view(512, 5, 64).amax(1), a.argmax(1), a.logsumexp(1))


def _layers(rng: Generator) -> Iterator[Tensor]:
    for rows, inputs, outputs in (*SIZES, (6000, 64, 64), (640, 64, 1), (1, 64, 64)):
        x, w, b = (_uniform(rng, *size) for size in ((rows, inputs), (outputs, inputs), (outputs,)))
        parts = [part.requires_grad_() for part in (x, w, b)]
        y = linear(*parts)
        yield from (y, *torch.autograd.grad(y, parts, _uniform(rng, rows, outputs)))


def _products(rng: Generator) -> Iterator[Tensor]:
    for rows, inputs, outputs in SIZES:
        x, w = _uniform(rng, rows, inputs), _uniform(rng, outputs, inputs)
        y = x @ w.T
        yield from (y, y.T @ x, y @ w)
    yield torch.bmm(_uniform(rng, 128, 13, 5), _uniform(rng, 128, 5, 13))
    yield torch.einsum("bij,bjk->bik", _uniform(rng, 32, 20, 64), _uniform(rng, 32, 64, 20))


def _training(rng: Generator) -> Iterator[Tensor]:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        net = nn.Sequential(Linear(11, 64), nn.ReLU(), Linear(64, 64), nn.Tanh(), Linear(64, 3))
    params: list[Tensor] = list(net.parameters())
    slow = [param.detach().clone() for param in params]
    optimiser = torch.optim.Adam(params, lr=1e-3, fused=True)
    for _ in range(50):
        x = _uniform(rng, 256, 11)
        loss = huber_loss(net(x), torch.stack((x.sum(1), x[:, 0] * x[:, 1], x.amax(1)), 1))
        for param, grad in zip(params, torch.autograd.grad(loss, params), strict=True):
            param.grad = grad
        nn.utils.clip_grad_norm_(params, 1.0, foreach=True)
        optimiser.step()
        with torch.no_grad():
            torch._foreach_lerp_(slow, params, 0.005)
    yield from (*params, *slow)


def _uniform(rng: Generator, *size: int) -> Tensor:
    return torch.rand(*size, generator=rng) * 2 - 1


GROUPS: dict[str, Callable[[Generator], Iterator[Tensor]]] = {
    "random numbers": _random,
    "elementwise": _elementwise,
    "transcendental": _transcendental,
    "reductions": _reductions,
    "layers": _layers,
    "products of matrices": _products,
    "training": _training,
}
