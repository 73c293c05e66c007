"""What `make test` leaves of a grid."""

from itertools import product

import pytest

from tests.depth import covering

GRIDS = [
    (range(9), "ab", "xyz"),
    ("ab", range(9)),
    ("ab", "xy"),
    ("a",),
    ("ab", "x", range(7), range(7)),
    ("abc", "xyz"),
]


@pytest.mark.parametrize("factors", GRIDS, ids=str)
@pytest.mark.parametrize("shift", [0, 1])
def test_a_part_has_every_value_and_the_whole_every_combination(factors: tuple[range | str, ...], shift: int) -> None:
    part, whole = covering(*factors, shift=shift, deep=False), covering(*factors, shift=shift, deep=True)
    assert whole == list(product(*factors))
    assert len(part) == max(map(len, factors))
    assert set(part) <= set(whole)
    assert [set(column) for column in zip(*part, strict=True)] == [set(values) for values in factors]


def test_short_factors_do_not_go_in_step_and_a_shift_gives_the_other_ones() -> None:
    methods = range(4)
    here, there = (covering(methods, "ab", "xy", shift=shift, deep=False) for shift in (0, 1))
    assert here == [(0, "a", "x"), (1, "b", "x"), (2, "a", "y"), (3, "b", "y")]
    assert there == [(0, "b", "y"), (1, "a", "y"), (2, "b", "x"), (3, "a", "x")]
