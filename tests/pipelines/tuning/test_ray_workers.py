"""Workers of a search: one that dies is replaced, and a trial is told as if none had."""

import time
from pathlib import Path
from typing import Any

import pytest
import ray
from ray.exceptions import ActorDiedError

from pipelines.execution import cluster
from pipelines.execution.cluster import DEATHS, NODE_DIED, Place
from pipelines.execution.seed_group import Seeds
from pipelines.tuning import ray_workers
from pipelines.tuning.ray_workers import Failed, Pool, Taken, TrialJob
from rhmc.types import Metrics
from tests.pipelines.support import tiny

SETTING = tiny(points=5).base
SEEDS = [7, 8]


def job(folder: Path, key: str) -> TrialJob:
    """A trial that saves itself at every second point."""
    return {
        "key": key,
        "spec": SETTING.canonical(),
        "seeds": SEEDS,
        "folder": str(folder / key),
        "checkpoint_every": 2,
        "stop": str(folder / "stop"),
    }


def values(points: list[Metrics]) -> list[Metrics]:
    """Points without clocks."""
    return [{name: value for name, value in point.items() if not name.startswith("time/")} for point in points]


@pytest.mark.ray
def test_a_dead_worker_and_too_little_room_change_nothing(tmp_path: Path, cluster: None) -> None:
    pool, names = Pool(3, 1), ("a", "b", "c")  # for two processors
    told: dict[str, list[Metrics]] = {name: [] for name in names}
    died, left = [], set(names)
    for name in names:
        pool.begin(job(tmp_path, name))
    end = time.monotonic() + 300
    while left and time.monotonic() < end:
        for key, result in pool.next(1.0).items():
            assert isinstance(result, dict)
            if "died" in result:
                died.append(key)
                continue
            told[key] += result["points"]
            if key == "a" and not died and len(told["a"]) == 4:
                ray.kill(pool.busy["a"].actor)
            if result["done"]:
                left.discard(key)
                pool.end(key)
            else:
                pool.go_on(key)
    assert left == set()
    assert died == ["a"]
    expected = values(list(by_hand()))
    assert [values(points) for points in told.values()] == [expected] * 3


def by_hand() -> list[Metrics]:
    """The points of a trial that nobody disturbed."""
    seeds, points = Seeds(SETTING, SEEDS), []
    while not seeds.done:
        points.append(next(seeds))
    return points


def test_points_are_told_once() -> None:
    taken, points = Taken(job(Path(), "a"), None), [{"step": float(number)} for number in range(4)]
    assert taken.new(points[:2]) == points[:2]
    assert taken.new(points[2:3]) == points[2:3]
    taken.seen = 0  # another worker, from an older checkpoint
    assert taken.new(points[:2]) == []
    assert taken.new(points[2:3]) == []
    assert taken.new(points[3:]) == points[3:]
    taken.seen = 0  # from the newest one
    assert taken.new([*points, {"step": 4.0}]) == [{"step": 4.0}]


class Handed(Pool):
    """Without workers."""

    def _hand_over(self, taken: Taken) -> None:
        taken.actor = "another"


def test_a_trial_whose_workers_die_without_getting_further_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers: list[Any] = []

    def get(call: object) -> dict[str, Any]:
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return dict(answer)

    lives = {"here": {}}
    monkeypatch.setattr(cluster, "alive", lambda: lives)
    monkeypatch.setattr(ray_workers.ray, "get", get)
    pool = Handed(1, 1)
    pool.begin(job(tmp_path, "a"))
    point = {"points": [{"step": 0.0}], "place": Place("here", "host")}
    answers += [*[ActorDiedError()] * (DEATHS - 1), point, *[ActorDiedError()] * DEATHS]
    found = [pool._result("a", None) for _ in range(len(answers) - 1)]
    assert [isinstance(one, Failed) for one in found] == [False] * len(found)
    assert pool._result("a", None) == Failed("the worker died", str(ActorDiedError()))
    assert pool.free == 1


def test_what_dies_with_its_node_does_not_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def get(call: object) -> None:
        raise LostError

    class LostError(ActorDiedError):
        def __str__(self) -> str:
            return f"because {NODE_DIED}. Node Id: c"

    monkeypatch.setattr(cluster, "alive", dict)
    monkeypatch.setattr(ray_workers.ray, "get", get)
    pool = Handed(1, 1)
    pool.begin(job(tmp_path, "a"))
    for _ in range(2 * DEATHS):
        assert pool._result("a", None) == {"died": True, "points": []}
