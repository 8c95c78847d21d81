"""The API's reference as OpenAPI 3.1: the routes as they describe themselves, schemas, examples."""

import json
from functools import cache
from importlib.resources import files
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, models_json_schema

from service import __version__
from service.observe.wire import BatchIn
from service.web.access import POLICIES
from service.web.describe import SCHEMAS, guarded_responses
from service.web.routes.access import SignIn
from service.web.routes.alarms import CommentIn, LimitIn, Said, ShelveIn
from service.web.routes.batches import WhatIfIn
from service.web.routes.compare import CompareIn
from service.web.routes.runs import RunIn
from service.web.routes.zones import WarmIn
from service.web.schemas import (
    access,
    advice,
    alarms,
    answers,
    base,
    compare,
    overview,
    runs,
    spacecraft,
    trends,
    zones,
)

DESCRIPTION = """\
Stars that a star tracker observed go in; their identities and the spacecraft's
attitude come out and are recorded.

Quaternions are scalar last, inertial (EME2000) to body. Times are UTC, calendar
or day-of-year. Units stand in the names. Every error is a problem
(RFC 9457, `application/problem+json`). Lists come in pages; the `Link` header
leads to the next. Parameters and fields that are not described here are refused.
"""

TAGS = {
    "batches": "Observed stars and what was made of them.",
    "frames": "Frames of star trackers, from which stars are taken.",
    "spacecraft": "Settings, state, attitude history and star rates.",
    "zones": "The cached parts of the sky in which stars are looked for.",
    "runs and replays": "Named runs, apart from live batches, and the files replayed into them.",
    "access": "Who asks, a browser's session, and the list of who changed what.",
    "alarms": "Limits, what is out of them, and who does what about it.",
    "events": "What happens, as it happens.",
    "probes": "For whoever keeps the service running.",
}


SECURITY = {
    "token": {
        "type": "http",
        "scheme": "bearer",
        "description": "From `acquire token create`; not needed on loopback until one was made.",
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
    described = get_openapi(
        title="Attitude acquisition",
        version=__version__,
        openapi_version="3.1.0",
        description=DESCRIPTION,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        tags=[{"name": name, "description": text} for name, text in TAGS.items()],
        routes=app.routes,
    )
    described["components"] = {"schemas": _schemas(), "securitySchemes": SECURITY}
    for path in described["paths"].values():
        for operation in path.values():
            _finish(operation)
    return described


def _schemas() -> dict[str, Any]:
    shapes: list[type[BaseModel]] = [
        BatchIn,
        WhatIfIn,
        WarmIn,
        RunIn,
        CompareIn,
        Said,
        ShelveIn,
        CommentIn,
        LimitIn,
        SignIn,
        *_shapes(),
    ]
    _, found = models_json_schema(
        [(shape, "validation") for shape in shapes],
        ref_template=SCHEMAS + "{model}",
        schema_generator=_Plain,
    )
    defined: dict[str, Any] = found["$defs"]
    return dict(sorted(defined.items()))


def _shapes() -> list[type[BaseModel]]:
    return [
        each
        for module in (
            base,
            answers,
            spacecraft,
            overview,
            advice,
            compare,
            alarms,
            trends,
            zones,
            runs,
            access,
        )
        for each in vars(module).values()
        if isinstance(each, type) and issubclass(each, base.Shape) and each is not base.Shape
    ]


def _finish(operation: dict[str, Any]) -> None:
    operation["summary"] = operation.pop("description").rstrip(".")
    policy = POLICIES[operation["operationId"]]
    if not policy.open:
        operation["security"] = [{"token": []}, {"session": []}, {}]
        operation["x-scope"] = policy.scope
        if policy.or_scope is not None:
            operation["x-scope-or"] = policy.or_scope
        operation["responses"] = dict(
            sorted({**guarded_responses(), **operation["responses"]}.items())
        )
    known = examples().get(operation["operationId"], {})
    for parameter in operation.get("parameters", []):
        for repeated in ("title", "description"):
            parameter["schema"].pop(repeated, None)
    request = operation.get("requestBody", {})
    _put_examples(request, known.get("request"))
    for status, response in operation["responses"].items():
        _put_examples(response, known.get(status))


def _put_examples(part: dict[str, Any], known: dict[str, Any] | None) -> None:
    for kind, content in part.get("content", {}).items():
        if known and kind.endswith("json"):
            content["examples"] = {name: {"value": value} for name, value in known.items()}
