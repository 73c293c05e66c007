"""A study's readings: factors whose levels each change every arm a little, and which levels are tried together.

    readings:
      factors:
        algo.alpha: [0.1, 0.02, 0.3, 1]                # a setting and its values
        network:                                       # or a name, and a name for each level
          paper: {env: {observation: paper}, algo: {encoder: mlp}}
          pairs: {env: {observation: extended}, algo: {encoder: pairwise}}
      design: {resolution: 4, readings: 64, seed: 0}   # or `full`, every combination

A reading is named by the place of each factor's level, from 1: `reading=21` has the second of the first factor. Every
arm is taken to every reading, as `full, reading=21`. An arm goes before a reading, so that an ablation stays one.
"""

from collections.abc import Collection, Mapping, Sequence
from functools import reduce
from math import prod
from typing import Any, Literal, NamedTuple, Self

from pydantic import Field, model_validator

from pipelines.specs import design
from pipelines.specs.document import Fault, Node, merge, show
from pipelines.specs.grid import MOST, faults_of, nested, text_of, values
from rhmc.types import Frozen

FEWEST, MANY = 2, 9  # levels of a factor; a digit names a level
SECTIONS = ("env", "algo", "trainer")


class Settings(Frozen):
    """The block `design`."""

    kind: Literal["full", "fractional"] = Field("fractional", description="every combination, or a regular fraction")
    resolution: int = Field(4, ge=3, le=6, description="least number of factors in a word of the defining relation")
    readings: int | None = Field(
        None, ge=4, le=design.MOST, description="a power of two; the least that will do if not given"
    )
    seed: int = Field(0, ge=0, description="of the search for generators")

    @model_validator(mode="after")
    def _a_power_of_two(self) -> Self:
        if self.readings is not None and self.readings & (self.readings - 1):
            raise ValueError(f"readings: {self.readings} is not allowed; must be a power of two, such as 64")
        return self


class Readings(Frozen):
    """The block `readings`. What stands in a level is checked once the layers are merged."""

    factors: dict[str, Any] = Field(min_length=1)
    design: Settings = Settings()


class ProfileReadings(Frozen):
    """The design that a profile has instead."""

    design: Settings = Settings()


class Cell(Frozen):
    """An arm under a reading."""

    arm: str  # as written
    reading: str
    levels: dict[str, str]  # name of the level by factor


class Plan(Frozen):
    """The design of a study, for people.

    Attributes:
        factors: names of the levels, in order, by factor.
        kind: of the design, in words.
        generators: columns by factor; none for a full design.
        confounded: sets of effects up to second order that cannot be told apart, such as `alpha` and `lr x tau`.
    """

    factors: dict[str, tuple[str, ...]]
    kind: str
    generators: dict[str, str] = Field(default_factory=dict)
    confounded: tuple[tuple[str, ...], ...] = ()


class Reading(NamedTuple):
    """One reading: its name, the level of each factor, and what it changes."""

    name: str
    levels: dict[str, str]
    layer: Node


class Spelled(NamedTuple):
    """All readings of a study, and the plan that they follow; none where it is faulty."""

    readings: list[Reading]
    plan: Plan | None
    faults: list[Fault]


NOTHING = Spelled([], None, [])


def spelled(node: Node | None, profile: Node | None, fields: Collection[str], arms: int) -> Spelled:
    """Every reading of a study.

    Args:
        node: the block `readings`; its shape is checked elsewhere.
        profile: the same of a profile.
        fields: dotted names that there are, to find the nearest of them.
        arms: how many arms are taken to every reading.
    """
    factors = node.children.get("factors") if node else None
    if node is None or factors is None or not factors.children:
        return NOTHING
    faults = [fault for name, factor in factors.children.items() for fault in _faults(name, factor, fields)]
    settings, place = _settings(node, profile)
    if faults or settings is None:
        return Spelled([], None, faults)
    levels = {name: _levels(name, factor) for name, factor in factors.children.items()}
    found, faults = _designed(settings, place, levels, arms)
    if found is None:
        return Spelled([], None, faults)
    return Spelled([_reading(row, levels) for row in found.rows], _plan(settings, found, levels), [])


def _settings(node: Node, profile: Node | None) -> tuple[Settings | None, Node]:
    """The design as the profile has it, and where it stands; None where its shape is wrong, which is said elsewhere."""
    stated = [one.children["design"] for one in (node, profile) if one and "design" in one.children]
    if not stated:
        return Settings(), node
    whole = reduce(merge, stated)
    try:
        return Settings.model_validate({key: child.value for key, child in whole.children.items()}, strict=True), whole
    except ValueError:
        return None, whole


def _designed(
    settings: Settings, place: Node, levels: Mapping[str, Mapping[str, Node]], arms: int
) -> tuple[design.Design | None, list[Fault]]:
    counts = tuple(len(one) for one in levels.values())
    every, text = prod(counts), ""
    found: design.Design | None = None
    if settings.kind == "full":
        text = _too_many(every, arms)
        found = None if text else design.full(counts)
    elif odd := [name for name, one in levels.items() if len(one) not in design.LEVELS]:
        text = f"factor {show(odd[0])} has {len(levels[odd[0]])} levels; a fraction takes 2, 4 or 8: give it as many"
    elif settings.readings is not None and settings.readings > every:
        text = f"{settings.readings} readings of {every} combinations; write 'design: full'"
    else:
        found = design.fractional(counts, settings.resolution, settings.readings, settings.seed)
        size = f" in {settings.readings} readings" if settings.readings else f" in {design.MOST} readings or fewer"
        none = f"no design of resolution {settings.resolution}{size} was found; take more readings, or a lower one"
        text = none if found is None else _too_many(len(found.rows), arms)
    return (None, [Fault(place.key, place.path, text)]) if text else (found, [])


def _too_many(readings: int, arms: int) -> str:
    count = readings * max(arms, 1)
    return f"{count:,} arms in all; at most {MOST:,}" if count > MOST else ""


def _faults(name: str, factor: Node, fields: Collection[str]) -> list[Fault]:
    """Faults in the shape of a factor."""
    if isinstance(factor.value, list):
        faults = faults_of(name, factor, fields)
    elif isinstance(factor.value, dict):
        faults = [fault for level in factor.children.values() for fault in _level_faults(level)]
    else:
        text = f"{show(factor.value)} is not allowed; must be a list of values, or a mapping of levels"
        return [Fault(factor.place, factor.path, text)]
    count = len(factor.value)
    if not FEWEST <= count <= MANY:
        faults.append(Fault(factor.key, factor.path, f"{count} levels; must be {FEWEST} to {MANY}"))
    return faults


def _level_faults(level: Node) -> list[Fault]:
    allowed = f"a level is a mapping with {', '.join(SECTIONS)}"
    if level.value is not None and not isinstance(level.value, dict):
        return [Fault(level.place, level.path, f"{show(level.value)} is not allowed; {allowed}")]
    found = [(key, child) for key, child in level.children.items() if key not in SECTIONS]
    faults = [Fault(child.key, child.path, f"unknown key {show(key)}; {allowed}") for key, child in found]
    wrong = [child for key, child in level.children.items() if key in SECTIONS and not isinstance(child.value, dict)]
    return faults + [
        Fault(one.place, one.path, f"{show(one.value)} is not allowed; must be a mapping") for one in wrong
    ]


def _levels(name: str, factor: Node) -> dict[str, Node]:
    """The layer of each level of a factor, by name."""
    if isinstance(factor.value, list):
        listed = values(factor)
        return {text_of(value, i): nested(name.split("."), value) for i, value in enumerate(listed)}
    return {level: node._replace(value=node.children) for level, node in factor.children.items()}


def _reading(row: Sequence[int], levels: Mapping[str, Mapping[str, Node]]) -> Reading:
    chosen = {name: list(each.items())[place] for (name, each), place in zip(levels.items(), row, strict=True)}
    name = "reading=" + "".join(str(place + 1) for place in row)
    layer = reduce(merge, [layer for _, layer in chosen.values()])
    return Reading(name, {factor: level for factor, (level, _) in chosen.items()}, layer)


def _plan(settings: Settings, found: design.Design, levels: Mapping[str, Mapping[str, Node]]) -> Plan:
    names = list(levels)
    words = {"full": "every combination", "fractional": f"a fraction of resolution {settings.resolution}"}
    sets = [tuple(" x ".join(names[i] for i in term) for term in terms) for terms in found.confounded]
    generators = dict(zip(names, found.generators, strict=True)) if found.generators else {}
    factors = {name: tuple(each) for name, each in levels.items()}
    return Plan(factors=factors, kind=words[settings.kind], generators=generators, confounded=tuple(sets))
