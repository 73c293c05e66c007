"""Old names of settings: refused in one line that says the new one."""

from pathlib import Path
from typing import Any

import pytest

from pipelines.specs.document import settings
from pipelines.specs.plugins import configs
from pipelines.specs.renamed import BLOCKS, RENAMED
from pipelines.specs.search import Search
from pipelines.specs.study import Study, StudyError
from rhmc.training import trainer

OWNERS: dict[str, tuple[str, Any]] = {kind: ("algo", config) for kind, config in configs("algo").items()}
OWNERS["trainer"] = ("trainer", trainer.Config)
ROWS = [
    (kind, old, new)
    for kind, (_, config) in OWNERS.items()
    for old, entry in RENAMED.items()
    if old not in config.model_fields
    for new in [name for name in entry.names if name in settings(config)][:1]
]


def said(path: Path, kind: str, line: str, overrides: tuple[str, ...] = ()) -> list[str]:
    """The faults of a study with a line in the section of a method, or of the trainer, which is line 5."""
    section = "trainer:" if kind == "trainer" else f"algo:\n    kind: {kind}"
    method = "algo: {kind: iql}" if kind == "trainer" else "trainer: {}"
    path.write_text(
        f"question: Why?\nbase: \n  {section}\n    {line}\n  {method}\n  env: {{kind: coverage}}\n"
        "arms: {a: {}}\nseeds: 1\nsteps: 100_000\n"
    )
    with pytest.raises(StudyError) as error:
        Study.load(path, overrides=overrides)
    return str(error.value).splitlines()


def place(path: Path, kind: str) -> str:
    """Of the line."""
    return f"{path}:4:5" if kind == "trainer" else f"{path}:5:5"


def test_every_row_has_a_method_that_it_is_told_to() -> None:
    assert {old for _, old, _ in ROWS} == set(RENAMED)
    assert {new for _, _, new in ROWS} == {new for entry in RENAMED.values() for new in entry.names}


@pytest.mark.parametrize(("kind", "old", "new"), ROWS)
def test_an_old_key_is_refused_with_the_new_one(kind: str, old: str, new: str, tmp_path: Path) -> None:
    section, path = OWNERS[kind][0], tmp_path / "x.yaml"
    (line,) = said(path, kind, f"{old}: 1")
    block, _, field = new.rpartition(".")
    told = f"'{field}' in the block '{block}': {block}: {{{field}: ...}}" if block else f"'{new}'"
    note = f" ({RENAMED[old].note})" if RENAMED[old].note else ""
    assert line == f"{place(path, kind)}: base.{section}.{old}: '{old}' is now {told}{note}"


def test_the_conversion_of_a_share_is_told(tmp_path: Path) -> None:
    (line,) = said(tmp_path / "x.yaml", "iql", "polyak: 0.99")
    assert line.endswith("base.algo.polyak: 'polyak' is now 'tau' (share moved per update: 1 - polyak)")


@pytest.mark.parametrize(
    ("key", "word", "told"),
    [
        ("coordinator", "counterfactual", "coordinator: {gradient: counterfactual}"),
        ("executor", "expected", "executor: {method: expected}"),
        ("executor", "mixed", "executor: {method: qmix}"),
    ],
)
def test_a_word_that_became_a_block(key: str, word: str, told: str, tmp_path: Path) -> None:
    assert key in BLOCKS
    path = tmp_path / "x.yaml"
    column = 5 + len(key) + 2
    assert said(path, "rhmc", f"{key}: {word}") == [
        f"{path}:5:{column}: base.algo.{key}: '{key}' is now a block: {told}"
    ]


def test_an_old_key_inside_a_block_and_in_an_override(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    assert said(path, "rhmc", "coordinator: {entropy: 0.1}") == [
        f"{path}:5:19: base.algo.coordinator.entropy: 'entropy' is now 'ent_coef'"
    ]
    lines = said(path, "rhmc", "lr: 1e-3", ("algo.gamma_h=0.5",))
    assert lines == [
        "--set algo.gamma_h=0.5: base.algo.gamma_h: 'gamma_h' is now 'gamma' in the block 'coordinator': "
        "coordinator: {gamma: ...}"
    ]


def test_an_old_key_in_a_space(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text(
        "question: Why?\nbase: {env: {kind: coverage}, algo: {kind: rhmc}}\narms:\n  a:\n    space:\n"
        "      gamma_h: {low: 0.1, high: 0.9}\ntrials: 1\nseeds: 1\nsteps: 100_000\n"
    )
    with pytest.raises(StudyError) as error:
        Search.load(path)
    assert str(error.value) == f"{path}:6:7: arms.a.space.gamma_h: 'gamma_h' is now 'coordinator.gamma'"


def test_a_block_is_merged_named_and_searched_by_dotted_path(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text(
        "question: Why?\nbase:\n  env: {kind: coverage}\n"
        "  algo: {kind: rhmc, coordinator: {gamma: 0.7, batch_size: 64}}\narms:\n  a: {}\n"
        "  b: {algo: {coordinator: {gamma: 0.8}}}\nseeds: 1\nsteps: 100_000\n"
    )
    study = Study.load(path, overrides=("algo.coordinator.ent_coef=0.1",))
    assert study.arms["b"].algo.coordinator.model_dump(exclude_defaults=True) == {
        "gamma": 0.8,
        "batch_size": 64,
        "ent_coef": 0.1,
    }
    assert '"coordinator":{"batch_size":64,"ent_coef":0.1,"gamma":0.8},"kind"' in study.arms["b"].stated()
    from pipelines.specs.study import changes

    assert changes(study.base, study.arms["b"]) == {"algo.coordinator.gamma": 0.8}


@pytest.mark.parametrize(("suffix", "block"), [("h", "coordinator"), ("l", "executor")])
def test_a_level_of_old_keys_is_one_block(suffix: str, block: str) -> None:
    blocks = {name.partition(".")[0] for old, e in RENAMED.items() if old.endswith(f"_{suffix}") for name in e.names}
    assert blocks == {block}
