"""OpenAPI 3.1 description of the API: routes with descriptions, schemas and examples.

Handlers return finished bytes, so the framework cannot derive their schema.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any, TypeVar

from fastapi import APIRouter, FastAPI
from fastapi.dependencies.models import Dependant
from fastapi.dependencies.utils import get_dependant
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, models_json_schema
from starlette.responses import Response

from service import __version__
from service.contract.base import Record, component_name, described
from service.contract.events import EVENT_DATA
from service.feature import known_features
from service.observations.input_formats import INPUT_FORMATS, NDJSON, input_formats
from service.table_files.formats import TABLE_FORMATS, OutputFormat
from service.web.middleware import API
from service.web.requests.access import POLICIES, Policy
from service.web.requests.problems import MEDIA_TYPE as PROBLEM_JSON
from service.web.requests.query_parameters import NO_QUERY, TIME_SCHEMA
from service.web.requests.request_body import BINARY, JSON

Handler = TypeVar("Handler", bound=Callable[..., Any])

SCHEMAS = "#/components/schemas/"
FORMATS = "x-formats"
"""Key that marks a response with several formats until the document is made."""
FORMATS_OF: dict[str, Callable[[], Mapping[str, OutputFormat]]] = {"tables": lambda: TABLE_FORMATS}
"""Output formats of an answer by kind of content; features add theirs."""


def _header(name: str, description: str, **schema: Any) -> dict[str, Any]:
    return {name: {"description": description, "schema": {"type": "string", **schema}}}


REPLAYED = _header(
    "Replayed", "`true`: the answer was recorded before this request.", enum=["true"]
)
LOCATION = _header("Location", "The address of the new resource.")
CONTENT_LOCATION = _header("Content-Location", "The address of this result.")
ETAG = _header("ETag", "Changes with the answer; send it as `If-None-Match`.")
LINK = _header("Link", 'The next page, as `<...>; rel="next"`; absent on the last page.')
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
READING_NDJSON = READING_FILE = (408, 413, 415)
_BINARY = {"type": "string", "format": "binary"}
_RETRY_AFTER = _header("Retry-After", "Seconds.")
_CHALLENGE = _header("WWW-Authenticate", "Bearer.")
_HEADERS: Mapping[int, Any] = {
    401: {"headers": _CHALLENGE},
    429: {"headers": _RETRY_AFTER},
    503: {"headers": _RETRY_AFTER},
}
AUTH_STATUSES = (401, 403, 429)
"""HTTP error statuses of every route that requires a token."""
EVENT_STREAM = "text/event-stream"

_REQUESTS: set[type[BaseModel]] = set()
"""Models of the request bodies of all routes, collected for the OpenAPI document."""


@dataclass(frozen=True)
class Returns:
    """Successful response of a route; without a shape it is plain text or bytes."""

    description: str
    shape: type[Record] | None = None
    headers: Mapping[str, Any] = field(default_factory=dict)
    media_type: str = JSON
    also: str | None = None
    """Alternative media type that the client can request, as plain text or bytes."""
    formats: str | None = None
    """Key in `FORMATS_OF` of the formats that the client can request."""
    status: int = 200


@dataclass(frozen=True)
class ClientMethod:
    """Method of the Python client for a route, which `make client` writes from its description.

    Arguments are the names in the path, then the fields of query and body: those `by_place` in
    this order, the others by keyword, `omitted` ones not at all.  `renamed` maps fields to other
    names of arguments.  A `body` names one argument for a body that is sent unchanged.  A field
    `format` is no argument: a method with a `format` asks for it, and returns its text.
    `repeatable` marks a POST request that changes nothing when it is sent again.  `example` is a
    doctest of the synchronous client, after the batch of the documents was submitted.
    """

    name: str
    by_place: tuple[str, ...] = ()
    renamed: Mapping[str, str] = field(default_factory=dict)
    omitted: tuple[str, ...] = ()
    defaults: Mapping[str, Any] = field(default_factory=dict)
    body: str = ""
    format: str = ""
    repeatable: bool = False
    example: str = ""

    def __call__(self, handler: Handler) -> Handler:
        """Give the route of the decorated handler this method of the client."""
        CLIENT_METHODS.setdefault(handler.__name__, []).append((handler, self))
        return handler


@dataclass(frozen=True)
class Example:
    """Request of a route that the OpenAPI document shows with its answer.

    `python -m service.web.examples` sends it after the first batches.  `path` has values for the
    names in the path, `body` is sent as JSON.  A request that needs others before it is sent by
    the module `examples` of its feature instead.
    """

    name: str
    query: str = ""
    path: Mapping[str, str] = field(default_factory=lambda: {"name": "XTE"})
    body: Mapping[str, Any] | None = None

    def __call__(self, handler: Handler) -> Handler:
        """Add an example to the route of the decorated handler."""
        EXAMPLE_REQUESTS.setdefault(handler.__name__, []).insert(0, self)
        return handler


EXAMPLE_REQUESTS: dict[str, list[Example]] = {}
"""Requests whose answers are examples of a route, by the name of its handler."""

CLIENT_METHODS: dict[str, list[tuple[Callable[..., Any], ClientMethod]]] = {}
"""Methods of the Python client for each route, with its handler, by the name of the handler."""


class ApiRouter(APIRouter):
    """Router for the API routes of one subject, with their descriptions."""

    def __init__(self, subject: str, prefix: str = "/api/v1") -> None:
        super().__init__(prefix=prefix, tags=[subject])

    def serves(
        self,
        method_and_path: str,
        policy: Policy,
        *answers: Returns,
        body: type[BaseModel] | None = None,
        body_required: bool = True,
        lines_of: type[BaseModel] | None = None,
        array_of: tuple[type[BaseModel], int] | None = None,
        files: Sequence[str] = (),
        problems: Sequence[int] = (),
        parameters: Sequence[Mapping[str, Any]] = (),
        dependencies: Sequence[Any] = (),
        may_create: bool = False,
    ) -> Callable[[Handler], Handler]:
        """Register the decorated handler; one without query parameters refuses any.

        `policy` is the access that it requires.
        What a path names may not be there, so 404 is described, unless the route creates it.
        Without `body_required` the body may be left out: its fields all have defaults.
        In place of `lines_of` a model, every input format that has a media type can be sent.
        `array_of` is the model of an array's elements, and how many there may be.
        `files` are the media types of a file that is sent.
        """
        content: dict[str, Any] = {}
        reading: Sequence[int] = ()
        if body is not None:
            content, reading = {JSON: {"schema": _ref(body)}}, READING_JSON
        if array_of is not None:
            element, most = array_of
            array = {"type": "array", "items": _ref(element), "minItems": 1, "maxItems": most}
            content, reading = {JSON: {"schema": array}}, READING_JSON
        if lines_of is not None:
            description = f"A `{lines_of.__name__}` a line."
            lines = {"schema": _BINARY | {"description": description}}
            types = INPUT_FORMATS[NDJSON].media_types[0], BINARY
            content, reading = dict.fromkeys(types, lines), READING_NDJSON
            for name, each in input_formats().items():
                if name != NDJSON and each.media_types:
                    schema = _BINARY | {"description": each.uploaded}
                    content[each.media_types[0]] = {"schema": schema}
        if files:
            file = {"schema": _BINARY}
            content, reading = dict.fromkeys(files, file), READING_FILE
        extra: dict[str, Any] = {}
        if content:
            extra["requestBody"] = {"required": body_required, "content": content}
        if parameters:
            extra["parameters"] = list(parameters)
        by_status = {each.status: each for each in answers}
        responses: dict[int | str, Any] = {
            status: _answer(by_status[status]) for status in sorted(by_status)
        }
        unknown = (404,) if "{" in method_and_path and not may_create else ()
        for status in sorted({*problems, *reading, *unknown, 422}):
            responses[status] = _problem(_PROBLEMS[status]) | _HEADERS.get(status, {})
        responses["default"] = _problem("Any other problem: a wrong method, an internal error.")
        method, _, path = method_and_path.partition(" ")

        def register(handler: Handler) -> Handler:
            POLICIES[handler.__name__] = policy
            takes_query = _takes_query(get_dependant(path=path, call=handler))
            self.add_api_route(
                path,
                handler,
                methods=[method],
                dependencies=[*([] if takes_query else [NO_QUERY]), *dependencies],
                status_code=min(by_status, key=lambda status: (status != 201, status)),
                responses=responses,
                openapi_extra=extra,
                response_class=Response,
                response_description=by_status[min(by_status)].description,
            )
            return handler

        return register


def _takes_query(declared: Dependant) -> bool:
    return bool(declared.query_params) or any(map(_takes_query, declared.dependencies))


def auth_responses() -> dict[str, Any]:
    """OpenAPI responses for the statuses of missing or refused access."""
    return {str(each): _problem(_PROBLEMS[each]) | _HEADERS.get(each, {}) for each in AUTH_STATUSES}


def _ref(shape: type[BaseModel] | type[Record]) -> dict[str, str]:
    if issubclass(shape, BaseModel):
        _REQUESTS.add(shape)
    return {"$ref": SCHEMAS + component_name(shape)}


def _answer(doc: Returns) -> dict[str, Any]:
    schema = _plain(doc.media_type) if doc.shape is None else _ref(doc.shape)
    answer: dict[str, Any] = {"description": doc.description}
    if doc.headers:
        answer["headers"] = dict(doc.headers)
    answer["content"] = {doc.media_type: {"schema": schema}}
    if doc.also is not None:
        answer["content"][doc.also] = {"schema": _plain(doc.also)}
    if doc.formats is not None:
        answer[FORMATS] = doc.formats
    return answer


def add_formats(response: dict[str, Any]) -> None:
    """Add the media types of all registered output formats to a response."""
    if (held := response.pop(FORMATS, None)) is None:
        return
    for each in FORMATS_OF[held]().values():
        if each.media_type not in response["content"]:
            response["content"][each.media_type] = {"schema": _plain(each.media_type)}


def _plain(media_type: str) -> dict[str, str]:
    return {"type": "string"} if media_type.startswith("text/") else _BINARY


def _problem(description: str) -> dict[str, Any]:
    content = {PROBLEM_JSON: {"schema": {"$ref": SCHEMAS + "Problem"}}}
    return {"description": description, "content": content}


_NOT_MODIFIED = "The client holds this answer already: `If-None-Match` names its `ETag`."

DESCRIPTION = """\
Send the stars that a star tracker observed; the service identifies them, solves for
the spacecraft's attitude, records both, and returns them.

Quaternions have the scalar part last and transform inertial (EME2000) components into
body components. Times are UTC, in calendar form or with the day of the year. Names end
in their unit. Every error is a problem (RFC 9457, `application/problem+json`). Long
lists come in pages; the `Link` header holds the address of the next page. The service
refuses parameters and fields that are not described here. Answers are compressed for
clients that accept gzip.
"""

TAGS = {
    "batches": "Batches of observed stars, and their results.",
    "frames": "Frames of star trackers.",
    "spacecraft": "Settings, state, attitude history and star rates.",
    "products": "Recorded attitudes as files for other programs.",
    "zones": "The cached zones in which the service searches for stars.",
    "runs and replays": "Named runs, which are separate from live batches, and the files "
    "replayed into them.",
    "access": "The caller, the session of a browser, and the audit list.",
    "alarms": "Limits, alarms, and actions on alarms.",
    "gyro": "Rates of a spacecraft's gyro, in blocks of samples.",
    "annotations": "Notes that people write on times and periods.",
    "calibrations": "Trackers calibrated from recorded batches, and what was adopted when.",
    "events": "Live events.",
    "webhooks": "Events that the service sends to receivers (Standard Webhooks).",
    "probes": "Probes and metrics for operation and monitoring.",
}


SECURITY = {
    "token": {
        "type": "http",
        "scheme": "bearer",
        "description": "A token from `acquire token create`; not needed while access is open.",
    },
    "session": {"type": "apiKey", "in": "cookie", "name": "acquire_session"},
}


class _Plain(GenerateJsonSchema):
    """JSON schema generator without titles derived from field names."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


EXAMPLES = "examples.json"


@cache
def examples() -> dict[str, Any]:
    """Examples from a real run: by operation, then `request` or status.

    Those of a feature's routes lie in its folder.
    """
    found: dict[str, Any] = {}
    for package in ("service.web", *(each.package for each in known_features().values())):
        file = files(package) / EXAMPLES
        if file.is_file():
            found |= json.loads(file.read_text(encoding="utf-8"))
    return found


def add_reference(app: FastAPI) -> None:
    """Make the app serve the same description as `openapi.yaml`."""
    app.openapi = cache(lambda: reference_of(app))  # type: ignore[method-assign]


def reference_of(app: FastAPI) -> dict[str, Any]:
    """Complete OpenAPI description of an app's routes."""
    root = getattr(app.state, "root_path", "")
    described = get_openapi(
        title="Attitude acquisition",
        version=__version__,
        openapi_version="3.1.0",
        description=DESCRIPTION,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        servers=[
            {"url": root or "/", "description": "The service that returned this description."}
        ],
        tags=[{"name": name, "description": text} for name, text in TAGS.items()],
        routes=app.routes,
    )
    described["components"] = {"schemas": _schemas(), "securitySchemes": SECURITY}
    described["webhooks"] = {kind: _webhook(kind, data) for kind, data in EVENT_DATA.items()}
    described["paths"] = dict(sorted(described["paths"].items(), key=_place))
    for address, methods in described["paths"].items():
        for method, operation in methods.items():
            if method == "get" and address.startswith(API):
                _add_conditional(operation)
            _finish(operation)
    return described


def _place(path: tuple[str, Mapping[str, Any]]) -> tuple[int, str]:
    """Sort key of a path in the document: the first tag of its operations, then the name."""
    address, methods = path
    (tag,) = next(iter(methods.values()))["tags"]
    known = list(TAGS)
    return known.index(tag) if tag in known else len(known), address


def _webhook(kind: str, data: type[Record]) -> dict[str, Any]:
    """OpenAPI description of the message that a webhook sends for an event."""
    text = {"type": ["string", "null"]}
    fields = {
        "type": {"const": kind},
        "timestamp": {"type": "string", "format": "date-time"},
        "event": {"type": "integer", "description": "The number of the event in the stream."},
        "run": text,
        "spacecraft": text,
        "data": {"$ref": SCHEMAS + component_name(data)},
    }
    schema = {"type": "object", "required": sorted(fields), "properties": fields}
    return {
        "post": {
            "summary": f"An event `{kind}`",
            "tags": ["events"],
            "requestBody": {"required": True, "content": {"application/json": {"schema": schema}}},
            "responses": {"204": {"description": "Any status from 200 to 299: it was received."}},
        }
    }


def _schemas() -> dict[str, Any]:
    answers = [described(each) for each in _records(Record)]
    _, found = models_json_schema(
        [(shape, "validation") for shape in (*_REQUESTS, *answers)],
        ref_template=SCHEMAS + "{model}",
        schema_generator=_Plain,
    )
    names = {shape.__name__: component_name(shape) for shape in _REQUESTS}
    defined = {names.get(name, name): schema for name, schema in found["$defs"].items()}
    # A validator says more than a pattern: it is only described here.
    defined["BatchIn"]["properties"]["time"] |= TIME_SCHEMA
    return dict(sorted(defined.items()))


def _records(kind: type[Record]) -> Iterator[type[Record]]:
    for each in kind.__subclasses__():
        if vars(each).get("component", each.__name__):
            yield each
        yield from _records(each)


def _add_conditional(operation: dict[str, Any]) -> None:
    """Describe ETag and 304 of answers that are sent in one piece."""
    responses = operation["responses"]
    held = responses["200"].get(FORMATS)
    # All formats but those of tables are always streamed.
    if EVENT_STREAM in responses["200"]["content"] or held not in (None, "tables"):
        return
    if held is None:  # Tables may be streamed.
        responses["200"]["headers"] = {**responses["200"].get("headers", {}), **ETAG}
    responses["304"] = {"description": _NOT_MODIFIED, "headers": ETAG, "content": {}}


def _finish(operation: dict[str, Any]) -> None:
    operation["summary"] = operation.pop("description").rstrip(".")
    policy = POLICIES[operation["operationId"]]
    if not policy.open:
        operation["security"] = [{"token": []}, {"session": []}, {}]
        operation["x-scope"] = policy.scope
        if policy.or_scope is not None:
            operation["x-scope-or"] = policy.or_scope
        operation["responses"] = dict(
            sorted({**auth_responses(), **operation["responses"]}.items())
        )
    known = examples().get(operation["operationId"], {})
    for parameter in operation.get("parameters", []):
        for repeated in ("title", "description"):
            parameter["schema"].pop(repeated, None)
    request = operation.get("requestBody", {})
    _put_examples(request, known.get("request"))
    for status, response in operation["responses"].items():
        add_formats(response)
        _put_examples(response, known.get(status))


def _put_examples(part: dict[str, Any], known: dict[str, Any] | None) -> None:
    for kind, content in part.get("content", {}).items():
        if known and kind.endswith("json"):
            content["examples"] = {name: {"value": value} for name, value in known.items()}
