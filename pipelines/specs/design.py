"""Designs of experiments: which levels of several factors are tried together, and what cannot be told apart then.

A regular fraction has 2^k readings. A factor of 2, 4 or 8 levels takes 1, 2 or 3 columns of two values, which together
number its levels; all products of its columns are its main effect. The first k columns are letters, the others products
of letters. A seeded search draws them so that no word of the defining relation has fewer different factors than the
resolution says, and of the designs that it finds it takes one with the fewest confounded effects. The signs are such
that the reading of all first levels is in the design. `pydoe` spells designs out.
"""

import random
import string
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import combinations, islice
from typing import NamedTuple

LEVELS = (2, 4, 8)  # how many a factor of a fraction has
MOST = 512  # readings of a fraction
TRIES = 100  # designs that are drawn for each size
EXAMINED = 10  # designs among which the best is taken

Term = tuple[int, ...]  # the factors of an effect, by place: (0,) is a main effect, (0, 2) an interaction


class Design(NamedTuple):
    """Readings as places of levels, what generates them, and effects up to second order that are confounded."""

    rows: tuple[tuple[int, ...], ...]  # a reading each: the place of the level of every factor, from 0
    generators: tuple[str, ...] = ()  # of each factor: its columns, such as `a b` or `-abc`; empty for a full design
    confounded: tuple[tuple[Term, ...], ...] = ()  # effects that share a contrast


def full(levels: Sequence[int]) -> Design:
    """Every combination, the last factor's levels changing fastest. levels: how many each factor has."""
    from pydoe import fullfact

    rows = fullfact(list(reversed(levels))).astype(int).tolist()
    return Design(tuple(tuple(reversed(row)) for row in rows))


@cache
def fractional(levels: tuple[int, ...], resolution: int, readings: int | None, seed: int) -> Design | None:
    """A regular fraction of a resolution, the smallest that is found, or of as many readings; None if none is found.

    Args:
        levels: how many each factor has, each one of `LEVELS`.
        resolution: least number of different factors in a word of the defining relation, 3 or more.
        readings: a power of two, or None. All combinations, where they are fewer.
        seed: of the search.
    """
    bits = [count.bit_length() - 1 for count in levels]
    effects = sum(levels) - len(levels)
    sizes = range(effects.bit_length(), MOST.bit_length()) if readings is None else [readings.bit_length() - 1]
    for k in sizes:
        found = _found(bits, min(k, sum(bits)), resolution, random.Random(f"{seed} {k}"))
        if found:
            return _spelled(min(found, key=lambda one: sum(len(terms) - 1 for terms in _confounded(one))))
    return None


Columns = list[list[int]]  # of each factor, its columns; a column is the sum of the letters whose bits it has


def _found(bits: Sequence[int], k: int, resolution: int, rng: random.Random) -> list[Columns]:
    """Designs of 2^k readings that a search finds."""
    drawn = (_drawn(bits, k, resolution, rng) for _ in range(TRIES if k < sum(bits) else 1))
    return list(islice((columns for columns in drawn if columns), EXAMINED))


def _drawn(bits: Sequence[int], k: int, resolution: int, rng: random.Random) -> Columns | None:
    """One design, factors of many levels first, each column the first of a drawn order that keeps the resolution."""
    letters = [1 << i for i in range(k)]
    products = [column for column in range(1, 1 << k) if column not in letters]
    rng.shuffle(products)
    sums = [{0}, *(set[int]() for _ in range(resolution - 2))]  # of one effect each of so many factors
    columns: Columns = [[] for _ in bits]
    for place in sorted(range(len(bits)), key=lambda i: -bits[i]):
        effects: set[int] = set()
        for _ in range(bits[place]):
            fits = (c for c in letters + products if _free({c} | {c ^ e for e in effects}, sums[1:]))
            column = next(fits, None)
            if column is None:
                return None
            columns[place].append(column)
            effects |= {column} | {column ^ effect for effect in effects}
            letters = [letter for letter in letters if letter != column]
            products = [product for product in products if product not in effects]
        for more, fewer in zip(reversed(sums[1:]), reversed(sums[:-1]), strict=True):
            more |= {effect ^ one for effect in effects for one in fewer}
    return columns


def _free(effects: set[int], sums: Sequence[set[int]]) -> bool:
    return all(effects.isdisjoint(one) for one in sums)


def _effects(columns: Sequence[int]) -> set[int]:
    """All products of a factor's columns: its main effect."""
    found = {0}
    for column in columns:
        found |= {column ^ one for one in found}
    return found - {0}


def _terms(columns: Columns) -> Iterator[tuple[Term, set[int]]]:
    """Main effects and interactions of two factors, each with its contrasts."""
    mains = [_effects(one) for one in columns]
    yield from (((i,), effects) for i, effects in enumerate(mains))
    for i, j in combinations(range(len(mains)), 2):
        yield (i, j), {a ^ b for a in mains[i] for b in mains[j]}


def _confounded(columns: Columns) -> list[tuple[Term, ...]]:
    """Sets of terms that share a contrast, main effects first; a set inside another is left out."""
    by_contrast: dict[int, list[Term]] = {}
    for term, contrasts in _terms(columns):
        for contrast in contrasts:
            by_contrast.setdefault(contrast, []).append(term)
    shared = {tuple(terms) for terms in by_contrast.values() if len(terms) > 1}
    widest = [terms for terms in shared if not any(set(terms) < set(other) for other in shared)]
    return sorted(widest, key=lambda terms: ([len(term) for term in terms], terms))


def _spelled(columns: Columns) -> Design:
    """The design, its letters first as `pydoe` wants them: those of the factors of most levels."""
    from pydoe import ff2n, fracfact

    order = sorted(range(len(columns)), key=lambda i: -len(columns[i]))
    words = {place: [_word(column) for column in columns[place]] for place in order}
    each = [word for place in order for word in words[place]]
    signs = fracfact(" ".join(each)) if any(len(word) > 1 for word in each) else ff2n(len(each))
    values = iter((signs > 0).astype(int).T.tolist())
    bits = {place: [next(values) for _ in columns[place]] for place in order}
    numbers = [[sum(b << i for i, b in enumerate(row)) for row in zip(*bits[place], strict=True)] for place in bits]
    rows = zip(*(level for _, level in sorted(zip(bits, numbers, strict=True))), strict=True)
    generators = tuple(" ".join(words[i]) for i in range(len(columns)))
    return Design(tuple(rows), generators, tuple(_confounded(columns)))


def _word(column: int) -> str:
    """A product of letters, with the sign that makes it -1 where all of them are."""
    letters = [letter for i, letter in enumerate(string.ascii_lowercase) if column >> i & 1]
    return ("-" if len(letters) % 2 == 0 else "") + "".join(letters)
