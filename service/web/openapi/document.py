"""The API's reference as OpenAPI 3.1: the routes as they describe themselves, schemas, examples."""

import json
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, models_json_schema

from service import __version__
from service.gyro import GyroBlockIn
from service.observations.schema import BatchIn
from service.storage.models.base import Record, component_name, described
from service.storage.models.events import EVENT_DATA
from service.web.api.alarms import (
    AnnotationIn,
    CommentIn,
    LimitIn,
    LimitTrialIn,
    ShelveIn,
    StatementIn,
)
from service.web.api.batches import CompareIn, WhatIfIn
from service.web.api.calibrations import (
    CalibrationAdoptIn,
    CalibrationIn,
    CalibrationRevertIn,
    CalibrationTrialIn,
)
from service.web.api.events import EVENT_STREAM
from service.web.api.products import DefinitiveIn
from service.web.api.runs import ForgetIn, RunIn
from service.web.api.tokens import SignIn, TokenIn
from service.web.api.webhooks import ReplayEventsIn, RetryIn, SecretIn, WebhookIn
from service.web.api.zones import WarmIn
from service.web.middleware import API
from service.web.openapi.route import (
    ATTITUDES,
    ETAG,
    SCHEMAS,
    TABLES,
    add_table_formats,
    auth_responses,
)
from service.web.requests.access import POLICIES
from service.web.requests.query_parameters import TIME_SCHEMA

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
    """Schemas without titles made up from field names."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


@cache
def examples() -> dict[str, Any]:
    """Requests and answers of a real run: by operation, then `request` or status."""
    text = (files("service.web") / "examples.json").read_text(encoding="utf-8")
    found: dict[str, Any] = json.loads(text)
    return found


def add_reference(app: FastAPI) -> None:
    """Let the app describe itself as `openapi.yaml` does."""
    app.openapi = cache(lambda: reference_of(app))  # type: ignore[method-assign]


def reference_of(app: FastAPI) -> dict[str, Any]:
    """The whole description of an app's routes."""
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
    for address, methods in described["paths"].items():
        for method, operation in methods.items():
            if method == "get" and address.startswith(API):
                _add_conditional(operation)
            _finish(operation)
    return described


def _webhook(kind: str, data: type[Record]) -> dict[str, Any]:
    """The body that a webhook sends for an event; the event stream has the same data."""
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


REQUESTS: Sequence[type[BaseModel]] = (
    BatchIn,
    WhatIfIn,
    WarmIn,
    RunIn,
    ForgetIn,
    CompareIn,
    StatementIn,
    ShelveIn,
    CommentIn,
    AnnotationIn,
    DefinitiveIn,
    GyroBlockIn,
    LimitIn,
    LimitTrialIn,
    SignIn,
    TokenIn,
    WebhookIn,
    SecretIn,
    RetryIn,
    ReplayEventsIn,
    CalibrationIn,
    CalibrationTrialIn,
    CalibrationAdoptIn,
    CalibrationRevertIn,
)


def _schemas() -> dict[str, Any]:
    answers = [described(each) for each in _records(Record)]
    _, found = models_json_schema(
        [(shape, "validation") for shape in (*REQUESTS, *answers)],
        ref_template=SCHEMAS + "{model}",
        schema_generator=_Plain,
    )
    names = {shape.__name__: component_name(shape) for shape in REQUESTS}
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
    """Describe what `ConditionalAnswers` adds to the answers that come in one piece."""
    responses = operation["responses"]
    # Attitudes are always streamed.
    if EVENT_STREAM in responses["200"]["content"] or ATTITUDES in responses["200"]:
        return
    if TABLES not in responses["200"]:  # Tables may be streamed.
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
        add_table_formats(response)
        _put_examples(response, known.get(status))


def _put_examples(part: dict[str, Any], known: dict[str, Any] | None) -> None:
    for kind, content in part.get("content", {}).items():
        if known and kind.endswith("json"):
            content["examples"] = {name: {"value": value} for name, value in known.items()}
