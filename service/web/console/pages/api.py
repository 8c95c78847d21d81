"""Pages that describe the API and each `type` of problem."""

import html
import json
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from fastapi import FastAPI
from markupsafe import Markup, escape
from starlette.requests import Request
from starlette.responses import Response

from service.errors import NotFound
from service.web.console.page import (
    FromQuery,
    PageQuery,
    console_page,
    open_layout,
    rendered,
    rendered_part,
)
from service.web.openapi import SCHEMAS
from service.web.requests.access import OPEN
from service.web.requests.problems import types_with_pages


@console_page("/docs", "API", OPEN)
def api_page(request: Request, query: FromQuery[PageQuery]) -> Response:
    """Page with every route of the API: parameters, answers and examples."""
    layout = open_layout(query.run, "API", "/docs")
    shown = _operations(request.app)
    return rendered("api.html.jinja", layout, heading="API", reference=shown)


@console_page("/docs/shapes", "API shapes", OPEN, section="/docs")
def api_shapes_page(request: Request, query: FromQuery[PageQuery]) -> Response:
    """Page with the schemas of requests and answers, field by field."""
    layout = open_layout(query.run, "API shapes", "/docs")
    shown = _shapes(request.app)
    return rendered("api.html.jinja", layout, heading="API: shapes", reference=shown)


# Made once, since anybody may request these pages without a token; and kept for one app only, as a
# program may open and close several.
@lru_cache(maxsize=1)
def _operations(app: FastAPI) -> Markup:
    document = app.openapi()
    return rendered_part(
        "_api.html.jinja",
        document=document,
        operations=[
            (method.upper(), path, described, described.get("requestBody", {}).get("content", {}))
            for path, methods in document["paths"].items()
            for method, described in methods.items()
        ],
        prose=prose,
        parameter_kind=_parameter_kind,
        contents=_content,
        command=_command,
        example=_example,
    )


@lru_cache(maxsize=1)
def _shapes(app: FastAPI) -> Markup:
    shapes = app.openapi()["components"]["schemas"]
    return rendered_part("_api_shapes.html.jinja", shapes=shapes, prose=prose, kind_of=kind_of)


@console_page("/problems", "Problems", OPEN, section="/docs")
def problems_page(query: FromQuery[PageQuery]) -> Response:
    """Page with every type of problem."""
    kinds = list(types_with_pages().values())
    return rendered(
        "problems.html.jinja",
        open_layout(query.run, "Problems", "/docs"),
        kinds=kinds,
        heading="Problems",
    )


@console_page("/problems/{slug}", "Problem", OPEN, section="/docs")
def problem_page(slug: str, query: FromQuery[PageQuery]) -> Response:
    """Page about one type of problem."""
    kind = types_with_pages().get(slug)
    if kind is None:
        known = ", ".join(types_with_pages())
        raise NotFound(f"there is no problem {slug[:80]!r}; there are {known}")
    return rendered(
        "problems.html.jinja",
        open_layout(query.run, kind.title, "/docs"),
        kinds=[kind],
        heading="Problem",
    )


Json = Mapping[str, Any]

EXAMPLE_LINES = 40
_SHORT_ARRAY = re.compile(r"\[[^][{}\"]*\]")
_CODE = re.compile(r"`([^`]+)`")
_IN_A_PATH = {"{name}": "XTE", "{quantity}": "residual_ratio", "{run}": "pass-7", "{id}": "ID"}
_LOW = {"minimum": "from ", "exclusiveMinimum": "above ", "minLength": "length from "}
_HIGH = {"maximum": "to ", "exclusiveMaximum": "below ", "maxLength": "length to "}


def prose(text: str) -> Markup:
    """HTML of a description, with code for texts between backticks."""
    return Markup(_CODE.sub(r"<code>\1</code>", str(escape(text))))


def kind_of(schema: Json) -> Markup:
    """HTML that describes a schema in words, with links to the schemas that it names."""
    if "$ref" in schema:
        name = schema["$ref"].removeprefix(SCHEMAS)
        return Markup('<a href="/docs/shapes#{0}">{0}</a>').format(name)
    for either in ("anyOf", "oneOf"):
        if either in schema:
            return Markup(" or ").join(map(kind_of, schema[either]))
    if "enum" in schema or "const" in schema:
        values = schema.get("enum", [schema.get("const")])
        return Markup(", ").join(Markup("<code>{}</code>").format(each) for each in values)
    if schema.get("type") == "array":
        return _array(schema)
    words = [str(schema.get("type", "any value")), str(schema.get("format", ""))]
    words += [f"{word}{schema[key]}" for key, word in (_LOW | _HIGH).items() if key in schema]
    return escape(", ".join(filter(None, words)))


def _array(schema: Json) -> Markup:
    inner: Json = schema.get("items") or next(iter(schema.get("prefixItems", ())), {})
    low, high = schema.get("minItems", 0), schema.get("maxItems")
    count = f"{low} " if low == high else f"{low} to {high} " if high is not None else ""
    return Markup("array of {}{}").format(count, kind_of(inner))


def _parameter_kind(described: Json) -> Markup:
    kind = kind_of(described["schema"])
    if described["schema"].get("default") is not None:
        kind += Markup(", default <code>{}</code>").format(described["schema"]["default"])
    return kind


def _content(content: Json) -> Markup:
    kinds = (
        Markup("{} <code>{}</code>").format(kind_of(each["schema"]) if "json" in kind else "", kind)
        for kind, each in content.items()
    )
    return Markup(", ").join(kinds)


def _example(content: Json) -> Markup | None:
    for each in content.values():
        for example in each.get("examples", {}).values():
            text = json.dumps(example["value"], indent=1, ensure_ascii=False)
            # Vectors in one line, and of a long answer its beginning.
            lines = _SHORT_ARRAY.sub(lambda found: " ".join(found[0].split()), text).split("\n")
            cut = [*lines[:EXAMPLE_LINES], "..."] if len(lines) > EXAMPLE_LINES else lines
            return Markup(html.escape("\n".join(cut), quote=False))
    return None


def _command(method: str, path: str, request: Json) -> str:
    for name, value in _IN_A_PATH.items():
        path = path.replace(name, value)
    words = [
        "curl -s",
        *([] if method == "GET" else [f"-X {method}"]),
        f"http://127.0.0.1:8000{path}",
    ]
    if request:
        kind = next(iter(request))
        file = "request.json" if "json" in kind and "nd" not in kind else "FILE"
        words += [f"-H 'content-type: {kind}'", f"--data-binary @{file}"]
    return " ".join(words)
