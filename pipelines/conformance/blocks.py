"""Settings of methods as flat dicts: `coordinator.gamma`, or `coordinator__gamma` as a keyword, is one in a block."""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from pipelines.specs.document import settings


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """The settings as a file has them: the inverse of `pipelines.tracking.plan.flatten`."""
    tree: dict[str, Any] = {}
    for key, value in flat.items():
        block, _, name = key.replace("__", ".").rpartition(".")
        (tree.setdefault(block, {}) if block else tree)[name] = value
    return tree


def fitted(config: type[BaseModel], values: Mapping[str, Any]) -> dict[str, Any]:
    """Of the values those that the configuration has; one without a block goes to every block that has such a field."""
    names = {name: name if name in values else name.rpartition(".")[2] for name in settings(config)}
    return {name: values[key] for name, key in names.items() if key in values}
