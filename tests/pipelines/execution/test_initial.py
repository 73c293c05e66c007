"""Runs that start from a trained policy: where they begin, what names them, and that they go on without it."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from ruamel.yaml import YAML

from pipelines.execution.seed_group import Seeds
from pipelines.execution.trainable import RunTrainable
from pipelines.policies.evaluation import EvaluationEpisodes, Policy, score
from pipelines.specs.study import RunSpec, Setting, Study, StudyError
from pipelines.tracking.initial import begun, digest, finder, keep, kept
from pipelines.tracking.mlflow_tracker import MlflowTracker
from pipelines.tracking.plan import items, study_card
from pipelines.tracking.policy import Saved, load, save
from pipelines.workspace.work_folder import Home, StoreError
from rhmc.learning.initial import learned, started
from rhmc.training.trainer import Trainer
from rhmc.types import Metrics, State
from tests.pipelines.support import setting, tiny

Load = Callable[..., Study]

PLAIN = {"kind": "mappo", "encoder": "pairwise", "hidden_dim": 8, "n_steps": 5, "minibatches": 1, "epochs": 1}
SHORT = {"num_envs": 8, "evaluations": 2, "eval_episodes": 4, "final_episodes": 4}


def fields(**changes: Any) -> dict[str, Any]:
    """A study's base: MAPPO, whose critic is normalised, in navigation."""
    env = {"kind": "navigation", "agents": 2, "episode": 7} | changes.get("env", {})
    return {"env": env, "algo": PLAIN | changes.get("algo", {}), "trainer": SHORT | changes.get("trainer", {})}


def policy(seed: int = 0, **changes: Any) -> Saved:
    """Of a run of 400 steps."""
    tree = fields(**changes)
    one = RunSpec.model_validate(tree | {"trainer": tree["trainer"] | {"steps": 400}, "seed": seed})
    trainer = Trainer(one.env, one.algo, one.trainer, one.seed)
    list(trainer)
    return Saved(one, trainer.algorithm.state_dict())


@pytest.fixture(scope="module")
def trained() -> Saved:
    """Not to be changed."""
    return policy()


@pytest.fixture
def study(home: Path, tmp_path: Path) -> Load:
    """Writes and loads a study whose base starts from `init`."""

    def write(init: str | None = "p.pt", **changes: Any) -> Study:
        tree = fields(**changes)
        tree["trainer"] |= {"init": init} if init else {}
        text = {"question": "Which?", "base": tree, "arms": {"a": {}}, "seeds": 1, "steps": 400}
        with (tmp_path / "x.yaml").open("w") as file:
            YAML(typ="safe").dump(text, file)
        return Study.load(tmp_path / "x.yaml", find=finder(home))

    return write


def the_run(study: Study) -> RunSpec:
    (run,) = study.runs()
    return run.spec


def job(spec: RunSpec, home: Path, folder: Path) -> RunTrainable:
    fixed = {"key": "run", "spec": spec.canonical(), "folder": str(folder / "run"), "stop": str(folder / "stop")}
    return RunTrainable({"job": fixed | {"checkpoint_every": 1, "home": str(home)}})


def points(run: RunTrainable) -> list[Metrics]:
    """To the end; clocks aside."""
    found: list[dict[str, Any]] = [run.step()]
    while not found[-1]["done"]:
        found.append(run.step())
    assert not found[-1].get("error"), found[-1]
    return [{k: v for k, v in p.items() if not k.startswith("time/")} for one in found for p in one["points"]]


def test_training_starts_from_the_score_of_the_policy(study: Load, trained: Saved, home: Path, tmp_path: Path) -> None:
    save(tmp_path / "p.pt", trained)
    plan = study()
    spec = the_run(plan)
    keep(plan.policies, home)
    first = next(begun(spec, home))
    own = EvaluationEpisodes(spec.trainer.eval_episodes, spec.trainer.eval_seed)
    there = score(Policy("a", load(tmp_path / "p.pt")), own).values
    assert {name: first[f"eval/{name}"] for name in there} == there
    drawn = next(Trainer(spec.env, spec.algo, spec.trainer.model_copy(update={"init": None}), spec.seed))
    assert first["eval/return"] != drawn["eval/return"]
    with pytest.raises(ValueError, match=f"^init: the run starts from policy {spec.trainer.init}; give it"):
        next(Trainer(spec.env, spec.algo, spec.trainer, spec.seed))


def test_networks_and_statistics_are_taken_over_and_nothing_else(trained: Saved) -> None:
    one = trained.spec
    trainer = Trainer(one.env, one.algo, one.trainer, 5)
    before = trainer.algorithm.state_dict()
    rng, actor = before["rng"].clone(), before["actor"]["net"]
    other = {name: value.clone() for name, value in actor.items()}
    trainer.start_from(trained.algorithm)
    after = trainer.algorithm.state_dict()
    for name in ("actor", "critic"):
        for part in ("net", "target_net"):
            given = trained.algorithm[name][part]
            assert all(torch.equal(given[key], after[name][part][key]) for key in given)
        assert after[name]["optimiser"]["state"] == {}
    assert any(not torch.equal(value, after["actor"]["net"][name]) for name, value in other.items())
    assert torch.equal(after["standardiser"]["sums"], trained.algorithm["standardiser"]["sums"])
    assert torch.equal(after["rng"], rng)
    next(trainer)
    with pytest.raises(ValueError, match="a policy is where it starts from"):
        trainer.start_from(trained.algorithm)


def test_a_policy_that_only_acts_leaves_the_rest_as_it_was_drawn(trained: Saved) -> None:
    one = trained.spec
    own = Trainer(one.env, one.algo, one.trainer, 5).algorithm.state_dict()
    acting: State = {"actor": {"net": trained.algorithm["actor"]["net"]}}
    merged = started(own, acting)
    assert merged["critic"] is own["critic"]
    assert merged["actor"]["target_net"] is acting["actor"]["net"]
    assert learned({"rng": own["rng"], "rollout": {"rows": []}}) == {}


def test_the_id_is_of_the_policy_and_not_of_its_address(
    study: Load, trained: Saved, home: Path, tmp_path: Path
) -> None:
    save(tmp_path / "p.pt", trained)
    (tmp_path / "moved").mkdir()
    shutil.copy(tmp_path / "p.pt", tmp_path / "moved" / "policy.pt")
    ids = {the_run(study(init)).id for init in ("p.pt", "moved", str(tmp_path / "moved" / "policy.pt"))}
    assert len(ids) == 1
    assert "p.pt" not in the_run(study()).canonical()
    assert the_run(study(None)).id not in ids
    assert "init" not in the_run(study(None)).canonical()
    changed = trained.algorithm["critic"]["net"]["head.0.bias"].clone()
    changed[0] = torch.nextafter(changed[0], torch.tensor(9.0))
    net = trained.algorithm["critic"]["net"] | {"head.0.bias": changed}
    critic = trained.algorithm["critic"] | {"net": net}
    save(tmp_path / "p.pt", trained._replace(algorithm=trained.algorithm | {"critic": critic}))
    assert the_run(study()).id not in ids


def test_killed_and_continued_it_gives_equal_bits_and_needs_no_policy_again(
    study: Load, trained: Saved, home: Path, tmp_path: Path
) -> None:
    save(tmp_path / "p.pt", trained)
    plan = study()
    spec = the_run(plan)
    keep(plan.policies, home)
    whole = points(job(spec, home, tmp_path / "whole"))
    begun_once = job(spec, home, tmp_path / "cut")
    begun_once.step(), begun_once.step()
    begun_once.cleanup()
    os.unlink(tmp_path / "p.pt")
    again = study()  # its address is gone, and what was there is known
    assert the_run(again).id == spec.id
    assert any("not there any more: the copy in the work folder is used" in remark for remark in again.remarks)
    shutil.rmtree(home / "policies")
    assert points(job(spec, home, tmp_path / "cut")) == whole
    result = job(spec, home, tmp_path / "late").step()
    assert result["error"].startswith(f"trainer.init: no copy of policy {spec.trainer.init} that is whole in ")
    with pytest.raises(StudyError, match=r"base.trainer.init: 'p.pt' is not allowed; .*p.pt: no such file"):
        study()


def test_a_copy_that_changed_and_a_policy_that_changed_meanwhile_are_refused(
    study: Load, trained: Saved, home: Path, tmp_path: Path
) -> None:
    save(tmp_path / "p.pt", trained)
    plan = study()
    name = str(the_run(plan).trainer.init)
    other = policy(seed=1)
    save(tmp_path / "p.pt", other)
    with pytest.raises(StoreError, match=r"p\.pt: has changed meanwhile; launch again"):
        keep(plan.policies, home)
    save(Home(home).root / "policies" / f"{name}.pt", other)
    with pytest.raises(StoreError, match="holds another policy; move it away"):
        kept(name, home)
    assert digest(other.algorithm) != name == digest(trained.algorithm)
    with pytest.raises(StudyError, match=f"'{name}' is not allowed; trainer.init: "):
        study(name)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"algo": {"kind": "ippo"}}, "algo.kind is 'mappo' there and 'ippo' here"),
        ({"algo": {"encoder": "mlp"}}, "algo.encoder is 'pairwise' there and 'mlp' here"),
        ({"algo": {"standardise": "none"}}, "algo.standardise is 'return' there and 'none' here"),
        ({"env": {"observation": "extended"}}, "env.observation is 'paper' there and 'extended' here"),
        (
            {"algo": {"hidden_dim": 4}},
            r"actor.net.body.pairs.pair.weight: \(8, 2\) in the policy, \(4, 2\) in this run; "
            "settings that differ: algo.hidden_dim",
        ),
        (
            {"algo": {"share": False}, "env": {"agents": 3}},
            "2 agents and 2 targets there and 3 agents and 3 targets here; only 'encoder: pairwise' or 'pairwise_gru', "
            "with 'share: true'",
        ),
    ],
)
def test_what_does_not_fit_is_one_line_at_its_place(
    changes: dict[str, Any], said: str, study: Load, trained: Saved, tmp_path: Path
) -> None:
    save(tmp_path / "p.pt", trained)
    with pytest.raises(StudyError, match=rf"x.yaml:\d+:\d+: base.trainer.init: the policy does not fit: {said}") as one:
        study(**changes)
    assert len(str(one.value).splitlines()) == 1


def test_another_task_does_not_fit_and_other_numbers_do(
    study: Load, trained: Saved, home: Path, tmp_path: Path
) -> None:
    save(tmp_path / "p.pt", trained)
    larger = study(env={"agents": 3})
    keep(larger.policies, home)
    first = next(begun(the_run(larger), home))
    own = EvaluationEpisodes(4, the_run(larger).trainer.eval_seed, agents=3)
    assert first["eval/return"] == score(Policy("a", trained), own).values["return"]
    save(tmp_path / "p.pt", trained._replace(spec=trained.spec.model_copy(update={"env": setting_of_coverage().env})))
    with pytest.raises(StudyError, match=r"env\.kind is 'coverage' there and 'navigation' here"):
        study()


def setting_of_coverage() -> Setting:
    return Setting.model_validate(fields() | {"env": {"kind": "coverage"}})


def test_a_run_of_the_log_and_a_model_are_addresses(study: Load, trained: Saved, home: Path, tmp_path: Path) -> None:
    log = tiny("made", arms={"a": setting()})
    tracker = MlflowTracker(study_card(log), Home(home))
    run = tracker.start(items(log)[0].card)
    save(tmp_path / "policy.pt", trained)
    run.artifact(tmp_path / "policy.pt")
    run.finish("finished")
    tracker.client.create_registered_model("made-quick-a")
    tracker.client.create_model_version("made-quick-a", "file:///nowhere", run.ref)
    by = [the_run(study(init)).id for init in ("policy.pt", f"runs:/{run.ref}", "models:/made-quick-a/1")]
    assert len(set(by)) == 1
    for init, said in {
        "models:/made-quick-b/1": r"no model 'made-quick-b' in the registry; .* did you mean 'made-quick-a'\?",
        "models:/made-quick-a/2": "model 'made-quick-a' has no version 2; allowed: 1",
        "models:/made-quick-a": "no such form of an address; allowed: a file, a folder, runs:/ID",
        f"runs:/{'0' * 32}": "MLflow cannot go on: Run with id=0+ not found",
        "policy.p": r"policy.p: no such file; did you mean 'policy.pt'\?",
    }.items():
        with pytest.raises(StudyError, match=said):
            study(init)


def test_a_grid_takes_policies_and_two_addresses_of_one_are_one_arm(trained: Saved, home: Path, tmp_path: Path) -> None:
    save(tmp_path / "p.pt", trained)
    save(tmp_path / "q.pt", policy(seed=1))
    shutil.copy(tmp_path / "p.pt", tmp_path / "r.pt")
    text = {"question": "Which?", "base": fields(), "seeds": 1, "steps": 400}

    def load(*names: str) -> Study:
        with (tmp_path / "x.yaml").open("w") as file:
            YAML(typ="safe").dump(text | {"grid": {"trainer.init": list(names)}}, file)
        return Study.load(tmp_path / "x.yaml", find=finder(home))

    assert [arm.trainer.init for arm in load("p.pt", "q.pt").arms.values()] == list(load("p.pt", "q.pt").policies)
    with pytest.raises(StudyError, match="is there twice"):
        load("p.pt", "r.pt")


def test_every_seed_of_a_trial_starts_from_the_policy(trained: Saved) -> None:
    one = Setting.model_validate(fields(trainer={"steps": 400, "init": digest(trained.algorithm)}))
    seeds = Seeds(one, [0, 1])
    seeds.start_from(trained.algorithm)
    first, second = (next(trainer) for trainer in seeds.trainers.values())
    assert first["eval/return"] == second["eval/return"]
