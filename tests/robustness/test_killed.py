"""Every verb that writes, killed at random writes: `python -m tests.robustness.killed` does it for longer."""

import random
from pathlib import Path

import pytest

from tests.depth import often
from tests.robustness.killed import VERBS, WRONG, Verb, World, disturb, make_world

KILLS = often(1, 2)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory, template: Path) -> World:
    """Trained once for all."""
    return make_world(tmp_path_factory.mktemp("killed"), template)


@pytest.mark.parametrize("verb", VERBS, ids=lambda verb: verb.name.replace(" ", "-"))
def test_a_verb_that_is_killed_ends_as_one_that_is_not(verb: Verb, world: World) -> None:
    folder = world.home.parent / f"verb{VERBS.index(verb)}"
    folder.mkdir()
    done = disturb(verb, folder, world, KILLS, random.Random(2))
    assert done.kills == KILLS
    assert {kind: done.wrong[kind] for kind in WRONG} == dict.fromkeys(WRONG, 0), done.left
