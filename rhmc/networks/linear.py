"""Linear layers with the same bytes on every x86-64 processor that has FMA, at the speed of its widest instructions.

MKL, which `torch.nn.Linear` calls, sums in an order that differs between processors. oneDNN's products of up to 512
terms are chains of fused multiply-adds, in order, whatever the width of its instructions. Elsewhere than on an x86-64
processor this is `torch.nn.functional.linear`.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional
from torch.nn.modules import module as modules

from rhmc.portable import X86

_product = torch.ops.mkldnn._linear_pointwise.default if torch.backends.mkldnn.is_available() else None
BLOCK = 512  # terms that are one chain; of longer sums oneDNN makes blocks by the kind of processor


class Linear(nn.Linear):
    """`torch.nn.Linear`, drawn as it draws: (..., in) -> (..., out)."""

    def forward(self, x: Tensor) -> Tensor:
        return linear(x, self.weight, self.bias)


class MLP(nn.Sequential):
    """Linear layers with ReLU between them, computed at once: (..., in) -> (..., out)."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) if _watched(self) else stack(x, [*self][::2], last="none")


def linear(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """x weight^T + bias: (..., in), (out, in), (out,) -> (..., out)."""
    return _stack(x, ["none"], weight, bias)


def stack(x: Tensor, layers: Sequence[nn.Linear], *, last: str) -> Tensor:
    """Layers with ReLU between them and `last`, "relu" or "none", behind them: (..., in) -> (..., out)."""
    kinds = ["relu"] * (len(layers) - 1) + [last]
    if _watched(layers):
        for layer, kind in zip(layers, kinds, strict=True):
            x = layer(x).relu() if kind == "relu" else layer(x)
        return x
    params = [param for layer in layers for param in (layer.weight, layer.bias)]
    return _stack(x, kinds, *params)


def _watched(layers: Iterable[nn.Module]) -> bool:
    """Some module has a hook, which sees that one's output: they are computed one by one, to the same bytes."""
    return bool(modules._global_forward_hooks) or any(layer._forward_hooks for layer in layers)


def _stack(x: Tensor, after: list[str], *params: Tensor | None) -> Tensor:
    if _product is None or not X86 or x.device.type != "cpu":
        for (weight, bias), kind in zip(_pairs(params), after, strict=True):
            x = functional.linear(x, weight, bias)
            x = x.relu() if kind == "relu" else x
        return x
    rows = x if x.dim() == 2 else x.flatten(0, -2)
    if torch.is_grad_enabled():
        y: Tensor = _Stack.apply(rows, after, *params)
    else:
        y = _outputs(rows, after, params)[-1]
    return y if x.dim() == 2 else y.unflatten(0, x.shape[:-1])  # of rows no view: what is done to it in place is cheap


def product(a: Tensor, b: Tensor, bias: Tensor | None = None, after: str = "none") -> Tensor:
    """a b^T + bias: (m, k), (n, k), (n,) -> (m, n), the sum of the products of `BLOCK` columns each; then `after`."""
    k = a.shape[1]
    if k <= BLOCK:
        return _chain(a, b, bias, after)
    total = _chain(a[:, :BLOCK], b[:, :BLOCK], bias)
    for i in range(BLOCK, k, BLOCK):
        total += _chain(a[:, i : i + BLOCK], b[:, i : i + BLOCK])
    return total.relu_() if after == "relu" else total


def _chain(a: Tensor, b: Tensor, bias: Tensor | None = None, after: str = "none") -> Tensor:
    if min(*a.shape, len(b)) < 2:  # single rows or columns: oneDNN sums these otherwise, and MKL alike everywhere
        y = functional.linear(a, b, bias)
        return y.relu_() if after == "relu" else y
    assert _product is not None
    dense = b if b.is_contiguous() or b.t().is_contiguous() else b.contiguous()  # else a slow loop, of other sums
    product: Tensor = _product(a, dense, bias, after, [], "")
    return product


class _Stack(torch.autograd.Function):
    """The layers and their derivatives, each a product as above; (rows, features) throughout."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, after: list[str], *params: Tensor | None) -> Tensor:
        ctx.after, ctx.count = after, len(params)
        outputs = _outputs(x, after, params)
        ctx.save_for_backward(x, *outputs, *params)
        return outputs[-1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        saved, count = ctx.saved_tensors, ctx.count
        values, weights = saved[:-count], saved[-count::2]
        by_x, _, *by_params = ctx.needs_input_grad
        grads: list[Tensor | None] = []  # from the last layer to the first
        for i in reversed(range(len(weights))):
            if ctx.after[i] == "relu":
                into = grad if i + 1 < len(weights) else torch.empty_like(values[i + 1])  # the last one is not ours
                grad = torch.ops.aten.threshold_backward.grad_input(grad, values[i + 1], 0, grad_input=into)
            by_weight, by_bias = by_params[2 * i : 2 * i + 2]
            grads += [grad.sum(0) if by_bias else None, _outer(grad, values[i]) if by_weight else None]
            if i or by_x:
                grad = product(grad, weights[i].t())
        return grad if by_x else None, None, *reversed(grads)


def _outputs(x: Tensor, after: list[str], params: Sequence[Tensor | None]) -> list[Tensor]:
    """The output of each layer: (rows, in) -> (rows, out) each."""
    outputs = []
    for (weight, bias), kind in zip(_pairs(params), after, strict=True):
        x = product(x, weight, bias, kind)
        outputs.append(x)
    return outputs


def _pairs(params: Sequence[Tensor | None]) -> Iterator[tuple[Tensor, Tensor | None]]:
    for weight, bias in zip(params[::2], params[1::2], strict=True):
        assert weight is not None
        yield weight, bias


def _outer(grad: Tensor, x: Tensor) -> Tensor:
    """grad^T x: (rows, out), (rows, in) -> (out, in). oneDNN copies its left side: the narrow one stands there.

    It lies in memory as the weights do, without which the fused optimiser takes other numbers for it.
    """
    return _over_rows(grad, x) if grad.shape[1] <= x.shape[1] else _over_rows(x, grad).t().contiguous()


def _over_rows(a: Tensor, b: Tensor) -> Tensor:
    """`product(a.t(), b.t())`, with `a` the narrower: (rows, m), (rows, n) -> (m, n)."""
    count = len(a) // BLOCK
    end = count * BLOCK
    if not count or a.shape[1] < 2:
        return product(a.t(), b.t())
    assert _product is not None
    total, *rest = (
        _product(columns, rows.t(), None, "none", [], "")
        for columns, rows in zip(_columns(a[:end], count), b[:end].contiguous().split(BLOCK), strict=True)
    )
    for part in rest:
        total += part
    return total if end == len(a) else total.add_(_chain(a[end:].t(), b[end:].t()))


def _columns(a: Tensor, count: int) -> Tensor:
    """The transposes of `count` blocks of rows: (count rows, m) -> (count, m, rows).

    A shuffle of channels is that too, and several times as fast as torch's copy of a transpose.
    """
    rows, m = len(a) // count, a.shape[1]
    channels = a.reshape(count, 1, 1, rows * m).permute(0, 3, 1, 2)
    return torch.native_channel_shuffle(channels, rows).permute(0, 2, 3, 1).view(count, m, rows)
