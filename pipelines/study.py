"""Studies: a YAML file says what is compared, and resolves to the runs that answer its question.

A file has `question`, `base` (env, algo, trainer), `arms` (each changes the base), `seeds` and `steps` (a number, or
one for each profile), and may have `profiles` (what else a profile changes in the base) and `resources`. The layers of
a run are base, profile, arm. All that is wrong with a file is found before anything starts.
"""

import hashlib
import json
from collections.abc import Iterable, Sequence
from functools import reduce
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

from pydantic import BaseModel, Field, field_validator

from pipelines.document import Fault, Node, Place, Unreadable, choices, join, merge, override, read, show, validate
from pipelines.errors import InputError
from rhmc import trainer
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS, EnvConfig
from rhmc.types import Frozen

PROFILES = ("quick", "paper")
SECTIONS = ("env", "algo", "trainer")
TABLES: dict[str, dict[str, type[Any]]] = {  # the configuration of every kind
    "env": {kind: entry[0] for kind, entry in ENVS.items()},
    "algo": {kind: method.config for kind, method in ALGORITHMS.items()},
}
TWIN = "is the same as arm"
COMMON = {"env": "observation", "algo": "encoder"}  # what must not differ between methods by oversight


class StudyError(InputError):
    """Every fault of a study, one a line."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        self.faults = sorted(set(faults), key=lambda f: (f.place.source.startswith("--set"), *f))
        super().__init__("\n".join(str(fault) for fault in self.faults))


class Setting(Frozen):
    """A run but for its seed."""

    env: EnvConfig = Field(discriminator="kind")
    algo: Any
    trainer: trainer.Config

    @field_validator("algo", mode="before")
    @classmethod
    def _algo_of_kind(cls, value: Any) -> Any:
        """A plain mapping becomes the configuration that its kind names."""
        return ALGORITHMS[value["kind"]].config.model_validate(value) if isinstance(value, dict) else value

    def canonical(self) -> str:
        """JSON with every default written out and keys sorted: equal exactly for equal settings."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))


class RunSpec(Setting):
    """All that decides a run's result, the code and its libraries aside."""

    seed: int = Field(ge=0, lt=1_000_000)  # the evaluation banks' generators are seeded from 10 million on

    @property
    def id(self) -> str:
        """12 hex digits that name the run."""
        return hashlib.sha256(self.canonical().encode()).hexdigest()[:12]


class PlannedRun(NamedTuple):
    """A run in its study."""

    study: str
    arm: str
    spec: RunSpec


class Resources(Frozen):
    """How a study is run; changes no result."""

    concurrent: int = Field(2, ge=1, description="runs at a time")
    cpus: int = Field(1, ge=1, description="processors of a run")
    checkpoint_every: int = Field(10, ge=1, description="points of the evaluation grid between checkpoints")
    animate: Literal["first", "all", "none"] = Field("first", description="seeds whose runs keep an animated episode")


class Study(Frozen):
    """A study resolved for one profile: every arm is a complete setting."""

    name: str
    profile: str
    question: str
    base: Setting
    arms: dict[str, Setting]
    seeds: int
    steps: int
    resources: Resources
    file: str = ""  # as given, for commands that a person can repeat
    overrides: tuple[str, ...] = ()

    @classmethod
    def load(cls, path: Path | str, profile: str = "quick", overrides: Sequence[str] = ()) -> Self:
        """Read, merge and check a study.

        Args:
            path: the file; its stem is the study's name.
            profile: one of `PROFILES`.
            overrides: `key=value`, key a dotted path of the file (`seeds`, `base.algo.lr`, `arms.full.env.agents`),
                merged into it as an arm is into the base. `env.`, `algo.` and `trainer.` stand for `base.env.` and so
                on, and `trainer.steps` for `steps`. They go before a profile's changes; an arm keeps what it states.

        Raises:
            StudyError: with every fault found.
        """
        path = Path(path)
        faults = [] if profile in PROFILES else [_no_profile(profile)]
        root, found = read(path)
        faults += found
        if root is None or not isinstance(root.value, dict):
            raise StudyError(faults or [_no_mapping(path, root)])
        if not path.stem.replace("_", "").replace("-", "").isalnum():
            faults.append(Fault(Place(str(path)), "", "a study's file is named with letters, digits, '-' and '_' only"))
        patches, found = _patches(root, overrides)
        root = _normal(reduce(merge, patches, root))
        file, structure = validate(File, root)
        settings = {name: _settings(root, name, patches) for name in PROFILES}
        wanted = settings.get(profile) or settings[PROFILES[0]]
        faults += found + structure
        # An arm that is wrong in its shape resolves to the base: that it is the same as another is no news then.
        faults += [f for one in settings.values() for f in one.faults if not (structure and TWIN in f.text)]
        if file is not None and profile in PROFILES:
            faults += [f for name in ("seeds", "steps") for f in _no_value(root, name, profile)]
        if faults or file is None or wanted.base is None:
            raise StudyError(faults)
        resolved = {"seeds": getattr(file.seeds, profile), "steps": getattr(file.steps, profile)}
        fixed = {"question": file.question.strip(), "resources": file.resources, "profile": profile}
        fixed |= {"file": str(path), "overrides": tuple(overrides)}
        return cls(name=path.stem, base=wanted.base, arms=wanted.arms, **fixed, **resolved)

    def runs(self) -> list[PlannedRun]:
        """Every run: arms in the file's order, seeds 0, 1, ..."""
        return [
            PlannedRun(self.name, arm, RunSpec(**dict(setting), seed=seed))
            for arm, setting in self.arms.items()
            for seed in range(self.seeds)
        ]


def changes(base: Setting, setting: Setting) -> dict[str, Any]:
    """What differs from the base, by dotted path; of another kind, the kind alone."""
    differs: dict[str, Any] = {}
    for section in SECTIONS:
        before, after = getattr(base, section), getattr(setting, section)
        if type(before) is not type(after):
            differs[f"{section}.kind"] = after.kind
            continue
        names = [name for name in type(after).model_fields if getattr(before, name) != getattr(after, name)]
        differs |= {f"{section}.{name}": getattr(after, name) for name in names}
    return differs


# The file's shape. What stands inside env, algo and trainer is checked once the layers are merged.


class Layer(Frozen):
    """What the base, a profile or an arm states."""

    env: dict[str, Any] = Field(default_factory=dict)
    algo: dict[str, Any] = Field(default_factory=dict)
    trainer: dict[str, Any] = Field(default_factory=dict)


class Base(Layer):
    """What every run starts from."""

    env: dict[str, Any]
    algo: dict[str, Any]


class Counts(Frozen):
    """A number for each profile."""

    quick: int | None = Field(None, ge=1, le=10**12)
    paper: int | None = Field(None, ge=1, le=10**12)


class SeedCounts(Frozen):
    """A number of seeds for each profile."""

    quick: int | None = Field(None, ge=1, le=1000)
    paper: int | None = Field(None, ge=1, le=1000)


class Layers(Frozen):
    """What each profile changes."""

    quick: Layer = Layer()
    paper: Layer = Layer()


class File(Frozen):
    """A study's file."""

    question: str = Field(min_length=1)
    base: Base
    arms: dict[str, Layer] = Field(min_length=1)
    seeds: SeedCounts
    steps: Counts
    profiles: Layers = Layers()
    resources: Resources = Resources()


# Overrides


def _patches(root: Node, overrides: Iterable[str]) -> tuple[list[Node], list[Fault]]:
    """Each override as a tree to be merged into the file's."""
    patches: list[Node] = []
    faults: list[Fault] = []
    for text in overrides:
        key, equals, value = text.partition("=")
        parts = _target(root, key.strip())
        source = f"--set {text}"
        arms = list(root.children.get("arms", root).children)
        if parts[0] == "arms" and len(parts) > 2 and parts[1] not in arms:  # a whole arm may be added
            faults.append(Fault(Place(source), "arms", f"no arm '{parts[1]}'; {choices(parts[1], arms)}"))
            continue
        if not equals or not all(parts):
            faults.append(Fault(Place(source), "", "must be key=value, as in --set seeds=1 or --set algo.lr=1e-3"))
            continue
        node, found = override(source, ".".join(parts), value)
        faults += found
        if node is not None:
            patches.append(_nested(parts, node))
        elif not found:
            faults.append(Fault(Place(source), ".".join(parts), "no value"))
    return patches, faults


def _target(root: Node, key: str) -> list[str]:
    """Keys from the root to what an override names; names with dots in them are matched against what is there."""
    parts = key.split(".")
    parts = ["base", *parts] if parts[0] in SECTIONS else parts
    if parts == ["base", "trainer", "steps"]:
        return ["steps"]
    names = list(root.children.get("arms", root).children)
    for name in names if parts[0] == "arms" else []:
        words = name.split(".")
        if parts[1 : 1 + len(words)] == words:
            return ["arms", name, *parts[1 + len(words) :]]
    return parts


def _nested(parts: Sequence[str], node: Node) -> Node:
    for i in reversed(range(len(parts))):
        node = Node({parts[i]: node}, node.place, node.place, ".".join(parts[:i]))
    return node


# Layers to settings


class _Settings(NamedTuple):
    base: Setting | None
    arms: dict[str, Setting]
    faults: list[Fault]


def _normal(root: Node) -> Node:
    """One form for what may be written shortly: a number for all profiles, an arm with nothing in it."""
    children = dict(root.children)
    for name in ("seeds", "steps"):
        node = children.get(name)
        if node is not None and not isinstance(node.value, dict):
            children[name] = node._replace(value=dict.fromkeys(PROFILES, node))
    for name in ("arms", "profiles"):
        if name in children and children[name].children:
            filled = {k: v._replace(value={}) if v.value is None else v for k, v in children[name].children.items()}
            children[name] = children[name]._replace(value=filled)
    return root._replace(value=children)


def _settings(root: Node, profile: str, patches: Sequence[Node]) -> _Settings:
    """Resolve the base and every arm for a profile. Overrides of the base go before what the profile changes in it."""
    layers = [root.children.get("base"), _child(_child(root, "profiles"), profile)]
    layers += [_child(patch, "base") for patch in patches]
    stated = [layer for layer in layers if layer is not None and isinstance(layer.value, dict)]
    common = [reduce(merge, stated)] if stated else []
    steps = _child(_child(root, "steps"), profile)
    base, found = _setting(common, steps)
    faults, arms = list(found), dict[str, Setting]()
    owners: dict[Fault, list[str]] = {}
    for name, arm in (_child(root, "arms") or root._replace(value={})).children.items():
        faults += _name_faults(name, arm) + _unstated(common[0] if common else None, arm)
        setting, found = _setting([*common, arm], steps)
        for fault in set(found) - set(faults):
            owners.setdefault(fault, []).append(name)
        if setting is not None:
            faults += _twin(setting, arms, arm, name)
            arms[name] = setting
    faults += [_owned(fault, names) for fault, names in owners.items()]
    return _Settings(base, arms, faults)


def _setting(layers: Sequence[Node], steps: Node | None) -> tuple[Setting | None, list[Fault]]:
    parts, faults = {}, []
    for section in SECTIONS:
        node = _section(layers, section)
        if node is not None:
            parts[section], found = _trainer(node, steps) if section == "trainer" else _of_kind(section, node)
            faults += found
    complete = len(parts) == len(SECTIONS) and all(part is not None for part in parts.values())
    if not complete or faults:
        return None, faults
    setting = Setting(**parts)
    faults = _misfit(setting, layers)
    return (None if faults else setting), faults


def _misfit(setting: Setting, layers: Sequence[Node]) -> list[Fault]:
    """A method that cannot act in its task, at the place of the task's field that it cannot do with."""
    text = trainer.misfit(setting.env, setting.algo)
    if not text:
        return []
    field, _, fault = text.partition(": ")
    env = _section(layers, "env")
    node = _child(env, field) or env
    return [Fault(node.place, node.path, fault)] if node else []


def _section(layers: Sequence[Node], name: str) -> Node | None:
    """One section of all layers merged; None where the file's shape is wrong, which is said elsewhere."""
    stated = [layer.children[name] for layer in layers if name in layer.children]
    if not stated and name == "trainer" and layers:
        return layers[0]._replace(value={})
    if not stated or not all(isinstance(node.value, dict) for node in stated):
        return None
    return reduce(merge, stated)


def _of_kind(section: str, node: Node) -> tuple[BaseModel | None, list[Fault]]:
    table, kind = TABLES[section], node.children.get("kind")
    if kind is None and node.path.startswith("base."):
        return None, [Fault(node.key, join(node.path, "kind"), f"missing; allowed: {', '.join(table)}")]
    if kind is None or isinstance(kind.value, Unreadable):
        return None, []  # said of the base, or of the value
    if not isinstance(kind.value, str) or kind.value not in table:
        return None, [Fault(kind.place, kind.path, f"{show(kind.value)} is not allowed; {choices(kind.value, table)}")]
    return validate(table[kind.value], node)


def _trainer(node: Node, steps: Node | None) -> tuple[BaseModel | None, list[Fault]]:
    children, faults = dict(node.children), []
    if "steps" in children:
        written = children.pop("steps")
        text = "a study's budget is the same for every run; write it as 'steps' at the top of the file"
        faults.append(Fault(written.key, written.path, text))
    if steps and isinstance(steps.value, int) and steps.value >= 1:
        children["steps"] = steps
    config, found = validate(trainer.Config, node._replace(value=children), hidden=("steps",))
    return config, faults + found


def _child(node: Node | None, key: str) -> Node | None:
    return node.children.get(key) if node else None


# Faults that no model finds


def _no_profile(profile: str) -> Fault:
    return Fault(Place("--profile"), "", f"{show(profile)} is not allowed; {choices(profile, PROFILES)}")


def _no_mapping(path: Path, root: Node | None) -> Fault:
    if root is None or root.value is None:
        return Fault(Place(str(path), 1, 1), "", f"empty; a study has {', '.join(File.model_fields)}")
    text = f"{show(root.value)} is not a study; must be a mapping with {', '.join(File.model_fields)}"
    return Fault(root.place, "", text)


def _no_value(root: Node, name: str, profile: str) -> list[Fault]:
    """A study may leave out a profile, until it is asked for."""
    node = root.children[name]
    given = [key for key, child in node.children.items() if child.value is not None]
    if profile in given:
        return []
    return [Fault(node.key, join(node.path, profile), f"missing; there is a value for: {', '.join(given) or 'none'}")]


def _name_faults(name: str, arm: Node) -> list[Fault]:
    if name and name == name.strip() and name.isprintable() and "/" not in name:
        return []
    return [Fault(arm.key, arm.path, f"{show(name)} is no name for an arm; use a few words, without '/'")]


def _unstated(base: Node | None, arm: Node) -> list[Fault]:
    """An arm of another kind inherits nothing, so what must be alike for all methods has to be said again."""
    faults = []
    for section, field in COMMON.items():
        before, after = _child(base, section), _child(arm, section)
        common, kind, other = _child(before, field), _child(before, "kind"), _child(after, "kind")
        if not (common and kind and after and other) or kind.value == other.value or field in after.children:
            continue
        config = TABLES[section].get(str(other.value))
        if config and field in config.model_fields:
            text = f"missing; another kind inherits nothing, and the base has {show(common.value)}: state it here"
            faults.append(Fault(after.place, join(after.path, field), text))
    return faults


def _twin(setting: Setting, arms: dict[str, Setting], arm: Node, name: str) -> list[Fault]:
    same = [other for other, there in arms.items() if there == setting]
    return [Fault(arm.key, arm.path, f"arm {show(name)} {TWIN} {show(other)}") for other in same[:1]]


def _owned(fault: Fault, arms: Sequence[str]) -> Fault:
    """Name the arms in which a fault shows, where its place does not."""
    if fault.path.startswith("arms."):
        return fault
    return fault._replace(text=f"{fault.text} (in arm {', '.join(show(name) for name in arms)})")
