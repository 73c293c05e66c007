"""Studies: a YAML file says what is compared, and resolves to the runs that answer its question.

A file has `question`, `base` (env, algo, trainer), `arms` (each changes the base), `seeds` and `steps` (a number, or
one for each profile), and may have `grid` (lists of values for dotted keys: every arm, or the base without arms, is
taken to every combination) or `readings` (every arm is taken to each, see `pipelines.specs.readings`), `variants`
(each changes every arm, whatever its kind), `preset` (settings under all that is stated), `profiles` (what else a
profile changes in the base, and in single arms as `changes`; the arms, the values of the grid and the design of the
readings that it is content with) and `resources`. The layers of a run are preset, base, profile, reading, arm, the
profile's change of the arm, point of the grid, variant. All that is wrong with a file is found before anything starts.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, NamedTuple, Self, TypeVar

from pydantic import BaseModel, Field, SerializeAsAny, ValidationInfo, field_validator, model_validator

from pipelines.specs import limits, plugins
from pipelines.specs.document import (
    Fault,
    Node,
    Place,
    Unreadable,
    choices,
    join,
    merge,
    override,
    plain,
    read,
    settings,
    show,
    validate,
)
from pipelines.specs.grid import MOST, Point, nested, points, replaced
from pipelines.specs.include import PRESET, Preset, included
from pipelines.specs.initial import FIELD, Find, Policy, Starts, addresses, nowhere
from pipelines.specs.plugins import configs
from pipelines.specs.readings import NOTHING, Cell, Plan, ProfileReadings, Reading, Readings, Spelled, spelled
from pipelines.specs.safe_names import ARM, PROFILES, alike, fault_of_study, simple, study_name, too_long
from pipelines.workspace.errors import InputError, seen
from rhmc.envs import EnvConfig
from rhmc.training import trainer
from rhmc.types import Frozen

SECTIONS = ("env", "algo", "trainer")
IMPORTS = "imports"  # of a study, what it names; of a setting, what it needs
SPACE = "space"  # of a search's arm; it may include as sections do
COUNTS = ("seeds", "steps")  # fields of a study that hold a number for each profile
NAMED = 3  # arms that a fault names
VARIANTS = 100  # of a study
TWIN = "is the same as arm"
M = TypeVar("M", bound=BaseModel)
COMMON = {"env": "observation", "algo": "encoder"}  # what must not differ between methods by oversight


class StudyError(InputError):
    """Every fault of a study, one a line."""

    def __init__(self, faults: Sequence[Fault]) -> None:
        self.faults = sorted(_once(faults), key=lambda f: (f.place.source.startswith("--set"), *f))
        super().__init__(*map(str, self.faults))


def _once(faults: Iterable[Fault]) -> list[Fault]:
    """Each fault once; where several methods refuse a value, that of the method that allows least."""
    found: dict[tuple[Any, ...], Fault] = {}
    for fault in sorted(faults, key=lambda fault: len(fault.text)):
        found.setdefault((fault.place, fault.path, fault.text.partition(" is not allowed; allowed:")[0]), fault)
    return list(found.values())


def fields() -> list[str]:
    """Every dotted name of a run's settings, of all kinds that are registered now."""
    tables: dict[str, dict[str, Any]]
    tables = {"env": configs("env"), "algo": configs("algo"), "trainer": {"": trainer.Config}}
    return [
        f"{section}.{field}"
        for section, table in tables.items()
        for field in sorted({name for config in table.values() for name in settings(config)})
    ]


class Setting(Frozen):
    """A run but for its seed.

    Raises:
        UnnamedError: it is of a package that nobody has named here, see `pipelines.specs.plugins`.
    """

    env: SerializeAsAny[EnvConfig]
    algo: Any
    trainer: trainer.Config
    # What defines method, task and coordinator outside this project; follows from their kinds, and names nothing.
    imports: tuple[str, ...] = Field((), exclude_if=lambda modules: not modules)

    @model_validator(mode="before")
    @classmethod
    def _with_imports(cls, data: Any) -> Any:
        """See that the modules are there, also where the record is from elsewhere, and write down which they are."""
        if not isinstance(data, dict):
            return data
        parts = {name: data.get(name) for name in ("env", "algo")}
        plugins.require(parts, data.get(IMPORTS))
        return data | {IMPORTS: plugins.pages(plugins.kinds_of(parts))}

    @field_validator("env", "algo", mode="before")
    @classmethod
    def _of_kind(cls, value: Any, field: ValidationInfo) -> Any:
        """A plain mapping becomes the configuration that its kind names."""
        if not isinstance(value, dict):
            return value
        section, kind = str(field.field_name), value.get("kind")
        table = configs(section)
        if not isinstance(kind, str) or kind not in table:
            raise ValueError(f"kind: {plugins.unknown(section, kind)}")
        return table[kind].model_validate(value)

    def canonical(self) -> str:
        """JSON with every default written out and keys sorted: equal exactly for equal settings."""
        return _json(self.model_dump(mode="json"))

    def stated(self) -> str:
        """As `canonical`, with the kinds and what differs from the defaults alone.

        A field that is new, with a default under which nothing changes, leaves it as it was; what a default does is in
        the code.
        """
        sections = {name: getattr(self, name) for name in SECTIONS}
        kinds = {"env": {"kind": self.env.kind}, "algo": {"kind": self.algo.kind}, "trainer": {}}
        return _json({k: kinds[k] | v.model_dump(mode="json", exclude_defaults=True) for k, v in sections.items()})


class RunSpec(Setting):
    """All that decides a run's result, the code and its libraries aside."""

    seed: int = Field(ge=0, lt=1_000_000)  # the generators of evaluation episodes are seeded from 10 million on

    @property
    def id(self) -> str:
        """12 hex digits that name the settings and the seed."""
        return hashlib.sha256(f"{self.stated()} {self.seed}".encode()).hexdigest()[:12]


def _json(tree: Any) -> str:
    return json.dumps(tree, sort_keys=True, separators=(",", ":"))


class PlannedRun(NamedTuple):
    """A run in its study."""

    study: str
    arm: str
    spec: RunSpec


class Resources(Frozen):
    """Resources and pace of a study; changes no result."""

    concurrent: int = Field(2, ge=1, description="runs at a time")
    cpus: int = Field(1, ge=1, description="processors of a run")
    checkpoint_every: int = Field(20, ge=1, description="points of the evaluation grid between checkpoints")
    animate: Literal["first", "all", "none"] = Field("first", description="seeds whose runs keep an animated episode")


class Study(Frozen):
    """A study resolved for one profile and variant: every arm is a complete setting."""

    name: str  # the file's stem; of a variant `stem@variant`, so that its runs and results have a place of their own
    profile: str
    question: str
    base: Setting
    arms: dict[str, Setting]
    seeds: int
    steps: int
    resources: Resources
    file: str = ""  # as given, for commands that a person can repeat
    overrides: tuple[str, ...] = ()
    variant: str = ""
    readings: Plan | None = None
    cells: dict[str, Cell] = Field(default_factory=dict)  # by arm, where the study has readings
    # Arms whose budget ends before they learn; what the policies are that runs start from.
    remarks: tuple[str, ...] = ()
    policies: dict[str, str] = Field(default_factory=dict)  # by digest, where those were found that runs start from

    @classmethod
    def load(
        cls,
        path: Path | str,
        profile: str = "quick",
        overrides: Sequence[str] = (),
        variant: str | None = None,
        find: Find = nowhere,
    ) -> Self:
        """Read, merge and check a study.

        Args:
            path: the file; its stem is the study's name.
            profile: one of `PROFILES`.
            overrides: `key=value`, key a dotted path of the file (`seeds`, `base.algo.lr`, `arms.full.env.agents`),
                merged into it as an arm is into the base. `env.`, `algo.` and `trainer.` stand for `base.env.` and so
                on, and `trainer.steps` for `steps`. They go before a profile's changes of the base;
                an arm keeps what it states, or the profile for it.
            variant: one of the file's `variants`; None for the arms as they stand.
            find: looks for the policies that `trainer.init` names.

        Raises:
            StudyError: with every fault found.
        """
        loaded = load_layers(Path(path), File, profile, overrides, COUNTS, gridded=GridFile, variant=variant, find=find)
        file, wanted = loaded.file, loaded.wanted
        if loaded.faults or file is None or wanted.base is None:
            raise StudyError(_no_study(loaded.root) or loaded.faults)
        resolved = {name: getattr(getattr(file, name), profile) for name in COUNTS}
        fixed: dict[str, Any] = {"question": file.question.strip(), "resources": file.resources, "profile": profile}
        fixed |= {"file": str(path), "overrides": tuple(overrides), "variant": variant or ""}
        name = study_name(Path(path), variant or "")
        fixed |= {"readings": wanted.readings, "cells": wanted.cells}
        fixed["remarks"] = tuple(map(str, dict.fromkeys(wanted.remarks)))
        fixed["policies"] = addresses(loaded.policies)
        return cls(name=name, base=wanted.base, arms=wanted.arms, **fixed, **resolved)

    def runs(self) -> list[PlannedRun]:
        """Every run: arms in the file's order, seeds 0, 1, ..."""
        return [
            PlannedRun(self.name, arm, RunSpec(**dict(setting), seed=seed))
            for arm, setting in self.arms.items()
            for seed in range(self.seeds)
        ]


def changes(base: Setting, setting: Setting) -> dict[str, Any]:
    """The differences from the base, by dotted path; of another kind, the kind alone."""
    differs: dict[str, Any] = {}
    for section in SECTIONS:
        before, after = getattr(base, section), getattr(setting, section)
        if type(before) is not type(after):
            differs[f"{section}.kind"] = after.kind
            continue
        values = {name: attrgetter(name) for name in settings(type(after))}
        differs |= {f"{section}.{name}": of(after) for name, of in values.items() if of(before) != of(after)}
    return differs


# The file's shape. What stands inside env, algo and trainer is checked once the layers are merged.


class Layer(Frozen):
    """The statements of the base, a profile or an arm."""

    env: dict[str, Any] = Field(default_factory=dict)
    algo: dict[str, Any] = Field(default_factory=dict)
    trainer: dict[str, Any] = Field(default_factory=dict)


class Base(Layer):
    """The settings that every run starts from."""

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


Grid = dict[str, Annotated[list[Any], Field(min_length=1)]]  # by dotted name of a setting


class Profile(Layer):
    """The changes of a profile in the base and in single arms, the arms that it runs, and the values of the grid."""

    arms: list[str] | None = Field(None, min_length=1)
    changes: dict[str, Layer] = Field(default_factory=dict)
    grid: Grid = Field(default_factory=dict)
    readings: ProfileReadings = ProfileReadings()


class Profiles(Frozen):
    """The changes of each profile."""

    quick: Profile = Profile()
    paper: Profile = Profile()


class File(Frozen):
    """A study's file. `preset`: what lies under all that it states, see `pipelines.specs.include`."""

    question: str = Field(min_length=1)
    preset: Literal["tuned", "paper"] | None = None
    base: Base
    arms: dict[str, Layer] = Field(min_length=1)
    grid: Grid = Field(default_factory=dict)
    readings: Readings | None = None
    variants: dict[str, Layer] = Field(default_factory=dict)
    seeds: SeedCounts
    steps: Counts
    profiles: Profiles = Profiles()
    resources: Resources = Resources()
    imports: list[str] = Field(default_factory=list)


class GridFile(File):
    """A study's file with a grid, which need not have arms."""

    arms: dict[str, Layer] = Field(default_factory=dict)
    grid: Grid = Field(min_length=1)


# Reading


class Resolved(NamedTuple):
    """The layers of a file merged for one profile and variant."""

    base: Setting | None
    arms: dict[str, Setting]
    faults: list[Fault]
    remarks: Sequence[Fault] = ()
    readings: Plan | None = None
    cells: dict[str, Cell] = {}  # noqa: RUF012


class Planned(NamedTuple):
    """An arm at a point of the grid, or under a reading: the arm as written, and all that it states."""

    written: str
    layer: Node
    reading: Reading | None = None


class Beside(NamedTuple):
    """Parts that a study takes from elsewhere."""

    preset: Preset
    starts: Starts


class Loaded(NamedTuple, Generic[M]):
    """A file whose layers are merged, and every fault so far; `file` is None where its shape is wrong."""

    file: M | None
    root: Node
    wanted: Resolved
    faults: list[Fault]
    policies: Mapping[str, Policy]


def load_layers(
    path: Path,
    model: type[M],
    profile: str,
    overrides: Sequence[str],
    counts: Sequence[str],
    *,
    gridded: type[M] | None = None,
    variant: str | None = None,
    find: Find = nowhere,
) -> Loaded[M]:
    """Read, merge and check what all files with arms have in common.

    Args:
        path: the file.
        model: its shape; what that does not know changes no arm.
        profile: one of `PROFILES`.
        overrides: see `Study.load`.
        counts: names of the fields that hold a number for each profile.
        gridded: its shape where it has a grid.
        variant: one of its `variants`; None for the arms as they stand.
        find: see `Study.load`.

    Raises:
        StudyError: there is no mapping to go on with, or a module that it imports cannot be used.
        InputError: `plugins.VARIABLE` names such a module.
    """
    root, patches, faults = _trees(path, model, profile, overrides)
    root = _normal(reduce(merge, patches, root), counts)
    if found := plugins.imported(root.children.get(IMPORTS), path.parent):
        raise StudyError([*faults, *found])
    plugins.discover()
    starts = Starts(path.parent, find)  # after what is imported, of which a policy may be
    beside = Beside(Preset(root.children.get(PRESET), path.parent), starts)
    whole = [starts.named(tree) for tree in (root, *patches)]
    root, patches = whole[0][0], [tree for tree, _ in whole[1:]]
    unnamed = list(dict.fromkeys(fault for _, found in whole for fault in found))
    file, structure = validate(gridded if gridded and "grid" in root.children else model, root)
    known = root._replace(value={key: child for key, child in root.children.items() if key in model.model_fields})
    variants = _group(known, "variants")
    resolved = {(p, v): _settings(known, p, v, patches, beside) for p in PROFILES for v in (None, *variants)}
    faults += structure + unnamed + _variant_faults(path, variants, variant)
    # An arm that is wrong in its shape resolves to the base: that it is the same as another is no news then.
    faults += [f for one in resolved.values() for f in one.faults if not ((structure or unnamed) and TWIN in f.text)]
    if file is not None and profile in PROFILES:
        faults += [f for name in counts for f in _no_value(root, name, profile)]
    wanted = resolved.get((profile, variant)) or resolved[PROFILES[0], None]
    remarks = [*wanted.remarks, *beside.preset.without, *starts.remarks]
    return Loaded(file, root, wanted._replace(remarks=remarks), faults, starts.found)


def _trees(
    path: Path, model: type[BaseModel], profile: str, overrides: Sequence[str]
) -> tuple[Node, list[Node], list[Fault]]:
    """The file and each override as a tree, what they include in its place, and the faults of the options.

    Raises:
        StudyError: there is no mapping to go on with.
    """
    faults = [] if profile in PROFILES else [_no_profile(profile)]
    root, found = read(path)
    faults += found
    if root is None or not isinstance(root.value, dict):
        raise StudyError(faults or [_no_mapping(path, root, model)])
    if fault := fault_of_study(study_name(path)):
        faults.append(Fault(Place(str(path)), "", fault))
    if crowded := _crowded(root):
        raise StudyError([*faults, *crowded])
    patches, found = _patches(root, overrides)
    whole = [included(tree, path.parent, (*SECTIONS, SPACE)) for tree in (root, *patches)]
    faults += found + [fault for _, more in whole for fault in more]
    return whole[0][0], [tree for tree, _ in whole[1:]], faults


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
            patches.append(nested(parts, node))
        elif not found:
            faults.append(Fault(Place(source), ".".join(parts), "no value"))
    return patches, faults


def _target(root: Node, key: str) -> list[str]:
    """Keys from the root to what an override names; names with dots in them are matched against what is there."""
    parts = key.split(".")
    parts = ["base", *parts] if parts[0] in SECTIONS else parts
    if parts == ["base", "trainer", "steps"]:
        return ["steps"]
    for i, part in enumerate(parts[:-1]):
        of_profile = i == 2 and parts[0] == "profiles"
        if part == "grid" and (i == 0 or of_profile):  # its keys are dotted themselves
            return [*parts[: i + 1], ".".join(parts[i + 1 :])]
    start, names = _named(root, parts)
    for name in names:
        words = name.split(".")
        if parts[start : start + len(words)] == words:
            return [*parts[:start], name, *parts[start + len(words) :]]
    return parts


def _named(root: Node, parts: Sequence[str]) -> tuple[int, list[str]]:
    """The part of a key that is a person's name, as of an arm, and the names that there are."""
    if parts[:2] == ["readings", "factors"]:
        return 2, list(_group(root.children.get("readings", root), "factors"))
    start = 1 if parts[0] == "arms" else 3 if parts[0] == "profiles" and parts[2:3] == ["changes"] else 0
    return start, list(_group(root, "arms")) if start else []


# Layers to settings


def _normal(root: Node, counts: Sequence[str]) -> Node:
    """One form for what may be written shortly: a number for all profiles, an arm with nothing in it."""
    children = dict(root.children)
    for name in counts:
        node = children.get(name)
        if node is not None and not isinstance(node.value, dict):
            children[name] = node._replace(value=dict.fromkeys(PROFILES, node))
    for name in ("arms", "profiles", "variants"):
        if name in children and children[name].children:
            filled = {k: v._replace(value={}) if v.value is None else v for k, v in children[name].children.items()}
            filled = {k: _with_design(v) for k, v in filled.items()} if name == "profiles" else filled
            children[name] = children[name]._replace(value=filled)
    return _with_design(root._replace(value=children))


def _with_design(node: Node) -> Node:
    """`design: full` in the readings of a study or a profile written out."""
    readings = node.children.get("readings")
    design = readings.children.get("design") if readings else None
    if readings is None or design is None or not isinstance(design.value, str):
        return node
    whole = design._replace(value={"kind": design._replace(path=join(design.path, "kind"))})
    block = readings._replace(value=readings.children | {"design": whole})
    return node._replace(value=node.children | {"readings": block})


def _settings(root: Node, profile: str, variant: str | None, patches: Sequence[Node], beside: Beside) -> Resolved:
    """Resolve the base and every arm for a profile. Overrides of the base go before what the profile changes in it."""
    chosen = _child(_child(root, "profiles"), profile)
    layers = [root.children.get("base"), chosen, *(_child(patch, "base") for patch in patches)]
    stated = [layer for layer in layers if layer is not None and isinstance(layer.value, dict)]
    common = [reduce(merge, stated)] if stated else []
    last = [layer for layer in [_child(_child(root, "variants"), variant or "")] if layer]
    steps = _child(_child(root, "steps"), profile)
    base, faults = _setting([*common, *last] if common else [], steps, beside)
    planned, plan, found = _planned(root, chosen, patches)
    faults += found + [fault for layer in last for fault in _unstated(common[0] if common else None, layer)]
    arms: dict[str, Setting] = {}
    first: dict[str, str] = {}  # arm by its setting
    owners: dict[Fault, list[str]] = {}
    for name, (written, arm, reading) in planned.items():
        faults += _unstated(common[0] if common else None, arm)
        setting, found = _setting([*common, arm, *last], steps, beside)
        for fault in set(found) - set(faults):
            owners.setdefault(fault, []).append(written)
        if setting is not None:
            same = first.setdefault(setting.canonical(), name)
            masked = reading and planned[same].written == written  # the arm decides what the readings differ in
            faults += _twin(same, arm, name, variant) if same != name and not masked else []
            arms[name] = setting
    plain = ("arms.", f"profiles.{profile}.changes.", *(() if _group(root, "arms") else ("grid.",)))
    faults += [f if f.path.startswith(plain) else _owned(f, names) for f, names in owners.items()]
    kept, found = _kept(root, chosen)
    arms = {name: arm for name, arm in arms.items() if kept is None or planned[name].written in kept}
    told = [(name, planned[name].written, planned[name].reading) for name in arms]
    cells = {name: Cell(arm=arm, reading=r.name, levels=r.levels) for name, arm, r in told if r}
    return Resolved(base, arms, faults + found, _unlearned(arms, steps) if steps else [], plan, cells)


def _unlearned(arms: Mapping[str, Setting], steps: Node) -> list[Fault]:
    """Arms whose budget ends before they learn, at its place."""
    from pipelines.specs.learning_start import shortfall  # which knows settings

    owners: dict[str, list[str]] = {}
    for name, setting in arms.items():
        owners.setdefault(shortfall(setting), []).append(name)
    return [_owned(Fault(steps.place, steps.path, text), names) for text, names in owners.items() if text]


def _planned(
    root: Node, profile: Node | None, patches: Sequence[Node]
) -> tuple[dict[str, Planned], Plan | None, list[Fault]]:
    """Every arm of a profile at every point of its grid, or under every reading, by name."""
    arms, faults = _changed(_group(root, "arms"), profile, patches)
    grid, found = replaced(_child(root, "grid"), _child(profile, "grid"))
    combined, more = points(grid, fields(), len(arms))
    block = _child(root, "readings")
    read = _exclusive(block, grid) or spelled(block, _child(profile, "readings"), fields(), len(arms))
    crossed = _under(arms, read.readings) if read.readings else _crossed(arms, combined)
    more += _alike_faults("arm", {name: arm.layer for name, arm in crossed.items()})
    more += [_long_name(name, arm.layer) for name, arm in crossed.items() if len(name) > ARM]
    return crossed, read.plan, faults + found + more + read.faults


def _exclusive(readings: Node | None, grid: Node | None) -> Spelled | None:
    """The fault of a study that has a grid as well as readings."""
    if readings is None or grid is None:
        return None
    text = "not beside a grid; a key of the grid can be a factor"
    return NOTHING._replace(faults=[Fault(readings.key, readings.path, text)])


def _changed(
    arms: dict[str, Node], profile: Node | None, patches: Sequence[Node]
) -> tuple[dict[str, Node], list[Fault]]:
    """The arms with what a profile changes in them. Overrides, which the arms hold already, go before that."""
    faults = [fault for name, arm in arms.items() for fault in _name_faults(name, arm)]
    changes = _group(profile, "changes") if profile else {}
    unknown = {name: node for name, node in changes.items() if name not in arms}
    allowed = {name: choices(name, arms) if arms else "this study has none, but a grid" for name in unknown}
    faults += [Fault(n.key, n.path, f"{show(name)} is no arm; {allowed[name]}") for name, n in unknown.items()]
    layers = [changes, *(_group(patch, "arms") for patch in patches)] if changes else []
    changed = {name: [layer[name] for layer in layers if name in layer] for name in arms if name in changes}
    return {name: reduce(merge, changed.get(name, []), arm) for name, arm in arms.items()}, faults


def _crossed(arms: Mapping[str, Node], combined: Sequence[Point]) -> dict[str, Planned]:
    if not arms or not combined:
        return {name: Planned(name, arm) for name, arm in [*arms.items(), *combined]}
    return {f"{name}, {p.name}": Planned(name, merge(arm, p.layer)) for name, arm in arms.items() for p in combined}


def _under(arms: Mapping[str, Node], readings: Sequence[Reading]) -> dict[str, Planned]:
    """Every arm under every reading; the arm goes before the reading."""
    pairs = ((name, arm, one) for one in readings for name, arm in arms.items())
    return {f"{name}, {one.name}": Planned(name, _over(one.layer, arm), one) for name, arm, one in pairs}


def _over(layer: Node, arm: Node) -> Node:
    """An arm over a layer, at the arm's place."""
    return arm._replace(value=merge(layer, arm).value)


def _kept(root: Node, profile: Node | None) -> tuple[set[str] | None, list[Fault]]:
    """The arms, as written, that a profile is content with; None for all."""
    wanted, arms = _child(profile, "arms"), _group(root, "arms")
    if wanted is None or not isinstance(wanted.value, list):
        return None, []
    names = [one for one in wanted.value if isinstance(one.value, str)]
    faults = [Fault(n.place, n.path, f"{show(n.value)} is no arm; {choices(n.value, arms)}") for n in names]
    return {str(n.value) for n in names}, [f for n, f in zip(names, faults, strict=True) if n.value not in arms]


def _group(root: Node, key: str) -> dict[str, Node]:
    """The arms, or the variants, as written."""
    group = _child(root, key)
    return group.children if group else {}


def _setting(layers: Sequence[Node], steps: Node | None, beside: Beside) -> tuple[Setting | None, list[Fault]]:
    parts, faults = {}, []
    stated = {section: _section(layers, section) for section in SECTIONS}
    for section, node in stated.items():
        if node is not None:
            node, faulty = _over_preset(section, node, stated, beside.preset)
            parts[section], found = _trainer(node, steps) if section == "trainer" else _of_kind(section, node)
            faults += [*faulty, *found]
    complete = len(parts) == len(SECTIONS) and all(part is not None for part in parts.values())
    if not complete or faults:
        return None, faults
    setting = Setting(**parts)
    faults = _misfit(setting, layers) or _no_start(setting, layers, beside.starts)
    return (None if faults else setting), faults


def _over_preset(
    section: str, node: Node, stated: Mapping[str, Node | None], preset: Preset
) -> tuple[Node, list[Fault]]:
    """A section over what the preset of the study has for its task and its method."""
    kinds = {name: plain(_child(stated[name], "kind")) for name in ("env", "algo")}
    if any(not isinstance(kind, str) or kind not in configs(name) for name, kind in kinds.items()):
        return node, []  # which is said of the kind
    fields = configs(section)[kinds[section]].model_fields if section in kinds else trainer.Config.model_fields
    return preset.under(node, section, kinds["env"], kinds["algo"], fields)


def _misfit(setting: Setting, layers: Sequence[Node]) -> list[Fault]:
    """A method that cannot act in its task, at the place of the task's field that it cannot do with."""
    text = limits.misfit(setting.env, setting.algo)
    if not text:
        return []
    field, _, fault = text.partition(": ")
    env, named = _section(layers, "env"), field in type(setting.env).model_fields
    node = (_child(env, field) if named else None) or env
    return [Fault(node.place, node.path, fault if named else text)] if node else []


def _no_start(setting: Setting, layers: Sequence[Node], starts: Starts) -> list[Fault]:
    """A policy from which the run cannot start, at the place where it is named."""
    node = _child(_section(layers, "trainer"), FIELD)
    text = starts.misfit(setting) if node else ""
    return [Fault(node.place, node.path, text)] if node and text else []


def _section(layers: Sequence[Node], name: str) -> Node | None:
    """One section of all layers merged; None where the file's shape is wrong, which is said elsewhere."""
    stated = [layer.children[name] for layer in layers if name in layer.children]
    if not stated and name == "trainer" and layers:
        return layers[0]._replace(value={})
    if not stated or not all(isinstance(node.value, dict) for node in stated):
        return None
    return reduce(merge, stated)


def _of_kind(section: str, node: Node) -> tuple[BaseModel | None, list[Fault]]:
    table, kind = configs(section), node.children.get("kind")
    if kind is None and node.path.startswith("base."):
        return None, [Fault(node.key, join(node.path, "kind"), f"missing; allowed: {', '.join(table)}")]
    if kind is None or isinstance(kind.value, Unreadable):
        return None, []  # said of the base, or of the value
    if not isinstance(kind.value, str) or kind.value not in table:
        return None, [Fault(kind.place, kind.path, plugins.unknown(section, kind.value))]
    return validate(table[kind.value], node)


def _trainer(node: Node, steps: Node | None) -> tuple[BaseModel | None, list[Fault]]:
    children, faults = dict(node.children), []
    if "steps" in children:
        written = children.pop("steps")
        text = "a study's budget is the same for every run; write it as 'steps' at the top of the file"
        faults.append(Fault(written.key, written.path, text))
    if steps and isinstance(steps.value, int) and 1 <= steps.value <= limits.BOUNDS["steps"]:
        children["steps"] = steps
    config, found = validate(trainer.Config, node._replace(value=children), hidden=("steps",))
    return config, faults + found


def _child(node: Node | None, key: str) -> Node | None:
    return node.children.get(key) if node else None


# Faults that no model finds


def _no_profile(profile: str) -> Fault:
    return Fault(Place("--profile"), "", f"{show(profile)} is not allowed; {choices(profile, PROFILES)}")


def _crowded(root: Node) -> list[Fault]:
    """More arms or variants than a study can be resolved with in reasonable time."""
    most = {"arms": MOST, "variants": VARIANTS}
    found = {key: len(node.children) for key, node in root.children.items() if key in most}
    where = root.children
    return [
        Fault(where[key].key, key, f"{count:,} of them; at most {most[key]:,}")
        for key, count in found.items()
        if count > most[key]
    ]


def study_fault(name: str) -> str:
    """The fault of the name of a study (of a variant: `stem@variant`), or nothing; it becomes part of paths."""
    stem, at, variant = name.partition("@")
    fault = fault_of_study(stem) or too_long(name)
    return fault or ("a variant is named with letters, digits, '-' and '_' only" if at and not simple(variant) else "")


def arm_fault(name: str) -> str:
    """The fault of the name of an arm, or nothing."""
    if not all(map(seen, name)):
        return f"{show(name)} is not a name for an arm; it has characters that cannot be seen"
    arm = Node(None, Place(""), Place(""), "")
    found = _name_faults(name, arm) or ([_long_name(name, arm)] if len(name) > ARM else [])
    return found[0].text if found else ""


def _variant_faults(path: Path, variants: Mapping[str, Node], wanted: str | None) -> list[Fault]:
    text = "a variant is named with letters, digits, '-' and '_' only"
    faults = [Fault(node.key, node.path, text) for name, node in variants.items() if not simple(name)]
    longest = {name: too_long(study_name(path, name)) for name in variants}
    faults += [
        Fault(variants[name].key, variants[name].path, f"with the study's, {fault}")
        for name, fault in longest.items()
        if fault
    ]
    faults += _alike_faults("variant", variants)
    if wanted is not None and wanted not in variants:
        allowed = choices(wanted, variants) if variants else "this study has no variants"
        faults.append(Fault(Place("--variant"), "", f"{show(wanted)} is not allowed; {allowed}"))
    return faults


def _no_mapping(path: Path, root: Node | None, model: type[BaseModel]) -> Fault:
    if root is None or root.value is None:
        return Fault(Place(str(path), 1, 1), "", f"empty; a study has {', '.join(model.model_fields)}")
    text = f"{show(root.value)} is not a study; must be a mapping with {', '.join(model.model_fields)}"
    return Fault(root.place, "", text)


def _no_study(root: Node) -> list[Fault]:
    """Say this alone where a search was given."""
    if not any("space" in arm.children for arm in _group(root, "arms").values()):
        return []
    text = "an arm has a space: a search, for `rhmc search check`, `run` and `status`, is no study"
    return [Fault(Place(root.place.source, 1, 1), "", text)]


def _no_value(root: Node, name: str, profile: str) -> list[Fault]:
    """A study may leave out a profile, until it is asked for."""
    node = root.children[name]
    given = [key for key, child in node.children.items() if child.value is not None]
    if profile in given:
        return []
    return [Fault(node.key, join(node.path, profile), f"missing; there is a value for: {', '.join(given) or 'none'}")]


def _name_faults(name: str, arm: Node) -> list[Fault]:
    if name and name == name.strip() and "/" not in name:  # that it can be seen is said of every key
        return []
    return [Fault(arm.key, arm.path, f"{show(name)} is not a name for an arm; use a few words, without '/'")]


def _alike_faults(what: str, named: Mapping[str, Node]) -> list[Fault]:
    """Names that people, file systems and databases take for one."""
    text = "in case, blanks or the form of a letter alone; give it another name"
    return [
        Fault(named[name].key, named[name].path, f"{show(name)} differs from {what} {show(other)} {text}")
        for name, other in alike(named)
    ]


def _long_name(name: str, arm: Node) -> Fault:
    text = f"{show(name)} is not a name for an arm; it has {len(name):,} characters, at most {ARM}"
    return Fault(arm.key, arm.path, text)


def _unstated(base: Node | None, arm: Node) -> list[Fault]:
    """An arm of another kind inherits nothing, so what must be alike for all methods has to be said again."""
    faults = []
    for section, field in COMMON.items():
        before, after = _child(base, section), _child(arm, section)
        common, kind, other = _child(before, field), _child(before, "kind"), _child(after, "kind")
        if not (common and kind and after and other) or kind.value == other.value or field in after.children:
            continue
        config = configs(section).get(str(other.value))
        if config and field in config.model_fields:
            text = f"missing; another kind inherits nothing, and the base has {show(common.value)}: state it here"
            faults.append(Fault(after.place, join(after.path, field), text))
    return faults


def _twin(other: str, arm: Node, name: str, variant: str | None) -> list[Fault]:
    where = f" in variant {show(variant)}" if variant else ""
    return [Fault(arm.key, arm.path, f"arm {show(name)} {TWIN} {show(other)}{where}")]


def _owned(fault: Fault, arms: Sequence[str]) -> Fault:
    """Name the arms in which a fault shows, as its place does not."""
    names = list(dict.fromkeys(arms))
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return fault._replace(text=f"{fault.text} (in arm {', '.join(show(name) for name in names[:NAMED])}{more})")
