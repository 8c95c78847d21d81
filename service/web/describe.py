"""What a route says of itself in the API's description: bodies, answers, problems.

Handlers return finished bytes, so the framework knows nothing of their shape;
here it is told.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel
from starlette.responses import Response

from service.web.bodies import BINARY, FRAMES, JSON, NDJSON
from service.web.errors import MEDIA_TYPE as PROBLEM_JSON

SCHEMAS = "#/components/schemas/"

REPLAYED = {
    "Replayed": {
        "description": "`true`: the answer was recorded before this request.",
        "schema": {"type": "string", "enum": ["true"]},
    }
}
LOCATION = {"Location": {"description": "Where it is from now on.", "schema": {"type": "string"}}}
LINK = {
    "Link": {
        "description": 'The next page, as `<...>; rel="next"`; absent on the last.',
        "schema": {"type": "string"},
    }
}
IDEMPOTENCY_KEY = {
    "name": "Idempotency-Key",
    "in": "header",
    "description": (
        "Any text of the client's choice. Sent again with the same body it gives the first "
        "answer again; with another body it is refused. Each token has keys of its own."
    ),
    "schema": {"type": "string", "minLength": 1, "maxLength": 255, "pattern": "^[\\x20-\\x7e]+$"},
}
LAST_EVENT_ID = {
    "name": "Last-Event-ID",
    "in": "header",
    "description": (
        "The number of the last event that was received; those after it come first. A browser's "
        "EventSource sends it by itself when it comes again."
    ),
    "schema": {"type": "string", "maxLength": 18},
}

_PROBLEMS = {
    400: "The body is not JSON: truncated, empty, or in another encoding.",
    401: "No token, or one that nobody is known by.",
    403: "The token does not cover this: its scopes, its spacecraft.",
    404: "There is no such thing.",
    408: "The body did not arrive in time.",
    409: "The batch is recorded already with another body, or the state does not allow this.",
    413: "The body is too large.",
    415: "The body has another type or coding than this route reads.",
    422: "Something in the request is wrong; `errors` names every field and value.",
    429: "More requests than the token's rate; `Retry-After` says when to try again.",
    503: "The service cannot take this now; `Retry-After` says when to try again.",
}
READING_JSON = (400, 408, 413, 415, 503)
READING_NDJSON = READING_FRAME = (408, 413, 415)
_BINARY = {"type": "string", "format": "binary"}
_RETRY_AFTER = {"Retry-After": {"description": "Seconds.", "schema": {"type": "string"}}}
_WHO = {"WWW-Authenticate": {"description": "Bearer.", "schema": {"type": "string"}}}
_HEADERS: Mapping[int, Any] = {
    401: {"headers": _WHO},
    429: {"headers": _RETRY_AFTER},
    503: {"headers": _RETRY_AFTER},
}
GUARDED = (401, 403, 429)
"""What every route answers that asks for a token."""


@dataclass(frozen=True)
class Gives:
    """One answer of a route that is not a problem; without a shape it is plain text or bytes."""

    description: str
    shape: type[BaseModel] | None = None
    headers: Mapping[str, Any] = field(default_factory=dict)
    media_type: str = JSON
    also: str | None = None
    """Another media type that it can be asked for in, as plain text or bytes."""


def described(
    answers: Mapping[int, Gives],
    *,
    body: type[BaseModel] | None = None,
    lines_of: type[BaseModel] | None = None,
    frame: bool = False,
    problems: Sequence[int] = (),
    parameters: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """The arguments for a route's decorator that describe it."""
    extra: dict[str, Any] = {}
    if body is not None:
        extra["requestBody"] = {"required": True, "content": {JSON: {"schema": _ref(body)}}}
        problems = (*problems, *READING_JSON)
    if lines_of is not None:
        description = f"A `{lines_of.__name__}` a line."
        lines = {"schema": _BINARY | {"description": description}}
        content = dict.fromkeys((NDJSON[0], BINARY), lines)
        extra["requestBody"] = {"required": True, "content": content}
        problems = (*problems, *READING_NDJSON)
    if frame:
        file = {"schema": _BINARY}
        extra["requestBody"] = {"required": True, "content": dict.fromkeys(FRAMES, file)}
        problems = (*problems, *READING_FRAME)
    if parameters:
        extra["parameters"] = list(parameters)
    responses: dict[int | str, Any] = {
        status: _answer(gives) for status, gives in sorted(answers.items())
    }
    for status in sorted({*problems, 422}):
        responses[status] = _problem(_PROBLEMS[status])
        responses[status] |= _HEADERS.get(status, {})
    responses["default"] = _problem("Any other problem: a wrong method, a fault of the service.")
    return {
        "status_code": min(answers, key=lambda status: (status != 201, status)),
        "responses": responses,
        "openapi_extra": extra,
        "response_class": Response,
        "response_description": answers[min(answers)].description,
    }


def guarded_responses() -> dict[str, Any]:
    """The answers of `GUARDED`, as they stand in the description."""
    return {str(each): _problem(_PROBLEMS[each]) | _HEADERS.get(each, {}) for each in GUARDED}


def _ref(shape: type[BaseModel]) -> dict[str, str]:
    return {"$ref": SCHEMAS + shape.__name__}


def _answer(gives: Gives) -> dict[str, Any]:
    schema = _plain(gives.media_type) if gives.shape is None else _ref(gives.shape)
    answer: dict[str, Any] = {"description": gives.description}
    if gives.headers:
        answer["headers"] = dict(gives.headers)
    answer["content"] = {gives.media_type: {"schema": schema}}
    if gives.also is not None:
        answer["content"][gives.also] = {"schema": _plain(gives.also)}
    return answer


def _plain(media_type: str) -> dict[str, str]:
    return {"type": "string"} if media_type.startswith("text/") else _BINARY


def _problem(description: str) -> dict[str, Any]:
    content = {PROBLEM_JSON: {"schema": {"$ref": SCHEMAS + "Problem"}}}
    return {"description": description, "content": content}
