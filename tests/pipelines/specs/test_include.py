"""`include` in a study: what it means, and that a fault points to the file and line where it was written."""

from pathlib import Path

import pytest

from pipelines.specs.include import SHIPPED, closure
from pipelines.specs.study import Study, StudyError, changes

GOOD = """\
question: Which?
base:
  env: {kind: coverage, agents: 4}
  algo: {kind: rhmc, encoder: pairwise}
arms:
  full: {}
  found: {algo: {include: best_params/rhmc.yaml, horizon: 4}}
  QMIX: {algo: {include: best_params/qmix.yaml}}
seeds: 1
steps: 1000
"""
RHMC = """\
algo:
  kind: rhmc
  horizon: 2
  alpha: 0.3
provenance:
  search: somewhere
"""
QMIX = "algo:\n  kind: qmix\n  encoder: pairwise\n  lr: 2e-3\n"


@pytest.fixture(autouse=True)
def _in_a_project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "studies" / "best_params").mkdir(parents=True)
    write("rhmc", RHMC)
    write("qmix", QMIX)


def write(name: str, text: str) -> None:
    Path(f"studies/best_params/{name}.yaml").write_text(text)


def load(text: str = GOOD, *overrides: str) -> Study:
    Path("studies/x.yaml").write_text(text)
    return Study.load("studies/x.yaml", "quick", overrides)


def faults(text: str = GOOD, *overrides: str) -> list[str]:
    with pytest.raises(StudyError) as caught:
        load(text, *overrides)
    return str(caught.value).splitlines()


def changed(old: str, new: str, text: str = GOOD) -> str:
    assert text.count(old) == 1
    return text.replace(old, new)


def test_the_arm_goes_before_what_it_includes_and_that_before_the_base() -> None:
    study = load()
    assert changes(study.base, study.arms["found"]) == {"algo.horizon": 4, "algo.alpha": 0.3}
    qmix = study.arms["QMIX"].algo
    assert (qmix.kind, qmix.encoder, qmix.lr) == ("qmix", "pairwise", 2e-3)


def test_a_study_with_an_include_is_the_study_with_it_written_out() -> None:
    written = changed("include: best_params/rhmc.yaml, horizon: 4", "horizon: 4, alpha: 0.3").replace(
        "{include: best_params/qmix.yaml}", "{kind: qmix, encoder: pairwise, lr: 2e-3}"
    )
    assert load().arms == load(written).arms
    assert [run.spec.id for run in load().runs()] == [run.spec.id for run in load(written).runs()]


def test_a_base_a_profile_and_an_override_may_include() -> None:
    text = changed("algo: {kind: rhmc, encoder: pairwise}", "algo: {include: best_params/rhmc.yaml}")
    assert load(text).base.algo.alpha == pytest.approx(0.3)
    profile = GOOD + "profiles: {quick: {algo: {include: best_params/rhmc.yaml}}}\n"
    assert load(profile).arms["full"].algo.alpha == pytest.approx(0.3)
    assert load(GOOD, "algo.include=best_params/rhmc.yaml").base.algo.horizon == 2
    study = load(GOOD, "arms.full.algo.include=best_params/rhmc.yaml")
    assert study.arms["full"].algo.horizon == 2
    assert study.base.algo.horizon == 1


def test_a_variant_may_include() -> None:
    write("mlp", "algo:\n  encoder: mlp\n")
    load(GOOD + "variants: {paper_faithful: {algo: {include: best_params/mlp.yaml}}}\n")
    study = Study.load("studies/x.yaml", variant="paper_faithful")
    assert {arm.algo.encoder for arm in study.arms.values()} == {"mlp"}
    assert study.arms["found"].algo.alpha == pytest.approx(0.3)


def test_a_grid_takes_what_an_arm_includes_to_every_point() -> None:
    study = load(GOOD + "grid: {env.targets: [3, 5]}\n")
    found = [study.arms[f"found, targets={count}"] for count in (3, 5)]
    assert [(one.algo.horizon, one.env.targets) for one in found] == [(4, 3), (4, 5)]


def test_a_task_may_be_included_as_well() -> None:
    write("task", "env:\n  kind: coverage\n  agents: 3\n")
    study = load(changed("env: {kind: coverage, agents: 4}", "env: {include: best_params/task.yaml, targets: 2}"))
    assert (study.base.env.agents, study.base.env.targets) == (3, 2)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "alpha: 0.3",
            "alpha: 3",
            "4:10: algo.alpha: 3 is not allowed; must be less than or equal to 1 (in arm 'found')",
        ),
        ("alpha: 0.3", "alfa: 0.3", "4:3: algo.alfa: unknown key 'alfa'; *did you mean 'alpha'? (in arm 'found')"),
        ("alpha: 0.3", "alpha: 0.3\n  alpha: 1", "5:3: algo.alpha: duplicate key 'alpha', first in line 4"),
        ("alpha: 0.3", "alpha: [", "6:9: not YAML: *"),
        (
            "  alpha: 0.3",
            "  include: other.yaml",
            "4:12: algo.include: studies/best_params/other.yaml: no such file",
        ),
        (
            "  alpha: 0.3",
            "  include: best_params/rhmc",
            "4:12: algo.include: studies/best_params/rhmc.yaml: includes itself, "
            "by way of studies/best_params/rhmc.yaml",
        ),
    ],
)
def test_a_fault_in_an_included_file_is_named_there(old: str, new: str, said: str) -> None:
    write("rhmc", changed(old, new, RHMC))
    start, _, end = said.partition("*")
    lines, start = faults(), f"studies/best_params/rhmc.yaml:{start}"
    assert any(line.startswith(start) and line.endswith(end) for line in lines), lines


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "include: best_params/rhmc.yaml",
            "include: best_params/rmhc.yaml",
            "7:27: arms.found.algo.include: studies/best_params/rmhc.yaml: no such file; "
            "did you mean 'best_params/rhmc.yaml'?",
        ),
        (
            "include: best_params/rhmc.yaml",
            "include: 3",
            "7:27: arms.found.algo.include: 3 is not allowed; must be the path of a file",
        ),
        (
            "horizon: 4",
            "kind: qmix",
            "7:56: arms.found.algo.kind: 'qmix' is not allowed; what is included here is of kind 'rhmc'",
        ),
        (
            "env: {kind: coverage, agents: 4}",
            "env: {include: best_params/rhmc.yaml}",
            "3:18: base.env.include: studies/best_params/rhmc.yaml has no mapping 'env'; it has: algo, provenance",
        ),
        (
            "horizon: 4",
            "horizon: 0",
            "7:59: arms.found.algo.horizon: 0 is not allowed; must be greater than or equal to 1",
        ),
    ],
)
def test_a_fault_of_the_study_is_named_there(old: str, new: str, said: str) -> None:
    assert f"studies/x.yaml:{said}" in faults(changed(old, new))


def test_what_is_missing_in_an_included_file_is_missing_in_the_study() -> None:
    write("rhmc", "algo: {alpha: 0.3}\n")
    text = changed("algo: {kind: rhmc, encoder: pairwise}", "algo: {include: best_params/rhmc.yaml}")
    assert any(line.startswith("studies/x.yaml:4:3: base.algo.kind: missing; allowed: rhmc,") for line in faults(text))
    write("rhmc", "")
    assert "studies/x.yaml:7:27: arms.found.algo.include: studies/best_params/rhmc.yaml: empty;" in "\n".join(faults())


def test_another_kind_must_state_what_all_have_in_common_also_when_included() -> None:
    write("qmix", changed("  encoder: pairwise\n", "", QMIX))
    lines = faults()
    assert len(lines) == 1
    assert "algo.encoder: missing; another kind inherits nothing, and the base has 'pairwise'" in lines[0]


# Presets

TUNED = """\
question: Which?
preset: tuned
base:
  env: {kind: coverage}
  algo: {kind: rhmc}
arms:
  RHMC: {}
  six steps: {algo: {horizon: 6}}
  QMIX: {algo: {kind: qmix, lr: 3e-3}}
  elsewhere: {env: {kind: navigation, observation: extended}}
seeds: 1
steps: 1000000
"""
TUNED_BY_HAND = """\
question: Which?
base:
  env: {include: settings/coverage}
  algo: {include: settings/coverage/rhmc}
  trainer: {include: settings/coverage}
arms:
  RHMC: {}
  six steps: {algo: {horizon: 6}}
  QMIX: {algo: {include: settings/coverage/qmix, lr: 3e-3}}
  elsewhere:
    env: {include: settings/navigation}
    algo: {include: settings/navigation/rhmc}
    trainer: {final_lr_fraction: 1}
seeds: 1
steps: 1000000
"""


def test_tuned_is_what_the_settings_of_each_runs_task_and_method_say() -> None:
    ids = [run.spec.id for run in load(TUNED_BY_HAND).runs()]
    assert [run.spec.id for run in load(TUNED).runs()] == ids
    assert [run.spec.id for run in load(TUNED.replace("preset: tuned\n", ""), "preset=tuned").runs()] == ids
    assert load(TUNED).remarks == ()


def test_paper_is_the_defaults_said_aloud() -> None:
    text = changed("tuned", "paper", TUNED).replace(", observation: extended", "")
    assert [run.spec.id for run in load(text).runs()] == [
        run.spec.id for run in load(changed("preset: paper\n", "", text)).runs()
    ]


def test_settings_of_ones_own_go_before_the_packages_in_a_preset_too() -> None:
    Path("studies/settings/coverage").mkdir(parents=True)
    Path("studies/settings/coverage/qmix.yaml").write_text("algo:\n  kind: qmix\n  gama: 0.5\n")
    assert any(
        line.startswith("studies/settings/coverage/qmix.yaml:3:3: algo.gama: unknown key 'gama'; ")
        for line in faults(TUNED)
    )
    Path("studies/settings/coverage/qmix.yaml").write_text("algo: {kind: qmix, gamma: 0.5}\n")
    arms = load(TUNED).arms
    assert (arms["QMIX"].algo.gamma, arms["QMIX"].algo.lr, arms["RHMC"].algo.horizon) == (0.5, 3e-3, 1)
    names = [path.name for path in closure(Path("studies/x.yaml"))]
    assert {"qmix.yaml", "navigation.yaml", "coverage.yaml"} <= set(names)


def test_an_unknown_preset_is_one_line_with_the_nearest_name() -> None:
    said = "studies/x.yaml:2:9: preset: 'tuend' is not allowed; allowed: tuned, paper; did you mean 'tuned'?"
    assert faults(changed("tuned", "tuend", TUNED)) == [said]


def test_a_base_that_states_what_all_share_is_still_asked_of_other_kinds() -> None:
    lines = faults(changed("{kind: rhmc}", "{kind: rhmc, encoder: mlp}", TUNED))
    assert "algo.encoder: missing; another kind inherits nothing, and the base has 'mlp'" in lines[0]


def test_a_method_without_tuned_settings_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("pipelines.specs.include.SHIPPED", tmp_path / "none")
    assert load(TUNED).remarks[0] == (
        "studies/x.yaml:2:9: preset: no tuned settings for 'rhmc' in 'coverage': what is not stated has its default"
    )


# Files that include others, and where names start


def test_an_included_file_may_include_others() -> None:
    write("tuned", "algo:\n  kind: rhmc\n  horizon: 5\n  alpha: 0.3\n  lr: 2e-3\n")
    write("rhmc", "algo:\n  include: best_params/tuned\n  horizon: 2\n")
    algo = load().arms["found"].algo
    assert (algo.horizon, algo.alpha, algo.lr) == (4, 0.3, 2e-3)
    assert load(GOOD.replace(", horizon: 4", "")).arms["found"].algo.horizon == 2


def test_a_fault_is_named_in_the_file_that_an_included_one_includes() -> None:
    write("tuned", "algo:\n  kind: rhmc\n  alpha: 3\n")
    write("rhmc", "algo:\n  include: tuned\n  horizon: 2\n")  # beside itself
    said = "algo.alpha: 3 is not allowed; must be less than or equal to 1 (in arm 'found')"
    assert faults() == [f"studies/best_params/tuned.yaml:3:10: {said}"]
    write("tuned", "algo:\n  kind: qmix\n")
    write("rhmc", "algo:\n  include: tuned\n  kind: rhmc\n")
    said = (
        "studies/best_params/rhmc.yaml:3:9: algo.kind: 'rhmc' is not allowed; what is included here is of kind 'qmix'"
    )
    assert said in faults()


def test_files_that_include_each_other_are_a_fault() -> None:
    write("rhmc", "algo:\n  include: tuned\n")
    write("tuned", "algo:\n  include: ../best_params/rhmc\n")
    tuned = "studies/best_params/tuned.yaml"
    said = f"studies/best_params/../best_params/rhmc.yaml: includes itself, by way of {tuned}"
    assert f"{tuned}:2:12: algo.include: {said}" in faults()
    assert len(closure(Path("studies/x.yaml"))) == 4


def test_a_name_is_looked_for_beside_the_file_then_in_the_project_then_in_the_package() -> None:
    Path("mine").mkdir()
    Path("mine/x.yaml").write_text(changed("best_params/qmix.yaml", "settings/coverage/qmix"))
    study = Study.load("mine/x.yaml")
    assert study.arms["found"].algo.alpha == pytest.approx(0.3)  # of the project
    shipped = Study.load(SHIPPED / "coverage.yaml").arms["QMIX"].algo
    assert study.arms["QMIX"].algo == shipped
    Path("mine/best_params").mkdir()
    Path("mine/best_params/rhmc.yaml").write_text(changed("alpha: 0.3", "alpha: 0.4", RHMC))
    assert Study.load("mine/x.yaml").arms["found"].algo.alpha == pytest.approx(0.4)


def test_settings_of_ones_own_go_before_those_of_the_package_also_where_these_include_them() -> None:
    Path("mine/settings/coverage").mkdir(parents=True)
    Path("mine/settings/coverage/rhmc.yaml").write_text(RHMC)
    Path("mine/x.yaml").write_text(changed("best_params/rhmc.yaml", "settings/navigation/rhmc"))
    assert Study.load("mine/x.yaml").arms["found"].algo.alpha == pytest.approx(0.3)


def test_a_name_that_is_not_found_has_a_suggestion_from_the_package() -> None:
    lines = faults(changed("best_params/qmix.yaml", "settings/coverage/qmx"))
    said = "studies/settings/coverage/qmx.yaml: no such file; did you mean 'settings/coverage/qmix'?"
    assert f"studies/x.yaml:8:26: arms.QMIX.algo.include: {said}" in lines


def test_all_that_a_study_includes_is_known() -> None:
    write("tuned", "algo:\n  kind: rhmc\n")
    write("rhmc", "algo:\n  include: best_params/tuned\n")
    Path("studies/x.yaml").write_text(GOOD)
    names = [path.as_posix() for path in closure(Path("studies/x.yaml"))]
    assert names == [
        f"studies/{name}.yaml" for name in ("x", "best_params/rhmc", "best_params/qmix", "best_params/tuned")
    ]
    assert closure(Path("studies/none.yaml")) == []
