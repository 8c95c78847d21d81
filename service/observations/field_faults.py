"""Faults of what clients send, in the service's words: each names a field, a message, a value.

The faults that pydantic finds are put into words here, for every shape that is read.
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
"""Faults of a body for which the nearest field is looked for, which takes milliseconds."""

PRIOR_KINDS = {each: each for each in ("quaternion", "boresight", "sun_pointed")} | {
    "from_last": "from"
}
"""The kinds of a priori knowledge, and the field that tells each."""


def faults_of(
    error: ValidationError, prefix: tuple[str, ...] = (), model: type[BaseModel] | None = None
) -> list[Fault]:
    """Faults that pydantic found, in the service's words: a dotted field, a message, the value.

    With the model that was validated, an unknown field is answered with the nearest that there is.
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
    """The field that an unknown one may stand for, or those that there are, as end of a message."""
    if model is None or fault["type"] != "extra_forbidden":
        return ""
    # A field whose name is a word of Python, such as from, ends with a low line there.
    keys = allowed_keys(model, _fields_of(fault["loc"])[:-1])
    allowed = [key.removesuffix("_") for key in keys]
    if fault["loc"][-1] in allowed:
        # A field of another kind of a priori knowledge.
        kind = fault["loc"][-2]
        return f" beside {PRIOR_KINDS.get(kind, kind)}"
    if (near := nearest(str(fault["loc"][-1]), allowed)) is not None:
        return f"; did you mean {near}?"
    return f"; there are {', '.join(allowed)}" if allowed else ""


def checked_by(
    validate: Callable[[Any], Value], given: object, prefix: tuple[str, ...] = ()
) -> Value:
    """What one of pydantic's validators makes of what was given.

    Raises `BadBatch` with the faults, outside the handler: pydantic's error holds all that was
    given, and once it is part of a cycle Python's collector never frees it.
    """
    try:
        return validate(given)
    except ValidationError as error:
        # Of the validator of a model, a bound method, the model is known.
        owner = getattr(validate, "__self__", None)
        is_model = isinstance(owner, type) and issubclass(owner, BaseModel)
        faults = faults_of(error, prefix, owner if is_model else None)
    raise BadBatch(faults)


def _fields_of(location: tuple[str | int, ...]) -> list[str | int]:
    """A location without the tag of the kind of prior, which is pydantic's, not a field."""
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
    # A client's own key may be of any length.
    return ".".join(str(part)[:MAX_NAME_SHOWN] for part in _fields_of(location)) or "body"


def _value(fault: Any) -> str | None:
    # A missing field or a fault of the whole has nothing to show but its surroundings.
    return None if fault["type"] == "missing" or not fault["loc"] else shown_value(fault["input"])
