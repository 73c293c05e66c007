"""Segments: their order, the state at their start, and what follows each of their steps."""

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from pipelines.conformance.checks import seeded, through_a_file
from pipelines.conformance.same import assert_same
from rhmc.learning.learner import unpack
from rhmc.learning.segments import Segments, along, cut, following, in_time
from rhmc.learning.settings import OffPolicy
from rhmc.networks.nets import Sizes
from rhmc.networks.recurrent import encoder, stepped
from rhmc.types import Batch, Local, Obs, Spec, Transition
from tests.support import observed

SPEC = Spec(2, 3, agent_features=1, pair_features=2, peer_features=1, actions=3, continuous=False, episode=9)
N, M, H, B, LENGTH, EPISODE = 2, 3, 4, 3, 4, 6


def segments(seed: int = 0, **changes: int) -> Segments:
    cfg = OffPolicy(**{"buffer_size": 50, "batch_size": 80, "learning_starts": 10, "train_freq": 3} | changes)
    return Segments(cfg, cfg.batch_size, LENGTH, seeded(seed))


def step(t: int) -> tuple[Transition, Tensor]:
    """Step t of B environments, in which every number is 100 x environment + t; the state is that less 1/2."""
    number = 100.0 * torch.arange(B) + t

    def obs(numbers: Tensor, first: bool) -> Obs:
        pairs = numbers.view(B, 1, 1, 1).expand(B, N, M, 1)
        return Obs(torch.zeros(B, N, 0), pairs, torch.zeros(B, N, N, 0), torch.full((B,), first))

    no, over = torch.zeros(B, dtype=torch.bool), torch.full((B,), t % EPISODE == EPISODE - 1)
    local, completed = Local(torch.zeros(B, N, M), torch.zeros(B, N)), torch.zeros(B, N, M, dtype=torch.bool)
    action, after = torch.zeros(B, N, dtype=torch.int64), obs(number + 1, False)
    seen = obs(number, t % EPISODE == 0)
    made = Transition(seen, action, number, local, completed, no, over, after, lambda _: no, {})
    return made, (number - 0.5).view(B, 1, 1).expand(B, N, H)


def filled(kept: Segments, steps: range) -> Segments:
    for t in steps:
        kept.add_step(*step(t))
    return kept


def test_segments_are_steps_in_a_row_of_one_environment_from_the_state_before() -> None:
    """Of a replay of 50 steps there are the 12 newest segments of 4; the 13th, half begun, is not seen yet."""
    (rows,) = list(filled(segments(train_freq=50, batch_size=800), range(22)).due())
    assert rows["reward"].shape == (LENGTH, 200)
    starts = rows["reward"][0]
    assert set(starts.tolist()) == {100.0 * env + start for env in range(B) for start in (4, 8, 12, 16)}
    assert torch.equal(rows["reward"], starts + torch.arange(LENGTH).unsqueeze(1))
    assert torch.equal(rows["pairs"][..., 0, 0, 0], rows["reward"])
    assert torch.equal(rows["next_pairs"][..., 0, 0, 0], rows["reward"] + 1)
    assert torch.equal(rows["state"], (starts - 0.5).view(-1, 1, 1).expand(-1, N, H))
    assert torch.equal(rows["first"], rows["reward"] % 100 % EPISODE == 0)
    assert torch.equal(rows["done"], rows["reward"] % 100 % EPISODE == EPISODE - 1)


def test_updates_are_due_by_steps_and_not_before_a_segment_is_whole() -> None:
    kept, due = segments(learning_starts=1, train_freq=2), []
    for t in range(6):
        kept.add_step(*step(t))
        due.append(len(list(kept.due())))
    assert kept.steps == 18
    assert due == [0, 0, 0, 5, 2, 1]  # (12 - 1) / 2, (15 - 1) / 2, (18 - 1) / 2 in all


def test_a_replay_goes_on_from_a_checkpoint_within_a_segment() -> None:
    def drawn(kept: Segments, steps: range) -> Iterator[Batch]:
        for t in steps:
            kept.add_step(*step(t))
            yield from kept.due()

    kept, other = filled(segments(), range(22)), segments(seed=9)
    other.load_state_dict(through_a_file(kept.state_dict()))
    other.replay.rng.set_state(kept.replay.rng.get_state())
    assert_same(list(drawn(other, range(22, 30))), list(drawn(kept, range(22, 30))))
    assert_same(other.state_dict(), kept.state_dict())


def test_a_rollout_is_cut_where_it_is_said() -> None:
    grid = torch.arange(6).unsqueeze(1) + 100 * torch.arange(B)
    found = cut({"x": grid, "state": grid.view(6, B, 1, 1), "critic_state": -grid.view(6, B, 1, 1)}, 2)
    assert sorted(found["x"].tolist()) == sorted([100 * b + s, 100 * b + s + 1] for b in range(B) for s in (0, 2, 4))
    assert torch.equal(found["state"].flatten(), found["x"][:, 0])
    assert torch.equal(found["critic_state"].flatten(), -found["x"][:, 0])
    back = in_time(found)
    assert torch.equal(back["x"], found["x"].T)
    assert torch.equal(back["state"], found["state"])


@pytest.mark.parametrize("ends", [[], [2], [0, 3], [4], [0, 1, 2, 3, 4]])
def test_what_follows_a_step_is_one_step_further_with_its_memory(ends: list[int]) -> None:
    """Against a loop; in one environment of two, episodes end after the steps `ends`."""
    count, batch = 5, 2
    net = encoder("pairwise_gru").local(Sizes.of(SPEC), H, 3)
    rows = {key: value.unflatten(0, (count, batch)) for key, value in observed(SPEC, count * batch).items()}
    rows["done"] = torch.zeros(count, batch, dtype=torch.bool)
    rows["done"][ends, 1] = True
    rows["first"] = torch.cat((torch.ones(1, batch, dtype=torch.bool), rows["done"][:-1]))
    for name in ("agents", "pairs", "peers"):  # within an episode the next row is what came after
        for t in range(count - 1):
            goes_on = ~rows["done"][t]
            rows[f"next_{name}"][t][goes_on] = rows[name][t + 1][goes_on]
    state = torch.randn(batch, N, H)
    found = following(net, rows, *along(net, rows, state))
    assert not found.requires_grad
    for t in range(count):
        now = {key: value[t] for key, value in rows.items()}
        _, state = stepped(net, unpack(now)._replace(first=now["first"]), state)
        expected, _ = stepped(net, unpack(now, "next_"), state)
        assert torch.allclose(found[t], expected, atol=1e-6)
