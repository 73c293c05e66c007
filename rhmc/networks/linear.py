"""Linear layers with the same bytes on every x86-64 processor that has FMA, at the speed of its widest instructions.

MKL, which `torch.nn.Linear` calls, sums in an order that differs between processors. oneDNN's products of up to 512
terms are chains of fused multiply-adds, in order, whatever the width of its instructions. Elsewhere than on an x86-64
processor this is `torch.nn.Linear`.
"""

import platform
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

_product = torch.ops.mkldnn._linear_pointwise if torch.backends.mkldnn.is_available() else None
BLOCK = 512  # terms that are one chain; of longer sums oneDNN makes blocks by the kind of processor
X86 = platform.machine().lower() in {"x86_64", "amd64"}


class Linear(nn.Linear):
    """`torch.nn.Linear`, drawn as it draws: (..., in) -> (..., out)."""

    def forward(self, x: Tensor) -> Tensor:
        return linear(x, self.weight, self.bias)


def linear(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """x weight^T + bias: (..., in), (out, in), (out,) -> (..., out)."""
    if _product is None or not X86 or x.device.type != "cpu":
        return functional.linear(x, weight, bias)
    y: Tensor = _Linear.apply(x.flatten(0, -2), weight, bias)
    return y if x.dim() == 2 else y.unflatten(0, x.shape[:-1])  # of rows no view: what is done to it in place is cheap


def product(a: Tensor, b: Tensor, bias: Tensor | None = None) -> Tensor:
    """a b^T + bias: (m, k), (n, k), (n,) -> (m, n), as the sum of the products of `BLOCK` columns each."""
    k = a.shape[1]
    if k <= BLOCK:
        return _chain(a, b, bias)
    total = _chain(a[:, :BLOCK], b[:, :BLOCK], bias)
    for i in range(BLOCK, k, BLOCK):
        total += _chain(a[:, i : i + BLOCK], b[:, i : i + BLOCK], None)
    return total


def _chain(a: Tensor, b: Tensor, bias: Tensor | None) -> Tensor:
    if min(*a.shape, len(b)) < 2:  # single rows or columns: oneDNN sums these otherwise, and MKL alike everywhere
        return functional.linear(a, b, bias)
    assert _product is not None
    dense = b if b.is_contiguous() or b.t().is_contiguous() else b.contiguous()  # else a slow loop, of other sums
    y: Tensor = _product(a, dense, bias, "none", [], "")
    return y


class _Linear(torch.autograd.Function):
    """The layer and its derivatives, each a product as above; (rows, features) throughout."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        ctx.save_for_backward(x, weight)
        return product(x, weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, weight = ctx.saved_tensors
        by_x, by_weight, by_bias = ctx.needs_input_grad
        return (
            product(grad, weight.t()) if by_x else None,
            _outer(grad, x) if by_weight else None,
            grad.sum(0) if by_bias else None,
        )


def _outer(grad: Tensor, x: Tensor) -> Tensor:
    """grad^T x: (rows, out), (rows, in) -> (out, in). oneDNN copies its left side: the narrow one stands there.

    It lies in memory as the weights do, without which the fused optimiser takes other numbers for it.
    """
    return product(grad.t(), x.t()) if grad.shape[1] <= x.shape[1] else product(x.t(), grad.t()).t().contiguous()
