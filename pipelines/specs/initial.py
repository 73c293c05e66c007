"""`trainer.init`: a run that starts from the networks of a trained policy.

    arms:
      from coverage: {trainer: {init: work/checkpoints/.../policy.pt}}   # or runs:/ID, or models:/NAME/VERSION

A study says where the policy is. A run keeps a digest of what it takes over (`rhmc.learning.initial`): it is the same
run wherever that lies, and another one as soon as a bit of it differs. This page puts the digests in the place of the
addresses and says what does not fit; `pipelines.tracking.initial` knows where policies are.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Generator

from pipelines.specs.document import Fault, Node, Unreadable, settings, show
from pipelines.workspace.errors import InputError
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS
from rhmc.learning.initial import started
from rhmc.types import Spec, State

if TYPE_CHECKING:
    from pipelines.specs.study import Setting

SECTION, FIELD = "trainer", "init"
DIGEST = re.compile(r"[0-9a-f]{16}")  # what a run keeps, `rhmc.training.trainer.Config.init`
# Settings of a method, in whatever block, without which its numbers mean other things.
SAME = ("encoder", "standardise")


class Policy(NamedTuple):
    """A policy that a study names."""

    digest: str
    address: str  # where it was found: an absolute path, runs:/ID or models:/NAME/VERSION
    setting: "Setting"  # of the run that made it
    state: State  # of its method
    remark: str  # what it is, for people


Find = Callable[[str, Path], Policy]  # by its address and the folder of the study; raises InputError


def nowhere(address: str, folder: Path) -> Policy:
    """Find no policy: for who reads a study apart from any work folder."""
    raise InputError("policies are not looked for here; `rhmc study` and `rhmc search` do")


class Starts:
    """The policies that a study names, each looked for once.

    Attributes:
        found: by digest.
        remarks: what each of them is, where it is named.
    """

    def __init__(self, folder: Path, find: Find) -> None:
        self.folder, self.find = folder, find
        self.found: dict[str, Policy] = {}
        self.remarks: dict[Fault, None] = {}
        self._looked: dict[str, Policy | str] = {}

    def named(self, node: Node) -> tuple[Node, list[Fault]]:
        """The tree of a study with digests in the place of addresses, and the faults of those that name nothing."""
        if isinstance(node.value, dict):
            pairs = {key: self._child(key, child, node) for key, child in node.value.items()}
            whole: Any = {key: child for key, (child, _) in pairs.items()}
            return node._replace(value=whole), [fault for _, found in pairs.values() for fault in found]
        return node, []

    def _child(self, key: str, child: Node, parent: Node) -> tuple[Node, list[Fault]]:
        """`init` in `trainer`, or its dotted name with a list of values in a grid or among readings."""
        here = key == FIELD and parent.path.rpartition(".")[2] == SECTION
        listed = key == f"{SECTION}.{FIELD}" and isinstance(child.value, list)
        if listed:
            each = [self._digest(one) for one in child.value] if isinstance(child.value, list) else []
            return child._replace(value=[one for one, _ in each]), [fault for _, found in each for fault in found]
        return self._digest(child) if here else self.named(child)

    def _digest(self, node: Node) -> tuple[Node, list[Fault]]:
        if not isinstance(node.value, str):
            return node, []  # null for none; the rest is no text, which the check of the shape says
        found = self._looked[node.value] if node.value in self._looked else self._look(node.value)
        if isinstance(found, str):
            return node._replace(value=Unreadable.VALUE), [Fault(node.place, node.path, found)]
        self.found[found.digest] = found
        self.remarks[Fault(node.place, node.path, found.remark)] = None
        return node._replace(value=found.digest), []

    def _look(self, address: str) -> Policy | str:
        try:
            found: Policy | str = self.find(address, self.folder)
        except InputError as error:
            found = f"{show(address)} is not allowed; {error.args[0]}"
        self._looked[address] = found
        return found

    def misfit(self, setting: "Setting") -> str:
        """The reason why a run cannot start from the policy that it names; nothing where it can, or names none."""
        policy = self.found.get(setting.trainer.init or "")
        return misfit(policy, setting) if policy else ""


def misfit(policy: Policy, setting: "Setting") -> str:
    """The first thing in which a policy does not fit a run, in a line; nothing if it fits."""
    for name, its, own in _compared(policy.setting, setting):
        if its != own:
            return f"the policy does not fit: {name} is {show(its)} there and {show(own)} here"
    try:
        _tried(policy.state, setting)
    except (ValueError, RuntimeError) as error:
        theirs, ours = _sizes(policy.setting), _sizes(setting)
        fixed = not str(setting.algo.encoder).startswith("pairwise") or not setting.algo.share
        if fixed and (theirs.agents, theirs.targets) != (ours.agents, ours.targets):
            counts = f"{_counts(theirs)} there and {_counts(ours)} here"
            allowed = "only 'encoder: pairwise' or 'pairwise_gru', with 'share: true', takes other numbers"
            return f"the policy does not fit: {counts}; {allowed}"
        others = ", ".join(_differing(policy.setting, setting)) or "none"
        return f"the policy does not fit: {error}; settings that differ: {others}"
    return ""


def _compared(its: "Setting", own: "Setting") -> Iterator[tuple[str, Any, Any]]:
    yield "algo.kind", its.algo.kind, own.algo.kind
    yield "env.kind", its.env.kind, own.env.kind
    yield "env.observation", its.env.observation, own.env.observation
    for name in settings(type(own.algo)):
        if name.rpartition(".")[2] in SAME:
            yield f"algo.{name}", attrgetter(name)(its.algo), attrgetter(name)(own.algo)


def _differing(its: "Setting", own: "Setting") -> Iterator[str]:
    for section in ("env", "algo"):
        a, b = getattr(its, section), getattr(own, section)
        yield from (f"{section}.{name}" for name in settings(type(b)) if attrgetter(name)(a) != attrgetter(name)(b))


def _sizes(setting: "Setting") -> Spec:
    sizes: Spec = ENVS[setting.env.kind].physics.spec(setting.env)
    return sizes


def _counts(sizes: Spec) -> str:
    return f"{sizes.agents} agents and {sizes.targets} targets"


def _state(setting: "Setting") -> State:
    """Of the method as it is drawn."""
    with torch.random.fork_rng(devices=[]):
        built = ALGORITHMS[setting.algo.kind].build(
            setting.algo, _sizes(setting), setting.trainer.num_envs, Generator()
        )
    return built.state_dict()


def _tried(policy: State, setting: "Setting") -> None:
    """Raises ValueError if the state has parts of other shapes than the run."""
    started(_state(setting), policy)


def addresses(found: Mapping[str, Policy]) -> dict[str, str]:
    """Address of each policy, by digest."""
    return {digest: policy.address for digest, policy in found.items()}
