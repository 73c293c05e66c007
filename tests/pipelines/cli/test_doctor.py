"""The doctor's findings on installations that are well and of those that are not."""

import sys
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path

import pytest
import torch
from packaging.requirements import Requirement

from pipelines.cli import checks
from pipelines.cli.checks import (
    Finding,
    arithmetic,
    disk,
    examine,
    libraries,
    python,
    required,
    starts_ray,
    store,
    torch_build,
)
from pipelines.tracking.mlflow_tracker import MlflowTracker
from pipelines.tracking.plan import study_card
from pipelines.workspace.arithmetic import PUBLISHED
from pipelines.workspace.work_folder import Home
from tests.pipelines.support import CODE, plan, tiny


def test_another_python_is_a_fault() -> None:
    assert [python((3, minor))[0].level for minor in (10, 11, 12, 13, 14)] == ["fault", "ok", "ok", "ok", "fault"]
    text = "3.14, and one of 3.11, 3.12, 3.13 is needed: make setup PYTHON=/path/to/python3.11"
    assert python((3, 14)) == [Finding("fault", "python", text)]


def test_libraries_against_the_lock(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert {"torch", "ray", "mlflow", "pydantic"} <= {one.name for one in required()}
    assert libraries()[0].level == "ok"
    assert libraries([Requirement("filelock==0")])[0].level == "fault"
    names = ("torch", "numpy", "rich", "typer")
    (found,) = libraries(map(Requirement, ["no-such-library==1.0", *(f"{name}==0.1" for name in names)]))
    assert found.text.startswith("no-such-library missing instead of 1.0, torch 2")
    assert found.text.endswith(" and 1 more: make setup")
    assert libraries([])[0] == Finding("ok", "libraries", "all 0 as required")
    monkeypatch.setattr(checks, "LOCK", tmp_path / "no lock")  # installed from a wheel
    assert {"torch", "ray"} <= {one.name for one in required()}
    assert not {"pytest", "psycopg"} & {one.name for one in required()}
    assert libraries()[0].level == "ok"
    assert libraries([Requirement("torch>=2.13,<2.14")])[0].level == "ok"
    assert libraries([Requirement("torch>=99")])[0].text == f"torch {torch_version()} instead of >=99: make setup"


def torch_version() -> str:
    return version("torch").partition("+")[0]


def test_torch_computes_here() -> None:
    level = "note" if torch.version.cuda and not torch.cuda.is_available() else "ok"
    assert [(one.level, one.what) for one in torch_build()] == [(level, "torch")]


def test_arithmetic_is_that_of_the_published_results(monkeypatch: pytest.MonkeyPatch) -> None:
    assert arithmetic() == [Finding("ok", "arithmetic", "the published bytes")]
    monkeypatch.setitem(PUBLISHED, "reductions", "0" * 12)
    (found,) = arithmetic()
    assert (found.level, found.text.partition(":")[0]) == ("note", "reductions")


def test_room_and_rights(tmp_path: Path) -> None:
    assert disk(tmp_path / "work", needed=1)[0].level == "ok"
    (full,) = disk(tmp_path, needed=2**70)
    assert full.level == "fault"
    assert "make room, or set RHMC_HOME" in full.text
    (tmp_path / "file").touch()
    (closed,) = disk(tmp_path / "file" / "work", needed=1)
    assert (closed.level, closed.text.split()[0]) == ("fault", str(tmp_path / "file"))


def test_a_store_that_is_none_or_not_there(tmp_path: Path) -> None:
    assert [one.level for one in store(Home(tmp_path))] == ["ok"]
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "mlflow.db").write_text("something else" * 100)
    (found,) = store(Home(tmp_path))
    assert found.level == "fault"
    assert f"{tmp_path}/mlflow.db: not an MLflow database" in found.text


def test_what_waits_and_what_is_of_other_code(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipelines.specs.identity.code_id", lambda *place: CODE)
    tracker = MlflowTracker(study_card(tiny()), Home(home))
    slow, fast = plan()
    tracker.start(slow.card).finish("interrupted")
    tracker.start(fast.card).finish("failed")
    tracker.start(slow.card._replace(fingerprint="0ther")).finish("finished")
    found = [(one.level, one.what, one.text.split(":")[0]) for one in store(Home(home))]
    assert found[0][:2] == ("ok", "store")
    assert found[1:] == [
        ("note", "runs", "1 interrupted"),
        ("note", "runs", "1 failed"),
        ("note", "stale", "1 made by other code"),
    ]


def test_a_cluster_that_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ray.is_initialized", lambda: False)
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    (found,) = starts_ray()
    assert found.level == "fault"
    assert found.text.endswith("start that cluster, or unset RAY_ADDRESS")


@pytest.mark.ray
def test_ray_starts(cluster: None) -> None:
    text = "starts, listens on 127.0.0.1 alone and asks for a token"
    assert starts_ray() == [Finding("ok", "ray", text)]


@pytest.mark.parametrize("fence", [("192.0.2.1", True), ("127.0.0.1", False)])
def test_a_ray_that_strangers_reach_is_a_fault(fence: tuple[str, bool], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipelines.execution.ray_driver.ray_session", lambda *args, **kwargs: nullcontext([]))
    monkeypatch.setattr("pipelines.execution.cluster.fence", lambda: fence)
    assert [one.level for one in starts_ray()] == ["fault"]


def test_an_examination_goes_on_after_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "NEEDED", 2**70)
    monkeypatch.setattr(checks, "LOCK", tmp_path / "none")
    monkeypatch.setattr(checks, "requires", lambda name: ["torch==0.1", 'x==1; extra == "test"'])
    found = list(examine(tmp_path, ray=False))
    assert [one.what for one in found] == ["python", "libraries", "torch", "arithmetic", "code", "work folder", "store"]
    assert found[1].level == "fault"
    assert str(sys.executable) in found[0].text
