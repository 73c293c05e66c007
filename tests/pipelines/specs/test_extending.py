"""The package that `docs/extending.md` shows: it is what the page says."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipelines.conformance.checks import through_a_file
from pipelines.conformance.same import assert_same
from pipelines.policies.render import episode_gif
from pipelines.specs import identity
from pipelines.specs.study import Study
from pipelines.tracking.policy import Saved
from rhmc.training.trainer import Trainer
from rhmc.yardsticks.scores import play_yardsticks
from tests.pipelines.own_package import untouched

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs/extending.md").read_text(encoding="utf-8")


@pytest.fixture(autouse=True)
def _alone() -> Iterator[None]:
    with untouched():
        yield
    identity._code.cache_clear()


def test_the_changes_that_the_page_counts_can_be_made_to_the_code_as_it_is() -> None:
    table = dict(re.findall(r"^\| \[an? (\w+)\]\(#\S+\) (\|.*)$", PAGE, re.MULTILINE))
    counted = {name: [int(cell) for cell in row.strip("|").split("|")] for name, row in table.items()}
    pages = re.findall(r"```python\n(# mine/.*?)```", PAGE, re.DOTALL)
    found = {name: [1, text.count("\n"), 0] for name, text in zip(("method", "task"), pages, strict=True)}
    for name, diff in re.findall(r"### An? (\w+)\n.*?```diff\n(.*?)```", PAGE, re.DOTALL):
        parts = [part.splitlines() for part in diff.split("+++ b/")[1:]]
        for file, *lines in parts:
            code = (ROOT / file).read_text(encoding="utf-8")
            assert [line for line in lines if line[0] == "-" and line[1:] not in code] == []
        signs = [line[0] for _, *lines in parts for line in lines]
        found[name] = [len(parts), signs.count("+"), signs.count("-")]
    assert found == counted


def test_the_package_of_the_page_learns_is_continued_scored_and_drawn(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/__init__.py").touch()
    blocks = re.findall(r"```(?:python|yaml)\n# (\S+)\n(.*?)```", PAGE, re.DOTALL)
    assert [name for name, _ in blocks] == ["mine/methods.py", "mine/tasks.py", "doors.yaml"]
    for name, text in blocks:
        (tmp_path / name).write_text(text, encoding="utf-8")
    study = Study.load(tmp_path / "doors.yaml", "quick", ["trainer.num_envs=4", "trainer.evaluations=4", "steps=800"])
    assert study.remarks == ()
    assert {run.spec.imports for run in study.runs()} == {("mine.methods", "mine.tasks"), ("mine.tasks",)}
    spec = study.runs()[0].spec
    whole = Trainer(spec.env, spec.algo, spec.trainer, spec.seed)
    points = [next(whole), next(whole)]
    rest = Trainer(spec.env, spec.algo, spec.trainer, spec.seed)
    rest.load_state_dict(through_a_file(whole.state_dict()))
    points += list(whole)
    assert list(rest) == points[2:]
    assert_same(rest.state_dict(), whole.state_dict())
    assert points[-1]["final/return"] > points[0]["eval/return"]
    scores = play_yardsticks(spec.env, episodes=10)
    assert scores["own_door"]["return"] == 100
    saved = Saved(spec, whole.state_dict()["algorithm"])
    assert episode_gif(saved, beside="own_door", frames=2).startswith(b"GIF89a")
