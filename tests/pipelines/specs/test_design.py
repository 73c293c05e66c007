"""Designs: balance up to their resolution, counted; confounded effects against two other ways to find them."""

from collections import Counter
from collections.abc import Sequence
from itertools import combinations, product

import numpy as np
import pytest
from pydoe import fracfact, fracfact_aliasing

from pipelines.specs.design import Design, Term, fractional, full

MIXED = (4, 4, *[2] * 9)


def made(levels: Sequence[int], resolution: int, readings: int | None = None, seed: int = 0) -> Design:
    found = fractional(tuple(levels), resolution, readings, seed)
    assert found is not None
    return found


def balanced(found: Design, levels: Sequence[int], strength: int) -> bool:
    """True if any `strength` factors have each combination of their levels equally often."""
    for chosen in combinations(range(len(levels)), strength):
        counts = Counter(tuple(row[i] for i in chosen) for row in found.rows)
        wanted = len(found.rows) / np.prod([levels[i] for i in chosen])
        if set(counts.values()) != {wanted}:
            return False
    return True


@pytest.mark.parametrize(
    ("levels", "resolution", "readings"),
    [([2] * 7, 3, 8), ([2] * 8, 4, 16), ([2] * 5, 5, 16), (MIXED, 3, 16), (MIXED, 4, 64), ([4, 2, 8, 2], 3, 32)],
)
def test_a_fraction_is_balanced_in_as_many_factors_as_its_resolution_says(
    levels: Sequence[int], resolution: int, readings: int
) -> None:
    found = made(levels, resolution)
    assert len(found.rows) == len(set(found.rows)) == readings
    assert balanced(found, levels, resolution - 1)
    assert found.rows[0] == (0,) * len(levels)


def test_one_of_lower_resolution_is_not() -> None:
    assert not balanced(made([2] * 7, 3), [2] * 7, 3)
    assert not balanced(made(MIXED, 3, 64), MIXED, 3)


def test_more_readings_than_the_fewest_may_be_asked_for() -> None:
    assert [len(made([2] * 7, 3, count).rows) for count in (8, 16, 64)] == [8, 16, 64]
    assert fractional((2,) * 7, 4, 8, 0) is None
    assert fractional(MIXED, 4, 32, 0) is None


def test_all_combinations_where_they_are_no_more() -> None:
    found = made([4, 2], 3, 16)
    assert sorted(found.rows) == sorted(product(range(4), range(2)))
    assert found.confounded == ()


def test_the_seed_decides() -> None:
    assert made(MIXED, 4, 64) == made(MIXED, 4, 64)
    fractional.cache_clear()
    assert made(MIXED, 4, 64) == fractional(MIXED, 4, 64, 0) != made(MIXED, 4, 64, seed=1)


def test_generators_give_the_design_again() -> None:
    found = made([2] * 6, 4)
    again = fracfact(" ".join(found.generators))
    assert [tuple(row) for row in (again > 0).astype(int).tolist()] == list(found.rows)


@pytest.mark.parametrize(("count", "resolution"), [(5, 3), (6, 4), (7, 3), (8, 4)])
def test_confounded_effects_are_those_that_the_library_finds(count: int, resolution: int) -> None:
    found = made([2] * count, resolution)
    unsigned = fracfact(" ".join(found.generators).replace("-", ""))  # the library tells a contrast from its negative
    chains = fracfact_aliasing(unsigned)[0]
    terms = [
        [tuple("abcdefgh".index(c) for c in word) for word in chain.split(" = ") if len(word) < 3] for chain in chains
    ]
    assert set(found.confounded) == {tuple(chain) for chain in terms if len(chain) > 1}


def contrasts(found: Design, levels: Sequence[int], term: Term) -> np.ndarray:
    """Columns (readings, k) of an effect: products of centred dummy variables."""
    rows = np.array(found.rows)
    columns = np.ones((len(rows), 1))
    for i in term:
        one = np.eye(levels[i])[rows[:, i]][:, 1:] - 1 / levels[i]
        columns = np.einsum("ra,rb->rab", columns, one).reshape(len(rows), -1)
    return columns


@pytest.mark.parametrize(("levels", "resolution", "readings"), [(MIXED, 4, 64), ((4, 4, 2, 2, 2), 3, 16)])
def test_effects_of_several_levels_are_confounded_where_their_contrasts_are_not_orthogonal(
    levels: tuple[int, ...], resolution: int, readings: int
) -> None:
    found = made(levels, resolution, readings)
    said = {frozenset(pair) for terms in found.confounded for pair in combinations(terms, 2)}
    terms: list[Term] = [(i,) for i in range(len(levels))] + list(combinations(range(len(levels)), 2))
    for one, other in combinations(terms, 2):
        overlap = np.abs(contrasts(found, levels, one).T @ contrasts(found, levels, other)).max()
        assert (overlap > 1e-9) == (frozenset((one, other)) in said), (one, other)


def test_a_full_design_has_every_combination_in_order() -> None:
    assert full([2, 3]).rows == tuple(product(range(2), range(3)))
    assert full([2, 3]).confounded == full([2, 3]).generators == ()
