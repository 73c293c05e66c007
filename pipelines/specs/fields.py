"""The settings of a method, a task or the trainer as a reader needs them: what is allowed, the default, the meaning."""

from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from pipelines.specs.document import settings, show

KIND = "kind"  # names the model itself
TYPES = {bool: "true, false", int: "whole number", float: "number", str: "text"}
BOUNDS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}  # by attribute of a field's metadata


class Described(NamedTuple):
    """A setting by its dotted name, in words."""

    name: str
    allowed: str
    default: str
    meaning: str


def described(model: type[BaseModel]) -> list[Described]:
    """Every setting of a model but its kind, in the model's order."""
    found = {name: field for name, field in settings(model).items() if name != KIND}
    return [Described(name, allowed(field), _default(field), field.description or "") for name, field in found.items()]


def allowed(field: FieldInfo) -> str:
    """The values of a field: those that it lists or that its table has now, or a type with its bounds."""
    schema: dict[str, Any] = {}
    if callable(field.json_schema_extra):
        field.json_schema_extra(schema)
    if "enum" in schema:
        return ", ".join(schema["enum"])
    stated = [(word, getattr(one, name, None)) for one in field.metadata for name, word in BOUNDS.items()]
    bounds = [f"{word} {value}" for word, value in stated if value is not None]
    return " ".join([_type(field.annotation), *([", ".join(bounds)] if bounds else [])])


def _default(field: FieldInfo) -> str:
    value = list(field.default) if isinstance(field.default, tuple) else field.default
    return value if isinstance(value, str) else show(value)


def _type(annotation: Any) -> str:
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return ", ".join(map(str, inner))
    if origin in (Union, UnionType):
        return " or ".join(_type(one) for one in inner)
    if annotation is NoneType:
        return "null"
    return TYPES.get(annotation, "list" if origin in (tuple, list) else getattr(annotation, "__name__", "value"))
