"""The settings of a study's arms: what differs from the defaults of an arm's method, and how much it learns per step.

What differs between the arms of one method is told of all of them, of those that have the default as well. Settings
are those of an arm's first run, defaults those that `rhmc methods --out` exports.
"""

import json
from collections.abc import Iterable, Mapping
from math import isfinite, nan
from typing import Any

import numpy as np
import pandas as pd

from reports.data.frame import Results
from reports.render.tables import NONE, Table, joined

LONG = 40  # letters of a value that is spelled out
Settings = Mapping[str, Any]  # by dotted name
SETTINGS = "Settings that differ from the method's defaults or between its arms"
PACE = (
    "Rows replayed: rows of a replay or a rollout that updates use, per environment step, once learning has begun; "
    "each agent's part of a row is not counted for itself. A coordinator's row is an assignment period. HiT-MAC's two "
    "levels learn one after the other: its numbers are over the whole budget, with periods that no episode's end cuts."
)


def table(results: Results, study: str) -> Table:
    """A row per arm; what all arms have in common is in the note."""
    configs = results.configs(study)
    kinds = {arm: results.kind(study, arm) for arm in configs}
    defaults = {str(method["kind"]): flat(method.get("defaults")) for method in results.methods}
    names = {str(method["kind"]): str(method["name"]) for method in results.methods}
    algos = {arm: flat(config.get("algo")) for arm, config in configs.items()}
    alike = {kind: common(algos[arm] for arm in algos if kinds[arm] == kind) for kind in kinds.values()}
    own = {
        arm: _less(algo, defaults.get(kinds[arm], {})) | _less(algo, alike[kinds[arm]]) for arm, algo in algos.items()
    }
    around = {arm: flat({name: config.get(name) for name in ("env", "trainer")}) for arm, config in configs.items()}
    methods, places = common(own.values()) if len(own) > 1 else {}, common(around.values())
    pace = {arm: replayed(config) for arm, config in configs.items()}
    levels = list(dict.fromkeys(level for rates in pace.values() for level in rates))
    numbers, shown = [], []
    for arm, kind in kinds.items():
        other = _less(around[arm], places)
        numbers.append(
            {"study": study, "arm": arm, "method": kind, "settings": _json(own[arm] | other)}
            | {f"replayed_{level}".rstrip("_"): pace[arm].get(level, np.nan) for level in levels}
        )
        shown.append(
            {
                "Arm": arm,
                "Method": names.get(kind, kind),
                "Rows replayed per environment step": paced(pace[arm]),
                SETTINGS: words(_less(own[arm], methods) | other) or NONE,
            }
        )
    unknown = sorted({names.get(kind, kind) for kind in kinds.values() if not defaults.get(kind)})
    note = " ".join([PACE, *_common_words(methods, places), *_unknown_words(unknown)])
    return Table(f"Settings of the arms, study {study}", pd.DataFrame(numbers), pd.DataFrame(shown), note)


# Settings


def flat(tree: Any) -> dict[str, Any]:
    """Settings by dotted name; those of a block have its name before theirs."""
    found: dict[str, Any] = {}
    for name, value in tree.items() if isinstance(tree, dict) else ():
        inner = value if isinstance(value, dict) else None
        found |= {name: value} if inner is None else {f"{name}.{key}": held for key, held in inner.items()}
    return found


def common(found: Iterable[Settings]) -> dict[str, Any]:
    """The settings that are the same in all."""
    first, *others = found
    return {name: value for name, value in first.items() if all(_same(other, name, value) for other in others)}


def _less(settings: Settings, known: Settings) -> dict[str, Any]:
    """The settings that are not what is known; the kind, which names the method, is not one of them."""
    return {name: value for name, value in settings.items() if name != "kind" and not _same(known, name, value)}


def _same(settings: Settings, name: str, value: Any) -> bool:
    return name in settings and settings[name] == value and isinstance(value, bool) == isinstance(settings[name], bool)


def words(settings: Settings) -> str:
    """`lr=0.001, executor.gamma=0.95`, what is long cut short."""
    return ", ".join(f"{name}={_value(settings[name])}" for name in sorted(settings))


def _value(value: Any) -> str:
    text = value if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else _json(value)
    if len(text) <= LONG:
        return text
    return f"({len(value)} values)" if isinstance(value, list) else f"{text[:LONG]}…"


def _json(value: Any) -> str:
    return json.dumps(value, sort_keys=True, ensure_ascii=False)


def _common_words(methods: Settings, places: Settings) -> Iterable[str]:
    if methods:
        yield f"In all arms: {words(methods)}."
    for section, title in (("env", "Task"), ("trainer", "Trainer")):
        mine = {name.partition(".")[2]: x for name, x in places.items() if name.startswith(f"{section}.")}
        if mine:
            yield f"{title} of all arms: {words(mine)}."


def _unknown_words(names: list[str]) -> Iterable[str]:
    if names:
        yield f"Defaults of {joined(names)} are not exported, so that all settings are shown: see rhmc methods --out."


# What a method learns per step


def replayed(config: Mapping[str, Any]) -> dict[str, float]:
    """Rows that updates use per environment step, by level of the method ("" where there is one).

    A method that is none of those below learns from a replay if it has a `train_freq`, and else from rollouts in
    `epochs`. Nothing where the settings do not say.
    """
    algo, trainer = flat(config.get("algo")), flat(config.get("trainer"))

    def at(name: str, settings: Settings = algo) -> float:
        return _positive(settings.get(name))

    executors = at("executor.batch_size") / at("train_freq")
    match algo.get("kind"):
        case "rhmc":
            coordinator = at("coordinator.batch_size") / at("train_freq") / at("coordinator.update_every")
            rates = {"executors": executors, "coordinator": coordinator}
        case "hitmac":
            share = float(np.minimum(1, _positive(algo.get("pretrain"), zero=True) / at("steps", trainer)))  # NaN stays
            decisions = (1 - share) / at("assignment_period")
            rates = {"executors": share * executors, "coordinator": decisions * at("coordinator.epochs")}
        case "coma":
            rates = {"critic": at("epochs"), "actor": 1.0}
        case _:
            rates = {"": at("batch_size") / at("train_freq") if "train_freq" in algo else at("epochs")}
    return {level: rate for level, rate in rates.items() if isfinite(rate)}


def _positive(value: Any, *, zero: bool = False) -> float:
    """A number above zero, or from zero on; NaN for everything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return nan
    try:
        found = float(value)
    except OverflowError:
        return nan
    return found if isfinite(found) and (found > 0 or (zero and found == 0)) else nan


def paced(rates: Mapping[str, float]) -> str:
    """`executors 2, coordinator 0.5`; the number alone where there is one level."""
    return ", ".join(f"{level} {rate:.3g}".strip() for level, rate in rates.items()) or NONE
