"""Tuned settings stand once: in `studies/settings`, from which the studies include them."""

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from pipelines.specs.safe_names import PROFILES
from pipelines.specs.search import Search
from pipelines.specs.study import SECTIONS, SPACE, Study
from tests.depth import covering
from tests.test_architecture import is_search

ROOT = Path(__file__).parents[3]
STUDIES = ROOT / "studies"
FILES = sorted(path for path in STUDIES.rglob("*.yaml") if path.parent.name != "best_params")  # searches write those
ALIKE = 3  # settings that two sections may share by chance
LINES = 400
TRIED = 60  # lines of a file that spells out what is tried: the levels of factors, the arms and spaces of a search


def document(path: Path) -> dict[str, Any]:
    return YAML(typ="safe").load(path.read_text(encoding="utf-8"))


def sections(tree: Any, way: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every `env`, `algo` and `trainer` in a document, and where it stands."""
    for key, child in tree.items() if isinstance(tree, dict) else ():
        if key in SECTIONS:
            yield f"{way}{key}", child
        else:
            yield from sections(child, f"{way}{key}.")


def repeated(files: list[Path]) -> list[str]:
    """Pairs of sections with more than `ALIKE` settings in common, key and value, but for those of two kinds."""
    found = [(f"{p.name} {way}", section) for p in files for way, section in sections(document(p))]
    pairs = [(one, other, common(mine, theirs)) for (one, mine), (other, theirs) in itertools.combinations(found, 2)]
    return [f"{one}, {other}: {', '.join(same)}" for one, other, same in pairs if len(same) > ALIKE]


def common(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    if len({section["kind"] for section in (one, other) if "kind" in section}) == 2:
        return []
    same = [key for key in one if key in other and one[key] == other[key]]
    return [f"{key}: {one[key]}" for key in same if key not in ("kind", "include")]


def test_no_block_of_settings_stands_twice() -> None:
    assert repeated(FILES) == []


def test_a_block_that_stands_twice_is_found(tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("arms: {a: {algo: {lr: 2e-3, encoder: pairwise, epochs: 5, minibatches: 4}}}\n")
    (line,) = repeated([*FILES, mine])
    assert line.startswith("ppo.yaml algo, mine.yaml arms.a.algo: encoder: pairwise, lr: 0.002, ")


def test_the_studies_are_short() -> None:
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in FILES}
    tried = [path for path in FILES if {"readings", "space", "trials"} & document(path).keys()]
    assert sum(lines[path] for path in FILES if path not in tried) < LINES
    assert max(lines[path] for path in tried) < TRIED


def test_every_file_of_settings_is_included() -> None:
    texts = [path.read_text(encoding="utf-8") for path in FILES]
    names = [path.relative_to(STUDIES).with_suffix("").as_posix() for path in FILES if path.parent != STUDIES]
    assert names
    assert [name for name in names if not any(f"include: {name}{end}" in t for t in texts for end in "},\n")] == []


def written_out(tree: Any, section: str = "") -> Any:
    """A document with what it includes in its place; plain mappings, not the loader's."""
    if not isinstance(tree, dict):
        return tree
    tree = {key: written_out(child, key if key in (*SECTIONS, SPACE) else "") for key, child in tree.items()}
    if "include" not in tree:
        return tree
    name = str(tree.pop("include")).removesuffix(".yaml")
    return merged(written_out(document(STUDIES / f"{name}.yaml")[section], section), tree)


def merged(base: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """The change before the base, in blocks too."""
    blocks = {key for key in base.keys() & change.keys() if isinstance(base[key], dict)}
    return base | change | {key: merged(base[key], change[key]) for key in blocks}


@pytest.mark.parametrize(("profile", "study"), covering(PROFILES, sorted(path.stem for path in STUDIES.glob("*.yaml"))))
def test_a_study_is_the_study_with_everything_written_out(profile: str, study: str, tmp_path: Path) -> None:
    path = STUDIES / f"{study}.yaml"
    tree = written_out(document(path))
    copy = tmp_path / path.name
    copy.write_text(json.dumps(tree), encoding="utf-8")  # which is YAML
    assert "include" not in copy.read_text(encoding="utf-8")
    if is_search(path):
        here, there = (Search.load(one, profile) for one in (path, copy))
        assert here.arms == there.arms
        assert [here.identity(arm) for arm in here.arms] == [there.identity(arm) for arm in there.arms]
        return
    for variant in (None, *tree.get("variants", {})):
        here, there = (Study.load(one, profile, variant=variant).runs() for one in (path, copy))
        assert [(run.arm, run.spec.id) for run in here] == [(run.arm, run.spec.id) for run in there]
        assert [run.spec.canonical() for run in here] == [run.spec.canonical() for run in there]


ABLATION = """\
question: What does the filter contribute?
base:
  env: {include: settings/coverage}
  algo: {include: settings/coverage/rhmc}
arms:
  full: {}
  no filter: {algo: {filter: off}}
  IQL: {algo: {include: settings/coverage/iql}}
seeds: 3
steps: 100_000
"""


def test_an_ablation_in_a_folder_of_ones_own_is_ten_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(ABLATION)
    assert len(ABLATION.splitlines()) == 10
    mine, steady = Study.load("mine.yaml").arms, Study.load(STUDIES / "ablation.yaml", "paper").arms
    assert set(mine) == {"full", "no filter", "IQL"}
    assert {arm: one.algo for arm, one in mine.items()} == {arm: steady[arm].algo for arm in mine}
    assert {one.env for one in mine.values()} == {steady["full"].env}
