"""Figures 1 to 5 and 8 from small data: what they show, the form of their files, the same bytes twice."""

import json
from pathlib import Path

import pytest
from matplotlib.text import Text

from reports.data.drawn import Build, Scenes, read_modules, read_scenes
from reports.render import canvas, diagrams, scenes
from tests.reports import factory


@pytest.fixture
def builds(tmp_path: Path) -> tuple[Build, ...]:
    return read_modules(factory.drawings(tmp_path), [])


@pytest.fixture
def states(tmp_path: Path) -> Scenes:
    found = read_scenes(factory.drawings(tmp_path), [])
    assert found is not None
    return found


def words(drawing: canvas.Drawing) -> list[str]:
    return [found.get_text() for found in drawing.figure.findobj(Text) if isinstance(found, Text)]


def test_activations_stand_in_the_layer_before_them(builds: tuple[Build, ...]) -> None:
    flow = diagrams.flow(builds[0].network("executor actor"))
    assert list(flow.boxes) == ["x", "a", "b", "c", "d", "output"]
    assert flow.boxes["a"].detail == "3 → 4, ReLU"
    assert flow.boxes["b"].detail == "4 → 2"
    assert [flow.boxes[name].column for name in ("x", "a", "b", "c", "d", "output")] == [0, 1, 2, 2, 3, 4]
    assert ("a", "b", "") in flow.arrows
    assert ("c", "d", "sum") in flow.arrows


def test_widths_of_a_chain_and_of_a_branched_network(builds: tuple[Build, ...]) -> None:
    network = builds[0].network("coordinator actor")
    assert diagrams.widths(network) == "3 → … → 1, 4 layers"
    chain = network.model_copy(update={"layers": tuple(x for x in network.layers if x.name in ("a", "b", "d"))})
    assert diagrams.widths(chain) == "3 → 4 → 2 → 1"


def test_the_architecture_names_every_network_with_its_size(builds: tuple[Build, ...]) -> None:
    drawing = diagrams.architecture(builds)
    text = "\n".join(words(drawing))
    assert "actor, mlp: 3 → … → 1, 4 layers; 39 parameters" in text
    assert "paper: horizon 1" in text
    assert len(drawing.numbers) == 2 * 4 * 5
    level = diagrams.level(builds, "executor", "Low level")
    assert {"executor actor, mlp", "executor critic, pairwise"} <= set(words(level))
    assert set(level.numbers["network"]) == {"executor actor", "executor critic"}


def test_the_regulation_figure_states_both_rewards(states: Scenes) -> None:
    drawing = scenes.regulation(states.regulation)
    text = words(drawing)
    assert "Algorithm 1: completes 1, reward 0.40" in text
    assert "optimum: completes 1 and 2, reward 1.50" in text
    assert any("7 of 1,000 at horizon 6" in line for line in text)
    assert drawing.numbers[["agent", "option", "algorithm_1", "optimum"]].to_numpy().tolist() == [
        [1, 1, 1, 0],
        [1, 2, 0, 1],
        [2, 1, 1, 1],
    ]


def test_the_counterexamples_state_what_is_missed(states: Scenes) -> None:
    drawing = scenes.counterexamples(states.counterexamples)
    text = words(drawing)
    assert "2 agents, 2 targets: largest reward missed" in text
    assert "Algorithm 1: completes 2, reward 0.40" in text
    assert "optimum: completes 1, reward 0.90" in text
    columns = ["missed", "agent", "option", "algorithm_1", "optimum", "optimum_reward"]
    assert drawing.numbers[columns].to_numpy().tolist() == [
        ["reward", 1, 1, 1, 0, 0.9],
        ["reward", 1, 2, 0, 1, 0.9],
        ["reward", 2, 1, 1, 1, 0.9],
        ["reward", 2, 2, 0, 0, 0.9],
    ]


def test_a_file_without_counterexamples_draws_none(tmp_path: Path) -> None:
    old = {name: part for name, part in factory.SCENES.items() if name != "counterexamples"}
    (tmp_path / "scenes.json").write_text(json.dumps(old))
    found = read_scenes(tmp_path, [])
    assert found is not None
    assert found.counterexamples == ()


def test_the_tasks_are_drawn_from_their_states(states: Scenes) -> None:
    coverage = scenes.coverage(states.coverage)
    assert {"2 sensors: 1 of 2 targets seen", "3 sensors: 1 of 2 targets seen"} <= set(words(coverage))
    assert coverage.numbers.groupby(["sensors", "kind"]).size().to_dict() == {
        (2, "sensor"): 2,
        (2, "target"): 2,
        (3, "sensor"): 3,
        (3, "target"): 2,
    }
    navigation = scenes.navigation(states.navigation)
    assert {"step 0", "step 1"} <= set(words(navigation))
    assert len(navigation.numbers) == 2 * 2 + 2


def test_the_same_bytes_twice(states: Scenes, tmp_path: Path) -> None:
    written = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        canvas.save(scenes.regulation(states.regulation), tmp_path / name, "fig_4")
        written.append({file.name: file.read_bytes() for file in (tmp_path / name).iterdir()})
    assert sorted(written[0]) == ["fig_4.csv", "fig_4.pdf", "fig_4.png"]
    assert written[0] == written[1]


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("modules.json", "{", "Expecting property name"),
        ("modules.json", '[{"encoder": 3}]', "0.encoder: Input should be a valid string"),
        ("scenes.json", "[]", "Input should be a valid dictionary"),
    ],
)
def test_another_form_is_a_fault_of_one_line(tmp_path: Path, name: str, text: str, words: str) -> None:
    factory.drawings(tmp_path)
    (tmp_path / name).write_text(text)
    faults: list[str] = []
    read_modules(tmp_path, faults)
    read_scenes(tmp_path, faults)
    assert len(faults) == 1
    assert faults[0].startswith(f"{name}: not what `rhmc drawings --out` writes (")
    assert words in faults[0]


def test_without_files_nothing_is_drawn(tmp_path: Path) -> None:
    faults: list[str] = []
    assert (read_modules(tmp_path, faults), read_scenes(tmp_path, faults), faults) == ((), None, [])


def test_the_factory_writes_what_is_read(tmp_path: Path) -> None:
    assert json.loads((factory.drawings(tmp_path) / "scenes.json").read_text()) == factory.SCENES
