"""Studies: what they resolve to, and what is said about faulty ones."""

import json
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.specs.document import Node, Place, merge, plain, show
from pipelines.specs.study import PROFILES, RunSpec, Study, StudyError, changes
from rhmc.algorithms import ALGORITHMS
from tests.support import changing

GOOD = """\
question: Which?
base:
  env: {kind: coverage, agents: 4}
  algo: {kind: rhmc, encoder: pairwise}
arms:
  full: {}
  none:
    algo: {regulator: none}
  IQL: {algo: {kind: iql, encoder: pairwise}}
seeds: {quick: 2, paper: 3}
steps: 1000
"""
changed = changing(GOOD)
ARMS = GOOD[GOOD.index("arms:") : GOOD.index("seeds:")]
ROOT = Path(__file__).parents[3]


@pytest.fixture(autouse=True)
def _in_a_project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "studies").mkdir()


def load(text: str, profile: str = "quick", *overrides: str) -> Study:
    Path("studies/x.yaml").write_text(text)
    return Study.load("studies/x.yaml", profile, overrides)


def faults(text: str, *overrides: str, profile: str = "quick") -> list[str]:
    with pytest.raises(StudyError) as caught:
        load(text, profile, *overrides)
    return str(caught.value).splitlines()


# What a study resolves to


def test_arms_in_order_times_seeds() -> None:
    runs = load(GOOD).runs()
    assert [(r.study, r.arm, r.spec.seed) for r in runs] == [
        ("x", arm, seed) for arm in ("full", "none", "IQL") for seed in (0, 1)
    ]
    assert len({r.spec.id for r in runs}) == len(runs)


def test_arms_change_the_base_and_nothing_else() -> None:
    study = load(GOOD)
    assert changes(study.base, study.arms["full"]) == {}
    assert changes(study.base, study.arms["none"]) == {"algo.regulator": "none"}
    assert changes(study.base, study.arms["IQL"]) == {"algo.kind": "iql"}
    assert study.arms["none"].algo.encoder == "pairwise"
    assert study.arms["IQL"].algo.lr == pytest.approx(5e-4)


def test_a_profile_changes_single_arms() -> None:
    text = GOOD + "profiles: {quick: {changes: {IQL: {algo: {lr: 0.5}, env: {agents: 3}}}}}"
    quick, paper = load(text), load(text, "paper")
    assert paper.arms == load(GOOD, "paper").arms
    assert {name for name in quick.arms if quick.arms[name] != load(GOOD).arms[name]} == {"IQL"}
    assert (quick.arms["IQL"].algo.lr, quick.arms["IQL"].env.agents) == (0.5, 3)
    assert quick.arms["IQL"].algo.batch_size == paper.arms["IQL"].algo.batch_size
    over = load(text, "quick", "arms.IQL.algo.lr=0.25")
    assert (over.arms["IQL"].algo.lr, over.arms["IQL"].env.agents) == (0.25, 3)
    assert load(text, "quick", "profiles.quick.changes.IQL.algo.lr=0.125").arms["IQL"].algo.lr == 0.125
    dotted = load(text.replace("IQL", "a.b"), "quick", "profiles.quick.changes.a.b.algo.lr=0.125")
    assert dotted.arms["a.b"].algo.lr == 0.125
    assert load(text, "quick", "base.env.agents=2").arms["IQL"].env.agents == 3


def test_changes_of_a_study_that_has_only_a_grid_are_refused() -> None:
    text = GRID.replace(GRID[GRID.index("arms:") : GRID.index("grid:")], "")
    said = faults(text + "profiles: {quick: {changes: {IQL: {algo: {lr: 0.5}}}}}\n")
    assert [line.partition("changes.IQL: ")[2] for line in said] == ["'IQL' is no arm; this study has none, but a grid"]


def test_profiles_choose_seeds_steps_and_the_trainer() -> None:
    text = GOOD.replace(
        "steps: 1000", "steps: {quick: 1_000, paper: 5e6}\nprofiles: {quick: {trainer: {evaluations: 7}}}"
    )
    quick, paper = load(text), load(text, "paper")
    assert (quick.seeds, quick.steps, paper.seeds, paper.steps) == (2, 1000, 3, 5_000_000)
    assert quick.arms["none"].trainer.evaluations == 7
    assert paper.arms["none"].trainer.evaluations == 100
    assert [a.trainer.steps for a in paper.arms.values()] == [5_000_000] * 3


def test_an_arm_goes_before_the_profile_and_the_profile_before_the_base() -> None:
    text = changed("full: {}", "full: {trainer: {evaluations: 3}}").replace(
        "arms:", "  trainer: {evaluations: 2, num_envs: 8}\narms:"
    )
    study = load(text + "profiles: {quick: {trainer: {evaluations: 7}}}")
    assert [a.trainer.evaluations for a in study.arms.values()] == [3, 7, 7]
    assert {a.trainer.num_envs for a in study.arms.values()} == {8}


def test_words_that_other_yaml_takes_for_truth_stay_words() -> None:
    study = load(changed("regulator: none", "filter: off"))
    assert study.arms["none"].algo.filter == "off"


def test_numbers_as_people_write_them() -> None:
    text = changed("agents: 4", "agents: 4.0, penalty: 0").replace("steps: 1000", "steps: 1e3")
    study = load(text.replace("regulator: none", "lr: 1e-3"))
    assert (study.base.env.agents, study.base.env.penalty, study.steps) == (4, 0.0, 1000)
    assert study.arms["none"].algo.lr == pytest.approx(1e-3)


def test_a_byte_order_mark_and_an_arm_with_nothing_in_it() -> None:
    Path("studies/x.yaml").write_bytes(b"\xef\xbb\xbf" + changed("full: {}", "full:").encode())
    assert changes(Study.load("studies/x.yaml").base, Study.load("studies/x.yaml").arms["full"]) == {}


STUDIES = [p for p in sorted((ROOT / "studies").glob("*.yaml")) if not p.stem.startswith("search_")]


@pytest.mark.parametrize("path", STUDIES, ids=lambda p: p.stem)
@pytest.mark.parametrize("profile", PROFILES)
def test_the_studies_at_hand(path: Path, profile: str) -> None:
    study = Study.load(path, profile)
    assert study.question.endswith("?")
    assert study.runs()


@pytest.mark.parametrize("name", ["ablation", "coverage", "navigation", "scaling"])
def test_methods_are_compared_on_one_task_and_one_encoder(name: str) -> None:
    study = Study.load(ROOT / "studies" / f"{name}.yaml", "paper")
    assert {setting.algo.encoder for setting in study.arms.values()} == {"pairwise"}
    tasks = {setting.env.model_copy(update={"agents": 1}) for setting in study.arms.values()}
    assert len(tasks) == 1
    assert {task.observation for task in tasks} == {"extended"}


@pytest.mark.parametrize("name", ["ablation", "coverage", "navigation", "scaling"])
def test_paper_faithful_every_method_has_the_papers_encoder_and_observation(name: str) -> None:
    path = ROOT / "studies" / f"{name}.yaml"
    study, strong = (Study.load(path, "paper", variant=variant) for variant in ("paper_faithful", None))
    assert {(a.algo.encoder, a.env.observation) for a in study.arms.values()} == {("mlp", "paper")}
    assert (study.name, strong.name) == (f"{name}@paper_faithful", name)
    for arm, setting in strong.arms.items():
        assert set(changes(setting, study.arms[arm])) == {"algo.encoder", "env.observation"}


@pytest.mark.parametrize(
    ("name", "shared"),
    [
        ("ablation", {"full": "RHMC", "IQL": "IQL"}),
        ("alpha", {"alpha=0.02": "RHMC"}),
        ("assignment_period", {"assignment_period=10": "RHMC"}),
        ("scaling", {f"{arm}, agents=4": arm for arm in ("RHMC", "HiT-MAC", "QMIX", "VDN", "IQL", "COMA", "MAPPO")}),
        ("scaling", {f"{arm}, agents=4": arm for arm in ("IPPO", "MADDPG")}),
        (
            "encoder",
            {f"{arm}, encoder=pairwise, observation=extended": arm for arm in ("RHMC", "QMIX", "IQL", "MAPPO")},
        ),
    ],
)
def test_what_the_coverage_study_trains_is_not_trained_again(name: str, shared: dict[str, str]) -> None:
    def ids(study: str) -> dict[str, set[str]]:
        found: dict[str, set[str]] = {}
        for run in Study.load(ROOT / "studies" / f"{study}.yaml", "paper").runs():
            found.setdefault(run.arm, set()).add(run.spec.id)
        return found

    coverage, other = ids("coverage"), ids(name)
    assert {arm: other[arm] for arm in shared} == {arm: coverage[there] for arm, there in shared.items()}


@pytest.mark.parametrize("name", ["navigation", "scaling"])
def test_all_methods_are_there(name: str) -> None:
    study = Study.load(ROOT / "studies" / f"{name}.yaml", "paper")
    by_size: dict[int, list[str]] = {}
    for arm in study.arms.values():
        by_size.setdefault(arm.env.agents, []).append(arm.algo.kind)
    assert sorted(by_size) == {"navigation": [3], "scaling": [2, 3, 4, 5, 6]}[name]
    assert all(sorted(kinds) == sorted(ALGORITHMS) for kinds in by_size.values())


def test_the_template_is_short_without_its_comments() -> None:
    lines = (ROOT / "studies/template.yaml").read_text().splitlines()
    assert len([line for line in lines if line.partition("#")[0].strip()]) < 15


# Overrides


def test_overrides_change_the_base_and_every_arm_that_inherits_it() -> None:
    study = load(GOOD, "quick", "algo.regulator=exact", "base.env.targets=3", "seeds=1", "trainer.steps=5e3")
    assert [getattr(a.algo, "regulator", None) for a in study.arms.values()] == ["exact", "none", None]
    assert {a.env.targets for a in study.arms.values()} == {3}
    assert (study.seeds, study.steps, study.arms["IQL"].trainer.steps) == (1, 5000, 5000)


def test_overrides_of_one_profile_or_one_arm() -> None:
    study = load(GOOD, "quick", "seeds.quick=5", "arms.none.algo.regulator=exact", "arms.extra={algo: {filter: off}}")
    assert study.seeds == 5
    assert study.arms["none"].algo.regulator == "exact"
    assert changes(study.base, study.arms["extra"]) == {"algo.filter": "off"}
    assert load(GOOD, "paper", "seeds.quick=5").seeds == 3


def test_an_override_of_the_base_goes_before_the_profile() -> None:
    text = GOOD + "profiles: {quick: {trainer: {evaluations: 7}}}"
    assert load(text, "quick", "trainer.evaluations=3").base.trainer.evaluations == 3
    assert load(text, "quick", "profiles.quick.trainer.evaluations=4").base.trainer.evaluations == 4


def test_an_override_of_an_arm_whose_name_has_dots() -> None:
    study = load(changed("full:", "v1.5:"), "quick", "arms.v1.5.algo.horizon=2")
    assert changes(study.base, study.arms["v1.5"]) == {"algo.horizon": 2}


def test_an_override_that_changes_the_kind_replaces_what_belonged_to_the_other() -> None:
    text = GOOD.replace(ARMS, "arms: {only: {}}\n").replace("pairwise}", "pairwise, regulator: none}")
    study = load(text, "quick", "algo.kind=iql", "algo.encoder=pairwise")
    assert (study.base.algo.kind, study.base.algo.encoder) == ("iql", "pairwise")


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("algo.horizonn=6", "base.algo.horizonn: unknown key 'horizonn'; ... did you mean 'horizon'?"),
        ("seeds=0", "seeds: 0 is not allowed; must be greater than or equal to 1"),
        ("seed=1", "seed: unknown key 'seed'; ... did you mean 'seeds'?"),
        ("seeds.quik=1", "seeds.quik: unknown key 'quik'; allowed: quick, paper; did you mean 'quick'?"),
        ("trainer.steps=x", "steps: 'x' is not allowed; must be a valid integer"),
        ("env.agents=9", "base.env.agents: 9 sensors need as many boxes, and there are 6"),
        ("arms.none.algo.regulator=exct", "arms.none.algo.regulator: 'exct' is not allowed; ... did you mean 'exact'?"),
        ("arms.none.algo.filter=false", "arms.none.algo.filter: false is not allowed; allowed: on, off"),
        ("algo.lr=[1", "base.algo.lr: not YAML: ..."),
        ("algo.lr=", "base.algo.lr: no value"),
        ("seeds", "must be key=value, as in --set seeds=1 or --set algo.lr=1e-3"),
        ("=3", "must be key=value, as in --set seeds=1 or --set algo.lr=1e-3"),
        ("a..b=3", "must be key=value, as in --set seeds=1 or --set algo.lr=1e-3"),
        ("base=3", "base: 3 is not allowed; must be a mapping"),
    ],
)
def test_faulty_overrides_are_named_as_given(override: str, said: str) -> None:
    (line,) = faults(GOOD, override)
    start, _, end = said.partition("...")
    assert line.startswith(f"--set {override}: {start}")
    assert line.endswith(end)
    assert "..." in said or line == f"--set {override}: {said}"


# Grids

GRID = GOOD.replace("seeds:", "grid:\n  algo.lr: [1e-3, 5e-5]\n  env.agents: [2, 4]\nseeds:")
ONLY_GRID = GRID.replace(ARMS, "")


def test_a_grid_takes_every_arm_to_every_point() -> None:
    arms = load(GRID).arms
    points = ["lr=0.001, agents=2", "lr=0.001, agents=4", "lr=5e-05, agents=2", "lr=5e-05, agents=4"]
    assert list(arms) == [f"{arm}, {point}" for arm in ("full", "none", "IQL") for point in points]
    for name, arm in arms.items():
        lr, agents = name.rpartition(", lr=")[2].split(", agents=")
        assert (arm.algo.lr, arm.env.agents) == (float(lr), int(agents))
        assert arm.algo.encoder == "pairwise"
    assert arms["none, lr=0.001, agents=2"].algo.regulator == "none"


def test_without_arms_the_base_goes_to_every_point() -> None:
    study = load(ONLY_GRID)
    assert list(study.arms)[:2] == ["lr=0.001, agents=2", "lr=0.001, agents=4"]
    assert changes(study.base, study.arms["lr=5e-05, agents=2"]) == {"env.agents": 2, "algo.lr": 5e-5}


def test_keys_that_end_alike_are_named_in_full_and_lists_by_their_place() -> None:
    boxes = "[[0, 1, 0, 1], [2, 3, 2, 3]]"
    text = ONLY_GRID.replace("algo.lr: [1e-3, 5e-5]", f"env.boxes: [{boxes}]").replace("agents: [2, 4]", "agents: [2]")
    assert list(load(text).arms) == ["boxes=no. 1, agents=2"]
    text = ONLY_GRID.replace(
        "algo.lr: [1e-3, 5e-5]", "algo.kind: [rhmc]\n  env.kind: [coverage]\n  algo.encoder: [mlp]"
    )
    assert next(iter(load(text).arms)) == "algo.kind=rhmc, env.kind=coverage, encoder=mlp, agents=2"


def test_a_grid_may_say_what_another_kind_does_not_inherit() -> None:
    text = GRID.replace("iql, encoder: pairwise", "iql").replace("algo.lr: [1e-3, 5e-5]", "algo.encoder: [mlp]")
    assert {arm.algo.encoder for arm in load(text).arms.values()} == {"mlp"}


def test_a_profile_is_content_with_some_arms_and_values() -> None:
    text = GRID.replace("full: {}", "full: {}\n  full, too: {algo: {horizon: 2}}")
    text += "profiles: {quick: {arms: [full, IQL], grid: {env.agents: [3]}}}"
    assert list(load(text).arms) == [
        f"{arm}, lr={lr}, agents=3" for arm in ("full", "IQL") for lr in ("0.001", "5e-05")
    ]
    assert len(load(text, "paper").arms) == 16
    assert len(load(text, "paper", "profiles.paper.arms=[none]").arms) == 4
    assert len(load(text, "quick", "profiles.quick.grid.env.agents=[2,3]", "grid.algo.lr=[1]").arms) == 4


GRIDS = [
    ("algo.lr: [", "algo.lrr: [", ["11:3: grid.algo.lrr: unknown key 'lrr'; ...'lr'? (in arm 'full', 'none')"]),
    ("[1e-3, 5e-5]", "[1e-3, -1]", ["11:19: grid.algo.lr: -1 is not allowed; ... (in arm 'full', 'none', 'IQL')"]),
    ("[1e-3, 5e-5]", "[1e-3, 0.001]", ["11:19: grid.algo.lr: 0.001 is there twice"]),
    ("[1e-3, 5e-5]", "[1e-3, a/b]", ["11:19: grid.algo.lr: 'a/b' cannot be part of an arm's name"]),
    ("[1e-3, 5e-5]", "1e-3", ["11:12: grid.algo.lr: 0.001 is not allowed; must be a valid list"]),
    ("[1e-3, 5e-5]", "[]", ["11:12: grid.algo.lr: [] is not allowed; must not be empty"]),
    ("[1e-3, 5e-5]", "[.nan]", ["11:13: grid.algo.lr.0: .nan is not allowed; must be a finite number"]),
    ("algo.lr:", "lr:", ["11:3: grid.lr: 'lr' is no key of a run; ... did you mean 'algo.lr'?"]),
    ("algo.lr:", "seeds:", ["11:3: grid.seeds: 'seeds' is no key of a run; a dotted name such as algo.alpha..."]),
    ("algo.lr: [1e-3, 5e-5]", "trainer.steps: [1, 2]", ["11:3: grid.trainer.steps: ... 'none', 'IQL')"]),
    ("env.agents: [2, 4]", "env.agents: [2, 9]", ["12:19: grid.env.agents: 9 sensors need as many ..."]),
    ("steps: 1000", "steps: 9\nprofiles: {quick: {grid: {env.agent: [1]}}}",
     ["15:27: profiles.quick.grid.env.agent: 'env.agent' is no key of the grid; did you mean 'env.agents'?"]),
    ("steps: 1000", "steps: 9\nprofiles: {quick: {arms: [ful]}}",
     ["15:27: profiles.quick.arms.0: 'ful' is no arm; allowed: full, none, IQL; did you mean 'full'?"]),
    ("steps: 1000", "steps: 9\nprofiles: {quick: {changes: {ful: {algo: {lr: 1}}}}}",
     ["15:30: profiles.quick.changes.ful: 'ful' is no arm; allowed: full, none, IQL; did you mean 'full'?"]),
    ("steps: 1000", "steps: 9\nprofiles: {quick: {changes: {full: {algo: {lrr: 1}}}}}",
     ["15:44: profiles.quick.changes.full.algo.lrr: unknown key 'lrr'; allowed: ... did you mean 'lr'?"]),
    ("steps: 1000", "steps: 9\nprofiles: {quick: {arms: [[ful]]}}",
     ['15:27: profiles.quick.arms.0: ["ful"] is not allowed; must be a valid string']),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "said"), GRIDS)
def test_faulty_grids(old: str, new: str, said: list[str]) -> None:
    assert GRID.count(old) == 1
    assert_said([line for line in faults(GRID.replace(old, new)) if "(in arm 'IQL')" not in line], said)


def test_a_grid_too_large_to_train_is_refused_before_it_is_spelled_out() -> None:
    keys = "algo.lr", "algo.alpha", "algo.coordinator.gamma", "algo.executor.gamma", "algo.executor.epsilon"
    keys += "algo.coordinator.assignment_epsilon", "algo.tau"
    values = ", ".join(f"0.{i}" for i in range(10, 90))
    text = GRID.replace("  env.agents: [2, 4]\n", "").replace("  algo.lr: [1e-3, 5e-5]\n", "")
    text = text.replace("grid:\n", "grid:\n" + "".join(f"  {key}: [{values}]\n" for key in keys))
    assert faults(text) == ["studies/x.yaml:10:1: grid: 62,914,560,000,000 arms in all; at most 1,000"]


@settings(max_examples=100, deadline=None)
@given(st.text(max_size=40), st.integers(0, len(GRID)), st.integers(0, 20))
def test_whatever_is_written_into_a_grid_is_read_or_refused(text: str, at: int, cut: int) -> None:
    Path("studies/x.yaml").write_bytes((GRID[:at] + text + GRID[at + cut :]).encode())
    said = None
    try:
        assert Study.load("studies/x.yaml").runs()
    except StudyError as error:
        said = str(error)
    assert said is None or all(line.startswith("studies/x.yaml") for line in said.splitlines())


# Variants

VARIANTS = (
    GOOD
    + "variants:\n  paper_faithful: {env: {observation: paper}, algo: {encoder: mlp}}\n"
    + "  long: {trainer: {num_envs: 8}}\n"
)


def test_a_variant_changes_every_arm_whatever_its_kind_and_has_a_name_of_its_own() -> None:
    Path("studies/x.yaml").write_text(VARIANTS)
    plain, faithful, long = (Study.load("studies/x.yaml", variant=v) for v in (None, "paper_faithful", "long"))
    assert [study.name for study in (plain, faithful, long)] == ["x", "x@paper_faithful", "x@long"]
    assert {run.study for run in faithful.runs()} == {"x@paper_faithful"}
    assert plain.runs() == load(GOOD).runs()
    assert {(a.algo.encoder, a.env.observation) for a in faithful.arms.values()} == {("mlp", "paper")}
    assert [a.algo.kind for a in faithful.arms.values()] == ["rhmc", "rhmc", "iql"]
    assert faithful.arms["none"].algo.regulator == "none"
    assert changes(faithful.base, faithful.arms["none"]) == {"algo.regulator": "none"}
    assert {a.trainer.num_envs for a in long.arms.values()} == {8}


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "encoder: mlp",
            "encoder: mpl",
            ["13:63: variants.paper_faithful.algo.encoder: 'mpl' is not allowed; ... 'mlp'?"],
        ),
        (
            "paper_faithful: {env",
            "paper_faithful: {envs",
            ["13:20: variants.paper_faithful.envs: unknown key 'envs'; ... did you mean 'env'?"],
        ),
        ("long:", "a/b:", ["14:3: variants.a/b: a variant is named with letters, digits, '-' and '_' only"]),
        (
            "trainer: {num_envs: 8}",
            "algo: {kind: iql}",
            [
                "14:16: variants.long.algo.encoder: missing; ... the base has 'pairwise': state it here",
                "7:3: arms.none: arm 'none' is the same as arm 'full' in variant 'long'",
            ],
        ),
    ],
)  # fmt: skip
def test_faulty_variants(old: str, new: str, said: list[str]) -> None:
    assert VARIANTS.count(old) == 1
    assert_said(sorted(faults(VARIANTS.replace(old, new))), sorted(said))


def test_an_unknown_variant() -> None:
    for text, said in [
        (VARIANTS, "allowed: paper_faithful, long; did you mean 'paper_faithful'?"),
        (GOOD, "this study has no variants"),
    ]:
        Path("studies/x.yaml").write_text(text)
        with pytest.raises(StudyError) as caught:
            Study.load("studies/x.yaml", variant="paper_faithfull")
        assert str(caught.value) == f"--variant: 'paper_faithfull' is not allowed; {said}"


# Faulty files. Each: what is written instead of what, and what is said, `...` for a long list in the middle.

EMPTY = (
    "1:1: empty; a study has question, preset, base, arms, grid, readings, variants, seeds, steps, profiles, "
    "resources, imports"
)
WHOLE = [
    ("", EMPTY),
    ("# nothing\n", EMPTY),
    ("- 1\n", "1:1: [1] is not a study; must be a mapping with ... steps, profiles, resources, imports"),
    ("  hello\n", "1:3: 'hello' is not a study; must be a mapping with ... steps, profiles, resources, imports"),
    ("question: [1,\n", "2:1: not YAML: expected the node content, ... (while parsing a flow node)"),
    ("base:\n\tenv: {}\n", "2:1: not YAML: a TAB; indent with spaces"),
    ("question: a: b\n", "1:12: not YAML: mapping values are not allowed here"),
    ("question: @b\n", "1:11: not YAML: found character '@' that cannot start any token ..."),
    ("question: a\n---\nb: 1\n", "2:1: not YAML: ... (expected a single document in the stream)"),
    ("question: *a\n", "1:11: not YAML: found undefined alias 'a'"),
]
PARTS = [
    # keys
    (
        "question",
        "qestion",
        ["1:1: qestion: unknown key 'qestion'; ... did you mean 'question'?", "1:1: question: missing"],
    ),
    ("agents: 4", "agent: 4", ["3:25: base.env.agent: unknown key 'agent'; ... did you mean 'agents'?"]),
    (
        "{regulator: none}",
        "{regulatr: none}",
        ["8:12: arms.none.algo.regulatr: unknown key 'regulatr'; ... 'regulator'?"],
    ),
    ("full: {}", "full: {algos: {}}", ["6:10: arms.full.algos: unknown key 'algos'; ... did you mean 'algo'?"]),
    (
        "full: {}",
        "full: {trainer: {step: 1}}",
        ["6:20: arms.full.trainer.step: unknown key 'step'; allowed: num_envs, ..."],
    ),
    ("quick: 2", "quik: 2", ["10:9: seeds.quik: unknown key 'quik'; allowed: quick, paper; did you mean 'quick'?"]),
    (
        "steps: 1000",
        "steps: 9\nprofiles: {fast: {}}",
        ["12:12: profiles.fast: unknown key 'fast'; allowed: quick, paper"],
    ),
    ("steps: 1000", "steps: 9\nresources: {cpu: 1}", ["12:13: resources.cpu: unknown key 'cpu'; ... 'cpus'?"]),
    ("agents: 4", "<<: 4", ["3:25: base.env.<<: unknown key '<<'; ..."]),
    ("Which?", "Which?\n? [a]\n: 1", ["2:3: a key must be a word, not a list or a mapping"]),
    # kinds
    (
        "kind: coverage",
        "kind: covrage",
        ["3:15: base.env.kind: 'covrage' is not allowed; ... did you mean 'coverage'?"],
    ),
    ("kind: rhmc", "kind: RHMC", ["4:16: base.algo.kind: 'RHMC' is not allowed; ... did you mean 'rhmc'?"]),
    ("kind: iql", "kind: igl", ["9:22: arms.IQL.algo.kind: 'igl' is not allowed; ... did you mean 'iql'?"]),
    ("kind: rhmc", "kind: [rhmc]", ['4:16: base.algo.kind: ["rhmc"] is not allowed; allowed: rhmc, ...']),
    ("kind: rhmc, ", "", ["4:3: base.algo.kind: missing; allowed: rhmc, ..."]),
    (
        "iql, encoder: pairwise",
        "iql",
        ["9:15: arms.IQL.algo.encoder: missing; ... the base has 'pairwise': state it here"],
    ),
    (
        "iql, encoder: pairwise",
        "iql, encoder: pairwise, horizon: 2",
        ["9:46: arms.IQL.algo.horizon: unknown key 'horizon'; allowed: buffer_size, ...epsilon_steps, kind"],
    ),
    # values
    ("regulator: none", "regulator: papr", ["8:23: arms.none.algo.regulator: 'papr' is not allowed; ... 'paper'?"]),
    ("regulator: none", "filter: false", ["8:20: arms.none.algo.filter: false is not allowed; allowed: on, off"]),
    ("regulator: none", "lr: -1", ["8:16: arms.none.algo.lr: -1 is not allowed; must be greater than 0"]),
    ("regulator: none", "lr: '1e-3'", ["8:16: arms.none.algo.lr: '1e-3' is not allowed; must be a valid number"]),
    ("regulator: none", "lr: .nan", ["8:16: arms.none.algo.lr: .nan is not allowed; must be a finite number"]),
    (
        "regulator: none",
        "lr: 2020-01-01",
        ["8:16: arms.none.algo.lr: 2020-01-01 is read as a date; in quotes it is text"],
    ),
    ("regulator: none", "lr: !x 3", ["8:16: arms.none.algo.lr: '3' cannot be read as !x"]),
    (
        "regulator: none",
        "lr: &a 1, alpha: *a",
        ["8:22: arms.none.algo.alpha: used again by an alias; ... the value out"],
    ),
    ("agents: 4", "agents: four", ["3:33: base.env.agents: 'four' is not allowed; must be a valid integer"]),
    ("agents: 4", "agents: true", ["3:33: base.env.agents: true is not allowed; must be a valid integer"]),
    ("agents: 4", "agents: 4.5", ["3:33: base.env.agents: 4.5 is not allowed; must be a valid integer"]),
    ("agents: 4", "agents: 0", ["3:33: base.env.agents: 0 is not allowed; must be greater than or equal to 1"]),
    ("agents: 4", "agents: ~", ["3:33: base.env.agents: null is not allowed; must be a valid integer"]),
    ("agents: 4", "boxes: [[1, 2, x, 4]]", ["3:40: base.env.boxes.0.2: 'x' is not allowed; must be a valid integer"]),
    ("agents: 4", "agents: 9", ["3:33: base.env.agents: 9 sensors need as many boxes, and there are 6"]),
    (
        "full: {}",
        "big: {env: {agents: 7}}",
        ["6:23: arms.big.env.agents: 7 sensors need as many boxes, and there are 6"],
    ),
    ("full: {}", "big: {env: {preset: executor, targets: 2}}", ["3:33: base.env.agents: ... (in arm 'big')"]),
    # sections
    ("Which?", "''", ["1:11: question: '' is not allowed; must not be empty"]),
    ("Which?", "3", ["1:11: question: 3 is not allowed; must be a valid string"]),
    ("  algo: {kind: rhmc, encoder: pairwise}\n", "", ["2:1: base.algo: missing"]),
    (
        "algo: {kind: rhmc, encoder: pairwise}",
        "algo: rhmc",
        ["4:9: base.algo: 'rhmc' is not allowed; must be a mapping"],
    ),
    (
        "encoder: pairwise}\narms",
        "}\n  trainer: {steps: 3}\narms",
        ["5:13: base.trainer.steps: ... at the top of the file"],
    ),
    (ARMS, "", ["1:1: arms: missing"]),
    (ARMS, "arms: {}\n", ["5:7: arms: {} is not allowed; must not be empty"]),
    (ARMS, "arms: [full]\n", ['5:7: arms: ["full"] is not allowed; must be a mapping']),
    ("full: {}", "full: 3", ["6:9: arms.full: 3 is not allowed; must be a mapping"]),
    ("full: {}", "a/b: {}", ["6:3: arms.a/b: 'a/b' is not a name for an arm; use a few words, without '/'"]),
    ("full: {}", "full: {}\n  twin: {}", ["7:3: arms.twin: arm 'twin' is the same as arm 'full'"]),
    ("full: {}", "none: {}", ["7:3: arms.none: duplicate key 'none', first in line 6"]),
    # numbers of runs
    ("{quick: 2, paper: 3}", "0", ["10:8: seeds: 0 is not allowed; must be greater than or equal to 1"]),
    ("{quick: 2, paper: 3}", "[0, 1]", ["10:8: seeds: [0, 1] is not allowed; must be a valid integer"]),
    ("{quick: 2, paper: 3}", "{paper: 3}", ["10:1: seeds.quick: missing; there is a value for: paper"]),
    ("steps: 1000", "steps: 1e3.5", ["11:8: steps: '1e3.5' is not allowed; must be a valid integer"]),
    ("steps: 1000", "steps: .inf", ["11:8: steps: .inf is not allowed; must be a finite number"]),
    ("steps: 1000", "steps: " + "1" * 5000, ["11:8: steps: '1111... cannot be read as int"]),
    ("steps: 1000", "steps: 1\nsteps: 2", ["12:1: steps: duplicate key 'steps', first in line 11"]),
    ("steps: 1000\n", "", ["1:1: steps: missing"]),
    # several at once, in the order of the file
    (
        "agents: 4}\n  algo: {kind: rhmc",
        "agents: -1}\n  algo: {kind: rhmd",
        [
            "3:33: base.env.agents: -1 is not allowed; must be greater than or equal to 1",
            "4:16: base.algo.kind: 'rhmd' is not allowed; ... did you mean 'rhmc'?",
        ],
    ),
]


def assert_said(lines: list[str], said: list[str]) -> None:
    assert len(lines) == len(said), lines
    for line, expected in zip(lines, said, strict=True):
        start, dots, end = f"studies/x.yaml:{expected}".partition("...")
        assert line.startswith(start)
        assert line.endswith(end)
        assert dots or line == start


@pytest.mark.parametrize(("text", "said"), WHOLE)
def test_texts_that_are_no_study(text: str, said: str) -> None:
    assert_said(faults(text), [said])


@pytest.mark.parametrize(("old", "new", "said"), PARTS)
def test_faulty_studies(old: str, new: str, said: list[str]) -> None:
    assert_said(faults(changed(old, new)), said)


def test_a_fault_in_the_other_profile_is_found_too() -> None:
    text = GOOD + "profiles: {paper: {trainer: {evalutions: 7}}}"
    assert_said(
        faults(text), ["12:30: profiles.paper.trainer.evalutions: unknown key 'evalutions'; ... 'evaluations'?"]
    )


def test_files_that_cannot_be_read() -> None:
    Path("studies/x.yaml").write_bytes(b"question: a\nbase: caf\xe9\n")
    for path, said in [
        ("studies/x.yaml", "studies/x.yaml:2:10: byte 0xe9 is not UTF-8; save the file as UTF-8"),
        ("studies/y.yaml", "studies/y.yaml: no such file; did you mean 'studies/x.yaml'?"),
        ("x.yaml", "x.yaml: no such file; did you mean 'studies/x.yaml'?"),
        ("studies", "studies: a directory; give one study of it: x.yaml"),
        ("/dev/zero", "/dev/zero: a device, and a regular file is needed"),
    ]:
        with pytest.raises(StudyError) as caught:
            Study.load(path)
        assert str(caught.value) == said


def test_a_nest_without_end() -> None:
    assert faults("x: " + "[" * 600) == ["studies/x.yaml:1:33: nested too deeply; this is not a study"]


def test_an_unknown_profile() -> None:
    said = "--profile: 'papr' is not allowed; allowed: quick, paper; did you mean 'paper'?"
    assert faults(GOOD, profile="papr") == [said]


@settings(max_examples=150, deadline=None)
@given(st.text(max_size=60), st.integers(0, len(GOOD)), st.integers(0, 20))
def test_whatever_is_written_into_a_study_is_read_or_refused(text: str, at: int, cut: int) -> None:
    """No other exception than `StudyError`, and never without a word."""
    Path("studies/x.yaml").write_bytes((GOOD[:at] + text + GOOD[at + cut :]).encode())
    said = None
    try:
        assert Study.load("studies/x.yaml").runs()
    except StudyError as error:
        said = str(error)
    assert said is None or all(line.startswith("studies/x.yaml") for line in said.splitlines())


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("an arm", "'an arm'"),
        ("a\x1b", r"'a\x1b'"),
        (None, "null"),
        (0.5, "0.5"),
        ([1, {"lr": Node(True, Place(""), Place(""), "")}], '[1, {"lr": true}]'),
        ({(1, 2): 3, "a": b""}, '{"a": "bytes"}'),
        (b"x", "a bytes"),
        ([1] * 99, f"[{'1, ' * 19}1…"),
    ],
)
def test_any_value_can_be_shown(value: object, text: str) -> None:
    assert show(value) == text


# Merging


def node(value: object) -> Node:
    place = Place("")
    if isinstance(value, dict):
        return Node({key: node(child) for key, child in value.items()}, place, place, "")
    return Node(value, place, place, "")  # type: ignore[arg-type]


SCALARS = st.none() | st.booleans() | st.integers() | st.sampled_from(["on", "off"])
KEYS = st.sampled_from("abc")
TREES = st.recursive(SCALARS, lambda child: st.dictionaries(KEYS, child, max_size=3), max_leaves=8)
MAPPINGS = st.dictionaries(KEYS, TREES, max_size=3)


@settings(deadline=None)
@given(MAPPINGS, MAPPINGS, MAPPINGS)
def test_merging_without_kinds(a: dict, b: dict, c: dict) -> None:
    def merged(x: dict, y: dict) -> dict:
        return plain(merge(node(x), node(y)))

    assert merged(a, {}) == a
    assert merged({}, a) == a
    assert merged(merged(a, b), b) == merged(a, b)
    nested = [(x[k], y[k]) for x, y in pairwise((a, b, c)) for k in x.keys() & y.keys()]
    if not any(isinstance(x, dict) != isinstance(y, dict) for x, y in nested) and not mixed(a, b, c):
        assert merged(merged(a, b), c) == merged(a, merged(b, c))
    for key, value in b.items():
        if not isinstance(value, dict):
            assert merged(a, b)[key] == value
    assert {k: v for k, v in merged(a, b).items() if k not in b} == {k: v for k, v in a.items() if k not in b}


def mixed(*trees: dict) -> bool:
    """True if a key holds a mapping in one tree and something else in another, at any depth."""
    for key in {key for tree in trees for key in tree}:
        values = [tree[key] for tree in trees if key in tree]
        mappings = [value for value in values if isinstance(value, dict)]
        if mappings and (len(mappings) < len(values) or mixed(*mappings)):
            return True
    return False


@settings(deadline=None)
@given(MAPPINGS, MAPPINGS, st.sampled_from("xy"), st.sampled_from("xy"))
def test_another_kind_inherits_nothing(a: dict, b: dict, kind: str, other: str) -> None:
    base, patch = {"algo": a | {"kind": kind}, "env": a}, {"algo": b | {"kind": other}}
    merged = plain(merge(node(base), node(patch)))
    inherited = plain(merge(node(a), node(b))) if kind == other else b
    assert merged == {"algo": inherited | {"kind": other}, "env": a}


# Names of runs


def test_an_id_stands_for_the_whole_spec() -> None:
    spec = load(GOOD).runs()[0].spec
    again = RunSpec.model_validate(json.loads(spec.canonical()))
    assert again == spec
    assert again.id == spec.id
    assert len(spec.id) == 12
    assert int(spec.id, 16) >= 0
    assert spec.model_copy(update={"seed": 1}).id != spec.id


def test_an_id_does_not_depend_on_how_the_study_is_written() -> None:
    def ids(text: str) -> list[str]:
        return [run.spec.id for run in load(text).runs()]

    assert ids(changed("kind: coverage, agents: 4", "agents: 4, kind: coverage")) == ids(GOOD)
    assert ids(changed("agents: 4", "agents: 4, targets: 5")) == ids(GOOD)  # the default, written out
    assert ids(GOOD + "resources: {concurrent: 1}") == ids(GOOD)
    assert not set(ids(changed("steps: 1000", "steps: 1001"))) & set(ids(GOOD))


def test_a_method_that_cannot_act_in_its_task_is_named_where_the_task_says_so(tmp_path: Path) -> None:
    file = tmp_path / "x.yaml"
    file.write_text(
        "question: q\nbase:\n  env: {kind: navigation, continuous: true}\n  algo: {kind: rhmc}\n"
        "arms: {a: {}, b: {algo: {lr: 1e-3}}}\nseeds: 1\nsteps: 1000\n"
    )
    with pytest.raises(StudyError) as error:
        Study.load(file)
    place = f"{file}:3:39: base.env.continuous"
    assert str(error.value) == f"{place}: 'rhmc' chooses among discrete actions; allowed: false"


def test_an_override_adds_no_arm() -> None:
    with pytest.raises(StudyError, match=r"no arm 'ful'; allowed: .*did you mean 'full'\?"):
        load(GOOD, "quick", "arms.ful.algo.alpha=0.1")


def test_an_arm_of_the_wrong_shape_is_not_called_a_twin_as_well() -> None:
    with pytest.raises(StudyError) as error:
        load(GOOD.replace(ARMS, "arms:\n  a: {}\n  b: {horizon: 6}\n"))
    assert "unknown key 'horizon'" in str(error.value)
    assert "same as" not in str(error.value)
