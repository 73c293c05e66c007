"""Searches: a study's file whose arms have a space, and a budget of trials.

    question: Which settings suit RHMC in coverage?
    base:   {env: {...}, algo: {kind: rhmc, ...}, trainer: {...}}
    arms:
      RHMC: {space: {alpha: {low: 0, high: 0.2}, horizon: {choices: [1, 2, 4]}, lr: {low: 1e-4, high: 3e-3, log: true}}}
      QMIX: {algo: {kind: qmix, encoder: pairwise}, space: {gamma: {low: 0.9, high: 0.99}}}
    trials: {quick: 8, paper: 60}
    seeds:  {quick: 2, paper: 3}     # every trial trains all of them
    steps:  {quick: 50_000, paper: 500_000}
    sampler: {kind: tpe}
    pruner: {kind: median}

An arm may change the method and nothing else: task, evaluation, trials, seeds and steps are the same for all arms, so
that no method is searched harder than another. There is neither a grid nor a variant. Nothing here knows Optuna.
"""

import hashlib
import itertools
import json
from collections.abc import Collection, Iterator, Sequence
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self, get_args

from pydantic import Field, model_validator

from pipelines.specs import renamed
from pipelines.specs.document import Fault, Node, Place, choices, join, merge, settings, show, validate
from pipelines.specs.grid import nested
from pipelines.specs.identity import code_id
from pipelines.specs.include import closure
from pipelines.specs.initial import Find, addresses, nowhere
from pipelines.specs.plugins import COORDINATOR, configs, pages
from pipelines.specs.safe_names import study_name
from pipelines.specs.study import (
    TWIN,
    Base,
    Counts,
    Layer,
    Resources,
    SeedCounts,
    Setting,
    StudyError,
    load_layers,
)
from rhmc.types import Frozen

FIRST_SEED = 500_000  # a search trains on seeds of its own, so that a study tries its winner on others
EVAL_SEED = 20_000_000  # evaluation episodes of its own, unless the file names others
COMBINATIONS = 2_000  # of extremes, that are tried in a check
COUNTS = ("trials", "seeds", "steps")

Value = str | int | float | bool | None


class Dimension(Frozen):
    """The values that one setting may take: from `low` to `high`, or one of `choices`."""

    low: float | None = None
    high: float | None = None
    log: bool = Field(False, description="sampled evenly in the logarithm")
    step: float | None = Field(None, gt=0)
    choices: list[Any] | None = Field(None, min_length=1)
    whole: bool = Field(False, description="only whole numbers; follows from the method's field")

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if self.choices is not None:
            return self._a_list()
        if self.low is None or self.high is None:
            raise ValueError("must have 'low' and 'high', or 'choices'")
        if self.low >= self.high:
            raise ValueError(f"high: {self.high:g} is not allowed; must be above low")
        if self.log and self.low <= 0:
            raise ValueError(f"low: {self.low:g} is not allowed; must be above 0 where log is true")
        if self.log and self.step is not None:
            raise ValueError("step: not allowed where log is true")
        if self.step is not None and abs((steps := (self.high - self.low) / self.step) - round(steps)) > 1e-9:
            raise ValueError(f"high: {self.high:g} is not allowed; must be low and a whole number of steps")
        return self

    def _a_list(self) -> Self:
        if not (self.low is self.high is self.step is None) or self.log:
            raise ValueError("choices: not allowed beside low, high, log or step")
        assert self.choices is not None
        odd = [value for value in self.choices if isinstance(value, dict | list)]
        if odd:
            raise ValueError(f"choices: {show(str(odd[0]))} is not allowed; must be numbers or words")
        if len({json.dumps(value) for value in self.choices}) < len(self.choices):
            raise ValueError("choices: one is there twice")
        return self

    def __str__(self) -> str:
        if self.choices is not None:
            return "{" + ", ".join(v if isinstance(v, str) else json.dumps(v) for v in self.choices) + "}"
        notes = (", log" if self.log else "") + ("" if self.step is None else f", step {self.step:g}")
        return f"{self.low:g} to {self.high:g}{notes}"


class Sampler(Frozen):
    """The method that proposes settings."""

    kind: Literal["tpe", "random"] = "tpe"
    seed: int = Field(0, ge=0)
    startup: int = Field(10, ge=1, description="trials at random before TPE begins")


class Pruner(Frozen):
    """Rule for pruning trials, by the mean of all their seeds at a point of the curve."""

    kind: Literal["none", "median", "asha"] = "none"
    startup: int = Field(5, ge=1, description="median: trials that are never given up")
    warmup: int = Field(1, ge=1, description="points of the curve before the first decision")
    reduction: int = Field(3, ge=2, description="asha: one in this many trials goes on")


class SearchArm(Frozen):
    """The keys that an arm may state. Its space is checked against its method later."""

    algo: dict[str, Any] = Field(default_factory=dict)
    space: dict[str, Any] = Field(min_length=1)


class Profiles(Frozen):
    """The changes of each profile in the base: no profile does with fewer arms."""

    quick: Layer = Layer()
    paper: Layer = Layer()


class File(Frozen):
    """A search's file."""

    question: str = Field(min_length=1)
    preset: Literal["tuned", "paper"] | None = None
    base: Base
    arms: dict[str, SearchArm] = Field(min_length=1)
    trials: Counts
    seeds: SeedCounts
    steps: Counts
    sampler: Sampler = Sampler()
    pruner: Pruner = Pruner()
    profiles: Profiles = Profiles()
    resources: Resources = Resources()
    imports: list[str] = Field(default_factory=list)


class Arm(NamedTuple):
    """One method and its space, by dotted name of a setting."""

    setting: Setting
    space: dict[str, Dimension]

    def at(self, params: dict[str, Value]) -> Setting:
        """The setting with values from the space.

        Raises:
            ValueError: the method has no such setting (a rule across fields).
        """
        algo = self.setting.algo.model_dump()
        for key, value in params.items():
            *blocks, name = key.split(".")
            reduce(getitem, blocks, algo)[name] = value
        return Setting.model_validate({"env": self.setting.env, "trainer": self.setting.trainer, "algo": algo})

    def fixed(self) -> str:
        """The setting as `Setting.stated` has it, without what the space replaces: equal where all trials are."""
        stated = json.loads(self.setting.stated())
        stated["algo"] = _outside(self.space, stated["algo"])
        return json.dumps(stated, sort_keys=True, separators=(",", ":"))


def _outside(space: Collection[str], block: dict[str, Any], before: str = "") -> dict[str, Any]:
    """The settings of a block that are not in the space, and of its blocks those that have any left."""
    inner = {name: _outside(space, one, f"{before}{name}.") for name, one in block.items() if isinstance(one, dict)}
    kept = block | inner
    return {name: one for name, one in kept.items() if before + name not in space and one != {}}


class Search(Frozen):
    """A search resolved for one profile."""

    name: str
    profile: str
    question: str
    arms: dict[str, Arm]
    trials: int
    seeds: int
    steps: int
    sampler: Sampler
    pruner: Pruner
    resources: Resources
    file: str
    sha256: str  # of the file, and of what it includes
    overrides: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()  # as a study's
    policies: dict[str, str] = Field(default_factory=dict)  # as a study's

    @classmethod
    def load(
        cls, path: Path | str, profile: str = "quick", overrides: Sequence[str] = (), find: Find = nowhere
    ) -> Self:
        """Read, merge and check a search. Arguments and errors as in `Study.load`."""
        path = Path(path)
        loaded = load_layers(path, File, profile, overrides, COUNTS, find=find)
        faults = [fault for fault in loaded.faults if TWIN not in fault.text]
        if loaded.file is None or faults:
            raise StudyError(_no_search(loaded.root) or faults)
        arms: dict[str, Arm] = {}
        for name, setting in loaded.wanted.arms.items():
            arms[name], found = _arm(loaded.root.children["arms"].children[name], setting)
            faults += found
        if faults:
            raise StudyError(faults)
        file = loaded.file
        counts = {name: getattr(getattr(file, name), profile) for name in COUNTS}
        parts = {name: getattr(file, name) for name in ("sampler", "pruner", "resources")}
        names = {"name": study_name(path), "profile": profile, "file": str(path)}
        remarks = tuple(map(str, dict.fromkeys(loaded.wanted.remarks)))
        told = {"overrides": tuple(overrides), "remarks": remarks, "policies": addresses(loaded.policies)}
        digest = hashlib.sha256(b"".join(file.read_bytes() for file in closure(path))).hexdigest()
        return cls(question=file.question.strip(), arms=arms, sha256=digest, **names, **told, **counts, **parts)

    def seed_list(self) -> list[int]:
        """The seeds of every trial."""
        return list(range(FIRST_SEED, FIRST_SEED + self.seeds))

    def code(self, arm: str) -> str:
        """The code that decides the trials of an arm, with that of every coordinator that its space may choose."""
        one = self.arms[arm]
        methods = one.space.get(f"{COORDINATOR}.method")
        chosen = {page for name in (methods.choices or () if methods else ()) for page in pages({COORDINATOR: name})}
        setting = one.setting
        return code_id(setting.algo.kind, setting.env.kind, tuple(sorted({*setting.imports, *chosen})))

    def identity(self, arm: str) -> str:
        """12 hex digits over all that decides what the trials of an arm are and give, but for how many there are.

        More trials continue a search, anything else begins another.
        """
        one = self.arms[arm]
        parts = [one.fixed(), *(f"{k}={v.model_dump_json()}" for k, v in sorted(one.space.items()))]
        parts += [self.sampler.model_dump_json(), self.pruner.model_dump_json(), str(self.seeds), self.code(arm)]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


# Spaces


def _arm(node: Node, setting: Setting) -> tuple[Arm, list[Fault]]:
    if "eval_seed" not in setting.trainer.model_fields_set:
        own = setting.trainer.model_copy(update={"eval_seed": EVAL_SEED})
        setting = setting.model_copy(update={"trainer": own})
    space: dict[str, Dimension] = {}
    faults: list[Fault] = []
    for name, child in node.children["space"].children.items():
        dimension, found = _dimension(name, child, setting)
        faults += found
        if dimension is not None:
            space[name] = dimension
    if not faults:
        faults = _impossible(node.children["space"], space, setting)
    return Arm(setting, space), faults


def _dimension(name: str, node: Node, setting: Setting) -> tuple[Dimension | None, list[Fault]]:
    """One entry of a space, its bounds tried out in the method one at a time."""
    fields = settings(type(setting.algo))
    allowed = [field for field in fields if field != "kind"]
    if name not in allowed:
        unknown = f"'{setting.algo.kind}' has no setting {show(name)}; {choices(name, allowed)}"
        text = renamed.hint(name, allowed, dotted=True) or unknown
        return None, [Fault(node.key, node.path, text)]
    dimension, faults = validate(Dimension, node, hidden=("whole",))
    if dimension is None:
        return None, faults
    dimension = dimension.model_copy(update={"whole": _whole(fields[name].annotation)})
    if dimension.whole and dimension.step is not None and dimension.step % 1:
        step = node.children["step"]
        return None, [Fault(step.place, step.path, f"{show(step.value)} is not allowed; must be a whole number")]
    for value in _extremes(node):
        # A rule across fields may speak of another field: that is for the combinations to find.
        faults += [fault for fault in _tried(setting, {name: value}) if fault.path == value.path]
    return dimension, faults


def _whole(annotation: Any) -> bool:
    """True if a field holds whole numbers alone."""
    kinds = set(get_args(annotation)) or {annotation}
    return int in kinds and float not in kinds


def _extremes(node: Node) -> list[Node]:
    """The written ends, or all choices, of a dimension."""
    listed = node.children.get("choices")
    if listed is not None and isinstance(listed.value, list):
        return list(listed.value)
    return [node.children[name] for name in ("low", "high")]


def _tried(setting: Setting, values: dict[str, Node]) -> list[Fault]:
    """The faults that the method finds in these values; a fault about a value is at its place."""
    place = next(iter(values.values())).place
    layers = [nested(key.split("."), value) for key, value in values.items()]
    whole = reduce(merge, layers, _written("", setting.algo.model_dump(mode="json"), place))
    return validate(configs("algo")[setting.algo.kind], whole)[1]


def _written(key: str, value: Any, place: Place) -> Node:
    """A value that stands elsewhere as a node at `place`."""
    if isinstance(value, list):
        value = [_written(join(key, str(i)), child, place) for i, child in enumerate(value)]
    elif isinstance(value, dict):
        value = {name: _written(join(key, name), child, place) for name, child in value.items()}
    return Node(value, place, place, key)


def _impossible(node: Node, space: dict[str, Dimension], setting: Setting) -> list[Fault]:
    """The first combination of extremes that the method refuses, though it takes each one."""
    for values in _combinations(node, space):
        if faults := _tried(setting, values):
            way = ", ".join(f"{key}={show(value.value)}" for key, value in values.items())
            return [Fault(node.key, node.path, f"'{setting.algo.kind}' refuses {way}: {faults[0].text}")]
    return []


def _combinations(node: Node, space: dict[str, Dimension]) -> Iterator[dict[str, Node]]:
    ends = [_extremes(node.children[name]) for name in space]
    for values in itertools.islice(itertools.product(*ends), COMBINATIONS):
        yield dict(zip(space, values, strict=True))


def _no_search(root: Node) -> list[Fault]:
    """Say this alone where a study was given."""
    arms = root.children.get("arms", root).children
    if not arms or any("space" in arm.children for arm in arms.values()):
        return []
    text = "no arm has a space: a study, for `rhmc study check`, `run` and `status`, is no search"
    return [Fault(Place(root.place.source, 1, 1), "", text)]
