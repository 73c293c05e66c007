"""The coordinator of `examples/hungarian`: its assignment, its place in a run's name, and its study."""

import re
from itertools import product
from pathlib import Path

import pytest
import torch
from torch import Tensor

from pipelines.conformance.checks import seeded
from pipelines.specs.identity import code_id, modules, present
from pipelines.specs.learning_start import starts
from pipelines.specs.search import Search
from pipelines.specs.study import RunSpec, Study, StudyError
from pipelines.tracking.plan import items
from pipelines.workspace.errors import InputError
from rhmc.envs import coverage, make_env, navigation
from rhmc.hierarchy.coordinator import COORDINATORS, Coordination, register_coordinator
from rhmc.training.trainer import Trainer
from tests.examples.conftest import SHORT
from tests.pipelines.support import run_rhmc

EXAMPLE = "hungarian"
FILE = "studies/hungarian.yaml"
PLAIN = {"env": {"kind": "coverage"}, "algo": {"kind": "rhmc"}, "trainer": {}, "seed": 0}
OWN = PLAIN | {"algo": {"kind": "rhmc", "coordinator": {"method": "hungarian"}}}


def least(cost: list[list[float]]) -> float:
    """The least sum over all ways to give each target an agent, none of them more than the share, rounded up."""
    agents, targets = len(cost), len(cost[0])
    most = -(-targets // agents)
    ways = [way for way in product(range(agents), repeat=targets) if max(map(way.count, way)) <= most]
    return min(sum(cost[i][j] for j, i in enumerate(way)) for way in ways)


@pytest.mark.parametrize(("agents", "targets"), [(3, 3), (2, 5), (4, 2), (1, 3)])
def test_the_assignment_is_the_cheapest_of_all(agents: int, targets: int) -> None:
    Study.load(FILE)
    from hungarian.coordinator import cheapest

    cost = torch.rand(5, agents, targets, generator=seeded(3))
    assignment = cheapest(cost)
    assert bool((assignment.sum(1) == 1).all())
    assert int(assignment.sum(2).max()) <= -(-targets // agents)
    for own, chosen in zip(cost, assignment, strict=True):
        assert float((own * chosen).sum()) == pytest.approx(least(own.tolist()))


@pytest.mark.parametrize("observation", ["paper", "extended", "extended_own"])
def test_what_it_costs_is_the_distance(observation: str) -> None:
    Study.load(FILE)
    from hungarian.coordinator import COSTS, sizes

    def cost(cfg: coverage.Config | navigation.Config) -> tuple[Tensor, Tensor]:
        env = make_env(cfg, 3, seeded())
        found = COSTS[sizes(env.spec)](env.reset().pairs)
        one, other = ("sensors", "targets") if cfg.kind == "coverage" else ("position", "landmarks")
        return found, torch.cdist(getattr(env.state, one), getattr(env.state, other))

    found, away = cost(coverage.Config(observation=observation))
    assert torch.allclose(2000 * found, away)
    if observation != "extended_own":
        found, away = cost(navigation.Config(observation=observation))
        assert torch.allclose(found, away)


def test_it_conforms(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """With short episodes, as most of the time is play."""
    monkeypatch.setitem(coverage.PRESETS, "flat", coverage.PRESETS["flat"]._replace(episode=7))
    assert run_rhmc("conformance", "hungarian.coordinator", "--steps", "3000") == 0
    assert "16 checks hold, 0 do not, 0 left out" in capsys.readouterr().out


@pytest.mark.parametrize("variant", [None, "navigation"])
def test_its_study_has_no_fault_and_both_arms_train(variant: str | None) -> None:
    assert run_rhmc("study", "check", FILE, *(["--variant", variant] if variant else [])) == 0
    learned, own = (run.spec for run in Study.load(FILE, "quick", SHORT, variant).runs() if run.spec.seed == 0)
    ends = [list(Trainer(spec.env, spec.algo, spec.trainer, 0))[-1]["final/return"] for spec in (learned, own)]
    assert ends[0] != ends[1]


def test_a_run_is_named_by_the_package_of_its_coordinator_and_others_are_not() -> None:
    before, study = code_id("rhmc", "coverage"), Study.load(FILE)
    learned, own = (run.spec for run in study.runs() if run.spec.seed == 0)
    assert (learned.imports, own.imports) == ((), ("hungarian.coordinator",))
    assert code_id("rhmc", "coverage", learned.imports) == before
    assert code_id("rhmc", "coverage", own.imports) != before
    codes = [item.card.fingerprint for item in items(study) if item.spec.seed == 0]
    assert codes == [before, code_id("rhmc", "coverage", own.imports)]
    assert {*codes} <= present()
    found = modules("rhmc", "coverage", own.imports)
    assert [name for name in found if name.startswith("hungarian")] == ["hungarian.coordinator"]
    assert RunSpec.model_validate_json(own.canonical()) == own
    assert '"method":"hungarian"' in own.stated()
    assert "method" not in RunSpec.model_validate(PLAIN).stated().replace('"executor":{"method"', "")


def test_a_record_imports_nothing_that_nobody_has_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"'hungarian\.coordinator', which nobody has named here: if you trust"):
        RunSpec.model_validate(OWN | {"imports": ["hungarian.coordinator"]})
    with pytest.raises(ValueError, match="'hungarian' is not allowed; allowed: learned"):
        RunSpec.model_validate(OWN)
    monkeypatch.setenv("RHMC_IMPORTS", "hungarian.coordinator")
    assert RunSpec.model_validate(OWN).imports == ("hungarian.coordinator",)
    with pytest.raises(InputError, match="made with 'other', and its method and task are here of hungarian"):
        RunSpec.model_validate(OWN | {"imports": ["other"]})


@pytest.mark.parametrize(
    ("override", "said"),
    [
        (
            "arms.Hungarian.algo.coordinator.method=hungarain",
            "arms.Hungarian.algo.coordinator.method: 'hungarain' is not allowed; allowed: learned, hungarian; "
            "did you mean 'hungarian'?",
        ),
        (
            "arms.Hungarian.algo.coordinator.method=3",
            "arms.Hungarian.algo.coordinator.method: 3 is not allowed; must be",
        ),
    ],
)
def test_a_name_that_is_not_there_is_one_line_with_those_that_are(override: str, said: str) -> None:
    with pytest.raises(StudyError) as caught:
        Study.load(FILE, "quick", [override])
    assert [said in str(caught.value), "\n" in str(caught.value)] == [True, False]


def test_a_task_that_it_does_not_know_is_a_fault_of_the_study(tmp_path: Path) -> None:
    from pipelines.conformance import toy

    Study.load(FILE)
    wrong = COORDINATORS["hungarian"].misfit(toy.spec(toy.Config())._replace(pair_features=7))
    assert wrong.startswith("observation: 'hungarian' knows")
    register_coordinator("picky", Coordination(COORDINATORS["hungarian"].build, lambda spec: "observation: not this"))
    with pytest.raises(StudyError, match=re.escape("not this")):
        Study.load(FILE, "quick", ["arms.Hungarian.algo.coordinator.method=picky"])
    spec = RunSpec.model_validate(PLAIN | {"algo": {"kind": "rhmc", "coordinator": {"method": "picky"}}})
    with pytest.raises(ValueError, match="not this"):
        Trainer(spec.env, spec.algo, spec.trainer, 0)


def test_a_name_is_given_once() -> None:
    Study.load(FILE)
    with pytest.raises(ValueError, match="'learned' is registered already"):
        register_coordinator("learned", COORDINATORS["hungarian"])


def test_a_search_that_may_choose_it_has_its_package_in_the_code_of_its_trials(tmp_path: Path) -> None:
    Study.load(FILE)
    file = tmp_path / "search_x.yaml"
    text = (
        "base: {env: {kind: coverage}, algo: {kind: rhmc}}\n"
        "arms: {R: {space: {coordinator.method: {choices: [learned, hungarian]}}}}\n"
        "trials: 2\nseeds: 1\nsteps: 100_000\nquestion: Which?\n"
    )
    file.write_text(text)
    with_it = Search.load(file, "quick", []).code("R")
    file.write_text(text.replace("coordinator.method: {choices: [learned, hungarian]}", "horizon: {choices: [1, 2]}"))
    without = Search.load(file, "quick", []).code("R")
    assert with_it == code_id("rhmc", "coverage", ("hungarian.coordinator",)) != without == code_id("rhmc", "coverage")


def test_no_learning_is_waited_for_where_the_coordinator_does_not_learn() -> None:
    Study.load(FILE)
    algo = {"kind": "rhmc", "coordinator": {"method": "hungarian", "update_every": 20_000}}
    assert len(starts(RunSpec.model_validate(PLAIN | {"algo": algo}))) == 1


def test_a_reason_that_names_no_field_is_shown_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = "needs as many agents as targets: 3 and 3"
    monkeypatch.setitem(COORDINATORS, "even", COORDINATORS["learned"]._replace(misfit=lambda spec: text))
    file = tmp_path / "x.yaml"
    file.write_text(
        "question: Why?\nbase: {env: {kind: coverage}, algo: {kind: rhmc, coordinator: {method: even}}}\n"
        "arms: {a: {}, b: {algo: {alpha: 0.2}}}\nseeds: 1\nsteps: 1_000_000\n"
    )
    with pytest.raises(StudyError) as caught:
        Study.load(file)
    assert {str(fault).partition("base.env: ")[2] for fault in caught.value.faults} == {text}
