"""The faults that pydantic finds in a body, in the service's words."""

from typing import Any

from pydantic import ValidationError

from service.errors import Fault, shown_value

MAX_FAULTS_SHOWN = 20
MAX_NAME_SHOWN = 80

PRIOR_KINDS = {each: each for each in ("quaternion", "boresight", "sun_pointed")} | {
    "from_last": "from"
}
"""The kinds of a priori knowledge, and the field that tells each."""


def faults_of(error: ValidationError, prefix: tuple[str, ...] = ()) -> list[Fault]:
    """Faults that pydantic found, in the service's words: a dotted field, a message, the value."""
    return [
        Fault(_field((*prefix, *fault["loc"])), _message(fault), _value(fault))
        for fault in error.errors(include_url=False)[:MAX_FAULTS_SHOWN]
    ]


def _field(location: tuple[str | int, ...]) -> str:
    tags = tuple(PRIOR_KINDS)
    parts = [
        # A client's own key may be of any length.
        str(part)[:MAX_NAME_SHOWN]
        for index, part in enumerate(location)
        # The tag of the kind of prior is pydantic's, not a field of the body.
        if not (
            part in tags
            and index
            and location[index - 1] == "a_priori"
            and index + 1 < len(location)
        )
    ]
    return ".".join(parts) or "body"


def _message(fault: Any) -> str:
    if fault["type"] == "extra_forbidden":
        return "there is no such field"
    return str(fault["msg"]).removeprefix("Value error, ")


def _value(fault: Any) -> str | None:
    # A missing field or a fault of the whole has nothing to show but its surroundings.
    return None if fault["type"] == "missing" or not fault["loc"] else shown_value(fault["input"])
