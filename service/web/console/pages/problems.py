"""The pages that the `type` of a problem leads to: what it means, and what to do."""

from typing import Annotated

from fastapi import Path
from fastapi import Query as InQuery
from starlette.responses import Response

from service.errors import NotFound
from service.web.console.page_context import PageQuery, open_layout
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import OPEN
from service.web.requests.problem_types import types_with_pages


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
