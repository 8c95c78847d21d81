"""Validation errors of requests in the service's words: a field, a message and a value each.

Errors of pydantic are converted here for all request bodies.
"""

from collections.abc import Callable
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from service.errors import BadBatch, Fault, shown_value
from service.missions.faults import allowed_keys, causes, nearest, plain_message

Value = TypeVar("Value")

MAX_FAULTS_SHOWN = 20
MAX_NAME_SHOWN = 80
EXPLAINED = 3
"""Number of errors of a body for which the nearest field name is searched, since that is slow."""

PRIOR_KINDS = {each: each for each in ("quaternion", "boresight", "sun_pointed")} | {
    "from_last": "from"
}
"""The kinds of a priori knowledge, each with the field of a request that identifies it."""


def faults_of(
    error: ValidationError, prefix: tuple[str, ...] = (), model: type[BaseModel] | None = None
) -> list[Fault]:
    """The errors found by pydantic in the service's words: a dotted field, a message, the value.

    With the validated model, the message for an unknown field names the nearest known one.
    """
    return [
        Fault(
            _field((*prefix, *fault["loc"])),
            plain_message(fault) + (_meant(model, fault) if place < EXPLAINED else ""),
            _value(fault),
        )
        for place, fault in enumerate(causes(error.errors(include_url=False))[:MAX_FAULTS_SHOWN])
    ]


def _meant(model: type[BaseModel] | None, fault: Any) -> str:
    """The end of a message on an unknown field: the nearest known one, or all; else empty."""
    if model is None or fault["type"] != "extra_forbidden":
        return ""
    # In the model a field named like a Python keyword, such as from, ends with an underscore.
    keys = allowed_keys(model, _fields_of(fault["loc"])[:-1])
    allowed = [key.removesuffix("_") for key in keys]
    if fault["loc"][-1] in allowed:
        # The field belongs to another kind of a priori knowledge.
        kind = fault["loc"][-2]
        return f" beside {PRIOR_KINDS.get(kind, kind)}"
    if (near := nearest(str(fault["loc"][-1]), allowed)) is not None:
        return f"; did you mean {near}?"
    return f"; there are {', '.join(allowed)}" if allowed else ""


def checked_by(
    validate: Callable[[Any], Value], given: object, prefix: tuple[str, ...] = ()
) -> Value:
    """The value that one of pydantic's validators returns for an input; raises `BadBatch`.

    Raises `BadBatch` with the faults, outside of the exception handler: pydantic's error holds the
    whole input, and as part of a reference cycle it would never be freed.
    """
    try:
        return validate(given)
    except ValidationError as error:
        # For a bound method of a model class, the model is known.
        owner = getattr(validate, "__self__", None)
        is_model = isinstance(owner, type) and issubclass(owner, BaseModel)
        faults = faults_of(error, prefix, owner if is_model else None)
    raise BadBatch(faults)


def _fields_of(location: tuple[str | int, ...]) -> list[str | int]:
    """An error's location without pydantic's tag for the kind of a priori knowledge."""
    return [
        part
        for index, part in enumerate(location)
        if not (
            part in PRIOR_KINDS
            and index
            and location[index - 1] == "a_priori"
            and index + 1 < len(location)
        )
    ]


def _field(location: tuple[str | int, ...]) -> str:
    # A key from the client may have any length.
    return ".".join(str(part)[:MAX_NAME_SHOWN] for part in _fields_of(location)) or "body"


def _value(fault: Any) -> str | None:
    # For a missing field or a fault of the whole body there is no value to show.
    return None if fault["type"] == "missing" or not fault["loc"] else shown_value(fault["input"])
