"""Searches: what a file may say, that every method gets the same budget, and that a kill changes nothing."""

import gc
import hashlib
import itertools
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from io import StringIO
from pathlib import Path
from typing import Any

import optuna
import pytest
from optuna.storages import InMemoryStorage
from rich.console import Console
from ruamel.yaml import YAML

from pipelines.execution import ray_driver
from pipelines.execution.finite import DivergedError
from pipelines.execution.progress import PlainBoard
from pipelines.execution.seed_group import Seeds
from pipelines.execution.tally import Training
from pipelines.execution.trainable import ending
from pipelines.specs.search import EVAL_SEED, FIRST_SEED, Dimension, Search
from pipelines.specs.study import Setting, Study, StudyError
from pipelines.tracking.mlflow_tracker import open_existing
from pipelines.tracking.tracker import points_of
from pipelines.tuning import ray_workers
from pipelines.tuning.best_params import file_name, winner_yaml
from pipelines.tuning.ray_workers import Failed
from pipelines.tuning.search_plots import plots
from pipelines.tuning.search_run import Drive, TrialLog, results, run_search, search_card, show_search, tally
from pipelines.tuning.trials import ArmStudy, look, open_storage
from pipelines.workspace.work_folder import Home, StoreError
from rhmc.training.trainer import Trainer
from tests.memory_tracker import MemoryRun, MemoryTracker
from tests.pipelines.execution.test_trainable import same
from tests.pipelines.support import CODE, Said, all_end, interrupt, run_rhmc, setting
from tests.robustness.killed import PoolHere
from tests.support import changing

ROOT = Path(__file__).parents[3]
GOOD = """\
question: Which?
base:
  env: {kind: navigation, agents: 2, episode: 7}
  algo: {kind: iql, learning_starts: 64, batch_size: 32, train_freq: 16, hidden_dim: 16, buffer_size: 400}
  trainer: {num_envs: 8, evaluations: 3, eval_episodes: 4, final_episodes: 8}
arms:
  IQL:
    space:
      lr: {low: 1e-4, high: 1e-2, log: true}
      gamma: {low: 0.5, high: 0.9}
  VDN:
    algo: {kind: vdn, learning_starts: 64, batch_size: 32, train_freq: 16, hidden_dim: 16, buffer_size: 400}
    space:
      lr: {low: 1e-4, high: 1e-2, log: true}
      batch_size: {low: 16, high: 32}
      double_q: {choices: [true, false]}
trials: {quick: 5, paper: 9}
seeds: 2
steps: 600
sampler: {startup: 2}
"""
changed = changing(GOOD)


@pytest.fixture(autouse=True)
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty project as the current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("OPTUNA_STORAGE", raising=False)
    (tmp_path / "studies" / "best_params").mkdir(parents=True)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return tmp_path


def load(text: str = GOOD, profile: str = "quick", *overrides: str) -> Search:
    Path("studies/search_x.yaml").write_text(text)
    return Search.load("studies/search_x.yaml", profile, overrides)


# The file


def test_every_arm_has_the_same_budget_task_and_evaluation() -> None:
    search = load(GOOD, "paper")
    assert (search.trials, search.seeds, search.steps) == (9, 2, 600)
    one, other = (arm.setting for arm in search.arms.values())
    assert one.trainer == other.trainer
    assert one.env == other.env
    assert one.trainer.steps == 600


def test_a_search_trains_and_evaluates_on_what_no_study_meets() -> None:
    search = load()
    assert search.seed_list() == [500_000, 500_001] == [FIRST_SEED, FIRST_SEED + 1]
    assert EVAL_SEED == 20_000_000, "a search that goes on has met these episodes"
    assert {arm.setting.trainer.eval_seed for arm in search.arms.values()} == {EVAL_SEED}
    assert setting().trainer.eval_seed != EVAL_SEED
    told = load(changed("num_envs: 8", "num_envs: 8, eval_seed: 7"))
    assert {arm.setting.trainer.eval_seed for arm in told.arms.values()} == {7}


def test_an_override_changes_the_budget_of_all() -> None:
    search = load(GOOD, "quick", "trials=2", "steps=800", "trainer.evaluations=4")
    assert (search.trials, search.overrides) == (2, ("trials=2", "steps=800", "trainer.evaluations=4"))
    assert {(a.setting.trainer.steps, a.setting.trainer.evaluations) for a in search.arms.values()} == {(800, 4)}


def test_more_trials_continue_a_search_and_anything_else_begins_another() -> None:
    def identity(text: str) -> str:
        return load(text).identity("IQL")

    first = identity(GOOD)
    assert identity(changed("quick: 5", "quick: 50")) == first
    assert identity(GOOD.replace("high: 32", "high: 31")) == first  # of the other arm
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipelines.specs.search.code_id", lambda *place: "0ther")
        assert identity(GOOD) != first
    for old, new in [
        ("high: 0.9", "high: 0.8"),
        ("seeds: 2", "seeds: 3"),
        ("steps: 600", "steps: 601"),
        ("startup: 2", "startup: 3"),
        ("agents: 2", "agents: 3"),
        ("num_envs: 8", "num_envs: 4"),
    ]:
        assert identity(changed(old, new)) != first, new


def test_what_the_space_replaces_is_no_part_of_a_searchs_identity() -> None:
    first = load()
    assert "lr" in first.arms["IQL"].space
    other = load(changed("algo: {kind: iql,", "algo: {kind: iql, lr: 9e-3,"))
    assert other.arms["IQL"].setting != first.arms["IQL"].setting
    assert other.identity("IQL") == first.identity("IQL")


def test_what_the_space_replaces_in_a_block_is_no_part_of_it_either() -> None:
    def identity(block: str) -> str:
        arm = f"  RHMC: {{algo: {{kind: rhmc{block}}}, space: {{executor.gamma: {{low: 0.5, high: 0.9}}}}}}\n"
        return load(changed("arms:\n", f"arms:\n{arm}")).identity("RHMC")

    assert identity(", executor: {gamma: 0.7}") == identity("")
    one = identity(", executor: {gamma: 0.7, epsilon: 0.1}")
    assert one == identity(", executor: {epsilon: 0.1}") != identity(", executor: {epsilon: 0.2}")


def test_the_digest_of_a_search_covers_what_it_includes() -> None:
    text, tuned = changed("algo: {kind: vdn,", "algo: {include: best_params/vdn,"), Path("studies/best_params/vdn.yaml")
    tuned.parent.mkdir(exist_ok=True)
    tuned.write_text("algo: {kind: vdn}\n")
    first = load(text).sha256
    tuned.write_text("algo: {kind: vdn} # again\n")
    assert load(text).sha256 != first
    assert load().sha256 == hashlib.sha256(Path("studies/search_x.yaml").read_bytes()).hexdigest()


LR = "lr: {low: 1e-4, high: 1e-2, log: true}\n      gamma"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "gamma: {",
            "gama: {",
            "10: arms.IQL.space.gama: 'iql' has no setting 'gama'; allowed: *; did you mean 'gamma'?",
        ),
        (
            "high: 0.9",
            "high: 1.5",
            "10: arms.IQL.space.gamma.high: 1.5 is not allowed; must be less than or equal to 1",
        ),
        ("low: 0.5", "low: 0.95", "10: arms.IQL.space.gamma.high: 0.9 is not allowed; must be above low"),
        ("low: 0.5, ", "", "10: arms.IQL.space.gamma: must have 'low' and 'high', or 'choices'"),
        (
            "low: 0.5",
            "lo: 0.5",
            "10: arms.IQL.space.gamma.lo: unknown key 'lo'; allowed: low, high, log, step, choices*",
        ),
        (
            LR,
            LR.replace("1e-4", "0"),
            "9: arms.IQL.space.lr.low: 0 is not allowed; must be above 0 where log is true",
        ),
        (LR, LR.replace("1e-4", "tiny"), "9: arms.IQL.space.lr.low: 'tiny' is not allowed; must be a valid number"),
        ("low: 16", "low: 16.5", "15: arms.VDN.space.batch_size.low: 16.5 is not allowed; must be a valid integer"),
        (
            "high: 32",
            "high: 32, step: 0.5",
            "15: arms.VDN.space.batch_size.step: 0.5 is not allowed; must be a whole number",
        ),
        (
            "high: 32",
            "high: 32, step: 5",
            "15: arms.VDN.space.batch_size.high: 32 is not allowed; must be low and a whole*",
        ),
        (
            "[true, false]",
            "[true, 3]",
            "16: arms.VDN.space.double_q.choices.1: 3 is not allowed; must be a valid boolean",
        ),
        ("[true, false]", "[true, true]", "16: arms.VDN.space.double_q.choices: one is there twice"),
        ("[true, false]", "[]", "16: arms.VDN.space.double_q.choices: [] is not allowed; must not be empty"),
        ("{choices: [true, false]}", "yes", "16: arms.VDN.space.double_q: 'yes' is not allowed; must be a mapping"),
        ("quick: 5", "quick: 0", "17: trials.quick: 0 is not allowed; must be greater than or equal to 1"),
        (
            "trials: {quick: 5, paper: 9}",
            "trials: {paper: 9}",
            "17: trials.quick: missing; there is a value for: paper",
        ),
        ("{startup: 2}", "{kind: tpee}", "20: sampler.kind: 'tpee' is not allowed; allowed: tpe, random*'tpe'?"),
        ("sampler: {startup: 2}", "pruner: {kind: asha, reduction: 1}", "20: pruner.reduction: 1 is not allowed; *"),
        ("  VDN:\n", "  VDN:\n    trainer: {steps: 9}\n", "12: arms.VDN.trainer: unknown key 'trainer'; *"),
        ("  VDN:\n", "  VDN:\n    env: {kind: coverage}\n", "12: arms.VDN.env: unknown key 'env'; *"),
        ("seeds: 2", "grid: {algo.lr: [1e-3, 1e-2]}\nseeds: 2", "18: grid: unknown key 'grid'; allowed: question, *"),
        ("seeds: 2", "variants: {a: {env: {agents: 3}}}\nseeds: 2", "18: variants: unknown key 'variants'; allowed: *"),
        ("seeds: 2", "profiles: {quick: {arms: [IQL]}}\nseeds: 2", "18: profiles.quick.arms: unknown key 'arms'; *"),
        (
            "    space:\n      lr: {low: 1e-4, high: 1e-2, log: true}\n      gamma: {low: 0.5, high: 0.9}",
            "    space: {}",
            "*",
        ),
    ],
)
def test_a_fault_is_one_line_with_its_place(old: str, new: str, said: str) -> None:
    with pytest.raises(StudyError) as caught:
        load(changed(old, new))
    start, _, end = said.partition("*")
    lines = [re.sub(r"^(\S+:\d+):\d+:", r"\1:", line) for line in str(caught.value).splitlines()]
    assert any(line.startswith(f"studies/search_x.yaml:{start}") and line.endswith(end) for line in lines), lines


def test_a_fault_names_the_column_of_the_value() -> None:
    column = GOOD.splitlines()[9].index("0.9}") + 1
    with pytest.raises(StudyError, match=rf"^studies/search_x.yaml:10:{column}: arms.IQL.space.gamma.high: 1.5 is not"):
        load(changed("high: 0.9", "high: 1.5"))


def test_a_combination_that_the_method_refuses_is_found_in_the_check() -> None:
    space = "{regulator: {choices: [none, exact]}, coordinator.reward: {choices: [assigned, team]}}"
    arm = f"  RHMC: {{algo: {{kind: rhmc}}, space: {space}}}\n"
    with pytest.raises(
        StudyError, match=r"7:\d+: arms.RHMC.space: 'rhmc' refuses regulator='exact', coordinator.reward='team': "
    ):
        load(changed("arms:\n", f"arms:\n{arm}"))
    load(changed("arms:\n", f"arms:\n{arm}".replace("[none, exact]", "[none]")))


def test_arms_may_include_one_space() -> None:
    Path("studies/spaces.yaml").write_text(
        "space:\n  lr: {low: 1e-4, high: 1e-2, log: true}\n  gamma: {low: 0.5, high: 0.9}\n"
    )
    alike = "{algo: {kind: %s}, space: {include: spaces%s}}"
    arms = f"  mine: {alike % ('ippo', '')}\n  other: {alike % ('mappo', ', gamma: {low: 0.8, high: 0.9}')}\n"
    search = load(changed("arms:\n", f"arms:\n{arms}"))
    assert [list(search.arms[name].space) for name in ("mine", "other")] == [["lr", "gamma"]] * 2
    assert [search.arms[name].space["gamma"].low for name in ("mine", "other")] == [0.5, 0.8]
    before = search.identity("mine"), search.sha256
    Path("studies/spaces.yaml").write_text("space:\n  lr: {low: 1e-4, high: 2e-2}\n  gamma: {low: 0.5, high: 9}\n")
    with pytest.raises(StudyError, match=r"^studies/spaces.yaml:3:27: space.gamma.high: 9 is not allowed; .*"):
        load(changed("arms:\n", f"arms:\n  mine: {alike % ('ippo', '')}\n"))
    Path("studies/spaces.yaml").write_text("space:\n  lr: {low: 1e-4, high: 2e-2}\n  gamma: {low: 0.5, high: 0.9}\n")
    again = load(changed("arms:\n", f"arms:\n{arms}"))
    assert again.identity("mine") != before[0]
    assert again.sha256 != before[1]


def test_a_study_is_no_search_and_a_search_no_study() -> None:
    load()
    with pytest.raises(
        StudyError,
        match=r"^studies/search_x.yaml:1:1: .*: a search, for `rhmc search check`, .* is no study$",
    ):
        Study.load("studies/search_x.yaml")
    with pytest.raises(
        StudyError,
        match=r"coverage.yaml:1:1: no arm has a space: a study, for `rhmc study check`, .* is no search$",
    ):
        Search.load(ROOT / "studies" / "coverage.yaml")


@pytest.mark.parametrize("path", sorted((ROOT / "studies").glob("search_*.yaml")), ids=lambda p: p.stem)
@pytest.mark.parametrize("profile", ["quick", "paper"])
def test_the_searches_at_hand(path: Path, profile: str) -> None:
    search = Search.load(path, profile)
    assert search.question.endswith("?")
    encoders = {arm.setting.algo.encoder for arm in search.arms.values()}
    assert len(encoders) == 1


# Seeds side by side


def test_seeds_side_by_side_are_the_seeds_one_by_one() -> None:
    one = setting()
    alone = [list(Trainer(one.env, one.algo, one.trainer, seed)) for seed in (3, 4)]
    points = list(Seeds(one, [3, 4]))
    assert [p["step"] for p in points] == [0, 200, 400, 600]
    for point, first, second in zip(points, *alone, strict=True):
        for name in first:
            assert point[name] == pytest.approx((first[name] + second[name]) / 2), name
    assert [points[-1][f"seeds/{seed}"] for seed in (3, 4)] == [curve[-1]["final/return"] for curve in alone]
    assert not any(name.startswith("seeds/") for name in points[-2])


def test_seeds_continue_bit_for_bit() -> None:
    whole, half, rest = (Seeds(setting(), [3, 4]) for _ in range(3))
    for _ in range(2):
        next(whole), next(half)
    rest.load_state_dict(half.state_dict())
    assert list(whole) == list(rest)
    assert same(whole.state_dict(), rest.state_dict())


# A search with workers in this process


class Killed(BaseException):
    """As kill -9: nobody gets to clean up."""


Curve = Callable[[Setting, int], list[float]]


def curve(one: Setting, seed: int) -> list[float]:
    """Better the nearer lr is to 1e-3; the seed adds a little."""
    height = 10 - abs(math.log10(one.algo.lr) + 3) + (seed - FIRST_SEED) / 100
    return [height * k / 3 for k in range(4)]


class Twin:
    """Workers without processes: `disk` is how far each trial has saved itself."""

    def __init__(self, disk: dict[str, int], shape: Curve = curve, size: int = 1) -> None:
        self.disk, self.shape, self.free = disk, shape, size
        self.jobs: dict[str, Any] = {}
        self.told: dict[str, int] = {}
        self.queue: list[str] = []
        self.trained = 0

    def begin(self, job: Any) -> None:
        self.free -= 1
        self.jobs[job["key"]] = job
        self.told[job["key"]] = 0
        self.go_on(job["key"])

    def go_on(self, key: str) -> None:
        self.queue.append(key)

    def end(self, key: str) -> None:
        self.free += 1
        del self.jobs[key]

    def next(self, timeout: float) -> dict[str, Any]:
        key = self.queue.pop(0)
        job, self.trained = self.jobs[key], self.trained + 1
        try:
            curves = {seed: self.shape(Setting.model_validate_json(job["spec"]), seed) for seed in job["seeds"]}
        except ValueError as error:
            return {key: Failed(f"ValueError: {error}", "Traceback")}
        except DivergedError as error:
            return {key: ending(error=str(error), trace="Traceback", diverged=True)}
        last = len(next(iter(curves.values()))) - 1
        self.disk[key] = now = min(last, self.disk.get(key, -1) + 1)
        points = [point(curves, k, last) for k in range(self.told[key], now + 1)]
        self.told[key] = now + 1
        stopped = Path(job["stop"]).exists() and now < last
        return {key: {"done": stopped or now == last, "stopped": stopped, "points": points}}


def point(curves: dict[int, list[float]], k: int, last: int) -> dict[str, float]:
    mean = sum(values[k] for values in curves.values()) / len(curves)
    finals = {f"seeds/{seed}": values[k] for seed, values in curves.items()} | {"final/return": mean}
    return {"step": 200.0 * k, "eval/return": mean} | (finals if k == last else {})


class World:
    """The state that outlives a launch: Optuna's storage, the log and the checkpoints."""

    def __init__(self, search: Search, folder: Path, storage: Any = None) -> None:
        self.search, self.folder = search, folder
        self.storage = storage or InMemoryStorage()
        self.shelf: list[MemoryRun] = []
        self.disk: dict[str, int] = {}
        self.out = StringIO()

    def arm_studies(self) -> list[ArmStudy]:
        return [ArmStudy(self.search, arm, self.storage) for arm in self.search.arms]

    def launch(self, shape: Curve = curve, size: int = 1, twin: Twin | None = None) -> Twin:
        arm_studies = self.arm_studies()
        for arm_study in arm_studies:
            arm_study.take_up()
        workers = twin or Twin(self.disk, shape, size)
        tracker = MemoryTracker(search_card(self.search), self.shelf)
        trial_log = TrialLog(self.search, tracker, PlainBoard(Console(file=self.out)))
        Drive(self.search, arm_studies, workers, trial_log, Home(self.folder), self.folder / "stop").run()
        return workers

    def outcome(self) -> dict[str, Any]:
        """The result of every trial of every arm, and the log's content."""
        trials = {
            (arm_study.arm, place): (t.state.name, t.params, t.values, t.intermediate_values)
            for arm_study in self.arm_studies()
            for place, t in sorted(arm_study.latest().items())
        }
        log = {(r.card.arm, r.card.trial): (r.status, r.tags, r.card.params, points_of(r.values)) for r in self.shelf}
        assert len(log) == len(self.shelf), "a trial has two runs in the log"
        return {"trials": trials, "log": dict(sorted(log.items()))}

    def winners(self) -> list[str]:
        texts = []
        for arm_study in self.arm_studies():
            best = arm_study.best()
            assert best is not None
            texts.append(winner_yaml(self.search, arm_study.arm, best, arm_study.counts()))
        return texts


def test_every_arm_is_tried_as_often_and_all_advance_together(tmp_path: Path) -> None:
    world = World(load(), tmp_path)
    workers = world.launch(size=2)
    assert workers.trained == 2 * 5 * 4  # arms, trials, points
    assert [arm_study.counts()["complete"] for arm_study in world.arm_studies()] == [5, 5]
    order = [run.card.arm for run in world.shelf]
    assert all({"IQL", "VDN"} == set(order[k : k + 2]) for k in range(0, 10, 2))
    assert {arm_study.left for arm_study in world.arm_studies()} == {0}
    assert world.launch().trained == 0


def test_the_board_counts_the_trials_of_all_arms(tmp_path: Path) -> None:
    world, queue = World(load(), tmp_path), []
    make = TrialLog.__init__

    def counted(self: TrialLog, search: Search, tracker: Any, display: Any) -> None:
        make(self, search, tracker, display)
        queue.append(tally(search, world.arm_studies()))
        assert queue[-1].waiting == {Training("IQL", 600): 5, Training("VDN", 600): 5}
        display.expect(queue[-1])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrialLog, "__init__", counted)
        world.launch(size=2)
    assert world.out.getvalue().splitlines()[0] == "0 of 10 trials finished"
    assert (str(queue[0]), queue[0].left()) == ("10 of 10 trials finished", 0)
    assert str(tally(world.search, world.arm_studies())) == "10 of 10 trials finished"


def test_a_trial_is_judged_by_the_mean_of_its_seeds(tmp_path: Path) -> None:
    world = World(load(), tmp_path)
    world.launch()
    for arm_study in world.arm_studies():
        for trial in arm_study.latest().values():
            returns = [10 - abs(math.log10(trial.params["lr"]) + 3) + k / 100 for k in (0, 1)]
            assert trial.user_attrs["returns"] == pytest.approx(returns)
            assert trial.values == pytest.approx([sum(returns) / 2])
            assert list(trial.intermediate_values) == [0, 1, 2, 3]
        best = arm_study.best()
        assert best is not None
        assert best.value == max(trial.values[0] for trial in arm_study.latest().values())


def test_the_log_has_a_run_for_each_trial(tmp_path: Path) -> None:
    world = World(load(), tmp_path)
    world.launch()
    run = world.shelf[0]
    assert (run.card.name, run.status, run.tags["state"], run.tags["trial"]) == ("IQL t0", "finished", "complete", "0")
    assert run.card.params.keys() == {"method", "algo.lr", "algo.gamma"}
    config = YAML(typ="safe").load(run.files["config.yaml"].decode())
    assert config["algo"]["lr"] == float(run.card.params["algo.lr"])
    assert config["seeds"] == [FIRST_SEED, FIRST_SEED + 1]
    curve_there = points_of(run.values)
    assert [p["step"] for p in curve_there] == [0, 200, 400, 600]
    assert curve_there[-1]["objective"] == pytest.approx(curve_there[-1]["eval/return"])


def test_more_trials_go_on_where_fewer_ended(tmp_path: Path) -> None:
    few = World(load(GOOD, "quick", "trials=3"), tmp_path)
    few.launch()
    more = World(load(), tmp_path, few.storage)
    more.shelf, more.disk = few.shelf, few.disk
    more.launch()
    whole = World(load(), tmp_path)
    whole.launch()
    assert more.outcome() == whole.outcome()


@pytest.mark.parametrize("kind", ["random", "tpe"])
def test_a_search_one_at_a_time_is_the_same_again(tmp_path: Path, kind: str) -> None:
    first, again, other = (
        World(load(changed("startup: 2", f"startup: 2, kind: {kind}, seed: {seed}")), tmp_path) for seed in (0, 0, 1)
    )
    for world in (first, again, other):
        world.launch()
    assert first.outcome() == again.outcome()
    assert first.outcome()["trials"] != other.outcome()["trials"]
    lrs = [run.card.params["algo.lr"] for run in first.shelf if run.card.arm == "IQL"]
    assert len(set(lrs)) == 5


MEDIAN, ASHA = "pruner: {kind: median, startup: 1}\n", "pruner: {kind: asha, warmup: 1, reduction: 2}\n"


@pytest.mark.parametrize("pruner", [MEDIAN, ASHA])
def test_trials_that_fall_behind_are_given_up(tmp_path: Path, pruner: str) -> None:
    world = World(load(GOOD + pruner), tmp_path)
    trained = world.launch().trained
    assert trained < 2 * 5 * 4
    for arm_study in world.arm_studies():
        trials = arm_study.latest().values()
        counts = arm_study.counts()
        assert counts["complete"] + counts["pruned"] == 5
        assert counts["pruned"] > 0
        pruned = [t for t in trials if t.state.name == "PRUNED"]
        assert all(0 < max(t.intermediate_values) < 3 for t in pruned)
        best = arm_study.best()
        assert best is not None
        assert best.value == max(t.values[0] for t in trials if t.state.name == "COMPLETE")
    states = [(run.tags["state"], run.status, "objective" in points_of(run.values)[-1]) for run in world.shelf]
    assert set(states) == {("complete", "finished", True), ("pruned", "finished", False)}


def test_a_pruned_trial_never_wins_and_of_equals_the_earliest_does(tmp_path: Path) -> None:
    (iql, _) = World(load(), tmp_path).arm_studies()
    first, second, third, fourth = (iql.ask() for _ in range(4))
    assert first is not None
    assert second is not None
    assert third is not None
    assert fourth is not None
    iql.report(third, {"step": 200.0, "eval/return": 99.0}, 1)
    iql.prune(third, "behind the others")
    assert iql.best() is None
    iql.complete(fourth, [3.0, 4.0])
    iql.complete(second, [3.0, 5.0])
    iql.complete(first, [4.0, 4.0])
    best = iql.best()
    assert best is not None
    assert (best.trial_index, best.value, best.returns) == (0, 4.0, [4.0, 4.0])
    assert (iql.closed, iql.left) == (4, 1)


def test_the_earliest_of_equals_is_the_first_of_the_budget_whenever_it_was_tried(tmp_path: Path) -> None:
    (iql, _) = World(load(), tmp_path).arm_studies()
    died = iql.study.ask()  # before it had its values, while another was asked for
    died.set_user_attr("trial_index", 0)
    second = iql.ask()
    iql.study.tell(died, state=optuna.trial.TrialState.FAIL)
    first = iql.ask()
    assert first is not None
    assert second is not None
    assert (first.trial_index, second.trial_index) == (0, 1)
    for trial in (second, first):
        iql.complete(trial, [4.0, 4.0])
    best = iql.best()
    assert best is not None
    assert best.trial_index == 0


@pytest.mark.parametrize(("warmup", "given_up_at"), [(1, 1), (2, 2), (3, 3)])
def test_the_pruner_waits_for_its_points_and_trials(tmp_path: Path, warmup: int, given_up_at: int) -> None:
    """Two good trials, of which the median is made, then one that is bad from the start."""
    (iql, _) = World(load(GOOD + f"pruner: {{kind: median, startup: 2, warmup: {warmup}}}\n"), tmp_path).arm_studies()

    def points(trial: Any, height: float) -> list[int]:
        curve = [{"step": 200.0 * k, "eval/return": height} for k in range(1, 5)]
        return [k for k, one in enumerate(curve, start=1) if iql.report(trial, one, k)]

    for height in (9.0, 8.0):
        trial = iql.ask()
        assert trial is not None
        assert points(trial, height) == [], "too few trials"
        iql.complete(trial, [height])
    bad = iql.ask()
    assert bad is not None
    assert points(bad, 1.0)[0] == given_up_at
    assert iql.report(bad, {"step": 1000.0, "eval/return": 1.0, "final/return": 1.0}, 5) == "", "it is at its end"


def test_no_finite_return_ends_a_trial_and_counts(tmp_path: Path) -> None:
    def wild(one: Setting, seed: int) -> list[float]:
        late = [0.0, 1.0, 2.0, math.nan] if one.algo.kind == "vdn" else [0.0, math.inf, 2.0, 3.0]
        return late if one.algo.lr > 1e-3 else curve(one, seed)

    world = World(load(), tmp_path)
    world.launch(wild)
    for arm_study in world.arm_studies():
        whys = [t.user_attrs["pruned"] for t in arm_study.latest().values() if t.state.name == "PRUNED"]
        assert whys
        assert set(whys) == {
            "no finite return at step 600" if arm_study.arm == "VDN" else "no finite return at step 200"
        }
        assert arm_study.closed == 5


def test_a_trial_that_diverges_is_pruned_and_never_tried_again(tmp_path: Path) -> None:
    def diverging(one: Setting, seed: int) -> list[float]:
        if one.algo.lr > 1e-3:
            raise DivergedError("diverged: train/td_loss is inf at step 200")
        return curve(one, seed)

    world = World(load(), tmp_path)
    world.launch(diverging)
    gone = [t for arm_study in world.arm_studies() for t in arm_study.latest().values() if t.state.name == "PRUNED"]
    assert gone
    assert {t.user_attrs["pruned"] for t in gone} == {"diverged: train/td_loss is inf at step 200"}
    assert all(t.params["lr"] > 1e-3 for t in gone)
    assert [arm_study.closed for arm_study in world.arm_studies()] == [5, 5]  # the search went on, and is whole
    assert all(best.params["lr"] <= 1e-3 for arm_study in world.arm_studies() if (best := arm_study.best()))
    logs = [run for run in world.shelf if run.status == "failed"]
    assert len(logs) == len(gone)
    assert {(run.tags["state"], run.tags["error"]) for run in logs} == {
        ("pruned", "diverged: train/td_loss is inf at step 200")
    }
    assert world.launch(diverging).trained == 0


def test_a_trial_that_raises_is_tried_in_the_next_launches_and_then_left(tmp_path: Path) -> None:
    def raising(one: Setting, seed: int) -> list[float]:
        if one.algo.lr < 1e-3:
            raise ValueError("no such rate")
        return curve(one, seed)

    world = World(load(), tmp_path)
    world.launch(raising)
    failed = sum(arm_study.counts()["failed"] for arm_study in world.arm_studies())
    assert 0 < failed < 10
    assert sum(arm_study.closed for arm_study in world.arm_studies()) == 10 - failed
    run = next(run for run in world.shelf if run.status == "failed")
    assert (run.tags["error"], run.tags["state"]) == ("ValueError: no such rate", "failed")
    assert [world.launch(raising).trained for _ in range(3)] == [failed, failed, 0], "three launches try it"
    assert {arm_study.left for arm_study in world.arm_studies()} == {0}


def test_what_failed_once_may_end_well(tmp_path: Path) -> None:
    def raising(one: Setting, seed: int) -> list[float]:
        raise ValueError("the disk is full")

    world = World(load(), tmp_path)
    world.launch(raising)
    world.launch()
    assert [arm_study.counts()["complete"] for arm_study in world.arm_studies()] == [5, 5]
    assert {run.status for run in world.shelf} == {"finished"}


# Interruptions


class Fuse(InMemoryStorage):
    """Dies at the n-th write, before it is done."""

    def __init__(self) -> None:
        super().__init__()
        self.left = math.inf

    def burn(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise Killed


def _fused(name: str) -> Callable[..., Any]:
    def write(self: Fuse, *args: Any, **kwargs: Any) -> Any:
        self.burn()
        return getattr(InMemoryStorage, name)(self, *args, **kwargs)

    return write


for _name in [
    *("create_new_trial", "set_trial_param", "set_trial_state_values", "set_trial_intermediate_value"),
    *("set_trial_user_attr", "set_trial_system_attr"),
]:
    setattr(Fuse, _name, _fused(_name))


@pytest.mark.parametrize("pruner", [MEDIAN, ASHA])
def test_a_kill_at_any_write_changes_nothing(tmp_path: Path, pruner: str) -> None:
    one_arm = GOOD[: GOOD.index("  VDN")] + GOOD[GOOD.index("trials:") :]
    search = load(one_arm + pruner, "quick", "trials=3")
    whole = World(search, tmp_path)
    whole.launch()
    expected = whole.outcome()
    kills = 0
    for write in itertools.count():
        storage = Fuse()
        world = World(search, tmp_path, storage)
        world.arm_studies()
        died = False
        for left in (write, 3 * write % 17, math.inf):  # the second time perhaps while it takes up the first
            storage.left = left
            try:
                world.launch()
            except Killed:
                died = True
        if not died:
            break
        kills += 1
        assert world.outcome() == expected, write
        assert world.winners() == whole.winners()
        assert {arm_study.counts()["running"] + arm_study.counts()["waiting"] for arm_study in world.arm_studies()} == {
            0
        }
    assert kills > 25


def test_what_a_launch_left_open_is_counted_once(tmp_path: Path) -> None:
    world = World(load(), tmp_path)
    left = world.arm_studies()[0]
    asked = [left.ask() for _ in range(3)]
    assert asked[0] is not None
    left.complete(asked[0], [1.0, 2.0])
    assert world.arm_studies()[0].take_up() == 2
    assert [arm_study.take_up() for arm_study in world.arm_studies()] == [0, 0]


def test_a_stopped_search_saves_itself_and_continues(tmp_path: Path) -> None:
    class Stopping(Twin):
        def next(self, timeout: float) -> dict[str, Any]:
            if self.trained == 9:
                (tmp_path / "stop").touch()
            return super().next(timeout)

    world = World(load(), tmp_path)
    world.launch(twin=Stopping(world.disk, size=2))
    assert sorted(run.status for run in world.shelf) == ["finished"] * 2 + ["interrupted"] * 2
    (tmp_path / "stop").unlink()
    trained = world.launch(size=2).trained
    assert trained == 40 - 11  # no point is trained twice
    assert [arm_study.counts()["complete"] for arm_study in world.arm_studies()] == [5, 5]
    assert {run.status for run in world.shelf} == {"finished"}
    assert all([p["step"] for p in points_of(run.values)] == [0, 200, 400, 600] for run in world.shelf)


# The winner


def test_the_winner_says_where_it_comes_from_and_a_study_includes_it(tmp_path: Path) -> None:
    search = load()
    world = World(search, tmp_path)
    world.launch()
    tracker = MemoryTracker(search_card(search), world.shelf)
    written = results(search, world.arm_studies(), tracker, Home(tmp_path), Path("studies/best_params"))
    assert [str(file) for file in written.winners] == [
        "studies/best_params/search_x.iql.quick.yaml",
        "studies/best_params/search_x.vdn.quick.yaml",
    ]
    assert set(tracker.files) == {file.name for file in (*written.winners, *written.plots)}
    assert {"iql.history.png", "vdn.importance.png"} <= set(tracker.files)
    document = YAML(typ="safe").load(written.winners[0])
    said, best = document["provenance"], world.arm_studies()[0].best()
    assert best is not None
    assert said["search"] == "search_x.yaml"
    assert said["sha256"] == search.sha256
    assert said["trials"] == {"budget": 5, "complete": 5, "pruned": 0, "failed": 0}
    assert (said["steps"], said["fingerprint"], said["profile"]) == (600, CODE, "quick")
    assert said["best"]["value"] == best.value == pytest.approx(sum(said["best"]["seeds"].values()) / 2)
    assert said["best"]["params"] == best.params
    assert list(said["best"]["seeds"]) == search.seed_list()
    assert str(tmp_path) not in written.winners[0].read_text()
    Path("studies/use.yaml").write_text(
        "question: Which?\nbase: {env: {kind: coverage}, algo: {include: best_params/search_x.iql.quick.yaml}}\n"
        "arms:\n  found: {}\n  more: {algo: {hidden_dim: 32}}\n"
        "  VDN: {algo: {include: best_params/search_x.vdn.quick.yaml, gamma: 0.5}}\nseeds: 1\nsteps: 100\n"
    )
    arms = Study.load("studies/use.yaml").arms
    assert arms["found"].algo == search.arms["IQL"].at(best.params).algo
    assert (arms["more"].algo.lr, arms["more"].algo.hidden_dim) == (best.params["lr"], 32)
    assert (arms["VDN"].algo.kind, arms["VDN"].algo.gamma) == ("vdn", 0.5)


def test_names_of_arms_become_names_of_files() -> None:
    search = load()
    assert file_name(search, "HiT-MAC") == "search_x.hit-mac.quick.yaml"
    assert file_name(search, "RHMC, no filter") == "search_x.rhmc-no-filter-6c95856d.quick.yaml"
    assert file_name(search, "…") == "search_x.name-b4935894.quick.yaml"


def test_no_plot_without_trials_for_it(tmp_path: Path) -> None:
    search = load(GOOD, "quick", "trials=1")
    world = World(search, tmp_path)
    (iql, _) = world.arm_studies()
    assert plots(iql.study, "x", tmp_path / "iql") == []
    world.launch()
    assert [file.name for file in plots(iql.study, "x", tmp_path / "iql")] == ["iql.history.png"]


# The database


def test_a_dimension_is_offered_whole_or_not(tmp_path: Path) -> None:
    world = World(load(), tmp_path)
    world.launch()
    (_, vdn) = world.arm_studies()
    for trial in vdn.latest().values():
        assert isinstance(trial.params["batch_size"], int)
        assert 16 <= trial.params["batch_size"] <= 32
        assert 1e-4 <= trial.params["lr"] <= 1e-2
        assert trial.params["double_q"] in (True, False)
    assert str(Dimension(low=16, high=32, step=4)) == "16 to 32, step 4"


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("optuna.db", "OPTUNA_STORAGE=optuna.db: not the address of a database"),
        ("nosql://user:secret@host/db", "nosql://user:***@host/db: Optuna cannot "),
        ("sqlite:////nowhere/optuna.db", "/nowhere: no such folder (for Optuna's database)"),
    ],
)
def test_a_database_that_cannot_be_used_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, url: str, said: str
) -> None:
    monkeypatch.setenv("OPTUNA_STORAGE", url)
    with pytest.raises(StoreError) as caught:
        open_storage(Home(tmp_path))
    assert str(caught.value).startswith(said)
    assert "\n" not in str(caught.value)
    assert "secret" not in str(caught.value)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # Optuna leaves the file open
def test_a_file_that_is_no_database_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "optuna.db").write_text("no database at all, but a text of some length" * 20)
    with pytest.raises(StoreError, match=r"optuna.db: Optuna cannot .*not a database"):
        open_storage(Home(tmp_path))
    gc.collect()  # else a later test has the warning of Python 3.13


def test_status_before_anything_ran_makes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert show_search(load(), tmp_path / "work") == 3
    assert capsys.readouterr().out == "search_x (quick): nothing has been tried yet\n"
    assert not (tmp_path / "work").exists()


def test_status_is_done_where_every_trial_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    world = World(load(), tmp_path)
    world.launch()
    monkeypatch.setattr("pipelines.tuning.search_run.opened", lambda place, write: nullcontext(world.storage))
    best = world.arm_studies()[0].best()
    assert best is not None
    for trials, code, missing in ((5, 0, 0), (6, 3, 1), (3, 0, 0)):
        assert show_search(load(GOOD, "quick", f"trials={trials}"), tmp_path) == code
        out = capsys.readouterr().out
        (row,) = (line.split() for line in out.splitlines() if line.split()[:2] == ["IQL", str(trials)])
        assert row[2:] == ["5", "0", "0", "0", "0", str(missing), f"{best.value:.2f}", "0"]
        assert f"IQL: final/return {best.value:.2f} over 2 seeds in trial {best.trial_index}: lr=" in out


def test_trials_of_other_code_are_stale(tmp_path: Path) -> None:
    world = World(load(), tmp_path)
    world.launch()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipelines.specs.search.code_id", lambda *place: "0ther")
        arm_study, stale = look(world.search, "IQL", world.storage)
    assert (arm_study.closed, stale) == (0, 5)
    arm_study, stale = look(world.search, "IQL", world.storage)
    assert (arm_study.closed, stale) == (5, 0)


# The command

Rhmc = Callable[..., Said]


@pytest.fixture
def rhmc(project: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Rhmc:
    """Calls `rhmc search` in a project that holds the search."""
    load()
    monkeypatch.setenv("RHMC_HOME", str(project / "work"))

    def call(*words: str) -> Said:
        return Said(run_rhmc("search", *words), *capfd.readouterr())

    return call


def test_check_prints_spaces_and_budget(rhmc: Rhmc, project: Path) -> None:
    code, out, err = rhmc("check", "studies/search_x.yaml", "--set", "trials=7")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[:4] == ["search_x (quick): Which?", "IQL: iql", "  lr: 0.0001 to 0.01, log", "  gamma: 0.5 to 0.9"]
    assert lines[6:] == [
        "  batch_size: 16 to 32",
        "  double_q: {true, false}",
        "each arm: 7 trials x 2 seeds x 600 environment steps, 8,400 in all; "
        "sampler tpe, pruner none, 2 trials at a time",
    ]


@pytest.mark.parametrize("verb", ["check", "run", "status"])
def test_a_faulty_search_is_refused_by_every_verb(rhmc: Rhmc, project: Path, verb: str) -> None:
    gamma = "arms.IQL.space.gamma"
    code, out, err = rhmc(verb, "studies/search_x.yaml", "--set", "trials=0")
    assert (code, out) == (2, "")
    assert err == "--set trials=0: trials: 0 is not allowed; must be greater than or equal to 1\n"
    code, out, err = rhmc(verb, "studies/search_x.yaml", "--set", f"{gamma}.high=3")
    assert (code, out) == (2, "")
    assert err == f"--set {gamma}.high=3: {gamma}.high: 3 is not allowed; must be less than or equal to 1\n"
    assert not (project / "work").exists()


def test_a_file_is_no_folder_for_winners(rhmc: Rhmc, project: Path) -> None:
    said = rhmc("run", "studies/search_x.yaml", "--out", "studies/search_x.yaml")
    assert said == (2, "", "--out: studies/search_x.yaml is not a folder\n")
    assert not (project / "work").exists()


# The whole chain


@pytest.mark.ray
def test_a_killed_and_interrupted_search_ends_as_one_that_was_not(
    home: Path, cluster: None, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    resources = "resources: {concurrent: 1, checkpoint_every: 1}\n"
    long = changed("{kind: navigation, agents: 2, episode: 7}", "{kind: coverage, agents: 2, targets: 2}")
    text = long.replace("evaluations: 3", "evaluations: 4") + MEDIAN + resources
    search = load(text, "quick", "trials=2", "steps=800")
    shutil.copy(home / "mlflow.db", project / "template.db")
    with pytest.MonkeyPatch.context() as alone:  # without Ray: a worker takes seconds to start, and changes nothing
        alone.setattr(ray_driver, "ray_session", lambda *args: nullcontext([]))
        alone.setattr(ray_workers, "Pool", PoolHere)
        assert run_search(search, fresh(project, "whole"), project / "whole" / "out") == 0
    capsys.readouterr()

    work = fresh(project, "work")
    process = subprocess.Popen(command("run"), cwd=project, env=environment(work), start_new_session=True)
    wait_for(work, lambda: bool(list(work.glob("checkpoints/*/0*.pt"))), process)
    process.kill()
    process.wait()
    assert all_end(process.pid, "ray::Worker")  # else one saves a point, which `interrupt` takes for the next launch's
    assert show_search(search, work) == 3
    threading.Thread(target=interrupt, args=(work,)).start()
    assert run_search(search, work, work / "out") == 130
    said = capsys.readouterr().out
    assert "the next launch continues it" in said
    assert not (work / "out").exists()
    assert run_search(search, work, work / "out") == 0
    said += capsys.readouterr().out
    assert "search_x / VDN t0: objective " in said
    assert f"winner: {work / 'out' / 'search_x.iql.quick.yaml'}" in said
    assert show_search(search, work) == 0
    for name in ("search_x.iql.quick.yaml", "search_x.vdn.quick.yaml"):
        assert (work / "out" / name).read_bytes() == (project / "whole" / "out" / name).read_bytes()

    tracker = open_existing(search_card(search), Home(work))
    assert tracker is not None
    recorded = tracker.recorded()
    assert [run.status for run in recorded] == ["finished"] * 4
    for run in recorded:
        steps = [value.step for value in tracker.client.get_metric_history(run.ref, "eval/return")]
        assert steps == sorted(set(steps))
    (parent,) = tracker._search("tags.role = 'study'")
    kept = {file.path for file in tracker.client.list_artifacts(parent.info.run_id)}
    assert {"search_x.iql.quick.yaml", "search_x.vdn.quick.yaml", "iql.history.png", "vdn.history.png"} <= kept
    assert not list(work.glob("checkpoints/*/*.pt"))

    before = (work / "out" / "search_x.iql.quick.yaml").stat()
    assert run_search(search, work, work / "out") == 0  # nothing to do, and Ray is not asked
    assert "2 of 2 trials are done" in capsys.readouterr().out
    assert (work / "out" / "search_x.iql.quick.yaml").stat() == before


def fresh(project: Path, name: str) -> Path:
    (project / name).mkdir()
    shutil.copy(project / "template.db", project / name / "mlflow.db")
    return project / name


def command(verb: str) -> list[str]:
    words = ["search", verb, "studies/search_x.yaml", "--set", "trials=2", "--set", "steps=800"]
    return [sys.executable, "-W", "ignore", "-m", "pipelines.cli.main", *words]


def environment(work: Path) -> dict[str, str]:
    return os.environ | {"RHMC_HOME": str(work), "PYTHONPATH": str(ROOT)}


def wait_for(work: Path, ready: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
    for _ in range(12_000):  # ten minutes, for a busy machine
        if ready():
            return
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    raise AssertionError("the search did not get that far")
