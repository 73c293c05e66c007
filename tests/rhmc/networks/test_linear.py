"""Linear layers against chains of fused multiply-adds, and their derivatives against torch's own."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.nn.modules.module import register_module_forward_hook

from rhmc.networks.linear import Linear, _outer, linear, product, stack
from rhmc.networks.nets import _pool, mlp
from tests.oracles import products


def uniform(*size: int, seed: int = 0) -> Tensor:
    return torch.rand(*size, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def assert_chain(m: int, k: int, n: int, seed: int = 0) -> None:
    a, b = uniform(m, k, seed=seed), uniform(n, k, seed=seed + 1)
    assert np.array_equal(product(a, b).numpy(), products.product(a.numpy(), b.numpy()))


@settings(deadline=None, max_examples=60)
@given(m=st.integers(2, 300), k=st.integers(2, 400), n=st.integers(2, 80), seed=st.integers(0, 9))
def test_a_product_is_a_chain_of_fused_multiply_adds(m: int, k: int, n: int, seed: int) -> None:
    """So its bytes do not depend on the width of the processor's instructions."""
    assert_chain(m, k, n, seed)


@pytest.mark.parametrize("k", [512, 514, 576, 1024, 1026, 2560, 6000])
def test_a_long_sum_is_one_of_blocks(k: int) -> None:
    """As the gradients of weights are."""
    assert_chain(64, k, 10)


@pytest.mark.parametrize("rows", [2, 300, 512, 513, 514, 1024, 1300, 2561])
@pytest.mark.parametrize(("outputs", "inputs"), [(64, 10), (10, 64), (3, 20), (2, 2)])
def test_the_gradient_of_weights_is_a_sum_of_blocks_of_rows(rows: int, outputs: int, inputs: int) -> None:
    grad, x = uniform(rows, outputs), uniform(rows, inputs, seed=1)
    if rows % 512 == 1:  # the last row is a block of its own
        rest = grad[-1:].numpy().T * x[-1:].numpy()
        wanted = products.product(grad[:-1].numpy().T, x[:-1].numpy().T) + rest
    else:
        wanted = products.product(grad.numpy().T, x.numpy().T)
    assert np.array_equal(_outer(grad, x).numpy(), wanted)
    wide = torch.cat((grad, grad), 1)[:, :outputs], torch.cat((x, x), 1)[:, :inputs]
    assert torch.equal(_outer(*wide), _outer(grad, x))


def test_a_product_does_not_depend_on_how_its_factors_lie_in_memory() -> None:
    a, b = uniform(64, 40), uniform(10, 40, seed=1)
    wide = torch.cat((b, b), 1)
    for left in (a, a.t().contiguous().t(), torch.cat((a, a), 1)[:, :40]):
        for right in (b, b.t().contiguous().t(), wide[:, :40], wide[:, 40:]):
            assert torch.equal(product(left, right), product(a, b))
    constant = torch.ones(10, 1).expand(10, 40)
    assert np.array_equal(product(a, constant).numpy(), products.product(a.numpy(), constant.numpy()))


@pytest.mark.parametrize("size", [(2560, 10, 64), (2560, 64, 64), (512, 330, 64), (512, 64, 3), (7, 64, 1), (1, 5, 3)])
@pytest.mark.parametrize("bias", [True, False])
def test_values_and_derivatives_are_those_of_a_linear_layer(size: tuple[int, int, int], bias: bool) -> None:
    rows, inputs, outputs = size
    x, w, grad = uniform(rows, inputs), uniform(outputs, inputs, seed=1), uniform(rows, outputs, seed=2)
    given = [x, w, *([uniform(outputs, seed=3)] if bias else [])]
    mine, theirs = ([part.to(kind).requires_grad_() for part in given] for kind in (torch.float32, torch.float64))
    y, exact = linear(mine[0], mine[1], mine[2] if bias else None), nn.functional.linear(*theirs)
    assert torch.allclose(y.double(), exact, atol=1e-4)
    for found, wanted in zip(
        torch.autograd.grad(y, mine, grad), torch.autograd.grad(exact, theirs, grad.double()), strict=True
    ):
        assert found.shape == wanted.shape
        assert found.is_contiguous(), "the fused optimiser reads gradients as they lie in memory"
        assert torch.allclose(found.double(), wanted, rtol=1e-4, atol=1e-3)


def test_a_layer_keeps_leading_dimensions_and_draws_its_weights_as_torch_does() -> None:
    torch.manual_seed(5)
    mine = Linear(6, 4)
    torch.manual_seed(5)
    theirs = nn.Linear(6, 4)
    assert torch.equal(mine.weight, theirs.weight)
    assert torch.equal(mine.bias, theirs.bias)
    for shape in ((3, 6), (2, 3, 6), (2, 1, 5, 6), (0, 6), (0, 3, 6)):
        x = torch.ones(shape)
        assert mine(x).shape == theirs(x).shape
        assert torch.allclose(mine(x), theirs(x), atol=1e-6)


def test_derivatives_nobody_asks_for_are_not_computed() -> None:
    x, w = uniform(3, 6), uniform(4, 6).requires_grad_()
    (found,) = torch.autograd.grad(linear(x, w, None).sum(), [w])
    assert torch.allclose(found, x.sum(0).expand(4, 6))


@pytest.mark.parametrize("sizes", [(10, 64, 3), (10, 64, 32, 1), (5, 4)])
@pytest.mark.parametrize("by_input", [True, False])
def test_layers_computed_at_once_give_what_one_after_the_other_gives(sizes: tuple[int, ...], by_input: bool) -> None:
    """Values, and derivatives of inputs and weights, to the last bit; the gradient that comes in is left alone."""
    torch.manual_seed(5)
    net = mlp(*sizes)
    x, grad = uniform(600, 2, sizes[0]).requires_grad_(by_input), uniform(600, 2, sizes[-1], seed=1)
    given = [*([x] if by_input else []), *net.parameters()]
    single = x
    for layer in net:
        single = layer(single)
    together, kept = net(x), grad.clone()
    assert torch.equal(together, single)
    with torch.no_grad():
        assert torch.equal(net(x), single)
    found, wanted = (torch.autograd.grad(y, given, grad) for y in (together, single))
    assert all(torch.equal(a, b) for a, b in zip(found, wanted, strict=True))
    assert torch.equal(grad, kept)


@pytest.mark.parametrize("every", [False, True])
def test_a_hook_sees_each_layer_and_changes_no_byte(every: bool) -> None:
    """A hook of one layer, or one of all modules; and where layers stand in no `MLP`."""
    net, x = mlp(5, 8, 8, 3), torch.randn(7, 5)
    expected, seen = (net(x), stack(x, [*net][::2], last="relu")), []

    def note(module: nn.Module, inputs: Any, output: Tensor) -> None:
        if module is net[2]:
            seen.append(output.detach())

    handle = register_module_forward_hook(note) if every else net[2].register_forward_hook(note)
    watched = net(x), stack(x, [*net][::2], last="relu")
    handle.remove()
    assert all(torch.equal(a, b) for a, b in zip(watched, expected, strict=True))
    assert len(seen) == 2
    assert torch.equal(seen[0], seen[1])
    net(x)
    assert len(seen) == 2


def test_a_rectified_end_leaves_the_gradient_that_comes_in_alone() -> None:
    layer, x, grad = Linear(6, 4), uniform(8, 6), uniform(8, 4, seed=1)
    (found,) = torch.autograd.grad(stack(x, [layer], last="relu"), [layer.weight], grad)
    assert torch.equal(grad, uniform(8, 4, seed=1))
    assert torch.equal(found, torch.autograd.grad(layer(x).relu(), [layer.weight], grad)[0])


@pytest.mark.parametrize("dim", [1, 2])
@pytest.mark.parametrize("ties", [False, True])
def test_pooling_has_the_derivative_of_mean_and_maximum_bit_for_bit(dim: int, ties: bool) -> None:
    h = uniform(6, 4, 5, 8).relu()
    if ties:  # as targets that the filter hides from an executor
        h[:, :, 1] = h[:, :, 3] = h[:, :, 0]
        h[:, 2] = h[:, 1]
    h.requires_grad_()
    plain = torch.cat((h.mean(dim), h.amax(dim)), -1)
    grad = uniform(*plain.shape, seed=1)
    pooled = _pool(h, dim)
    assert torch.equal(pooled, plain)
    assert torch.equal(*(torch.autograd.grad(y, h, grad)[0] for y in (pooled, plain)))
