"""Findings of a check before a launch: numbers that are absurd, devices, what cannot go together, budgets too small."""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel, ValidationError
from ruamel.yaml import YAML
from typer.testing import CliRunner

from pipelines.cli.main import app
from pipelines.conformance.blocks import fitted, nested
from pipelines.execution.run import run_studies
from pipelines.specs import limits
from pipelines.specs.document import Node, Place, validate
from pipelines.specs.learning_start import shortfall, starts
from pipelines.specs.plugins import configs
from pipelines.specs.search import Dimension, Pruner, Sampler, Search
from pipelines.specs.study import PROFILES, Counts, Resources, RunSpec, SeedCounts, Setting, Study, StudyError
from pipelines.workspace.errors import InputError
from rhmc.algorithms import ALGORITHMS
from rhmc.learning.learner import Learner
from rhmc.training import trainer
from rhmc.training.trainer import Trainer
from tests.depth import covering
from tests.pipelines.support import setting, tiny

ROOT = Path(__file__).parents[3]
MODELS: list[type[BaseModel]] = [
    *configs("env").values(),
    *configs("algo").values(),
    *(trainer.Config, Resources, Counts, SeedCounts, Sampler, Pruner, Dimension),
]
HERE = Place("x.yaml", 1, 1)


def node(value: Any, path: str = "") -> Node:
    if isinstance(value, dict):
        value = {key: node(child, f"{path}.{key}" if path else key) for key, child in value.items()}
    if isinstance(value, list):
        value = [node(child, f"{path}.{i}") for i, child in enumerate(value)]
    return Node(value, HERE, HERE, path)


def numeric(model: type[BaseModel]) -> Iterator[str]:
    """The fields of a model that take a number."""
    for name, field in model.model_fields.items():
        if {int, float} & ({field.annotation} | set(get_args(field.annotation))):
            yield name


FIELDS = [
    pytest.param(model, name, id=f"{model.__module__}.{model.__name__}.{name}")
    for model in MODELS
    for name in numeric(model)
]


@pytest.mark.parametrize(("model", "name"), FIELDS)
@pytest.mark.parametrize("value", [10**30, 1e30, 2**63])
def test_every_number_has_an_upper_bound(model: type[BaseModel], name: str, value: float) -> None:
    found, faults = validate(model, node({name: value}))
    assert found is None
    text = next(str(fault) for fault in faults if fault.path == name)
    assert text.startswith(f"x.yaml:1:1: {name}: ")
    assert "\n" not in text
    assert "must be" in text or (name == "agents" and "sensors need as many boxes" in text)


def test_numbers_in_lists_have_one_too() -> None:
    boxes = [[0, 1, 0, 10**10]]
    found, (fault,) = validate(configs("env")["coverage"], node({"agents": 1, "boxes": boxes}))
    assert (found, fault.path, fault.text) == (
        None,
        "boxes.0.3",
        "10000000000 is not allowed; must be at most 1,000,000,000",
    )


STUDY: dict[str, Any] = {
    "question": "What is allowed?",
    "base": {
        "env": {"kind": "coverage", "agents": 2, "targets": 13},
        "algo": {"kind": "rhmc", "learning_starts": 0},
        "trainer": {"num_envs": 16},
    },
    "arms": {"full": {}},
    "seeds": 1,
    "steps": 3200,
}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    with (tmp_path / "x.yaml").open("w") as out:
        YAML().dump(STUDY, out)
    return tmp_path / "x.yaml"


@pytest.mark.parametrize(
    ("change", "path", "allowed"),
    [
        ("algo.regulator=exact", "base.env.targets", "the exact regulator takes at most 12 targets: use 'paper'"),
        ("trainer.device=gpu", "base.trainer.device", "allowed: cpu, cuda, cuda:N with N from 0 to 99"),
        ("trainer.device=cuda:-1", "base.trainer.device", "allowed: cpu, cuda, cuda:N with N from 0 to 99"),
        ("trainer.eval_seed=9223372036854775808", "base.trainer.eval_seed", "must be at most 1,000,000,000,000"),
        ("trainer.eval_seed=-1", "base.trainer.eval_seed", "must be greater than or equal to 0"),
        ("trainer.num_envs=1e9", "base.trainer.num_envs", "must be at most 100,000"),
        ("env.targets=1000", "base.env.targets", "must be at most 100"),
        ("algo.lr=1e12", "base.algo.lr", "must be at most 1,000,000,000"),
        ("resources.concurrent=1e6", "resources.concurrent", "must be at most 1,024"),
        ("seeds=1001", "seeds", "must be less than or equal to 1000"),
        ("steps=1e13", "steps", "must be less than or equal to 1000000000000"),
    ],
)
def test_what_can_be_known_before_a_launch_is_found_by_the_check(
    file: Path, change: str, path: str, allowed: str
) -> None:
    with pytest.raises(StudyError) as caught:
        Study.load(file, overrides=[change])
    lines = str(caught.value).splitlines()
    assert len(lines) == 1
    assert f" {path}: " in lines[0]
    assert lines[0].endswith(allowed)
    Study.load(file)


def test_navigation_has_as_many_targets_as_agents(file: Path) -> None:
    changes = ["env={kind: navigation, agents: 13}", "algo.regulator=exact"]
    with pytest.raises(StudyError, match=r"base\.env\.agents: 13 is not allowed; the exact regulator takes at most 12"):
        Study.load(file, overrides=changes)


def test_spaces_and_trials_of_a_search_have_bounds_too() -> None:
    file = ROOT / "studies" / "search_rhmc.yaml"
    assert Search.load(file).remarks == ()
    for change, text in (
        ("trials=1e9", r"trials: 1000000000 is not allowed; must be at most 100,000$"),
        ("arms.RHMC.space.lr={low: 1e-4, high: 1e12}", r"space\.lr\.high: 1000000000000 is not allowed; must be at"),
        (
            "arms.RHMC.space.hidden_dim={choices: [64, 1e6]}",
            r"space\.hidden_dim\.choices\.1: 1000000 is not allowed; must be",
        ),
        ("sampler.seed=1e15", r"sampler\.seed: 1000000000000000 is not allowed; must be at most 1,000,000,000,000$"),
    ):
        with pytest.raises(StudyError, match=text):
            Search.load(file, overrides=[change])


def test_a_device_that_is_not_here_is_found_before_anything_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.device_count", lambda: 0)
    one = setting()
    arms = {"far": one.model_copy(update={"trainer": one.trainer.model_copy(update={"device": "cuda:1"})})}
    said = r"^trainer\.device \(tiny / far\): 'cuda:1' is not there; this machine has: cpu$"
    with pytest.raises(InputError, match=said):
        run_studies([tiny(arms=arms)], tmp_path / "work")
    assert not (tmp_path / "work").exists()
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    assert limits.absent(["cpu", "cuda", "cuda:1"]) == []
    assert limits.absent(["cuda:2"]) == ["'cuda:2' is not there; this machine has: cpu, cuda, cuda:0, cuda:1"]


@pytest.mark.parametrize(
    "words",
    [
        ["evaluate", "x.yaml", "--episodes", "1000000000"],
        ["evaluate", "x.yaml", "--eval-seed", "9223372036854775808"],
        ["transfer", "x.yaml", "--out", "o", "--agents", "2", "--jobs", "100000"],
        ["transfer", "x.yaml", "--out", "o", "--targets", "1000"],
        ["yardsticks", "coverage", "--seed", "9223372036854775808"],
        ["yardsticks", "coverage", "--episodes", "1000000000"],
        ["yardsticks", "coverage", "--targets", "1000"],
        ["theorem", "--instances", "1000000000"],
        ["theorem", "--seed", "9223372036854775808"],
        ["render", "x.yaml", "--out", "x.gif", "--episode", "9223372036854775808"],
        ["ui", "--port", "65536"],
    ],
    ids=" ".join,
)
def test_numbers_in_options_have_bounds(words: list[str]) -> None:
    done = CliRunner().invoke(app, words)
    if done.exit_code == 1:  # `main` prints it and ends with 2
        assert isinstance(done.exception, InputError)
        assert "\n" not in str(done.exception)
    else:
        assert done.exit_code == 2
        assert "Traceback" not in done.output


# Budgets


FEW: dict[str, Any] = {
    "hidden_dim": 2,
    "batch_size": 4,
    "buffer_size": 100,
    "learning_starts": 25,
    "train_freq": 7,
    "n_steps": 4,
    "epochs": 1,
    "minibatches": 1,
    "pretrain": 50,
}
VARIANTS: list[dict[str, Any]] = [
    {},
    {"learning_starts": 0, "n_steps": 1, "pretrain": 9, "train_freq": 1},
    {"assignment_period": 3, "coordinator.update_every": 4},
    {"assignment_period": 100, "learning_starts": 0, "pretrain": 32},
    {"assignment_period": 10, "n_steps": 9, "pretrain": 40},
    {"pretrain": 20, "executor.method": "expected"},
    {"pretrain": 0, "coordinator.reward": "team", "regulator": "none"},
]
TASKS: dict[str, dict[str, Any]] = {
    "coverage": {"kind": "coverage", "agents": 2, "targets": 2},
    "navigation": {"kind": "navigation", "agents": 2, "episode": 7},
}


def told_apart() -> list[tuple[str, dict[str, Any]]]:
    """The methods with the variants that they know a setting of, those of others left out of them."""
    found: list[tuple[str, dict[str, Any]]] = []
    for kind, variant in product(ALGORITHMS, VARIANTS):
        case = (kind, fitted(ALGORITHMS[kind].config, variant))
        if case not in found:
            found.append(case)
    return found


def few(kind: str, task: str, variant: dict[str, Any], steps: int = 1) -> Setting:
    algo = {"kind": kind} | nested(fitted(ALGORITHMS[kind].config, FEW | variant))
    fixed = {"num_envs": 3, "steps": steps}
    return Setting.model_validate({"env": TASKS[task], "algo": algo, "trainer": fixed})


@pytest.mark.parametrize(("task", "kind", "variant"), [(task, *case) for task, case in covering(TASKS, told_apart())])
def test_the_first_updates_come_when_they_are_said_to(
    task: str, kind: str, variant: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trained for real: every network gets its first update at one of the steps, and the last of them at the last."""
    one = few(kind, task, variant)
    said = starts(one)
    first: dict[int, int] = {}
    update = Learner.update
    run = Trainer(one.env, one.algo, one.trainer, 0)

    def watched(learner: Learner[Any], loss: Any) -> Any:
        first.setdefault(id(learner), run.step + one.trainer.num_envs)
        return update(learner, loss)

    monkeypatch.setattr(Learner, "update", watched)
    last = max(start.step or 0 for start in said)
    while run.step < last + 60 and len(first) < len(run.algorithm.learners()):
        run._act()
        run.algorithm.update()
        run.step += one.trainer.num_envs
    assert set(first.values()) == {start.step for start in said if start.step is not None}
    never = any(start.step is None for start in said)
    assert never == (len(first) < len(run.algorithm.learners()))
    if not never:
        assert not shortfall(few(kind, task, variant, last))
        assert not shortfall(few(kind, task, variant, last - 2))  # which is trained to the same step
    before = shortfall(few(kind, task, variant, last - 3)) if last > 3 else "no"
    assert before
    assert never or last <= 3 or f"must be at least {last:,} (" in before


@pytest.mark.parametrize(
    ("profile", "study"), covering(PROFILES, sorted(p.stem for p in (ROOT / "studies").glob("*.yaml")), shift=1)
)
def test_every_arm_of_the_studies_at_hand_learns(profile: str, study: str) -> None:
    """HiT-MAC's coordinator excepted, in the quick profile of three of them: changed settings would be other runs."""
    path = ROOT / f"studies/{study}.yaml"
    kind = Search if path.stem.startswith("search_") else Study
    variants = [None] if kind is Search else [None, *(YAML(typ="safe").load(path).get("variants") or {})]
    for variant in variants:
        loaded = kind.load(path, profile) if variant is None else Study.load(path, profile, variant=variant)
        late = "50,000 steps end before 'hitmac' learns"
        known = profile == "quick" and path.stem in ("coordinator", "coverage", "coverage_paper_faithful")
        assert [remark for remark in loaded.remarks if not (known and late in remark)] == []


def test_the_check_names_the_arms_and_the_least_budget(file: Path) -> None:
    arms = "arms={b: {algo: {kind: mappo, encoder: mlp, n_steps: 201}}, c: {algo: {learning_starts: 4000}}}"
    done = CliRunner().invoke(app, ["study", "check", str(file), "--set", arms])
    assert done.exit_code == 0
    notes = [line for line in done.stdout.splitlines() if line.startswith("note: ")]
    assert notes == [
        f"note: {file}:15:8: steps: 3,200 steps end before 'mappo' learns; must be at least 3,216 (n_steps 201 x "
        "num_envs 16) (in arm 'b')",
        f"note: {file}:15:8: steps: 3,200 steps end before 'rhmc' learns; must be at least 4,064 (learning_starts "
        "4,000 + train_freq 64) (in arm 'c')",
    ]


def test_the_words_say_how_many_updates_a_coordinator_waits_for() -> None:
    def said(every: int) -> list[str]:
        return [one.waits for one in starts(few("rhmc", "coverage", {"coordinator.update_every": every}))]

    assert said(1) == ["learning_starts 25 + train_freq 7"]
    assert said(2) == ["learning_starts 25 + train_freq 7", "learning_starts 25 + train_freq 7 x 2"]


# Defaults and bounds of what is no method's


def test_a_study_and_a_search_that_say_nothing() -> None:
    assert Resources().model_dump() == {"concurrent": 2, "cpus": 1, "checkpoint_every": 20, "animate": "first"}
    assert Sampler().model_dump() == {"kind": "tpe", "seed": 0, "startup": 10}
    assert Pruner().model_dump() == {"kind": "none", "startup": 5, "warmup": 1, "reduction": 3}


@pytest.mark.parametrize(
    ("model", "name", "least", "most"),
    [
        *((Resources, name, 1, None) for name in ("concurrent", "cpus", "checkpoint_every")),
        *((Sampler, "seed", 0, None), (Sampler, "startup", 1, None)),
        *((Pruner, "startup", 1, None), (Pruner, "warmup", 1, None), (Pruner, "reduction", 2, None)),
        *((Counts, profile, 1, 10**12) for profile in PROFILES),
        *((SeedCounts, profile, 1, 1000) for profile in PROFILES),
        (RunSpec, "seed", 0, 999_999),
    ],
)
def test_numbers_on_either_side_of_their_bounds(
    model: type[BaseModel], name: str, least: int, most: int | None
) -> None:
    rest = dict(setting()) if model is RunSpec else {}
    for allowed in (least, *([most] if most else [])):
        assert getattr(model.model_validate(rest | {name: allowed}), name) == allowed
    for refused in (least - 1, *([most + 1] if most else [])):
        with pytest.raises(ValidationError, match=name):
            model.model_validate(rest | {name: refused})


@pytest.mark.parametrize(
    ("names", "most"),
    [
        ("agents targets", 100),
        ("horizon seeds", 1000),
        ("hidden_dim mixing_embed_dim", 8192),
        ("threads concurrent cpus", 1024),
        ("epochs minibatches actor_minibatches", 10_000),
        ("episode assignment_period n_steps num_envs evaluations trials startup", 100_000),
        ("batch_size checkpoint_every eval_episodes final_episodes", 1_000_000),
        ("buffer_size", 100_000_000),
        ("lr alpha unknown", 10**9),
        ("steps epsilon_steps pretrain learning_starts eval_seed seed", 10**12),
    ],
)
def test_the_largest_number_of_each_name(names: str, most: int) -> None:
    for name in names.split():
        assert (limits.beyond(name, most), limits.beyond(name, -most)) == ("", ""), name
        assert limits.beyond(name, most + 1) == f"must be at most {most:,}", name
        assert limits.beyond(name, -most - 1) == f"must be at least {-most:,}", name
