"""Each test here stands in the folder of one example, as its user does; what it registers is forgotten afterwards."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from pipelines.specs import identity
from tests.pipelines.own_package import untouched

EXAMPLES = Path(__file__).parents[2] / "examples"
SHORT = [  # a study of an example that is trained to its end in a moment
    "steps=80",
    "trainer.num_envs=4",
    "trainer.evaluations=1",
    "trainer.eval_episodes=2",
    "trainer.final_episodes=2",
]


@pytest.fixture(autouse=True)
def _there(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(EXAMPLES / request.module.EXAMPLE)
    monkeypatch.setenv("RHMC_IMPORTS", "")
    with untouched():
        yield
    identity._code.cache_clear()
