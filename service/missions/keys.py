"""Keys of a mission file, for messages: the one that is wrong, and those that are allowed."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, get_args

from pydantic import BaseModel

Models = list[type[BaseModel]]


def dotted_key(model: type[BaseModel], location: Sequence[str | int]) -> str:
    """The key at which pydantic found a fault, without the tags that it puts in between."""
    return ".".join(str(part) for part in _steps(model, location)) or "the file"


def allowed_keys(model: type[BaseModel], location: Sequence[str | int]) -> list[str]:
    """The keys of the table at a location."""
    models = [model]
    for part in location:
        models = _after(models, part)[1]
    return list(dict.fromkeys(key for each in models for key in each.model_fields))


def explained(model: type[BaseModel], error: Mapping[str, Any]) -> str:
    """A fault that pydantic found; for an unknown key the keys that are allowed there."""
    if error["type"] == "missing":
        return "is required"
    if error["type"] != "extra_forbidden":
        return str(error["msg"]).removeprefix("Value error, ")
    allowed = allowed_keys(model, error["loc"][:-1])
    return f"no such key; allowed here: {', '.join(allowed)}"


def _steps(model: type[BaseModel], location: Sequence[str | int]) -> Iterator[str | int]:
    models = [model]
    for part in location:
        is_key, models = _after(models, part)
        if is_key:
            yield part


def _after(models: Models, part: str | int) -> tuple[bool, Models]:
    """Whether a part of a location is a key or an index, and the tables to which it leads."""
    fields = [each.model_fields[part] for each in models if part in each.model_fields]
    if fields:
        return True, [found for field in fields for found in _models_in(field.annotation)]
    tagged = [each for each in models if part in _tags(each)]
    # Below a table pydantic also names the members of a union of values.
    is_key = isinstance(part, int) or bool(models and not tagged)
    return is_key, tagged or models


def _tags(model: type[BaseModel]) -> tuple[Any, ...]:
    kind = model.model_fields.get("kind")
    return () if kind is None else get_args(kind.annotation)


def _models_in(annotation: Any) -> Models:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for part in get_args(annotation) for found in _models_in(part)]
