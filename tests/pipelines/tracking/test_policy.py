"""Policies that were saved: read back they act as they did, also out of MLflow's registry in another process."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Generator, Tensor

from pipelines.specs.study import RunSpec
from pipelines.tracking import policy
from pipelines.tracking.mlflow_tracker import MlflowTracker
from pipelines.tracking.plan import resolved_yaml, study_card
from pipelines.tracking.policy import Actor, Saved
from pipelines.tracking.tracker import Card, StudyCard
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import Home, StoreError, save_atomically, without_replay
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import make_env
from rhmc.training.trainer import Trainer
from rhmc.types import Obs
from tests.depth import covering
from tests.pipelines.support import plan, spec, tiny

COVERAGE = {"kind": "coverage", "agents": 2, "targets": 3}
NAVIGATION = {"kind": "navigation", "agents": 2, "continuous": True, "episode": 6}
HELD = {"rhmc": {"assignment_period": 3}, "hitmac": {"pretrain": 0}}  # what makes a method remember


def run(kind: str, env: dict[str, Any] = COVERAGE) -> RunSpec:
    """A run of few copies."""
    trainer = {"steps": 40, "num_envs": 4, "evaluations": 1}
    return RunSpec.model_validate(
        {"env": env, "algo": {"kind": kind, "hidden_dim": 8, **HELD.get(kind, {})}, "trainer": trainer, "seed": 5}
    )


def episode(trainer: Trainer, batch: int = 3, steps: int = 8) -> tuple[list[Obs], list[Tensor]]:
    """Observations on the way of the trainer's greedy policy, and its actions."""
    rng = Generator().manual_seed(1)
    env, carry = make_env(trainer.env_cfg, batch, rng), trainer.algorithm.carry(batch)
    seen, done = [env.reset()], list[Tensor]()
    with torch.no_grad():
        for _ in range(steps):
            action, carry, extra = trainer.algorithm.act(seen[-1], carry, rng, explore=False)
            done.append(action)
            seen.append(env.step(action, extra.get("assignment")).obs)
    return seen[:-1], done


def made(one: RunSpec) -> Trainer:
    return Trainer(one.env, one.algo, one.trainer, one.seed)


@pytest.mark.parametrize("kind", ALGORITHMS)
def test_a_saved_policy_acts_as_the_trainer_evaluates(kind: str, tmp_path: Path) -> None:
    one = run(kind)
    trainer = made(one)
    policy.save(tmp_path / "policy.pt", Saved(one, trainer.state_dict()["algorithm"]))
    before = torch.get_rng_state()
    actor = Actor(policy.load(tmp_path / "policy.pt"))
    assert torch.equal(torch.get_rng_state(), before)
    seen, done = episode(trainer)
    for obs, action in zip(seen, done, strict=True):
        assert torch.equal(actor.act(obs)[0], action)


def test_a_continuous_policy(tmp_path: Path) -> None:
    one = run("maddpg", NAVIGATION)
    trainer = made(one)
    actor = Actor(Saved(one, trainer.state_dict()["algorithm"]))
    seen, done = episode(trainer, steps=4)
    assert done[0].shape == (3, 2, 2)
    assert all(torch.equal(actor.act(obs)[0], action) for obs, action in zip(seen, done, strict=True))


def test_another_batch_begins_anew() -> None:
    one = run("rhmc")
    actor = Actor(Saved(one, made(one).state_dict()["algorithm"]))
    many = episode(made(one), batch=3)[0]
    for obs in many[:2]:
        actor.act(obs)
    alone = many[2]._replace(**{name: part[:1] for name, part in many[2]._asdict().items()})
    assert not alone.first.any()
    assigned = actor.act(alone)[1]["assignment"]
    fresh = actor.algorithm.coordinator.assign(alone, Generator(), explore=False)  # type: ignore[attr-defined]
    assert torch.equal(assigned, fresh)


# Files


def state_of(one: RunSpec) -> dict[str, Any]:
    return without_replay(made(one).state_dict())


def test_a_file_of_an_earlier_version_needs_the_configuration_beside_it(tmp_path: Path) -> None:
    item = plan()[0]
    save_atomically(tmp_path / "policy.pt", state_of(item.spec))
    with pytest.raises(InputError, match=r"policy\.pt: does not say which run it is of, and there is no config\.yaml"):
        policy.load(tmp_path / "policy.pt")
    (tmp_path / "config.yaml").write_text(resolved_yaml(item, study_card(tiny())))
    assert policy.load(tmp_path).spec == item.spec


def test_the_newest_checkpoint_of_a_folder_is_read(tmp_path: Path) -> None:
    one = spec()
    for point in (1, 2):
        state = state_of(one) | {"step": point}
        save_atomically(tmp_path / f"{point:08d}.pt", {"trainer": state, "spec": one.canonical()})
    assert policy.load(tmp_path).spec == one
    assert policy.load(tmp_path).reached == "at step 2"
    (tmp_path / "00000002.pt").write_bytes(b"cut short")
    assert policy.load(tmp_path).reached == "at step 1"
    (tmp_path / "00000001.pt").unlink()
    with pytest.raises(InputError, match=r"00000002\.pt: not a readable checkpoint"):
        policy.load(tmp_path)


def test_what_is_no_policy(tmp_path: Path) -> None:
    (tmp_path / "text.pt").write_text("no weights")
    save_atomically(tmp_path / "other.pt", {"a": 1})
    save_atomically(tmp_path / "odd.pt", {"algorithm": {}, "spec": '{"env": {"kind": "chess"}}'})
    (tmp_path / "empty").mkdir()
    for name, said in {
        "text.pt": "text.pt: not a readable checkpoint",
        "other.pt": "other.pt: readable, but not a checkpoint of a run",
        "odd.pt": "odd.pt: not the settings of a run that this code knows",
        "empty": "empty: no policy.pt and no checkpoint in this folder",
        "none.pt": "none.pt: no such file",
    }.items():
        with pytest.raises(InputError) as caught:
            policy.load(tmp_path / name)
        assert str(caught.value).startswith(f"{tmp_path}/{said}")
        assert "\n" not in str(caught.value)


def test_a_state_of_other_code_is_refused() -> None:
    state = made(run("iql")).state_dict()["algorithm"]
    with pytest.raises(ValueError, match="no state of 'vdn' as this code has it"):
        Actor(Saved(run("vdn"), {**state, "q": {}}))


# The registry

CARD = Card("no filter, 1", 5, "5pec", "c0de", "rhmc", "coverage", "abc", {"seed": "5"})
STUDY = StudyCard("demo", "quick", "")

LOAD = """
import sys, torch
import mlflow
mlflow.set_tracking_uri(sys.argv[1])
model = mlflow.pyfunc.load_model(f"models:/{sys.argv[4]}@seed-5")
seen = torch.load(sys.argv[2], weights_only=True)
torch.save([torch.from_numpy(model.predict({k: v.numpy() for k, v in obs.items() if v.numel()})) for obs in seen],
           sys.argv[3])
"""


def test_a_registered_policy_acts_in_a_fresh_process_as_the_trainer_evaluates(home: Path, tmp_path: Path) -> None:
    one = run("rhmc")
    trainer = made(one)
    policy.save(tmp_path / "policy.pt", Saved(one, trainer.state_dict()["algorithm"]))
    tracker = MlflowTracker(STUDY, Home(home))
    log = tracker.start(CARD)
    log.model(tmp_path / "policy.pt")
    log.model(tmp_path / "policy.pt")
    (version,) = tracker.client.search_model_versions()
    assert re.fullmatch("demo-quick-no-filter-1-[0-9a-f]{8}", version.name)
    assert (version.run_id, version.tags["seed"]) == (log.ref, "5")
    tracker.start(CARD._replace(seed=6, spec_id="0ther")).model(tmp_path / "policy.pt")
    versions = tracker.client.search_model_versions(f"name = '{version.name}'")
    assert sorted(int(v.version) for v in versions) == [1, 2]
    outputs = tracker.client.get_run(log.ref).outputs.model_outputs
    assert [f"/{output.model_id}/" in version.source for output in outputs] == [True]

    seen, done = episode(trainer)
    torch.save([obs._asdict() for obs in seen], tmp_path / "seen.pt")
    words = [sys.executable, "-W", "ignore", "-c", LOAD, tracker.uri, str(tmp_path / "seen.pt"), str(tmp_path / "a.pt")]
    words.append(version.name)
    subprocess.run(words, check=True)
    actions = torch.load(tmp_path / "a.pt", weights_only=True)
    assert len(actions) == len(done)
    assert all(torch.equal(given, wanted) for given, wanted in zip(actions, done, strict=True))


STEPS = (
    *("create_logged_model", "log_model_artifacts", "finalize_logged_model", "log_outputs", "create_registered_model"),
    *("create_model_version", "set_registered_model_alias", "set_logged_model_tags"),
)


@pytest.mark.parametrize(("step", "done"), covering(STEPS, [False, True]))
def test_a_launch_killed_at_any_step_of_registering_leaves_one_model_to_the_next(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, done: bool
) -> None:
    one = run("iql")
    policy.save(tmp_path / "policy.pt", Saved(one, made(one).state_dict()["algorithm"]))
    tracker = MlflowTracker(STUDY, Home(home))
    client, log = tracker.client, tracker.start(CARD)
    real = getattr(client, step)

    def killed(*args: object, **options: object) -> None:
        if done:
            real(*args, **options)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(client, step, killed)
        with pytest.raises(KeyboardInterrupt):
            log.model(tmp_path / "policy.pt")
    log.model(tmp_path / "policy.pt")
    (version,) = client.search_model_versions()
    (model,) = client.search_logged_models([tracker.experiment])
    (output,) = client.get_run(log.ref).outputs.model_outputs
    assert (output.model_id, model.status, f"/{model.model_id}/" in version.source) == (model.model_id, "READY", True)
    assert client.get_model_version_by_alias(version.name, "seed-5").version == version.version
    assert version.name in model.tags["mlflow.modelVersions"]


def test_a_version_that_a_dying_server_made_twice_is_kept_once(home: Path, tmp_path: Path) -> None:
    one = run("iql")
    policy.save(tmp_path / "policy.pt", Saved(one, made(one).state_dict()["algorithm"]))
    tracker = MlflowTracker(STUDY, Home(home))
    log = tracker.start(CARD)
    log.model(tmp_path / "policy.pt")
    (version,) = tracker.client.search_model_versions()
    tracker.client.create_model_version(version.name, version.source, log.ref)
    log.model(tmp_path / "policy.pt")
    assert [found.version for found in tracker.client.search_model_versions()] == [version.version]


def test_a_policy_that_cannot_be_read_is_a_fault_of_the_store(home: Path, tmp_path: Path) -> None:
    (tmp_path / "policy.pt").write_bytes(b"weights")
    tracker = MlflowTracker(STUDY, Home(home))
    with pytest.raises(StoreError, match=r"policy\.pt: not a readable checkpoint"):
        tracker.start(CARD).model(tmp_path / "policy.pt")
    assert tracker.client.search_registered_models() == []
