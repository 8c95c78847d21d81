"""The OpenAPI description of a route: request bodies, responses, problems.

Handlers return finished bytes, so the framework cannot derive their schema.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel
from starlette.responses import Response

from service.products.formats import attitude_formats, table_formats
from service.storage.models.base import Record, component_name
from service.web.requests.problems import MEDIA_TYPE as PROBLEM_JSON
from service.web.requests.request_body import BINARY, FRAMES, JSON, NDJSON, PACKETS

SCHEMAS = "#/components/schemas/"
TABLES, ATTITUDES = "x-tables", "x-attitudes"
"""Mark a response in the formats of tables, or of attitudes, until the document is made."""

REPLAYED = {
    "Replayed": {
        "description": "`true`: the answer was recorded before this request.",
        "schema": {"type": "string", "enum": ["true"]},
    }
}
LOCATION = {
    "Location": {"description": "The address of the new resource.", "schema": {"type": "string"}}
}
CONTENT_LOCATION = {
    "Content-Location": {
        "description": "The address of this result.",
        "schema": {"type": "string"},
    }
}
ETAG = {
    "ETag": {
        "description": "Changes with the answer; send it as `If-None-Match`.",
        "schema": {"type": "string"},
    }
}
LINK = {
    "Link": {
        "description": 'The next page, as `<...>; rel="next"`; absent on the last page.',
        "schema": {"type": "string"},
    }
}
IDEMPOTENCY_KEY = {
    "name": "Idempotency-Key",
    "in": "header",
    "description": (
        "Any text that the client chooses. A request with the same key and the same body "
        "returns the first answer again; with another body it is refused. Each token has its "
        "own keys."
    ),
    "schema": {"type": "string", "minLength": 1, "maxLength": 255, "pattern": "^[\\x20-\\x7e]+$"},
}
LAST_EVENT_ID = {
    "name": "Last-Event-ID",
    "in": "header",
    "description": (
        "The number of the last received event; the stream begins with the next one. A "
        "browser's EventSource sends this header when it reconnects."
    ),
    "schema": {"type": "string", "maxLength": 18},
}

_PROBLEMS = {
    400: "The body is not JSON: truncated, empty, or in another encoding.",
    401: "No token, or an unknown, expired or revoked one.",
    403: "The token lacks the scope, or is bound to other spacecraft.",
    404: "Not found.",
    408: "The body did not arrive in time.",
    409: "Recorded already with another body, or the state does not allow this.",
    413: "The body is too large.",
    415: "This route does not accept the content type or the content coding of the body.",
    422: "Invalid input; `errors` names every field and value.",
    429: "The token's request rate is exceeded; `Retry-After` says when to try again.",
    503: "The service is busy or unavailable; `Retry-After` says when to try again.",
}
READING_JSON = (400, 408, 413, 415, 503)
READING_NDJSON = READING_FRAME = (408, 413, 415)
_BINARY = {"type": "string", "format": "binary"}
_RETRY_AFTER = {"Retry-After": {"description": "Seconds.", "schema": {"type": "string"}}}
_CHALLENGE = {"WWW-Authenticate": {"description": "Bearer.", "schema": {"type": "string"}}}
_HEADERS: Mapping[int, Any] = {
    401: {"headers": _CHALLENGE},
    429: {"headers": _RETRY_AFTER},
    503: {"headers": _RETRY_AFTER},
}
AUTH_STATUSES = (401, 403, 429)
"""Statuses of every route that requires a token."""


@dataclass(frozen=True)
class ResponseDoc:
    """A response of a route that is not a problem; without a shape it is plain text or bytes."""

    description: str
    shape: type[Record] | None = None
    headers: Mapping[str, Any] = field(default_factory=dict)
    media_type: str = JSON
    also: str | None = None
    """Another media type that the client can ask for, as plain text or bytes."""
    tables: bool = False
    """True if the client can ask for it as a table in each of the output formats."""
    attitudes: bool = False
    """True if the client can ask for it in each format of attitudes."""


def route_docs(
    answers: Mapping[int, ResponseDoc],
    *,
    body: type[BaseModel] | None = None,
    body_required: bool = True,
    lines_of: type[BaseModel] | None = None,
    archive: str | None = None,
    array_of: tuple[type[BaseModel], int] | None = None,
    frame: bool = False,
    problems: Sequence[int] = (),
    parameters: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """The arguments for a route's decorator that describe it.

    Without `body_required` the body may be left out: its fields all have defaults.
    `archive` says what an archive holds that can be sent in place of lines.
    `array_of` is the model of an array's elements, and how many there may be.
    """
    extra: dict[str, Any] = {}
    if body is not None:
        content = {JSON: {"schema": _ref(body)}}
        extra["requestBody"] = {"required": body_required, "content": content}
        problems = (*problems, *READING_JSON)
    if array_of is not None:
        element, most = array_of
        array = {"type": "array", "items": _ref(element), "minItems": 1, "maxItems": most}
        extra["requestBody"] = {"required": True, "content": {JSON: {"schema": array}}}
        problems = (*problems, *READING_JSON)
    if lines_of is not None:
        description = f"A `{lines_of.__name__}` a line."
        lines = {"schema": _BINARY | {"description": description}}
        content = dict.fromkeys((NDJSON[0], BINARY), lines)
        if archive is not None:
            content[PACKETS] = {"schema": _BINARY | {"description": archive}}
        extra["requestBody"] = {"required": True, "content": content}
        problems = (*problems, *READING_NDJSON)
    if frame:
        file = {"schema": _BINARY}
        extra["requestBody"] = {"required": True, "content": dict.fromkeys(FRAMES, file)}
        problems = (*problems, *READING_FRAME)
    if parameters:
        extra["parameters"] = list(parameters)
    responses: dict[int | str, Any] = {
        status: _answer(doc) for status, doc in sorted(answers.items())
    }
    for status in sorted({*problems, 422}):
        responses[status] = _problem(_PROBLEMS[status])
        responses[status] |= _HEADERS.get(status, {})
    responses["default"] = _problem("Any other problem: a wrong method, an internal error.")
    return {
        "status_code": min(answers, key=lambda status: (status != 201, status)),
        "responses": responses,
        "openapi_extra": extra,
        "response_class": Response,
        "response_description": answers[min(answers)].description,
    }


def auth_responses() -> dict[str, Any]:
    """The OpenAPI responses of `AUTH_STATUSES`."""
    return {str(each): _problem(_PROBLEMS[each]) | _HEADERS.get(each, {}) for each in AUTH_STATUSES}


def _ref(shape: type[BaseModel] | type[Record]) -> dict[str, str]:
    return {"$ref": SCHEMAS + component_name(shape)}


def _answer(doc: ResponseDoc) -> dict[str, Any]:
    schema = _plain(doc.media_type) if doc.shape is None else _ref(doc.shape)
    answer: dict[str, Any] = {"description": doc.description}
    if doc.headers:
        answer["headers"] = dict(doc.headers)
    answer["content"] = {doc.media_type: {"schema": schema}}
    if doc.also is not None:
        answer["content"][doc.also] = {"schema": _plain(doc.also)}
    if doc.tables:
        answer[TABLES] = True
    if doc.attitudes:
        answer[ATTITUDES] = True
    return answer


def add_table_formats(response: dict[str, Any]) -> None:
    """Add the media types of the output formats that are registered by now."""
    formats = {
        **(table_formats() if response.pop(TABLES, False) else {}),
        **(attitude_formats() if response.pop(ATTITUDES, False) else {}),
    }
    for each in formats.values():
        if each.media_type not in response["content"]:
            response["content"][each.media_type] = {"schema": _plain(each.media_type)}


def _plain(media_type: str) -> dict[str, str]:
    return {"type": "string"} if media_type.startswith("text/") else _BINARY


def _problem(description: str) -> dict[str, Any]:
    content = {PROBLEM_JSON: {"schema": {"$ref": SCHEMAS + "Problem"}}}
    return {"description": description, "content": content}
