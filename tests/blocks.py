"""Settings of methods as flat dicts: `coordinator.gamma`, or `coordinator__gamma` as a keyword, is one in a block."""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """The settings as a file has them."""
    tree: dict[str, Any] = {}
    for key, value in flat.items():
        block, _, name = key.replace("__", ".").rpartition(".")
        (tree.setdefault(block, {}) if block else tree)[name] = value
    return tree


def fields(config: type[BaseModel]) -> list[str]:
    """The names of all settings, those in blocks with their block."""
    found = []
    for name, field in config.model_fields.items():
        block = isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
        found += [f"{name}.{inner}" for inner in fields(field.annotation)] if block else [name]
    return found


def fitted(config: type[BaseModel], values: Mapping[str, Any]) -> dict[str, Any]:
    """Of the values those that the configuration has; one without a block goes to every block that has such a field."""
    names = {name: name if name in values else name.rpartition(".")[2] for name in fields(config)}
    return {name: values[key] for name, key in names.items() if key in values}


def flat(tree: Mapping[str, Any]) -> dict[str, Any]:
    """The inverse of `nested`."""
    found: dict[str, Any] = {}
    for name, value in tree.items():
        found |= {f"{name}.{inner}": one for inner, one in value.items()} if isinstance(value, dict) else {name: value}
    return found
