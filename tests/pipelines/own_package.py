"""A package outside the project for tests: a method that learns a value for each action, and a ring of headings."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipelines.conformance import toy
from pipelines.specs import plugins
from pipelines.workspace import own_packages
from pipelines.workspace.own_packages import top_of

NAME = "bandits"
METHOD = '''"""A value for each action of each agent, whatever it observes."""

from typing import Any, Literal

import torch
from pydantic import Field
from torch import Generator, Tensor

from rhmc.algorithms import Method, register_method
from rhmc.algorithms.base import About
from rhmc.learning.learner import Learners
from rhmc.types import Batch, Carry, Frozen, Obs, Spec, State, Transition

STEP = 1.0
ABOUT = About("Bandits", "none", "value-based", "decentralised", "decentralised", "none", "none")


class Config(Frozen):
    """Settings."""

    kind: Literal["bandits"] = "bandits"
    rate: float = Field(0.1, gt=0, le=1)
    epsilon: float = Field(0.2, ge=0, le=1)


class Bandits:
    """See the module."""

    def __init__(self, cfg: Config, spec: Spec, num_envs: int, rng: Generator) -> None:
        self.cfg, self.rng = cfg, rng
        self.values = torch.zeros(spec.agents, spec.actions)

    def carry(self, batch: int) -> Carry:
        return {}

    def act(self, obs: Obs, carry: Carry, rng: Generator, *, explore: bool) -> tuple[Tensor, Carry, Batch]:
        batch, (agents, actions) = len(obs.first), self.values.shape
        best = self.values.argmax(-1).expand(batch, agents)
        if not explore:
            return best, carry, {}
        other = torch.randint(actions, (batch, agents), generator=rng)
        return torch.where(torch.rand(batch, agents, generator=rng) < self.cfg.epsilon, other, best), carry, {}

    def observe(self, transition: Transition) -> None:
        for action, reward in zip(transition.action, transition.reward, strict=True):
            at = (torch.arange(len(action)), action)
            noise = 0.01 * torch.rand(len(action), generator=self.rng)
            self.values[at] += STEP * self.cfg.rate * (reward + noise - self.values[at])

    def update(self) -> Batch:
        return {"value": self.values.max()}

    def learners(self) -> Learners:
        return []

    def state_dict(self) -> State:
        return {"values": self.values.clone(), "rng": self.rng.get_state()}

    def load_state_dict(self, state: State) -> None:
        self.values = state["values"].clone()
        self.rng.set_state(state["rng"])


def build(cfg: Config, spec: Spec, num_envs: int, rng: Generator) -> Bandits:
    return Bandits(cfg, spec, num_envs, rng)


register_method("bandits", Method(Config, build, ABOUT))
'''
TASK = (
    Path(toy.__file__)
    .read_text(encoding="utf-8")
    .replace("from math import pi\n", "import sys\nfrom math import pi\n")
    .replace("import EnvConfig, Outcome", "import EnvConfig, Outcome, Task, register_task")
    .replace('kind: Literal["toy"] = "toy"', 'kind: Literal["ring"] = "ring"')
    + '\n\nregister_task("ring", Task(Config, sys.modules[__name__]))\n'
)
OFFERS = """

def stay(cfg: Config, state: State, rng: Generator) -> Tensor:
    return torch.zeros(state.bearing.shape[:2], dtype=torch.int64)


def paint(brush: Any, scene: Any) -> None:
    for place, bearing in enumerate(scene.state.bearing[0, :, 0].tolist()):
        brush.disc(bearing / HEADINGS, place / 4, 0.1, (28, 126, 62))


register_offers("ring", Offers(("return", "faced"), "share of targets faced", "faced", {"stay": stay}, paint))
"""
STUDY = """\
question: Does a package of one's own go all the way?
imports: [bandits]
base:
  env: {kind: ring, agents: 2, targets: 2}
  algo: {kind: bandits}
  trainer: {num_envs: 4, evaluations: 3, eval_episodes: 4, final_episodes: 4}
arms:
  bandits: {}
  MAPPO: {algo: {kind: mappo, hidden_dim: 8, n_steps: 8, minibatches: 1}}
seeds: 1
steps: 600
"""


def write(folder: Path, name: str = NAME, *, offers: bool = False) -> Path:
    """The package in a folder: two pages, and a module that nothing imports.

    offers: the task also has a policy without learning, a headline and a painter.
    """
    package = folder / name
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("from . import methods, tasks\n")
    (package / "methods.py").write_text(METHOD)
    more = "from rhmc.yardsticks import Offers, register_offers\nfrom typing import Any\n" if offers else ""
    (package / "tasks.py").write_text(more + TASK + OFFERS * offers)
    (package / "beside.py").write_text("SPARE = 1\n")
    return package


@contextmanager
def untouched() -> Iterator[None]:
    """What is imported and registered meanwhile is forgotten afterwards."""
    tables = [dict(table) for table in plugins.FILLED]
    before = set(sys.modules)
    kept = [dict(one) for one in (own_packages._named, own_packages._waiting, own_packages._finder.folders)]
    plugins._of_variable.cache_clear()
    try:
        yield
    finally:
        for table, old in zip(plugins.FILLED, tables, strict=True):
            table.clear()
            table.update(old)
        tops = {top_of(name) for name in own_packages._named} - {top_of(name) for name in kept[0]}
        for name in set(sys.modules) - before:
            if top_of(name) in tops:
                del sys.modules[name]
        live = (own_packages._named, own_packages._waiting, own_packages._finder.folders)
        for one, earlier in zip(live, kept, strict=True):
            one.clear()
            one.update(earlier)
        plugins._of_variable.cache_clear()
