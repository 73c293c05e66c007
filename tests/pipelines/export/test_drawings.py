"""The data behind the drawn figures: traced, not written down; and the same file twice."""

import json
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from typer.testing import CliRunner

from pipelines.cli.main import app
from pipelines.export.drawings import export_drawings
from pipelines.export.network_graph import Record, describe_modules, trace
from pipelines.export.scenes import describe_scenes
from pipelines.workspace.errors import InputError
from pipelines.workspace.work_folder import StoreError
from tests.oracles import regulation as oracle


@pytest.fixture(scope="module")
def networks() -> dict[tuple[str, str], Record]:
    return {(build["encoder"], n["role"]): n for build in describe_modules() for n in build["networks"]}


@pytest.fixture(scope="module")
def scenes() -> Record:
    return describe_scenes()


def edges(network: Record) -> set[tuple[str, str]]:
    return {(edge["from"], edge["to"]) for edge in network["edges"]}


def test_the_fully_connected_coordinator_is_counted_by_hand(networks: dict[tuple[str, str], Record]) -> None:
    """4 sensors x 5 targets x 4 features in, 64, 64, one logit per pair."""
    network = networks["mlp", "coordinator actor"]
    assert [(x["in"], x["out"]) for x in network["layers"] if x["kind"] == "Linear"] == [(80, 64), (64, 64), (64, 20)]
    assert network["parameters"] == 80 * 64 + 64 + 64 * 64 + 64 + 64 * 20 + 20
    assert (network["inputs"], network["output"]) == ([{"name": "pairs", "shape": [4, 5, 4]}], [4, 5, 1])
    chain = ["pairs", "net.0", "net.1", "net.2", "net.3", "net.4", "output"]
    assert edges(network) == set(pairwise(chain))


def test_layers_hold_all_parameters(networks: dict[tuple[str, str], Record]) -> None:
    assert len(networks) == 8
    for network in networks.values():
        assert sum(layer["parameters"] for layer in network["layers"]) == network["parameters"]


def test_only_executors_look_through_the_filter(networks: dict[tuple[str, str], Record]) -> None:
    filtered = {
        key: [(e["from"], e["to"]) for e in network["edges"] if "filter" in e["through"]]
        for key, network in networks.items()
    }
    first = {"mlp": "net.0", "pairwise": "body.pairs.pair"}
    for (encoder, role), found in filtered.items():
        assert found == ([("pairs", first[encoder])] if role == "executor actor" else [])


def test_the_pairwise_critic_knows_the_others_actions_and_pools(networks: dict[tuple[str, str], Record]) -> None:
    network = networks["pairwise", "executor critic"]
    assert {("others' actions", "other"), ("body.pairs.second", "head.0"), ("other", "head.0")} <= edges(network)
    through = {(e["from"], e["to"]): e["through"] for e in network["edges"]}
    assert through["body.pairs.second", "other"] == ["ReLU", "mean, max"]
    assert not any("others' actions" in edge for edge in edges(networks["pairwise", "executor actor"]))


class Branched(nn.Module):
    """Two layers on one input, rectified in place, added; a third layer that is there and not used."""

    def __init__(self) -> None:
        super().__init__()
        self.left, self.right, self.idle = nn.Linear(3, 2), nn.Linear(3, 2), nn.Linear(9, 9)

    def forward(self, x: Tensor) -> Tensor:
        return self.left(x).relu_() + self.right(x)


def test_a_network_is_traced_as_it_ran() -> None:
    net = Branched()
    found = trace("toy", net, {"x": torch.ones(1, 3), "none": torch.ones(1, 0)}, lambda given: net(given["x"]))
    assert [layer["name"] for layer in found["layers"]] == ["left", "right"]
    assert [x["name"] for x in found["inputs"]] == ["x"]
    through = {(e["from"], e["to"]): e["through"] for e in found["edges"]}
    assert through == {
        ("x", "left"): [],
        ("x", "right"): [],
        ("left", "output"): ["ReLU", "sum"],
        ("right", "output"): ["sum"],
    }
    assert all(not module._forward_hooks for module in net.modules())


def test_the_instance_is_solved_by_hand(scenes: Record) -> None:
    """Both paths against the slow oracle, on the options as they are drawn."""
    found = scenes["regulation"]
    most = max(map(len, found["options"]))
    padded = [agent + agent[-1:] * (most - len(agent)) for agent in found["options"]]
    options = [[[bool(x) for x in mask] for mask in agent] for agent in padded]
    assignment = [[bool(x) for x in row] for row in found["assignment"]]
    best, theirs = found["paths"]["optimum"], found["paths"]["algorithm_1"]
    assert best["reward"] == pytest.approx(oracle.optimum(options, assignment, found["alpha"]), abs=1e-5)
    assert theirs["reward"] == pytest.approx(oracle.algorithm1(options, assignment, found["alpha"]), abs=1e-5)
    assert theirs["reward"] < best["reward"]
    for path in (best, theirs):
        taken = [agent[choice] for agent, choice in zip(found["options"], path["choices"], strict=True)]
        assert [any(mask[j] for mask in taken) for j in range(5)] == path["completed"]


def test_the_counterexamples_refute_the_theorem_by_the_slow_oracle(scenes: Record) -> None:
    """The first misses the largest reward with as many targets, the second completes fewer than it could."""
    by_reward, by_count = scenes["counterexamples"]
    assert (by_reward["by"], by_count["by"]) == ("reward", "count")
    for found in (by_reward, by_count):
        options = [[[bool(x) for x in mask] for mask in agent] for agent in found["options"]]
        assignment = [[bool(x) for x in row] for row in found["assignment"]]
        best, theirs = found["paths"]["optimum"], found["paths"]["algorithm_1"]
        assert best["reward"] == pytest.approx(oracle.optimum(options, assignment, found["alpha"]), abs=1e-5)
        assert theirs["reward"] == pytest.approx(oracle.algorithm1(options, assignment, found["alpha"]), abs=1e-5)
        assert theirs["reward"] < best["reward"] - 0.1
    counts = [[sum(case["paths"][name]["completed"]) for name in case["paths"]] for case in (by_reward, by_count)]
    assert counts == [[1, 1], [1, 2]]


def test_options_are_of_assigned_targets_and_differ(scenes: Record) -> None:
    found = scenes["regulation"]
    for held, agent in zip(found["assignment"], found["options"], strict=True):
        assert len({tuple(mask) for mask in agent}) == len(agent)
        assert all(done <= given for mask in agent for done, given in zip(mask, held, strict=True))
    assert [row["horizon"] for row in found["met"]] == [1, found["horizon"]]
    assert all(0 < row["lost"] < row["states"] for row in found["met"])


def test_sensors_see_what_lies_in_their_sector(scenes: Record) -> None:
    assert [state["agents"] for state in scenes["coverage"]] == [2, 3, 4, 5, 6]
    for state in scenes["coverage"]:
        assert len(state["sensors"]) == len(state["heading"]) == state["agents"]
        for sensor, heading, seen in zip(state["sensors"], state["heading"], state["seen"], strict=True):
            for target, in_sight in zip(state["targets"], seen, strict=True):
                away = complex(*target) - complex(*sensor)
                turned = away * complex(*_unit(-heading))
                assert in_sight == (abs(away) <= state["range"] and abs(turned.imag) < turned.real)


def _unit(degrees: float) -> tuple[float, float]:
    angle = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    return float(angle.cos()), float(angle.sin())


def test_an_episode_of_navigation_is_whole(scenes: Record) -> None:
    found = scenes["navigation"]
    assert torch.tensor(found["positions"]).shape == (26, 3, 2)
    assert found["positions"][0] == found["positions"][1]  # they start at rest, and move before they speed up
    assert found["positions"][0] != found["positions"][-1]


def test_the_command_writes_the_same_files_twice(tmp_path: Path) -> None:
    written = []
    for name in ("a", "b"):
        done = CliRunner().invoke(app, ["drawings", "--out", str(tmp_path / name)])
        assert done.exit_code == 0, done.output
        written.append({file.name: file.read_bytes() for file in (tmp_path / name).iterdir()})
    assert sorted(written[0]) == ["modules.json", "scenes.json"]
    assert written[0] == written[1]
    assert json.loads(written[0]["modules.json"]) == json.loads(json.dumps(describe_modules()))


def test_tracing_leaves_the_global_generator_alone() -> None:
    before = torch.get_rng_state()
    describe_modules()
    assert torch.equal(torch.get_rng_state(), before)


def test_a_file_is_no_folder_and_a_closed_one_is_said(tmp_path: Path) -> None:
    (tmp_path / "x").touch()
    with pytest.raises(InputError, match=r"--out: .* is not a folder"):
        export_drawings(tmp_path / "x")
    with pytest.raises(StoreError, match=r"modules.json: cannot be written"):
        export_drawings(tmp_path / "x" / "y")


def test_the_drawings_are_of_what_the_report_says_they_are(scenes: Record) -> None:
    found = scenes["regulation"]
    assert (found["alpha"], found["horizon"]) == (0.1, 6)
    assert found["met"] == [
        {"horizon": 1, "states": 4800, "lost": 1, "max_gap": 0.5},
        {"horizon": 6, "states": 4800, "lost": 40, "max_gap": 1.1},
    ]
    assert [path["reward"] for path in found["paths"].values()] == [0.8, 1.233333]
    assert (scenes["navigation"]["radius"], scenes["navigation"]["near"]) == (0.15, 0.1)
    assert {state["step"] for state in scenes["coverage"]} == {50}
    first = scenes["coverage"][0]
    assert (first["sensors"], first["heading"]) == ([[294.0, 316.0], [403.0, -433.0]], [90.5201, -96.6723])
