"""Eq. 6, Algorithm 1 and the exact optimum, against hand-computed values and the oracles."""

from collections.abc import Callable, Iterator
from itertools import product
from random import Random

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from rhmc.hierarchy.regulation import (
    MOST_TARGETS,
    REGULATORS,
    Charges,
    algorithm1_path,
    executed,
    high_level_reward,
    optimal_path,
)
from rhmc.hierarchy.theorem import CROWDED, random_instances, shortfall_table, smallest_counterexample, summary
from tests.oracles import regulation as oracle

B = 5  # instances per drawn shape
Drawn = tuple[Tensor, Tensor, Charges]  # options, assignment, penalties
penalties = st.builds(Charges, st.sampled_from([0.0, 0.1, 0.5, 1.0]), st.sampled_from(["free", "charged"]))


@st.composite
def batches(draw: st.DrawFn, agents: int = 4, options: int = 4, targets: int = 5) -> Drawn:
    """Options (B, N, D, M), assignment (B, N, M) and penalties, from every density including none and all."""
    n, d, m = (draw(st.integers(1, most)) for most in (agents, options, targets))
    density = st.sampled_from([0.0, 0.2, 0.35, 0.5, 0.8, 1.0])
    rng = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    table = torch.rand(B, n, d, m, generator=rng) < draw(density)
    return table, torch.rand(B, n, m, generator=rng) < draw(density), draw(penalties)


def apply(function: Callable[..., float], options: Tensor, assignment: Tensor, charges: Charges) -> Tensor:
    """An oracle on each instance."""
    rows = zip(options.tolist(), assignment.tolist(), strict=True)
    return torch.tensor([function(*row, *charges) for row in rows])


def bits(*rows: str) -> Tensor:
    """bits("10", "01") is [[True, False], [False, True]]."""
    return torch.tensor([[c == "1" for c in row] for row in rows])


def every_instance(n: int, d: int, m: int) -> Iterator[tuple[oracle.Options, oracle.Assignment]]:
    """All options and assignments of a size, options within the assignment: per pair 2^d tables or, unassigned, one."""
    tables = [(False, (False,) * d), *((True, table) for table in product((False, True), repeat=d))]
    for pairs in product(tables, repeat=n * m):
        rows = [pairs[i * m : (i + 1) * m] for i in range(n)]
        yield (
            [[[pair[1][o] for pair in row] for o in range(d)] for row in rows],
            [[pair[0] for pair in row] for row in rows],
        )


def ones(options: oracle.Options, assignment: oracle.Assignment) -> int:
    """The number of bits of an instance that are set."""
    return sum(sum(map(sum, agent)) for agent in options) + sum(map(sum, assignment))


@pytest.mark.parametrize(
    ("completed", "assignment", "alpha", "expected"),
    [
        ("11", ("10", "01"), 0.3, 2.0),  # one agent each: 1 + 1
        ("11", ("11", "01"), 0.3, 1.5),  # two agents on the second: 1 + 1/2
        ("10", ("11", "01"), 0.3, 0.7),  # 1 - 0.3
        ("00", ("11", "01"), 0.3, -0.6),  # two penalties, whatever k_j
        ("11", ("00", "00"), 0.3, 0.0),  # k_j = 0: completed by chance counts nothing
        ("00", ("00", "00"), 0.3, 0.0),  # k_j = 0: and costs nothing
        ("101", ("100", "110"), 1.0, -0.5),  # 1/2 - 1 + 0
        ("111", ("111", "111", "111"), 0.0, 1.0),  # 3 * 1/3
        ("000", ("111", "111", "111"), 0.0, 0.0),  # no penalty
    ],
)
def test_eq6_by_hand(completed: str, assignment: tuple[str, ...], alpha: float, expected: float) -> None:
    value = high_level_reward(bits(completed), bits(*assignment).unsqueeze(0), Charges(alpha))
    assert value.shape == (1,)
    assert value.item() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("completed", "assignment", "expected"),
    [
        ("11", ("10", "10"), 0.2),  # 1/2 for the first; that the second is completed helps nobody: -0.3
        ("00", ("00", "00"), -0.6),  # to assign nothing is no way out
        ("01", ("10", "10"), -0.6),  # completed by chance is not completed by an agent assigned to it
        ("11", ("10", "01"), 2.0),  # nothing changes where all targets are assigned
        ("10", ("11", "01"), 0.7),
    ],
)
def test_unassigned_targets_may_be_charged(completed: str, assignment: tuple[str, ...], expected: float) -> None:
    """Earned by two agents of which each completes the same targets; the bounds of these as their only options."""
    each, held = bits(completed, completed).unsqueeze(0), bits(*assignment).unsqueeze(0)
    charges = Charges(0.3, "charged")
    assert executed(each, held, charges).item() == pytest.approx(expected)
    for name in ("paper", "exact"):
        assert REGULATORS[name](each.unsqueeze(2), held, charges).item() == pytest.approx(expected)


@given(batches())
@settings(deadline=None)
def test_charges_for_unassigned_targets_lower_every_value_alike(batch: Drawn) -> None:
    options, assignment, charges = batch
    price = charges.alpha * (assignment.sum(1) == 0).sum(-1)
    free, charged = (charges._replace(unassigned=level) for level in ("free", "charged"))
    for value in (REGULATORS["paper"], REGULATORS["exact"], lambda o, a, c: executed(o[:, :, 0], a, c)):
        torch.testing.assert_close(value(options, assignment, charged), value(options, assignment, free) - price)


@given(batches())
@settings(deadline=None)
def test_eq6_is_the_oracle(batch: Drawn) -> None:
    options, assignment, charges = batch
    completed = options[:, 0, 0]
    expected = apply(oracle.reward, completed, assignment, charges)
    torch.testing.assert_close(high_level_reward(completed, assignment, charges), expected)


@pytest.mark.parametrize("dtype", [torch.bool, torch.int64, torch.float32])
def test_assignment_in_any_dtype(dtype: torch.dtype) -> None:
    options, assignment = random_instances((64, 3, 4, 5), 0.4, 0.6, torch.Generator().manual_seed(1))
    for function in (*REGULATORS.values(), lambda o, a, charges: executed(o[:, :, 0], a, charges)):
        assert torch.equal(*(function(options, held, Charges(0.2)) for held in (assignment.to(dtype), assignment)))


def test_executed_counts_assigned_agents_only() -> None:
    completed = bits("110", "001").unsqueeze(0)  # agent 0 completes targets 0 and 1, agent 1 target 2
    swapped = bits("001", "110").unsqueeze(0)
    shared = bits("110", "011").unsqueeze(0)
    charges = Charges(0.3)
    assert executed(completed, completed, charges).item() == pytest.approx(3.0)
    assert executed(completed, swapped, charges).item() == pytest.approx(-0.9)  # all completed, by the wrong agents
    assert executed(completed, shared, charges).item() == pytest.approx(2.5)  # target 1: one of two suffices: 1/2


@given(batches())
@settings(deadline=None, max_examples=150)
def test_exact_is_brute_force(batch: Drawn) -> None:
    torch.testing.assert_close(REGULATORS["exact"](*batch), apply(oracle.optimum, *batch))


@given(batches(agents=6, options=7, targets=7))
@settings(deadline=None, max_examples=150)
def test_paper_is_algorithm_1(batch: Drawn) -> None:
    torch.testing.assert_close(REGULATORS["paper"](*batch), apply(oracle.algorithm1, *batch))


def test_paper_keeps_the_first_of_equal_masks_at_the_size_of_the_paper() -> None:
    options, assignment = random_instances((400, 4, 13, 5), 0.3, 0.5, torch.Generator().manual_seed(2))
    value = REGULATORS["paper"](options, assignment, Charges(0.2))
    torch.testing.assert_close(value, apply(oracle.algorithm1, options, assignment, Charges(0.2)))
    flipped = REGULATORS["paper"](options.flip(2), assignment, Charges(0.2))
    assert not torch.equal(value, flipped), "the order of the options decides among equals, so some value must differ"


@given(batches(agents=5, options=6, targets=8))
@settings(deadline=None)
def test_order_none_executed_paper_exact(batch: Drawn) -> None:
    options, assignment, charges = batch
    best = REGULATORS["exact"](*batch) + 1e-6
    assert (REGULATORS["none"](*batch) == -torch.inf).all()
    assert (REGULATORS["paper"](*batch) <= best).all()
    for d in range(options.shape[2]):  # what was executed is among the options
        assert (executed(options[:, :, d], assignment, charges) <= best).all()


@given(batches(targets=8), st.randoms(use_true_random=False))
@settings(deadline=None)
def test_exact_does_not_depend_on_any_order(batch: Drawn, random: Random) -> None:
    options, assignment, charges = batch
    value = REGULATORS["exact"](options, assignment, charges)
    agents, choices, targets = (random.sample(range(size), size) for size in options.shape[1:])
    moved = options[:, agents][:, :, choices][..., targets]
    torch.testing.assert_close(REGULATORS["exact"](moved, assignment[:, agents][..., targets], charges), value)


@given(batches())
@settings(deadline=None)
def test_exact_grows_with_what_an_option_completes_and_with_options(batch: Drawn) -> None:
    options, assignment, charges = batch
    value = REGULATORS["exact"](*batch) - 1e-6
    more = options | (torch.rand(options.shape, generator=torch.Generator().manual_seed(3)) < 0.2)
    assert (REGULATORS["exact"](more, assignment, charges) >= value).all()
    assert (REGULATORS["exact"](torch.cat((options, more.flip(3)), 2), assignment, charges) >= value).all()


@given(batches())
@settings(deadline=None)
def test_paper_is_exact_where_there_is_nothing_to_combine(batch: Drawn) -> None:
    """One agent, one option each, or one target: the sizes that the search for a counterexample may leave out."""
    options, assignment, charges = batch
    for o, a in (
        (options[:, :1], assignment[:, :1]),
        (options[:, :, :1], assignment),
        (options[..., :1], assignment[..., :1]),
    ):
        torch.testing.assert_close(REGULATORS["paper"](o, a, charges), REGULATORS["exact"](o, a, charges))


@given(batches(agents=5, options=6, targets=6))
@settings(deadline=None)
def test_paths_earn_what_the_regulators_say(batch: Drawn) -> None:
    options, assignment, charges = batch
    agents = list(range(options.shape[1]))
    for name, path in (("paper", algorithm1_path), ("exact", optimal_path)):
        values = REGULATORS[name](*batch)
        for b in range(B):
            found = path(options[b], assignment[b], charges)
            completed = options[b, agents, list(found.choices)]
            assert found.reward == pytest.approx(values[b].item())
            assert executed(completed[None], assignment[b : b + 1], charges).item() == pytest.approx(found.reward)
            assert list(found.completed) == (completed & assignment[b]).any(0).tolist()


@pytest.mark.parametrize("regulator", [REGULATORS["exact"], lambda o, a, charges: optimal_path(o[0], a[0], charges)])
def test_exact_refuses_too_many_targets(regulator: Callable[[Tensor, Tensor, Charges], object]) -> None:
    m = MOST_TARGETS + 1
    with pytest.raises(ValueError, match=f"at most {MOST_TARGETS} targets, and there are {m}"):
        regulator(torch.ones(1, 2, 2, m).bool(), torch.ones(1, 2, m), Charges(0.1))


def test_exact_weighs_the_penalty_against_shared_targets() -> None:
    """One target of its own, or two that are shared by three agents: 1 - 2 alpha against 2/3 - alpha."""
    options = torch.stack((bits("100", "011"), bits("000", "000"), bits("000", "000"))).unsqueeze(0)
    assignment = bits("111", "011", "011").unsqueeze(0)
    values = [REGULATORS["exact"](options, assignment, Charges(alpha)).item() for alpha in (0.0, 0.3, 0.4, 1.0)]
    assert values == pytest.approx([1, 1 - 0.6, 2 / 3 - 0.4, 2 / 3 - 1])
    assert REGULATORS["paper"](options, assignment, Charges(0.0)).item() == pytest.approx(2 / 3)


def test_exact_holds_the_number_of_ways_to_a_set() -> None:
    """Sets that are a union in many ways, and sets that are none: more than 8 and 16 bits count."""
    every = torch.tensor(list(product((False, True), repeat=10)))  # full set: 3^10 ways
    few = every[every.sum(-1) <= 4]  # 386 options: two reach eight targets, never nine
    assignment = torch.ones(1, 2, 10)
    assert REGULATORS["exact"](every.expand(1, 2, -1, 10), assignment, Charges(0.5)).item() == pytest.approx(5)
    assert REGULATORS["exact"](few.expand(1, 2, -1, 10), assignment, Charges(0.5)).item() == pytest.approx(4 - 2 * 0.5)


def test_largest_exact_table() -> None:
    m = MOST_TARGETS
    options = torch.eye(m).bool().expand(1, 3, m, m)  # option d completes target d: three agents reach three targets
    assert REGULATORS["exact"](options, torch.ones(1, 3, m), Charges(0.0)).item() == pytest.approx(1.0)


def test_the_smallest_counterexample_by_reward() -> None:
    found = smallest_counterexample(alpha=0.2)
    rows = found.options.tolist(), found.assignment.tolist(), 0.2
    assert found.paper == pytest.approx(oracle.algorithm1(*rows)) == pytest.approx(0.5 - 0.2)
    assert found.exact == pytest.approx(oracle.optimum(*rows)) == pytest.approx(1 - 0.2)
    assert tuple(found.options.shape) == (2, 2, 2)
    failing = [case for case in every_instance(2, 2, 2) if oracle.optimum(*case, 0.2) > oracle.algorithm1(*case, 0.2)]
    assert ones(*rows[:2]) == min(ones(*case) for case in failing)


def test_the_smallest_counterexample_by_count() -> None:
    """Equal weight for every completed target does not save the theorem: the count itself is not maximal."""

    def falls_short(options: oracle.Options, assignment: oracle.Assignment) -> bool:
        best = max(map(sum, oracle.joint_options(options, assignment)))
        return best > max(map(sum, oracle.algorithm1_masks(options, assignment)))

    found = smallest_counterexample(alpha=0.2, by="count")
    rows = found.options.tolist(), found.assignment.tolist()
    assert falls_short(*rows)
    assert found.paper == pytest.approx(oracle.algorithm1(*rows, 0.2))
    assert found.exact == pytest.approx(oracle.optimum(*rows, 0.2))
    assert tuple(found.options.shape) == (3, 2, 2)
    assert ones(*rows) == min(ones(*case) for case in every_instance(3, 2, 2) if falls_short(*case))
    assert not any(falls_short(*case) for case in every_instance(2, 2, 2))


def test_two_agents_reach_the_largest_count() -> None:
    """The reason why the counterexample by count needs three agents."""
    options, assignment = random_instances((300, 2, 4, 5), 0.3, 0.7, torch.Generator().manual_seed(4))
    for o, a in zip(options, assignment, strict=True):
        path = algorithm1_path(o, a, Charges(0.0))
        masks = (o & a.unsqueeze(1)).unbind(0)
        counts = (masks[0].unsqueeze(0) | masks[1].unsqueeze(1)).sum(-1)
        assert counts[path.choices[1]].max() == sum(path.completed)


def test_shortfall_table_counts_what_the_oracles_count() -> None:
    (row,) = shortfall_table(300, seed=5, sizes=((3, 3, 4),), densities=((0.4, 0.7),), alpha=0.3)
    options, assignment = random_instances((300, 3, 3, 4), 0.4, 0.7, torch.Generator().manual_seed(5))
    best, found = (apply(f, options, assignment, Charges(0.3)) for f in (oracle.optimum, oracle.algorithm1))
    gap = best - found
    lost = gap > 1e-6
    assert 0 < int(lost.sum()) < 300
    assert row.lost == int(lost.sum())
    assert row.mean_gap == pytest.approx(gap[lost].mean().item(), rel=1e-5)
    assert row.max_gap == pytest.approx(gap.max().item(), rel=1e-5)


def test_shortfall_is_seeded_and_there_at_the_sizes_of_the_paper() -> None:
    assert shortfall_table(200, seed=7) == shortfall_table(200, seed=7)
    assert shortfall_table(200, seed=7) != shortfall_table(200, seed=8)
    (crowded,) = shortfall_table(2000, seed=0, sizes=(CROWDED,), densities=((0.3, 0.5),))
    assert crowded.share > 0.15


def test_summary_has_the_table_and_the_counterexamples() -> None:
    out = summary(shortfall_table(50, seed=1), alpha=0.1)
    assert out.count("| 4 x 13 x 5 ") == 4
    assert "2 x 2 x 2" in out
    assert "3 x 2 x 2" in out
