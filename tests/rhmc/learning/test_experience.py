"""Rows that are kept until they are due: the replay's pace, the rollout's order, values along it."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pipelines.conformance.checks import seeded, through_a_file
from pipelines.conformance.same import assert_same
from rhmc.learning.experience import Experience, Rollout, ends, flat, values
from rhmc.learning.settings import OffPolicy
from rhmc.types import Batch, Local, Obs, Transition

N, M = 2, 3
CPU = torch.device("cpu")


# The replay


def experience(seed: int = 0, **changes: int) -> Experience:
    cfg = OffPolicy(**{"buffer_size": 50, "batch_size": 4, "learning_starts": 10, "train_freq": 3} | changes)
    return Experience(cfg, cfg.batch_size, seeded(seed))


def drawn(due: Experience) -> list[list[float]]:
    return [batch["x"].tolist() for batch in due.due()]


@settings(deadline=None)
@given(st.lists(st.integers(1, 9), max_size=12), st.integers(0, 20), st.integers(1, 7))
def test_an_update_is_due_for_every_few_steps_after_the_warm_up(counts: list[int], warmup: int, pace: int) -> None:
    """Whenever it is asked, and as often as it was not asked before."""
    kept, steps, updates = experience(learning_starts=warmup, train_freq=pace), 0, 0
    for k, count in enumerate(counts):
        kept.add({"x": torch.arange(steps, steps + count).float()}, count)
        steps += count
        if k % 3 != 1:
            updates += len(drawn(kept))
            assert updates == max(0, (steps - warmup) // pace)
            assert drawn(kept) == []


def test_steps_are_counted_and_not_rows() -> None:
    """A row may stand for a period of many steps, or be missing."""
    kept = experience(learning_starts=0, train_freq=5)
    kept.add({"x": torch.ones(1)}, 10)
    assert len(drawn(kept)) == 2
    kept.add({"x": torch.ones(0)}, 5)
    assert len(drawn(kept)) == 1


def test_nothing_is_due_from_an_empty_replay() -> None:
    kept = experience(learning_starts=0)
    kept.add({"x": torch.ones(0)}, 30)
    assert drawn(kept) == []
    kept.add({"x": torch.ones(1)}, 0)
    assert drawn(kept) == [[1.0] * 4] * 10


def test_a_batch_has_its_size_and_is_of_rows_seen() -> None:
    kept = experience(batch_size=7, buffer_size=5)
    kept.add({"x": torch.arange(16).float()}, 16)
    got = drawn(kept)
    assert [len(batch) for batch in got] == [7, 7]
    assert {x for batch in got for x in batch} <= {11.0, 12.0, 13.0, 14.0, 15.0}


def test_an_experience_continues_from_a_checkpoint() -> None:
    first, other = experience(), experience(seed=5)
    first.add({"x": torch.arange(14).float()}, 14)
    drawn(first)
    other.load_state_dict(through_a_file(first.state_dict()))
    other.replay.rng.set_state(first.replay.rng.get_state())
    for kept in (first, other):
        kept.add({"x": torch.arange(14, 30).float()}, 16)
    assert_same(first.state_dict(), other.state_dict())
    got = drawn(first)
    assert got == drawn(other)
    assert len(got) == 5
    assert_same(first.state_dict(), other.state_dict())


# The rollout


def named(name: Tensor) -> Obs:
    """An observation that says its name in every number."""
    b = len(name)
    agents, pairs = name.view(b, 1, 1).expand(b, N, 1), name.view(b, 1, 1, 1).expand(b, N, M, 2)
    return Obs(agents.clone(), pairs.clone(), torch.zeros(b, N, N, 0), torch.zeros(b, dtype=torch.bool))


def step(t: int, batch: int = 4, terminated: Tensor | None = None, truncated: Tensor | None = None) -> Transition:
    """Step t: environment b observes 100 t + b, and 100 t + b + 1/2 afterwards."""
    never, name = torch.zeros(batch, dtype=torch.bool), 100.0 * t + torch.arange(batch)
    return Transition(
        named(name),
        (name.long() % 5).unsqueeze(-1).expand(batch, N),
        -name,
        Local(torch.zeros(batch, N, M), torch.zeros(batch, N)),
        torch.zeros(batch, N, M, dtype=torch.bool),
        never if terminated is None else terminated,
        never if truncated is None else truncated,
        named(name + 0.5),
        lambda horizon: torch.zeros(0),
        {},
    )


def test_a_rollout_is_time_major_and_in_order() -> None:
    rollout = Rollout(3, CPU)
    for t in range(2):
        rollout.add(step(t), worth=torch.full((4, N), float(t)))
        assert rollout.take() is None
    rollout.add(step(2), worth=torch.full((4, N), 2.0))
    rows = rollout.take()
    assert rows is not None
    name = torch.tensor([[0.0, 1, 2, 3], [100, 101, 102, 103], [200, 201, 202, 203]])
    assert torch.equal(rows["reward"], -name)
    assert torch.equal(rows["action"], (name.long() % 5).unsqueeze(-1).expand(3, 4, N))
    assert torch.equal(rows["agents"], name.view(3, 4, 1, 1).expand(3, 4, N, 1))
    assert torch.equal(rows["next_pairs"], (name + 0.5).view(3, 4, 1, 1, 1).expand(3, 4, N, M, 2))
    assert torch.equal(rows["worth"], torch.arange(3.0).view(3, 1, 1).expand(3, 4, N))
    assert torch.equal(flat(rows)["reward"], -name.flatten())
    assert flat(rows)["pairs"].shape == (12, N, M, 2)


def test_the_next_rollout_starts_empty() -> None:
    rollout = Rollout(2, CPU)
    taken = []
    for t in range(5):
        rollout.add(step(t))
        rows = rollout.take()
        taken += [rows["reward"][:, 0].tolist()] if rows else []
    assert taken == [[0.0, -100.0], [-200.0, -300.0]]
    assert len(rollout.rows) == 1


def test_an_end_is_a_terminal_or_truncated_row() -> None:
    rollout = Rollout(1, CPU)
    over, cut = torch.tensor([0, 1, 0, 1]).bool(), torch.tensor([0, 0, 1, 1]).bool()
    rollout.add(step(0, terminated=over, truncated=cut))
    rows = rollout.take()
    assert rows is not None
    assert rows["terminated"].tolist() == [[False, True, False, True]]
    assert rows["done"].tolist() == [[False, True, True, True]]


@pytest.mark.parametrize("before", range(4))
def test_a_rollout_continues_from_a_checkpoint_however_much_of_it_there_is(before: int) -> None:
    first, other = Rollout(4, CPU), Rollout(4, CPU)
    other.add(step(9))
    for t in range(before):
        first.add(step(t))
    other.load_state_dict(through_a_file(first.state_dict()))
    assert len(other.rows) == before
    for t in range(before, 4):
        assert first.take() is None
        assert other.take() is None
        first.add(step(t))
        other.add(step(t))
    rows = first.take()
    assert rows is not None
    assert rows["reward"][:, 0].tolist() == [0.0, -100.0, -200.0, -300.0]
    assert_same(rows, other.take())


def test_a_state_is_not_changed_by_what_is_added_later() -> None:
    rollout = Rollout(4, CPU)
    rollout.add(step(0))
    state = rollout.state_dict()
    rollout.add(step(1))
    assert len(state["rows"]) == 1


# Values along a rollout


class Reader:
    """A network that answers with the observation's name, for every agent, and remembers what it was asked."""

    def __init__(self) -> None:
        self.asked: list[list[float]] = []

    def __call__(self, obs: Obs) -> Tensor:
        self.asked.append(obs.agents[:, 0, 0].tolist())
        return obs.agents[..., 0]


def rollout_of(done: Tensor) -> Batch:
    rollout = Rollout(len(done), CPU)
    for t, row in enumerate(done):
        rollout.add(step(t, batch=done.shape[1], truncated=row))
    rows = rollout.take()
    assert rows is not None
    return rows


shapes = st.tuples(st.integers(1, 5), st.integers(1, 4))


@settings(deadline=None)
@given(
    shapes.flatmap(
        lambda s: st.lists(st.lists(st.booleans(), min_size=s[1], max_size=s[1]), min_size=s[0], max_size=s[0])
    )
)
def test_the_true_successor_is_asked_about_exactly_where_the_next_row_is_another(pattern: list[list[bool]]) -> None:
    done, network = torch.tensor(pattern), Reader()
    value, next_values = values(network, rollout_of(done))
    length, batch = done.shape
    last = [(t, b) for t in range(length) for b in range(batch) if pattern[t][b] or t == length - 1]
    assert network.asked == [
        [100.0 * t + b for t in range(length) for b in range(batch)],
        [100.0 * t + b + 0.5 for t, b in last],
    ]
    for t in range(length):
        for b in range(batch):
            assert value[t, b].tolist() == [100.0 * t + b] * N
            after = 100.0 * t + b + 0.5 if (t, b) in last else 100.0 * (t + 1) + b
            assert next_values[t, b].tolist() == [after] * N


def test_ends_and_their_successors_stand_in_one_order() -> None:
    rows = rollout_of(torch.tensor([[False, True, False], [True, False, False], [False, False, True]]))
    kept = rows["done"].clone()
    last, after = ends(rows)
    assert last.tolist() == [[False, True, False], [True, False, False], [True, True, True]]
    assert after.agents[:, 0, 0].tolist() == [1.5, 100.5, 200.5, 201.5, 202.5]
    assert after.pairs.shape == (5, N, M, 2)
    assert torch.equal(rows["done"], kept)
