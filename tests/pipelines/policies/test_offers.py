"""What a task of another package says of itself: headlines, policies, a painter; and a method of what it acts on."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from pipelines.execution.cluster import check_plugins, travelling
from pipelines.execution.trainable import to_act
from pipelines.export.methods import describe
from pipelines.export.tables import write_tables
from pipelines.policies.animation import painter
from pipelines.policies.render import episode_gif, play, yardstick
from pipelines.specs import identity
from pipelines.specs.plugins import finals
from pipelines.specs.study import Study
from pipelines.tracking.plan import items
from pipelines.tracking.policy import Saved, acting, save
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import StoreError, load_whole
from reports.data.drawn import read_units
from reports.data.frame import Results
from reports.render.figures import per
from rhmc.learning.acting import ACTS_ON, register_acting
from rhmc.training.trainer import Trainer
from rhmc.yardsticks.scores import names, play_yardsticks
from tests.pipelines.own_package import STUDY, untouched, write
from tests.pipelines.support import run_rhmc


@pytest.fixture(autouse=True)
def _alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "studies").mkdir()
    Path("studies/x.yaml").write_text(STUDY)
    with untouched():
        yield
    identity._code.cache_clear()


def study(*, offers: bool) -> Study:
    write(Path("studies"), offers=offers)
    return Study.load("studies/x.yaml")


def saved(one: Study) -> Saved:
    spec = one.runs()[0].spec
    return Saved(spec, Trainer(spec.env, spec.algo, spec.trainer, spec.seed).state_dict()["algorithm"])


def units(one: Study) -> dict[str, str]:
    """What the report reads after an export."""
    write_tables(one, items(one), None, Path("runs"))
    faults: list[str] = []
    found = read_units(Path("runs"), faults)
    assert faults == []
    return found


def test_what_a_task_offers_is_scored_drawn_and_said(capfd: pytest.CaptureFixture[str]) -> None:
    one = study(offers=True)
    env = one.base.env
    assert names("ring") == ["stay"]
    (score,) = play_yardsticks(env, episodes=20).values()
    assert score.keys() == {"return", "faced", "sem"}
    assert 0 < score["faced"] < 1
    assert finals()["final/faced"] == "faced"
    assert list(finals())[:4] == ["final/return", "final/coverage", "final/landmarks_covered", "final/collisions"]
    last = play(env, yardstick(env, "stay", 0), 0)[-1]
    assert last.text.startswith("step 6: return ")
    assert ", faced " in last.text
    assert episode_gif(saved(one), beside="stay", frames=3).startswith(b"GIF89a")
    results = Results(*[None] * 3, units=units(one))  # type: ignore[list-item]
    assert per(results, "ring") == "share of targets faced"
    assert per(results, "navigation") == "sum over an episode"
    assert run_rhmc("yardsticks", "study", "studies/x.yaml", "--episodes", "10", "--out", "runs") == 0
    assert "ring, 2 x 2" in capfd.readouterr().out
    assert Path("runs/yardsticks.parquet").exists()


def test_a_task_that_offers_nothing_is_left_out_in_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    one = study(offers=False)
    assert names("ring") == []
    assert "final/faced" not in finals()
    with pytest.raises(InputError, match="the task 'ring' offers no painter, so its episodes are not drawn"):
        painter("ring")
    with pytest.raises(InputError, match="'stay' is not allowed; the task 'ring' offers no policy without learning"):
        episode_gif(saved(one), beside="stay")
    results = Results(*[None] * 3, units=units(one))  # type: ignore[list-item]
    assert per(results, "ring") == "as the task defines it"
    assert run_rhmc("yardsticks", "study", "studies/x.yaml") == 0
    assert capfd.readouterr().err == "the task 'ring' offers no policy without learning, so it is left out\n"


def test_a_study_of_this_project_writes_no_file_on_tasks() -> None:
    Path("studies/y.yaml").write_text(STUDY.replace("imports: [bandits]\n", "").replace("ring", "coverage").replace(
        "  bandits: {}\n", "").replace("{kind: bandits}", "{kind: iql}"))  # fmt: skip
    plain = Study.load("studies/y.yaml")
    assert units(plain) == {}
    assert not list(Path("runs").glob("*.json"))


@pytest.mark.parametrize("text", ["[]", '{"ring": 3}', '{"ring": {}}', "{", '{"ring": {"unit": "' + "x" * 81 + '"}}'])
def test_what_is_no_file_on_tasks_is_one_line(text: str) -> None:
    Path("x.tasks.json").write_text(text)
    faults: list[str] = []
    assert read_units(Path(), faults) == {}
    (fault,) = faults
    assert fault.startswith("x.tasks.json: not what `rhmc export` writes of tasks of other packages (")


def test_table_1_has_a_method_without_networks() -> None:
    study(offers=False)
    (row,) = [row for row in describe() if row["kind"] == "bandits"]
    assert {(size["acting"], size["all"]) for size in row["parameters"]} == {(0, 0)}


def test_a_method_says_what_it_acts_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may look like a replay, or keep something that does not."""
    one = saved(study(offers=False))
    whole = one.algorithm | {"rows": {"x": torch.ones(3)}}
    assert acting("bandits", {"rows": whole["rows"]}) == {"rows": []}  # as this project's methods have it
    monkeypatch.setitem(ACTS_ON, "bandits", lambda state: {"values": state["values"], "rng": state["rng"]})
    assert acting("bandits", whole).keys() == {"values", "rng"}
    (lean,) = to_act("bandits", {"seeds": [{"step": 1, "algorithm": whole}]})["seeds"]
    assert lean["algorithm"].keys() == {"values", "rng"}
    save(tmp_path / "policy.pt", one._replace(algorithm=whole))
    assert load_whole(tmp_path / "policy.pt")["algorithm"].keys() == {"values", "rng"}


def test_two_answers_of_one_method_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ACTS_ON, "bandits", dict)
    register_acting("bandits", dict)
    with pytest.raises(ValueError, match="'bandits' says already what it acts on"):
        register_acting("bandits", list)  # type: ignore[arg-type]


def test_a_launch_brings_the_package_to_every_node_and_a_worker_sees_whether_it_is_the_same() -> None:
    (run, *_) = items(study(offers=False))
    brought: list[Any] = travelling({})["py_modules"]
    assert brought[2:] == [str(Path("studies/bandits").resolve())]
    check_plugins(run.spec, run.key)
    with pytest.raises(StoreError, match="has other code of bandits than the launch began with: launch it again"):
        check_plugins(run.spec, f"{run.spec.id}-{'0' * 12}")
