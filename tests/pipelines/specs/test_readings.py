"""Readings of a study: every arm under every reading, and what is said about faulty ones."""

from pathlib import Path

import pytest

from pipelines.specs.study import Study, StudyError

GOOD = """\
question: Which?
base:
  env: {kind: coverage, agents: 4}
  algo: {kind: rhmc, encoder: pairwise}
arms:
  full: {}
  none: {algo: {regulator: none}}
readings:
  factors:
    algo.alpha: [0.1, 0.5]
    network:
      paper: {env: {observation: paper}, algo: {encoder: mlp}}
      pairs: {env: {observation: extended}}
    algo.lr: [5e-4, 1e-3]
  design: {resolution: 3}
seeds: 2
steps: 5000
"""
FULL = GOOD.replace("{resolution: 3}", "full")


@pytest.fixture(autouse=True)
def _in_a_project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def load(text: str, profile: str = "quick", *overrides: str) -> Study:
    Path("x.yaml").write_text(text)
    return Study.load("x.yaml", profile, overrides)


def faults(text: str) -> list[str]:
    with pytest.raises(StudyError) as caught:
        load(text)
    return str(caught.value).splitlines()


def test_every_arm_is_taken_to_every_reading() -> None:
    study = load(GOOD)
    names = [f"{arm}, reading={code}" for code in ("111", "122", "212", "221") for arm in ("full", "none")]
    assert sorted(study.arms) == sorted(study.cells) == sorted(names)
    assert len({run.spec.id for run in study.runs()}) == len(study.runs()) == 16
    for name, cell in study.cells.items():
        alpha, network, lr = (int(digit) - 1 for digit in cell.reading.removeprefix("reading="))
        arm = study.arms[name]
        assert (arm.algo.alpha, arm.algo.lr) == ((0.1, 0.5)[alpha], (5e-4, 1e-3)[lr])
        assert (arm.env.observation, arm.algo.encoder) == (("paper", "mlp"), ("extended", "pairwise"))[network]
        assert arm.algo.regulator == {"full": "paper", "none": "none"}[cell.arm]
        levels = {"algo.alpha": ("0.1", "0.5")[alpha], "network": ("paper", "pairs")[network]}
        assert cell.levels == levels | {"algo.lr": ("0.0005", "0.001")[lr]}


def test_the_plan_says_levels_generators_and_confounded_effects() -> None:
    plan = load(GOOD).readings
    assert plan is not None
    assert plan.factors == {"algo.alpha": ("0.1", "0.5"), "network": ("paper", "pairs"), "algo.lr": ("0.0005", "0.001")}
    assert plan.generators == {"algo.alpha": "a", "network": "b", "algo.lr": "-ab"}
    assert plan.confounded[0] == ("algo.alpha", "network x algo.lr")
    assert len(plan.confounded) == 3


def test_a_full_design_has_all_combinations_and_nothing_is_confounded() -> None:
    study = load(FULL)
    assert len(study.arms) == 16
    assert study.readings is not None
    assert (study.readings.kind, study.readings.confounded) == ("every combination", ())


def test_an_arm_goes_before_a_reading() -> None:
    regulator = "    regulator:\n      paper: {algo: {regulator: paper}}\n      exact: {algo: {regulator: exact}}\n"
    arms = load(FULL.replace("    network:\n", f"{regulator}    network:\n")).arms
    assert {arm.algo.regulator for name, arm in arms.items() if name.startswith("none")} == {"none"}
    assert {arm.algo.regulator for name, arm in arms.items() if name.startswith("full")} == {"paper", "exact"}


def test_what_an_arm_decides_itself_is_trained_once() -> None:
    """Readings that differ in the regulator alone are one training of the arm without it."""
    regulator = "    algo.regulator: [paper, exact]\n"
    study = load(FULL.replace("    network:\n", f"{regulator}    network:\n"))
    ids = {arm: {run.spec.id for run in study.runs() if study.cells[run.arm].arm == arm} for arm in ("full", "none")}
    assert {arm: len(each) for arm, each in ids.items()} == {"full": 32, "none": 16}
    assert len(study.runs()) == 64


def test_two_arms_that_are_one_are_a_fault_under_readings_too() -> None:
    said = faults(GOOD.replace("full: {}", "full: {}\n  twin: {}"))
    assert said[0] == "x.yaml:7:3: arms.twin: arm 'twin, reading=111' is the same as arm 'full, reading=111'"


def test_a_profile_and_an_override_have_another_design() -> None:
    text = GOOD + "profiles: {quick: {arms: [full], readings: {design: full}}}\n"
    assert (len(load(text).arms), len(load(text, "paper").arms)) == (8, 8)
    assert {cell.arm for cell in load(text).cells.values()} == {"full"}
    assert len(load(GOOD, "quick", "readings.design.kind=full").arms) == 16
    assert len(load(GOOD, "quick", "readings.design=full").arms) == 16
    study = load(GOOD, "quick", "readings.factors.algo.alpha=[0.2,0.3]", "readings.factors.network.pairs.algo.lr=1")
    assert {arm.algo.alpha for arm in study.arms.values()} == {0.2, 0.3}


def test_a_level_may_include(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("algo: {hidden_dim: 7}\n")
    arms = load(GOOD.replace("encoder: mlp", "include: mine, encoder: mlp")).arms
    assert {(arm.algo.hidden_dim, arm.algo.encoder) for arm in arms.values()} == {(7, "mlp"), (64, "pairwise")}


def test_without_readings_there_are_none() -> None:
    study = load(GOOD[: GOOD.index("readings:")] + GOOD[GOOD.index("seeds:") :])
    assert (study.readings, study.cells, list(study.arms)) == (None, {}, ["full", "none"])


FAULTS = [
    ("algo.alpha: [0.1, 0.5]", "algo.alpha: [0.1]", "10:5: readings.factors.algo.alpha: 1 levels; must be 2 to 9"),
    ("algo.alpha: [0.1, 0.5]", "algo.alpha: [0.1, 0.5, 1]",
     "15:3: readings.design: factor 'algo.alpha' has 3 levels; a fraction takes 2, 4 or 8: give it as many"),
    ("algo.alpha: [0.1, 0.5]", "algo.alpha: [0.1, 2]", "10:23: readings.factors.algo.alpha: 2 is not allowed; "),
    ("algo.alpha:", "alpha:", "10:5: readings.factors.alpha: 'alpha' is no key of a run; "),
    ("algo.alpha: [0.1, 0.5]", "algo.alpha: 0.1", "10:17: readings.factors.algo.alpha: 0.1 is not allowed; "),
    ("{env: {observation: extended}}", "{envs: {observation: extended}}",
     "13:15: readings.factors.network.pairs.envs: unknown key 'envs'; a level is a mapping with env, algo, trainer"),
    ("{env: {observation: extended}}", "extended",
     "13:14: readings.factors.network.pairs: 'extended' is not allowed; a level is a mapping with env, algo, trainer"),
    ("{env: {observation: extended}}", "{env: extended}",
     "13:20: readings.factors.network.pairs.env: 'extended' is not allowed; must be a mapping"),
    ("observation: extended", "observation: extendet", "13:34: readings.factors.network.pairs.env.observation: 'e"),
    ("resolution: 3", "resolution: 2", "15:24: readings.design.resolution: 2 is not allowed; must be great"),
    ("resolution: 3", "readings: 7", "15:22: readings.design.readings: 7 is not allowed; must be a power of two"),
    ("resolution: 3", "readings: 16", "15:3: readings.design: 16 readings of 8 combinations; write 'design: full'"),
    ("resolution: 3", "resolution: 4, readings: 4",
     "15:3: readings.design: no design of resolution 4 in 4 readings was found; take more readings, or a lower one"),
    ("{resolution: 3}", "whole", "15:11: readings.design.kind: 'whole' is not allowed; allowed: full, fractional"),
    ("seeds:", "grid: {algo.horizon: [1, 2]}\nseeds:",
     "8:1: readings: not beside a grid; a key of the grid can be a factor"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "said"), FAULTS)
def test_faulty_readings(old: str, new: str, said: str) -> None:
    assert GOOD.count(old) == 1
    found = faults(GOOD.replace(old, new))
    assert len(found) == 1
    assert found[0].startswith(f"x.yaml:{said}")


def test_too_many_are_refused_before_they_are_spelled_out() -> None:
    factors = "".join(f"    f{i}: {{a: {{}}, b: {{algo: {{lr: 0.{i + 1}}}}}}}\n" for i in range(60))
    said = faults(FULL.replace("    algo.alpha: [0.1, 0.5]\n", factors))
    assert said == [f"x.yaml:74:3: readings.design: {2**62 * 2:,} arms in all; at most 1,000"]
