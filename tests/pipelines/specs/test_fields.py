"""Settings in words: complete, with bounds that the models themselves have."""

from typing import Any

import pytest
from pydantic import BaseModel, ValidationError

from pipelines.conformance.blocks import nested
from pipelines.specs.document import settings
from pipelines.specs.fields import Described, described
from rhmc.algorithms import ALGORITHMS
from rhmc.envs import ENVS
from rhmc.training import trainer

MODELS = {kind: entry.config for table in (ALGORITHMS, ENVS) for kind, entry in table.items()}
MODELS["trainer"] = trainer.Config


@pytest.mark.parametrize("kind", MODELS)
def test_every_setting_is_there_once(kind: str) -> None:
    rows = described(MODELS[kind])
    assert [row.name for row in rows] == [name for name in settings(MODELS[kind]) if name != "kind"]
    assert all(row.allowed and row.default for row in rows)


@pytest.mark.parametrize("kind", MODELS)
def test_every_setting_has_a_meaning(kind: str) -> None:
    """`rhmc methods KIND`, `rhmc tasks KIND` and the reference show it: `Field(..., description=...)`."""
    assert [row.name for row in described(MODELS[kind]) if not row.meaning] == []


def test_a_bound_a_list_and_a_block_in_words() -> None:
    rows = {row.name: row for row in described(ALGORITHMS["rhmc"].config)}
    assert rows["alpha"] == Described("alpha", "number at least 0, at most 1", "0.1", "alpha_1 of Eq. 6")
    assert rows["horizon"].allowed == "whole number at least 1"
    assert rows["regulator"][1:3] == ("none, paper, exact", "paper")
    assert rows["executor.lr"][1:3] == ("number or null above 0", "null")
    assert {row.name: row for row in described(ALGORITHMS["mappo"].config)}["share"][1:3] == ("true, false", "true")
    assert {row.name: row for row in described(ENVS["coverage"].config)}["boxes"].default.startswith("[[250, 750")


@pytest.mark.parametrize("kind", MODELS)
def test_what_is_allowed_is_what_the_model_takes(kind: str) -> None:
    model = MODELS[kind]
    for row in described(model):
        for value, fits in tried(row.allowed):
            assert taken(model, row.name, value) == fits, f"{row.name}: {value} of '{row.allowed}'"


def tried(allowed: str) -> list[tuple[Any, bool]]:
    """Values on either side of what a text says."""
    if allowed == "true, false":
        return [(True, True), (False, True), ("perhaps", False)]
    if not allowed.startswith(("number", "whole number")):
        words = allowed.split(", ") if allowed not in ("list", "text", "text or null") else []
        return [(word, True) for word in words] + ([("no such word", False)] if words else [])
    values: list[tuple[Any, bool]] = [("many", False)]
    if "at least" in allowed:
        least = int(allowed.split("at least ")[1].split(",")[0])
        values += [(least, True), (least - 1, False)]
    if "at most" in allowed:
        values += [(1, True), (2, False)]
    if "above 0" in allowed:
        values += [(0, False), (0.5, True)]
    return values


def taken(model: type[BaseModel], name: str, value: Any) -> bool:
    """True unless the model refuses this very value."""
    try:
        model.model_validate(nested({name: value}))
    except ValidationError as error:
        return not any(".".join(map(str, one["loc"])).startswith(name) for one in error.errors())
    return True
