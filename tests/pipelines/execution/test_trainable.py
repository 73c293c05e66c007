"""A run as a Ray trial, driven by hand: no Ray is started."""

import errno
import io
import math
import os
import pickle
import random
import re
import resource
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from pipelines.conformance.blocks import fitted, nested
from pipelines.execution.cluster import here
from pipelines.execution.finite import DivergedError, check, defined
from pipelines.execution.seed_group import Seeds
from pipelines.execution.trainable import RunTrainable
from pipelines.workspace import work_folder
from pipelines.workspace.work_folder import (
    Checkpoints,
    DamagedError,
    StoreError,
    load_whole,
    save_atomically,
    without_replay,
)
from rhmc.algorithms import ALGORITHMS
from rhmc.training.trainer import Trainer
from tests.depth import covering
from tests.pipelines.support import setting, spec
from tests.robustness.chaos import DAMAGES, damaged

Start = Callable[..., RunTrainable]
Points = list[dict[str, float]]  # of a run, each with its values


def job(folder: Path, seed: int = 0, every: int = 1) -> dict[str, Any]:
    """A worker's configuration."""
    key = f"run{seed}"
    fixed = {"key": key, "spec": spec(seed).canonical(), "folder": str(folder / key), "stop": str(folder / "stop")}
    return {"job": fixed | {"checkpoint_every": every}}


@pytest.fixture
def start(tmp_path: Path) -> Start:
    def begin(folder: str = "a", **options: int) -> RunTrainable:
        return RunTrainable(job(tmp_path / folder, **options))

    return begin


def finish(run: RunTrainable) -> list[dict[str, Any]]:
    """Step to the end."""
    results = [run.step()]
    while not results[-1]["done"]:
        results.append(run.step())
    return results


def points(results: list[dict[str, Any]]) -> Points:
    """The values of training, clocks aside."""
    return [{k: v for k, v in p.items() if not k.startswith("time/")} for r in results for p in r["points"]]


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> Points:
    """The values of a run that nobody disturbed. Not to be changed."""
    return points(finish(RunTrainable(job(tmp_path_factory.mktemp("whole")))))


def same(a: Any, b: Any) -> bool:
    """True if two states are equal, bit for bit."""
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


def test_one_step_is_one_point_of_the_grid(start: Start) -> None:
    results = finish(start())
    assert [len(r["points"]) for r in results] == [1, 1, 1, 1]
    assert [p["step"] for p in points(results)] == [0, 200, 400, 600]
    assert [r["done"] for r in results] == [False, False, False, True]
    assert "final/return" in points(results)[-1]
    assert results[-1]["points"][0]["time/seconds"] == results[-1]["seconds"] > 0


@pytest.mark.parametrize("done", [1, 2, 3])
def test_a_continued_run_ends_in_the_same_state_and_tells_its_whole_history(start: Start, done: int) -> None:
    whole = start("whole")
    expected = points(finish(whole))
    first = start("parts")
    for _ in range(done):
        first.step()
    first.cleanup()
    second = start("parts")
    results = finish(second)
    assert points(results) == expected
    assert len(results) == 4 - done
    assert second.trainer is not None
    assert whole.trainer is not None
    assert same(second.trainer.state_dict(), whole.trainer.state_dict())


def test_a_run_whose_end_was_never_logged_only_tells_its_history(start: Start) -> None:
    expected = points(finish(first := start()))
    first.cleanup()
    again = start()
    result = again.step()
    assert result["done"]
    assert points([result]) == expected


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_falls_back_to_the_one_before(
    start: Start, tmp_path: Path, damage: str, expected: Points
) -> None:
    first = start()
    for _ in range(3):
        first.step()
    first.cleanup()
    files = sorted((tmp_path / "a" / "run0").glob("0*.pt"))
    assert [file.stem for file in files] == ["00000002", "00000003"]
    files[1].write_bytes(damaged(files[1].read_bytes(), damage, random.Random(1)))
    (tmp_path / "a" / "run0" / "00000004.77.part").write_bytes(b"half")  # of a killed writer
    results = finish(start())
    assert len(results[0]["points"]) == 3  # two from the checkpoint and the new one
    assert points(results) == expected
    assert not list((tmp_path / "a" / "run0").glob("*.part"))


class Broken(io.BufferedReader):
    """A file on a disk that fails."""

    def read(self, size: int | None = -1, /) -> bytes:
        raise OSError(errno.EIO, "Input/output error")


def system(code: int) -> Callable[..., Any]:
    """Errors that the system raises."""

    def refuse(*args: Any, **options: Any) -> Any:
        raise OSError(code, os.strerror(code))

    return refuse


def lack(error: Exception) -> Callable[..., Any]:
    """Errors that torch or zipfile raise."""

    def refuse(*args: Any, **options: Any) -> Any:
        raise error

    return refuse


ALLOCATOR = "[enforce fail at alloc_cpu.cpp:117] err == 0. DefaultCPUAllocator: can't allocate memory: you tried 1 GB"
SHORTAGES: dict[str, tuple[str, Callable[..., Any], str]] = {  # name -> what is patched, by what, what is said
    "descriptors of the process": ("pathlib.Path.open", system(errno.EMFILE), "Too many open files"),
    "descriptors of the system": ("pathlib.Path.open", system(errno.ENFILE), "Too many open files in system"),
    "rights": ("pathlib.Path.open", system(errno.EACCES), "Permission denied"),
    "rights of the owner": ("pathlib.Path.open", system(errno.EPERM), "Operation not permitted"),
    "disk at the first byte": ("pathlib.Path.open", lambda *a: Broken(io.FileIO(a[0])), "Input/output error"),
    "disk in the middle": ("zipfile.ZipExtFile.read", system(errno.EIO), "Input/output error"),
    "disk at the end": ("torch.load", system(errno.EIO), "Input/output error"),
    "memory of the sums": ("zipfile.ZipExtFile.read", lack(MemoryError()), "not enough memory"),
    "memory of Python": ("torch.load", lack(MemoryError()), "not enough memory"),
    "memory of torch": ("torch.load", lack(RuntimeError(ALLOCATOR)), "not enough memory"),
    "memory of torch on Windows": (
        "torch.load",
        lack(RuntimeError("not enough memory: you tried")),
        "not enough memory",
    ),
    "a newer format": ("torch.load", lack(pickle.UnpicklingError("Unsupported class x")), "Unsupported class x"),
}


@pytest.mark.parametrize("kind", SHORTAGES)
def test_a_shortage_touches_no_checkpoint(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, expected: Points
) -> None:
    first = start()
    for _ in range(3):
        first.step()
    first.cleanup()
    folder = tmp_path / "a" / "run0"
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    where, what, said = SHORTAGES[kind]
    with monkeypatch.context() as patch:
        patch.setattr(where, what)
        run = start()
        result = run.step()
        run.cleanup()
    assert result["done"]
    assert "\n" not in result["error"]
    assert said in result["error"]
    assert str(folder / "00000003.pt") in result["error"]
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    results = finish(start())
    assert len(results[0]["points"]) == 4  # three from the checkpoint and the new one
    assert points(results) == expected


def test_what_is_damaged_is_kept_under_another_name_until_the_run_is_finished(start: Start, tmp_path: Path) -> None:
    folder, rng = tmp_path / "a" / "run0", random.Random(3)
    set_aside: dict[str, bytes] = {}
    for _ in range(3):
        run = start()
        run.step()
        run.cleanup()
        newest = max(folder.glob("0*.pt"))
        set_aside[f"{newest.name}.damaged"] = content = damaged(newest.read_bytes(), "cut short", rng)
        newest.write_bytes(content)
        start().cleanup()
        assert not newest.exists()
        assert (folder / f"{newest.name}.damaged").read_bytes() == content
    assert len(list(folder.glob("*.damaged"))) == 1  # always the first checkpoint: its newest damage
    for point in range(1, 6):
        (folder / f"{point:08d}.pt").write_bytes(b"no archive")
    assert Checkpoints(folder).newest() is None
    assert sorted(file.name for file in folder.iterdir()) == ["00000004.pt.damaged", "00000005.pt.damaged"]
    assert Checkpoints(folder).points() == 0
    Checkpoints(folder).clear()
    assert not folder.exists()


def test_checkpoints_of_another_run_are_left_alone(start: Start, tmp_path: Path) -> None:
    run = start()
    run.step()
    run.cleanup()
    folder = tmp_path / "a" / "run0"
    shutil.copytree(folder, tmp_path / "a" / "run1")
    result = start(seed=1).step()
    assert result["error"] == f"{tmp_path / 'a' / 'run1'}: the checkpoints are of another run; move the folder away"
    assert (tmp_path / "a" / "run1" / "00000001.pt").read_bytes() == (folder / "00000001.pt").read_bytes()


def test_two_damaged_checkpoints_are_a_new_start(start: Start, tmp_path: Path, expected: Points) -> None:
    first = start()
    for _ in range(3):
        first.step()
    first.cleanup()
    for file in (tmp_path / "a" / "run0").glob("0*.pt"):
        file.write_bytes(b"")
    assert points(finish(start())) == expected


def test_any_changed_block_of_a_checkpoint_is_seen(tmp_path: Path) -> None:
    save_atomically(tmp_path / "x.pt", {"a": torch.arange(500.0), "b": [1, 2.5], "c": torch.ones(40, dtype=torch.bool)})
    content, rng = (tmp_path / "x.pt").read_bytes(), random.Random(2)
    whole, unseen = load_whole(tmp_path / "x.pt"), 0
    for start in range(0, len(content) - 64, 64):
        (tmp_path / "x.pt").write_bytes(content[:start] + rng.randbytes(64) + content[start + 64 :])
        try:
            unseen += not same(load_whole(tmp_path / "x.pt"), whole)
        except DamagedError:
            continue
    assert unseen == 0


def test_a_damaged_policy_is_written_again(start: Start, tmp_path: Path) -> None:
    finish(first := start())
    first.cleanup()
    policy = tmp_path / "a" / "run0" / "policy.pt"
    whole = torch.load(policy, weights_only=True)
    policy.write_bytes(policy.read_bytes()[:100])
    start().step()
    assert same(torch.load(policy, weights_only=True), whole)


def test_a_failure_is_a_result(start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: object) -> None:
        raise StoreError("x.pt: cannot be written: No space left on device")

    run = start()
    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "save", full)
        result = run.step()
    assert (result["done"], result["error"]) == (True, "x.pt: cannot be written: No space left on device")
    assert "Traceback" in result["trace"]
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "run0").touch()  # a file where the folder should be
    result = start("b").step()
    assert result["done"]
    assert str(tmp_path / "b" / "run0") in result["error"]


# Values that are not finite


@pytest.fixture
def wild(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, float, int], None]:
    """Let a metric, or the first weight, become a value at a point."""

    def become(name: str, value: float, number: int) -> None:
        plain = Trainer.__next__

        def wilder(trainer: Trainer) -> dict[str, float]:
            metrics = plain(trainer)
            if trainer.point != number:
                return metrics
            if name in metrics:
                return metrics | {name: value}
            with torch.no_grad():
                next(iter(trainer.algorithm.learners()[0].net.parameters())).view(-1)[0] = value
            return metrics

        monkeypatch.setattr(Trainer, "__next__", wilder)

    return become


WHERE = {
    "train/td_loss": "train/td_loss",
    "eval/return": "eval/return",
    "final/return": "final/return",
    "a weight": "learners.0.net.agents.net.0.weight",
}


@pytest.mark.parametrize(("name", "value"), covering(WHERE, [math.nan, math.inf, -math.inf]))
def test_a_value_that_is_not_finite_fails_the_run_and_is_not_kept(
    start: Start, tmp_path: Path, wild: Callable[[str, float, int], None], name: str, value: float
) -> None:
    wild(name, value, at := 3 if name == "final/return" else 2)
    results = finish(start())
    last = results[-1]
    assert last["error"].startswith(f"diverged: {WHERE[name]} is {value} at step {200 * at}; ")
    assert (last["diverged"], last["points"]) == (True, [])
    assert [len(r["points"]) for r in results] == [1] * at + [0]
    kept = sorted(file.name for file in (tmp_path / "a" / "run0").iterdir())
    assert kept == [f"{k:08d}.pt" for k in range(max(1, at - 1), at + 1)]  # neither a policy nor a later checkpoint


def test_statistics_that_are_not_finite_are_not_kept(start: Start, tmp_path: Path) -> None:
    run = start(every=2)
    run.step()
    trainer = run.trainer
    assert isinstance(trainer, Trainer)
    trainer.algorithm.standardiser.sums[2] = math.inf  # type: ignore[attr-defined]
    with pytest.raises(DivergedError, match=r"^diverged: algorithm\.standardiser\.sums is inf at step 0; "):
        run._save(trainer)
    assert not (tmp_path / "a" / "run0").exists()


def test_a_diverged_run_diverges_again_where_it_did(
    start: Start, tmp_path: Path, wild: Callable[[str, float, int], None]
) -> None:
    wild("train/td_loss", math.nan, 3)
    first = finish(run := start(every=100))
    run.cleanup()
    assert not list((tmp_path / "a" / "run0").glob("*.pt"))
    again = finish(start(every=100))
    assert first[-1]["error"] == again[-1]["error"]
    assert points(first) == points(again)
    assert len(points(again)) == 3


def test_a_step_size_that_diverges(start: Start, tmp_path: Path) -> None:
    """Nothing is patched here: the weights grow until the loss overflows."""
    one = spec(lr=1e6, learning_starts=0)
    fixed = {"key": "wild", "spec": one.canonical(), "folder": str(tmp_path / "wild"), "stop": str(tmp_path / "stop")}
    run = RunTrainable({"job": fixed | {"checkpoint_every": 1}})
    last = finish(run)[-1]
    assert re.match(r"diverged: train/\w+ is (inf|nan) at step 200; ", last["error"])
    assert [file.name for file in (tmp_path / "wild").iterdir()] == ["00000001.pt"]


@pytest.mark.parametrize("kind", ALGORITHMS)
def test_every_method_is_finite_at_every_point_and_each_of_its_networks_is_looked_at(kind: str) -> None:
    """With the settings under which some value is infinite or undefined although nothing is wrong."""
    few = {"hidden_dim": 4, "batch_size": 8, "learning_starts": 0, "train_freq": 4, "n_steps": 1, "pretrain": 32}
    few |= {"epochs": 1, "minibatches": 1}
    config = ALGORITHMS[kind].config
    algo = config.model_validate({"kind": kind} | nested(fitted(config, few)))
    if "regulator" in config.model_fields:
        algo = algo.model_copy(update={"regulator": "none"})
    one = setting().model_copy(update={"algo": algo})
    trainer = Trainer(one.env.model_copy(update={"agents": 1, "targets": 1}), one.algo, one.trainer, 0)
    for point in trainer:
        check(defined(point), trainer.state_dict())
    for learner in trainer.algorithm.learners():
        for part in (learner.net, learner.target_net):
            for weight in part.parameters():
                before = weight.detach().clone()
                weight.data.view(-1)[-1] = math.nan
                with pytest.raises(DivergedError, match=r"^diverged: algorithm\.\S+ is nan at step 7; "):
                    check({"step": 7.0}, trainer.state_dict())
                weight.data.copy_(before)
    check({"step": 7.0}, trainer.state_dict())


def test_what_has_no_value_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rollout whose targets are all the same explains nothing of their variance."""
    assert defined({"train/explained": -math.inf, "train/kl": 0.5}) == {"train/kl": 0.5}
    assert defined({"train/explained": 0.5}) == {"train/explained": 0.5}
    values = iter([math.nan, 0.5])
    monkeypatch.setattr(Trainer, "__next__", lambda _: {"step": 0.0, "train/explained": next(values)})
    assert next(Seeds(setting(), [1, 2])) == {"step": 0.0, "train/explained": 0.5}


def test_a_file_is_durable_before_its_name_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[str, bool]] = []
    monkeypatch.setattr(work_folder, "sync", lambda path: seen.append((path.name, (tmp_path / "x.pt").exists())))
    save_atomically(tmp_path / "x.pt", 1)
    assert [(name.split(".")[-1], there) for name, there in seen] == [("part", False), (tmp_path.name, True)]


def test_checkpoints_come_as_often_as_asked_and_at_the_end(start: Start, tmp_path: Path) -> None:
    run, seen = start(every=3), []
    for _ in range(4):
        run.step()
        seen.append(sorted(file.name for file in (tmp_path / "a" / "run0").glob("*.pt")))
    assert seen == [[], [], ["00000003.pt"], ["00000003.pt", "00000004.pt", "policy.pt"]]


def test_a_kept_policy_holds_nothing_that_learning_kept() -> None:
    replay, rows = {"rows": {"a": torch.ones(2)}, "next": 0, "size": 2}, [{"a": torch.ones(2)}]
    state = {"replay": replay, "rollout": {"rows": rows}, "net": {"rows.weight": torch.ones(1)}, "list": [replay]}
    state["decisions"] = {"rows": {"a": torch.ones(3, 2)}, "count": torch.ones(2)}
    kept = without_replay(state)
    empty = {"rows": {}, "next": 0, "size": 0}
    assert (kept["replay"], kept["list"], kept["rollout"]) == (empty, [empty], {"rows": []})
    assert (kept["decisions"]["rows"], len(kept["decisions"]["count"])) == ({}, 0)
    assert kept["net"] == state["net"]
    assert len(state["rollout"]["rows"]) == 1


@pytest.mark.parametrize("kind", ALGORITHMS)
def test_no_method_keeps_its_half_rollout(kind: str) -> None:
    """The policy of an untrained and of a trained run hold the same tensors but for the task's own state."""
    config = {"kind": kind, "hidden_dim": 8}
    one = setting().model_copy(update={"algo": ALGORITHMS[kind].config.model_validate(config)})
    trainer = Trainer(one.env, one.algo, one.trainer, 0)
    next(trainer)
    before = sizes(without_replay(trainer.state_dict()["algorithm"]))
    for _ in range(3):
        trainer._act()
    after = sizes(without_replay(trainer.state_dict()["algorithm"]))
    assert {path: size for path, size in after.items() if ".pending." not in path} == before


def sizes(state: Any, path: str = "") -> dict[str, int]:
    """Numbers in each tensor of a state."""
    if isinstance(state, torch.Tensor):
        return {path: state.numel()}
    inner = state.items() if isinstance(state, dict) else enumerate(state) if isinstance(state, list) else ()
    return {k: v for name, child in inner for k, v in sizes(child, f"{path}.{name}").items()}


def test_the_policy_is_the_last_state_with_empty_replays(start: Start, tmp_path: Path) -> None:
    run = start()
    finish(run)
    policy = torch.load(tmp_path / "a" / "run0" / "policy.pt", weights_only=True)
    assert run.trainer is not None
    state = run.trainer.state_dict()
    assert policy["algorithm"]["experience"]["replay"] == {"rows": {}, "next": 0, "size": 0}
    assert state["algorithm"]["experience"]["replay"]["size"] == 400
    assert same(policy["algorithm"]["q"], state["algorithm"]["q"])
    assert same(policy, without_replay(state) | {"spec": spec(0).canonical()})


def test_the_last_checkpoint_has_no_replay_either_and_tells_everything_once_more(start: Start, tmp_path: Path) -> None:
    run = start()
    told = points(finish(run))
    run.cleanup()
    newest = Checkpoints(tmp_path / "a" / "run0").newest()
    assert newest is not None
    assert newest["trainer"]["algorithm"]["experience"]["replay"]["size"] == 0
    policy = load_whole(tmp_path / "a" / "run0" / "policy.pt")
    again = start("a").step()
    assert (again["done"], again["stopped"], points([again])) == (True, False, told)
    assert same(load_whole(tmp_path / "a" / "run0" / "policy.pt"), policy)


def test_a_stop_saves_the_run_at_its_next_point(start: Start, tmp_path: Path) -> None:
    run = start(every=100)
    run.step()
    (tmp_path / "a" / "stop").touch()
    result = run.step()
    assert (result["done"], result["stopped"]) == (True, True)
    assert start("a").step() == {
        "done": True,
        "stopped": True,
        "points": [],
        "seconds": 0.0,
        "place": here(),
    }  # none begins
    run.cleanup()
    (tmp_path / "a" / "stop").unlink()
    assert len(start().step()["points"]) == 3


def test_a_process_goes_on_with_the_next_run(start: Start, tmp_path: Path) -> None:
    expected = points(finish(start("other", seed=1)))
    run = start(seed=0)
    run.step()
    assert run.reset_config(job(tmp_path / "a", seed=1))
    assert points(finish(run)) == expected
    assert points(finish(start(seed=0)))[0]["step"] == 0  # and the first run is free


def test_a_run_is_trained_by_one_process_at_a_time(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipelines.execution.trainable.PATIENCE", 0.0)
    run = start()
    assert start().step() == {
        "done": True,
        "stopped": True,
        "busy": True,
        "points": [],
        "seconds": 0.0,
        "place": here(),
    }
    run.cleanup()
    assert len(start().step()["points"]) == 1


def test_rays_own_checkpoints_hold_the_same(start: Start, tmp_path: Path, expected: Points) -> None:
    run = start(every=100)
    run.step()
    run.step()
    run.save_checkpoint(str(tmp_path / "ray"))
    other = start("b", every=100)
    other.load_checkpoint(str(tmp_path / "ray"))
    assert points(finish(other)) == expected
    with pytest.raises(StoreError, match="no readable checkpoint"):
        other.load_checkpoint(str(tmp_path / "nothing"))


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "x.pt"
    save_atomically(path, {"a": 1})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))  # as good as a full disk
    try:
        with pytest.raises(StoreError, match=r"x\.pt: cannot be written: File too large"):
            save_atomically(path, {"a": torch.zeros(100_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [file.name for file in tmp_path.iterdir()] == ["x.pt"]
    assert torch.load(path, weights_only=True) == {"a": 1}


def test_no_checkpoint_is_no_state(tmp_path: Path) -> None:
    assert Checkpoints(tmp_path / "none").newest() is None


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", "ValueError"),
        ("\n  first\nsecond", "first"),
        ("Traceback (most recent call last):\n  File x\nKeyError: 'place'\n", "KeyError: 'place'"),
    ],
)
def test_an_error_in_one_line(text: str, line: str) -> None:
    assert work_folder.one_line(ValueError(text)) == line
