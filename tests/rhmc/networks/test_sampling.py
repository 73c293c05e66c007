"""Draws: their frequencies, their values and their gradients."""

import pytest
import torch
from torch import Generator, Size

from rhmc.networks.sampling import bernoulli, gumbel, mix, relaxed_bernoulli

DRAWS = 40_000
FIVE_ERRORS = 5 * 0.5 / DRAWS**0.5  # five standard errors of a frequency, at most


@pytest.fixture
def rng() -> Generator:
    return Generator().manual_seed(3)


def test_the_largest_of_logits_and_gumbel_noise_is_a_draw_from_their_softmax(rng: Generator) -> None:
    logits = torch.tensor([0.0, 1.0, -2.0, 2.5])
    drawn = (logits + gumbel(Size((DRAWS, 4)), rng)).argmax(-1)
    assert drawn.bincount(minlength=4) / DRAWS == pytest.approx(logits.softmax(-1).numpy(), abs=FIVE_ERRORS)


def test_gumbel_noise_is_finite_and_has_the_mean_and_variance_of_its_law(rng: Generator) -> None:
    noise = gumbel(Size((DRAWS,)), rng)
    assert noise.isfinite().all()
    assert noise.mean().item() == pytest.approx(0.5772, abs=0.04)  # Euler's constant
    assert noise.var().item() == pytest.approx(torch.pi**2 / 6, abs=0.1)


@pytest.mark.parametrize("chance", [0.0, 0.2, 0.9, 1.0])
def test_bernoulli_frequencies(chance: float, rng: Generator) -> None:
    drawn = bernoulli(torch.full((DRAWS,), chance), rng)
    assert set(drawn.unique().tolist()) <= {0.0, 1.0}
    assert drawn.mean().item() == pytest.approx(chance, abs=FIVE_ERRORS if 0 < chance < 1 else 0)


@pytest.mark.parametrize("logit", [-1.5, 0.0, 2.0])
def test_relaxed_bernoulli_has_hard_values_with_the_chance_of_its_logit(logit: float, rng: Generator) -> None:
    drawn = relaxed_bernoulli(torch.full((DRAWS,), logit), rng)
    assert ((drawn - drawn.round()).abs() < 1e-6).all()
    assert set(drawn.round().unique().tolist()) == {0.0, 1.0}
    assert drawn.mean().item() == pytest.approx(torch.tensor(logit).sigmoid().item(), abs=FIVE_ERRORS)


def test_relaxed_bernoulli_has_the_gradient_of_the_relaxed_draw() -> None:
    """d/dl sigmoid(l + logit(u)) = s (1 - s), with the same u; and both outcomes carry it."""
    logits = torch.linspace(-2, 2, 50, requires_grad=True)
    drawn = relaxed_bernoulli(logits, Generator().manual_seed(0))
    drawn.sum().backward()
    u = torch.rand(50, generator=Generator().manual_seed(0))
    soft = (logits.detach() + u.logit()).sigmoid()
    assert torch.equal(drawn.round(), (soft > 0.5).float())
    assert logits.grad is not None
    assert torch.allclose(logits.grad, soft * (1 - soft), atol=1e-6)
    assert (logits.grad > 0).all()


def test_draws_come_from_the_given_generator_alone() -> None:
    before = torch.get_rng_state()
    chance = torch.full((20,), 0.5)
    draws = (lambda g: bernoulli(chance, g), lambda g: gumbel(Size((20,)), g), lambda g: relaxed_bernoulli(chance, g))
    for draw in draws:
        first, again = draw(Generator().manual_seed(1)), draw(Generator().manual_seed(1))
        assert torch.equal(first, again)
        assert not torch.equal(first, draw(Generator().manual_seed(2)))
    assert torch.equal(torch.get_rng_state(), before)


def test_mix_moves_a_distribution_towards_the_uniform_one() -> None:
    chance = torch.tensor([0.9, 0.1, 0.0, 0.0])
    mixed = mix(chance, 0.25, 0.2)
    assert mixed.tolist() == pytest.approx([0.77, 0.13, 0.05, 0.05])
    assert torch.equal(mix(chance, 0.25, 0.0), chance)
    assert mix(chance, 0.25, 1.0).tolist() == pytest.approx([0.25] * 4)
