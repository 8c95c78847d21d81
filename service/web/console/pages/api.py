"""The API's description for people, and what the `type` of each problem means."""

from functools import lru_cache
from typing import Annotated

from fastapi import FastAPI, Path
from fastapi import Query as InQuery
from markupsafe import Markup
from starlette.requests import Request
from starlette.responses import Response

from service.errors import NotFound
from service.web.console.api_reference import reference_for_people
from service.web.console.page_context import PageQuery, open_layout
from service.web.console.registry import console_page
from service.web.console.rendering import rendered, rendered_part
from service.web.requests.access import OPEN
from service.web.requests.problem_types import types_with_pages


@console_page("/docs", "API", OPEN)
def api_page(request: Request, query: Annotated[PageQuery, InQuery()]) -> Response:
    """Every route of the API with its parameters, answers and examples."""
    layout = open_layout(query.run, "API", "/docs")
    shown = _operations(request.app)
    return rendered("api.html.jinja", layout, heading="API", reference=shown)


@console_page("/docs/shapes", "API shapes", OPEN, section="/docs")
def api_shapes_page(request: Request, query: Annotated[PageQuery, InQuery()]) -> Response:
    """The shapes of requests and answers, field by field."""
    layout = open_layout(query.run, "API shapes", "/docs")
    shown = _shapes(request.app)
    return rendered("api.html.jinja", layout, heading="API: shapes", reference=shown)


# Made once: anybody may ask for these pages, without a token.  Of one app only: a program that
# opens and closes several keeps no other.
@lru_cache(maxsize=1)
def _operations(app: FastAPI) -> Markup:
    return rendered_part("_api.html.jinja", reference=reference_for_people(app))


@lru_cache(maxsize=1)
def _shapes(app: FastAPI) -> Markup:
    return rendered_part("_api_shapes.html.jinja", reference=reference_for_people(app))


@console_page("/problems", "Problems", OPEN, section="/docs")
def problems_page(query: Annotated[PageQuery, InQuery()]) -> Response:
    """Every type of problem."""
    kinds = list(types_with_pages().values())
    return rendered(
        "problems.html.jinja",
        open_layout(query.run, "Problems", "/docs"),
        kinds=kinds,
        heading="Problems",
    )


@console_page("/problems/{slug}", "Problem", OPEN, section="/docs")
def problem_page(slug: Annotated[str, Path()], query: Annotated[PageQuery, InQuery()]) -> Response:
    """One type of problem."""
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
