"""Trained policies are played as the trainer played them, and elsewhere."""

import shutil
from pathlib import Path

import pytest

from pipelines.policies.evaluation import EvaluationEpisodes, Policy, of_file, of_study, score
from pipelines.specs.study import RunSpec, Study
from pipelines.tracking.mlflow_tracker import MlflowTracker
from pipelines.tracking.plan import items, resolved_yaml, study_card
from pipelines.tracking.policy import Saved, load, save
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import Checkpoints, Home, save_atomically, without_replay
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import coverage
from rhmc.training.trainer import Trainer
from rhmc.types import Metrics
from tests.pipelines.support import setting, spec, tiny


@pytest.fixture(autouse=True)
def _short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(coverage.PRESETS, "flat", coverage.PRESETS["flat"]._replace(episode=7))


def trained(one: RunSpec) -> tuple[Trainer, Metrics]:
    """A finished run and its last point."""
    trainer = Trainer(one.env, one.algo, one.trainer, one.seed)
    return trainer, list(trainer)[-1]


def final(point: Metrics) -> Metrics:
    return {name.removeprefix("final/"): value for name, value in point.items() if name.startswith("final/")}


def of_kind(kind: str, encoder: str) -> RunSpec:
    """In coverage, where agents and targets have numbers of their own."""
    fields = {"kind": kind, "encoder": encoder, "hidden_dim": 8}
    algo = ALGORITHMS[kind].config.model_validate(fields)
    one = setting().model_copy(update={"env": coverage.Config(agents=2, targets=2), "algo": algo})
    budget = one.trainer.model_copy(update={"steps": 64, "evaluations": 1})
    return RunSpec(**dict(one.model_copy(update={"trainer": budget})), seed=1)


@pytest.fixture
def policy(tmp_path: Path) -> tuple[Path, Metrics]:
    """A kept policy with its config beside it, and the run's last point."""
    trainer, last = trained(spec())
    item = items(tiny())[0]._replace(spec=spec())
    save_atomically(tmp_path / "policy.pt", without_replay(trainer.state_dict()))
    (tmp_path / "config.yaml").write_text(resolved_yaml(item, study_card(tiny())))
    return tmp_path / "policy.pt", last


def test_a_kept_policy_scores_what_its_run_ended_with(policy: tuple[Path, Metrics]) -> None:
    file, last = policy
    found = score(of_file(file, None), EvaluationEpisodes())
    assert found.values == final(last)
    assert (found.arm, found.seed, found.source, found.episodes) == ("slow", 0, "finished", 8)
    assert (found.task["agents"], found.task["kind"], found.changed) == (2, "navigation", {})
    assert found.values["return_sem"] > 0


def test_other_episodes_are_another_score_and_more_episodes_a_smaller_error(policy: tuple[Path, Metrics]) -> None:
    file, last = policy
    other = score(of_file(file, None), EvaluationEpisodes(seed=7)).values
    assert other["return"] != last["final/return"]
    assert score(of_file(file, None), EvaluationEpisodes(episodes=200)).values["return_sem"] < other["return_sem"]


@pytest.mark.parametrize("kind", ALGORITHMS)
def test_every_method_acts_with_other_numbers_on_the_pairwise_encoder_only(kind: str) -> None:
    for encoder in ("pairwise", "mlp"):
        one = of_kind(kind, encoder)
        trainer, last = trained(one)
        policy = Policy("a", Saved(one, without_replay(trainer.state_dict())["algorithm"]))
        assert score(policy, EvaluationEpisodes()).values == final(last)
        if encoder == "pairwise":
            found = [
                score(policy, EvaluationEpisodes(agents=n, targets=m)).values["return"] for n, m in ((3, 4), (5, 2))
            ]
            assert len({last["final/return"], *found}) == 3
            played = score(policy, EvaluationEpisodes(episodes=2, seed=7, agents=3))
            assert played.changed == {"agents": 3, "episodes": 2, "eval_seed": 7}
            assert (played.task["agents"], played.task["targets"], played.eval_seed) == (3, 2, 7)
        else:
            with pytest.raises(InputError, match="acts only with the numbers that it was trained with"):
                score(policy, EvaluationEpisodes(agents=3, targets=4))


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        (EvaluationEpisodes(agents=9), "--agents: 9 sensors need as many boxes, and there are 6"),
        (EvaluationEpisodes(targets=0), "--targets: 0 is not allowed; must be greater than or equal to 1"),
    ],
)
def test_a_task_that_cannot_be_is_named_by_its_option(wanted: EvaluationEpisodes, said: str) -> None:
    one = of_kind("iql", "pairwise")
    with pytest.raises(InputError) as error:
        score(Policy("a", Saved(one, trained(one)[0].state_dict()["algorithm"])), wanted)
    assert str(error.value) == said


def test_a_study_gives_the_policies_of_its_runs(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study: Study = tiny(points=2, arms={"done": setting(), "half": setting(lr=1e-2), "none": setting(lr=1.0)})
    done, half, _ = items(study)
    tracker = MlflowTracker(study_card(study), Home(home))
    trainer, last = trained(done.spec)
    save_atomically(tmp_path / "policy.pt", without_replay(trainer.state_dict()))
    run = tracker.start(done.card)
    run.artifact(tmp_path / "policy.pt")
    run.finish("finished")
    tracker.close("interrupted")
    begun = Trainer(half.spec.env, half.spec.algo, half.spec.trainer, half.spec.seed)
    next(begun), next(begun)
    Checkpoints(Home(home).checkpoints(half.key)).save(
        2, {"trainer": begun.state_dict(), "history": [], "seconds": 0.0}
    )

    found = list(of_study(study, home))
    assert [(one.arm, one.saved.reached) for one in found] == [("done", "finished"), ("half", "at step 200")]
    assert score(found[0], EvaluationEpisodes()).values == final(last)
    assert [one.arm for one in of_study(study, home, ["half"])] == ["half"]
    for given, said in [
        ((["hal"], []), r"--arm: 'hal' is not allowed; allowed: done, half, none; did you mean 'half'\?"),
        (([], [3]), r"tiny \(quick\): no such run has a policy yet"),
        ((["none"], []), r"tiny \(quick\): no such run has a policy yet"),
    ]:
        with pytest.raises(InputError, match=said):
            list(of_study(study, home, *given))


def test_a_damaged_policy_of_the_log_is_named_by_its_run(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = tiny()
    tracker = MlflowTracker(study_card(study), Home(home))
    run = tracker.start(items(study)[0].card)
    (tmp_path / "policy.pt").write_bytes(b"weights")
    run.artifact(tmp_path / "policy.pt")
    run.finish("finished")
    with pytest.raises(InputError) as error:
        list(of_study(study, home))
    assert str(error.value) == f"tiny / slow s0: the policy.pt that its run {run.ref} keeps is damaged"


def test_a_run_under_way_is_read_and_left_alone(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = tiny(points=2)
    item = items(study)[0]
    trainer = Trainer(item.spec.env, item.spec.algo, item.spec.trainer, item.spec.seed)
    checkpoints = Checkpoints(Home(home).checkpoints(item.key))
    next(trainer)
    checkpoints.save(1, {"trainer": trainer.state_dict(), "history": [], "seconds": 0.0})
    (checkpoints.folder / "00000002.pt").write_bytes(b"cut short")
    (checkpoints.folder / "00000003.pt.17.part").write_bytes(b"being written")
    (found,) = of_study(study, home)
    assert found.saved.reached == "at step 0"
    assert {file.name for file in checkpoints.folder.iterdir()} == {"00000001.pt", "00000002.pt", "00000003.pt.17.part"}


def test_a_policy_that_names_its_run_needs_no_config_and_takes_its_arm_from_one(
    policy: tuple[Path, Metrics], tmp_path: Path
) -> None:
    file, last = policy
    save(tmp_path / "alone.pt", load(file))
    (tmp_path / "sub").mkdir()
    shutil.copy(tmp_path / "alone.pt", tmp_path / "sub")
    found = score(of_file(tmp_path / "sub" / "alone.pt", None), EvaluationEpisodes())
    assert (found.arm, found.source, found.values) == ("iql", "finished", final(last))
    assert of_file(tmp_path / "alone.pt", None).arm == "slow"
    (tmp_path / "config.yaml").write_text((tmp_path / "config.yaml").read_text().replace("seed: 0", "seed: 7"))
    assert of_file(tmp_path / "alone.pt", None).arm == "iql"  # of another run
    assert of_file(tmp_path / "alone.pt", tmp_path / "config.yaml").saved.spec.seed == 7


def test_a_state_of_other_code_is_one_line(policy: tuple[Path, Metrics]) -> None:
    file, _ = policy
    saved = load(file)
    with pytest.raises(InputError, match=r"^slow s0: no state of 'iql' as this code has it \("):
        score(Policy("slow", saved._replace(algorithm=saved.algorithm | {"q": {}})), EvaluationEpisodes())


def test_files_that_are_no_policy(policy: tuple[Path, Metrics], tmp_path: Path) -> None:
    file, _ = policy
    (tmp_path / "x.pt").write_bytes(file.read_bytes()[:500])
    save_atomically(tmp_path / "y.pt", {"a": 1})
    for name, said in [
        ("x.pt", "x.pt: not a readable checkpoint"),
        ("y.pt", "y.pt: readable, but not a checkpoint of a run"),
        ("z.pt", "z.pt: no such file"),
    ]:
        with pytest.raises(InputError, match=said):
            of_file(tmp_path / name, None)
    (tmp_path / "sub").mkdir()
    shutil.copy(file, tmp_path / "sub")
    with pytest.raises(InputError, match=r"policy.pt: does not say which run it is of"):
        of_file(tmp_path / "sub/policy.pt", None)
    with pytest.raises(InputError, match=r"none.yaml: no such file; --config names"):
        of_file(file, tmp_path / "none.yaml")
    for text in ("", "a: 1", "env: [", "[]"):
        (tmp_path / "c.yaml").write_text(text)
        with pytest.raises(InputError, match=r"c.yaml: not the config.yaml of a run"):
            of_file(file, tmp_path / "c.yaml")
