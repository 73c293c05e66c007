"""Animations: what they show is what happened, they are small, and they change nothing."""

import io
import json
from pathlib import Path

import pytest
import torch
from PIL import Image
from torch import Generator

from pipelines.execution.trainable import RunTrainable
from pipelines.policies import animation, render
from pipelines.policies.animation import Panel, Scene, gif
from pipelines.specs.study import RunSpec
from pipelines.tracking import policy
from pipelines.tracking.policy import Actor, Saved
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import Home
from reports.pages.page import shown_in
from rhmc.envs import coverage, navigation
from rhmc.training.evaluation import evaluate
from rhmc.training.trainer import Trainer
from rhmc.yardsticks import BOUNDS
from tests.pipelines.execution.test_trainable import finish, job, same
from tests.pipelines.support import run_rhmc
from tests.pipelines.tracking.test_policy import run


def saved(one: RunSpec) -> Saved:
    return Saved(one, Trainer(one.env, one.algo, one.trainer, one.seed).state_dict()["algorithm"])


NAVIGATION = {"kind": "navigation", "agents": 3}


@pytest.mark.parametrize("env", [{"kind": "coverage", "agents": 2, "targets": 3}, NAVIGATION])
def test_the_episode_is_the_one_that_evaluation_plays(env: dict[str, object]) -> None:
    one = saved(run("rhmc", env))
    actor = Actor(one)
    scenes = render.play(one.spec.env, render.trained(actor), episode=7)
    played = evaluate(actor.algorithm, one.spec.env, 1, 7).values
    assert len(scenes) == 1 + actor.sizes.episode
    assert scenes[-1].text.startswith(f"step {actor.sizes.episode}: return {float(played['return']):.1f}, ")
    if "coverage" in played:
        assert scenes[-1].text.endswith(f"coverage so far {float(played['coverage']):.1f} %")
    else:
        assert f"{100 * float(played['landmarks_covered']):.0f} % covered" in scenes[-1].text
    assert all(scene.assignment is not None for scene in scenes[1:])


def test_two_policies_meet_the_same_targets() -> None:
    env = coverage.Config(agents=2, targets=3)
    one, other = (render.play(env, render.yardstick(env, name, 3), 3) for name in ("random", "best_window"))
    assert all(torch.equal(a.state.targets, b.state.targets) for a, b in zip(one, other, strict=True))
    assert torch.equal(one[0].state.heading, other[0].state.heading)
    assert not torch.equal(one[-1].state.heading, other[-1].state.heading)
    third = render.play(env, render.yardstick(env, "best_window", 4), 4)
    assert not torch.equal(third[0].state.targets, other[0].state.targets)


def test_any_headings_see_what_the_bound_says() -> None:
    env = coverage.Config(agents=2, targets=4)
    free = render.panel(env, render.FREE, 5)
    other = render.play(env, render.yardstick(env, "best_window", 5), 5)
    assert all(torch.equal(a.state.targets, b.state.targets) for a, b in zip(free, other, strict=True))
    bound = [float(BOUNDS["coverage"][render.FREE](env, scene.state)) for scene in free[1:]]
    assert free[-1].text.endswith(f"coverage so far {100 * sum(bound) / len(bound):.1f} %")
    for scene, value in zip(free[1:], bound, strict=True):
        seen = coverage.visible(*coverage.relation(scene.state))[0].any(0).float().mean()
        assert float(seen) == pytest.approx(value)
    with pytest.raises(InputError, match="'free_heading_bound' is not allowed; allowed: random, hold"):
        render.panel(navigation.Config(agents=2), render.FREE, 5)


# Pictures


def frames(gif: bytes) -> list[Image.Image]:
    image = Image.open(io.BytesIO(gif))
    out = []
    for frame in range(image.n_frames):
        image.seek(frame)
        out.append(image.convert("RGB"))
    return out


def pixel(picture: Image.Image, x: float, y: float, half: float) -> tuple[int, ...]:
    """The colour at a point of the first panel."""
    scale = animation.SIDE / (2 * half)
    colour = picture.getpixel((round((x + half) * scale - 0.5), round((half - y) * scale - 0.5)))
    assert isinstance(colour, tuple)
    return colour


def test_a_sensor_looks_where_it_is_turned_to_and_a_seen_target_is_filled() -> None:
    env = coverage.Config(agents=1, targets=2)
    state = coverage.initial(env, 1, Generator().manual_seed(0))
    state = state._replace(
        sensors=torch.tensor([[[0.0, 0.0]]]),
        heading=torch.tensor([[90.0]]),  # upwards
        targets=torch.tensor([[[0.0, 500.0], [500.0, 0.0]]]),
    )
    (picture,) = frames(gif(env, [Panel("", [Scene(state, torch.ones(1, 2), "")])], 1, 50))
    half = animation.COVERAGE_VIEW
    assert pixel(picture, 0, 0, half) == animation.TEAM[0]
    assert pixel(picture, 0, 500, half) == animation.SEEN
    assert pixel(picture, 500, 0, half) == (255, 255, 255)  # a ring
    assert pixel(picture, 500, 30, half) == animation.MISSED
    inside, left, below = (pixel(picture, *place, half) for place in ((120, 600), (-600, 120), (0, -600)))
    assert inside != (255, 255, 255)
    assert left == below == (255, 255, 255)
    assert pixel(picture, 200, 0, half) != (255, 255, 255)  # the line to an assigned target


def test_a_covered_landmark_is_green_and_the_view_grows_with_the_agents() -> None:
    env = navigation.Config(agents=2)
    state = navigation.initial(env, 1, Generator().manual_seed(0))
    state = state._replace(
        position=torch.tensor([[[0.5, 0.5], [0.0, -2.0]]]), landmarks=torch.tensor([[[0.5, 0.55], [-0.5, -0.5]]])
    )
    (picture,) = frames(gif(env, [Panel("", [Scene(state, None, "")])], 1, 50))
    half = 2.2
    assert pixel(picture, -0.5 + navigation.NEAR - 0.01, -0.5, half) == animation.MISSED
    assert pixel(picture, 0, -2.0, half) != (255, 255, 255)
    assert pixel(picture, 1.5, 1.5, half) == (255, 255, 255)


@pytest.mark.parametrize(("steps", "most", "shown"), [(101, 30, 26), (26, 40, 26), (101, 2, 2), (7, 3, 3)])
def test_the_last_step_is_shown_and_no_more_frames_than_wanted(steps: int, most: int, shown: int) -> None:
    env = navigation.Config(agents=1)
    state = navigation.initial(env, 1, Generator().manual_seed(0))
    still = [Scene(state, None, f"step {k}") for k in range(steps)]
    pictures = frames(gif(env, [Panel("", still)], most, 50))
    assert len(pictures) == shown
    last = frames(gif(env, [Panel("", still[-1:])], 1, 50))[0]
    assert pictures[-1].tobytes() == last.tobytes()


def test_a_run_keeps_less_than_300_kb() -> None:
    one = run("rhmc", {"kind": "coverage", "agents": 4, "targets": 5})  # untrained: it assigns much
    gif = render.episode_gif(saved(one), frames=30)
    assert len(gif) < 300_000
    assert gif == render.episode_gif(saved(one), frames=30)
    assert frames(gif)[0].size == (animation.SIDE, animation.SIDE + animation.LINES)
    assert frames(render.episode_gif(saved(one), beside="hold", frames=2))[0].width == 2 * animation.SIDE
    both = f"hold,{render.FREE}"
    assert frames(render.episode_gif(saved(one), beside=both, frames=2))[0].width == 3 * animation.SIDE


# In a run


def test_a_worker_leaves_an_animation_that_changes_nothing(tmp_path: Path) -> None:
    plain, drawn = RunTrainable(job(tmp_path / "a")), job(tmp_path / "b")
    drawn["job"]["animate"] = True
    drawing_one = RunTrainable(drawn)
    finish(plain)
    finish(drawing_one)
    assert plain.trainer is not None
    assert drawing_one.trainer is not None
    assert same(plain.trainer.state_dict(), drawing_one.trainer.state_dict())
    assert not (tmp_path / "a" / "run0" / "episode.gif").exists()
    assert len(frames((tmp_path / "b" / "run0" / "episode.gif").read_bytes())) == 1 + 7  # the whole episode
    assert policy.load(tmp_path / "b" / "run0").spec.seed == 0


def test_an_animation_that_fails_is_noted_and_the_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_font(*args: object, **options: object) -> bytes:
        raise ImportError("no font")

    monkeypatch.setattr(render, "episode_gif", no_font)
    drawn = job(tmp_path / "a")
    drawn["job"]["animate"] = True
    assert finish(RunTrainable(drawn))[-1]["done"]
    assert (tmp_path / "a" / "run0" / "episode.txt").read_text() == "ImportError: no font\n"
    assert (tmp_path / "a" / "run0" / "policy.pt").exists()


# The command


def test_the_command_draws_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RHMC_HOME", raising=False)
    policy.save(tmp_path / "policy.pt", saved(run("iql")))
    assert run_rhmc("render", "policy.pt", "--out", "a.gif", "--beside", "best_window", "--frames", "4") == 0
    assert capsys.readouterr().err == "wrote a.gif\n"
    assert len(frames((tmp_path / "a.gif").read_bytes())) == 4
    for words, said in {
        ("policy.pt", "--out", "a.png"): "--out: a.png must end in .gif\n",
        ("policy.pt", "--out", "no/a.gif"): "--out: no is no folder\n",
        ("none.pt", "--out", "b.gif"): "none.pt: no such file\n",
        (
            "f" * 32,
            "--out",
            "b.gif",
        ): f"{tmp_path}/work/mlflow.db: nothing is logged yet, so there is no run {'f' * 32}\n",
    }.items():
        assert run_rhmc("render", *words) == 2
        assert capsys.readouterr().err == said
    study = str(Path(__file__).parents[3] / "studies" / "ablation.yaml")
    assert run_rhmc("render", study, "--arm", "full", "--out", "b.gif") == 2
    assert capsys.readouterr().err.startswith("ablation (quick): no such run has a policy yet; ")
    assert run_rhmc("render", study, "--arm", "ful", "--out", "b.gif") == 2
    assert "--arm: 'ful' is not allowed; " in capsys.readouterr().err
    assert run_rhmc("render", "policy.pt", "--out", "b.gif", "--beside", "best_windows") == 2
    said = capsys.readouterr().err
    assert said.startswith("--beside: 'best_windows' is not allowed; ")
    assert said.endswith("did you mean 'best_window'?\n")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.gif", "policy.pt"]


def test_what_evaluate_plays_is_drawn_with_the_same_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    one = run("iql")
    wide = one.model_copy(update={"algo": one.algo.model_copy(update={"encoder": "pairwise"})})
    policy.save(tmp_path / "wide.pt", saved(wide))
    policy.save(tmp_path / "flat.pt", saved(one))
    drawn: list[int] = []
    monkeypatch.setattr(render, "gif", lambda env, *_: drawn.append(env.agents) or b"")
    played = {}
    for agents in (one.env.agents, one.env.agents + 1):
        words = ("wide.pt", "--agents", str(agents))
        assert run_rhmc("render", *words, "--out", "a.gif", "--beside", "hold") == 0
        assert run_rhmc("evaluate", *words, "--episodes", "2", "--json") == 0
        (played[agents],) = json.loads(capsys.readouterr().out)
        assert run_rhmc("evaluate", *words, "--episodes", "2") == 0
        told = "episodes=2" if agents == one.env.agents else f"agents={agents}, episodes=2"
        said = capsys.readouterr().out.splitlines()[0]
        assert said.startswith(f"coverage (agents={agents}, targets=")
        assert said.endswith(f"; other than in the run's own evaluation: {told}")
    assert drawn == [found["task"]["agents"] for found in played.values()] == list(played)
    for verb, more in {"render": ("--out", "b.gif"), "evaluate": ()}.items():
        for words, error in {
            ("flat.pt", "--agents", "5"): "--agents or --targets: iql with encoder 'mlp' acts only with the numbers",
            ("wide.pt", "--agents", "9"): "--agents: 9 sensors need as many boxes, and there are 6",
            ("wide.pt", "--set", "steps=1"): "--set: belongs to a study, and wide.pt is one policy",
            ("wide.pt", "--arm", "a"): "--arm: belongs to a study, and wide.pt is one policy",
            ("x.yaml", "--config", "c.yaml"): "--config: belongs to a .pt file, and x.yaml is a study",
        }.items():
            assert run_rhmc(verb, *words, *more) == 2
            assert capsys.readouterr().err.startswith(error)


def test_a_run_of_the_log_is_drawn_and_an_unfinished_one_is_not(home: Path, tmp_path: Path) -> None:
    from pipelines.tracking.mlflow_tracker import MlflowTracker
    from tests.pipelines.tracking.test_policy import CARD, STUDY

    tracker = MlflowTracker(STUDY, Home(home))
    log = tracker.start(CARD)
    with pytest.raises(InputError, match=rf"run {log.ref} keeps no policy\.pt: it is not finished"):
        render.render(log.ref, tmp_path / "a.gif", Home(home))
    spec = run("iql")
    policy.save(tmp_path / "policy.pt", saved(spec))
    log.artifact(tmp_path / "policy.pt")
    drawn = render.render(log.ref, tmp_path / "a.gif", Home(home), episode=3, frames=2).read_bytes()
    assert shown_in(drawn) == spec.id  # the report's page leads from the run's row to it
    with pytest.raises(InputError, match="0" * 32):
        render.render("0" * 32, tmp_path / "b.gif", Home(home))
    assert not (tmp_path / "b.gif").exists()
