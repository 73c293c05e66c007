"""Table 1's records: complete, counted, and the same file twice."""

import json
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Generator, nn
from typer.testing import CliRunner

from pipelines.cli.main import app
from pipelines.export.methods import TASKS, count, describe, export_methods
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import StoreError
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import make_env
from rhmc.learning.learner import Learner
from rhmc.networks.nets import ENCODERS, Sizes


def size(*layers: tuple[int, int]) -> int:
    """Parameters of linear layers."""
    return sum(i * o + o for i, o in layers)


def test_a_network_counted_by_hand() -> None:
    """Coverage 4 x 5: 5 targets of 4 features and the id of 4 agents, 64, 64, 3 actions."""
    spec = make_env(TASKS[0], 1, Generator()).spec
    inputs = spec.agent_features + 5 * spec.pair_features + 4 * spec.peer_features + 4
    agent = size((inputs, 64), (64, 64), (64, 3))
    assert count("iql", "mlp", TASKS[0]) == (agent, agent)
    state = 4 * (inputs - 4)
    mixer = size((state, 64), (64, 4 * 32), (state, 32), (state, 64), (64, 32), (state, 32), (32, 1))
    assert count("qmix", "mlp", TASKS[0]) == (agent, agent + mixer)


@pytest.mark.parametrize("encoder", ENCODERS)
def test_two_levels_are_counted_with_both_actors(encoder: str) -> None:
    spec = make_env(TASKS[1], 1, Generator()).spec
    shapes = ENCODERS[encoder]
    high, low = Sizes.of(spec), Sizes.of(spec, pair=1)
    actors = shapes.pairs(high, 64, 1), shapes.local(low, 64, spec.actions)
    critics = shapes.pairs(low, 64, 1), shapes.central(low, 64, spec.actions, joint=spec.actions)
    acting, all_ = (sum(p.numel() for net in nets for p in net.parameters()) for nets in (actors, actors + critics))
    assert count("rhmc", encoder, TASKS[1]) == (acting, all_)


def test_every_method_is_described_and_counted() -> None:
    records = describe()
    assert [r["kind"] for r in records] == list(ALGORITHMS)
    for record in records:
        about = ALGORITHMS[record["kind"]].about._asdict()
        assert {key: record[key] for key in about} == about
        assert all(record[key] for key in about)
        assert [(s["task"]["kind"], s["encoder"]) for s in record["parameters"]] == list(
            product(("coverage", "navigation"), ("mlp", "pairwise"))
        )
        assert ALGORITHMS[record["kind"]].config(**record["defaults"]) == ALGORITHMS[record["kind"]].config()
        assert record["defaults"]["kind"] == record["kind"]
        assert all(0 < s["acting"] <= s["all"] for s in record["parameters"])
    centred = {r["kind"] for r in records if r["parameters"][0]["acting"] < r["parameters"][0]["all"]}
    assert centred == set(ALGORITHMS) - {"iql", "vdn"}


def test_what_is_counted_is_what_acts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A network that is asked twice counts once; one that is not asked, not at all."""
    fresh: list[nn.Module] = []

    class Twice:
        def __init__(self, cfg: Any, spec: Any, num_envs: int, rng: Generator) -> None:
            self.asked, self.other = nn.Linear(2, 3), nn.Linear(5, 7)
            fresh.append(self.asked)

        def carry(self, batch: int) -> dict[str, Any]:
            return {}

        def act(self, *args: Any, **kwargs: Any) -> None:
            assert kwargs == {"explore": False}
            self.asked(self.asked(torch.zeros(1, 2))[:, :2])

        def learners(self) -> list[Learner[nn.Linear]]:
            return [Learner(self.other, lr=0.1), Learner(self.asked, lr=0.1)]

    monkeypatch.setitem(ALGORITHMS, "iql", ALGORITHMS["iql"]._replace(build=Twice))
    assert count("iql", "mlp", TASKS[1]) == (9, 9 + 42)
    before = torch.get_rng_state()
    count("iql", "mlp", TASKS[1])
    assert torch.equal(torch.get_rng_state(), before)
    assert not nn.modules.module._global_forward_hooks


def test_the_command_writes_the_same_file_twice(tmp_path: Path) -> None:
    files = []
    for name in ("a", "b"):
        done = CliRunner().invoke(app, ["methods", "--out", str(tmp_path / name)])
        assert done.exit_code == 0, done.output
        files.append((tmp_path / name / "methods.json").read_bytes())
        assert [file.name for file in (tmp_path / name).iterdir()] == ["methods.json"]
    assert files[0] == files[1]
    assert json.loads(files[0]) == json.loads(json.dumps(describe()))
    assert all(method.about.name in done.stdout for method in ALGORITHMS.values())


def test_a_file_is_no_folder_and_a_closed_one_is_said(tmp_path: Path) -> None:
    (tmp_path / "x").touch()
    with pytest.raises(InputError, match=r"--out: .* is not a folder"):
        export_methods(tmp_path / "x")
    with pytest.raises(StoreError, match=r"methods.json: cannot be written"):
        export_methods(tmp_path / "x" / "y")
