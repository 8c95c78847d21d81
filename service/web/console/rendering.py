"""Turning a page into HTML: one environment, one set of headers, errors as pages of their own."""

import dataclasses
import re
from collections.abc import Callable, Coroutine, Mapping
from typing import Any
from urllib.parse import quote, urlencode

import msgspec
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from jinja2 import Environment, PackageLoader, StrictUndefined, pass_context
from jinja2.runtime import Context
from markupsafe import Markup
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response

from service import __version__
from service.errors import AcquisitionError, BadInput, Busy, problem_of, problem_of_faults
from service.storage.recording.unsaved_result import LIVE
from service.web.console.formatting import FILTERS, present
from service.web.console.page_context import EMPTY_LAYOUT, Layout
from service.web.requests.problem_types import (
    INTERNAL_ERROR,
    PROBLEM_TYPES,
    ProblemType,
    problem_type_of,
)
from service.web.requests.problems import faults_in_query, on_http_error, root_path

HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


@pass_context
def _to(context: Context, path: str, /, **query: object) -> str:
    """An address of the console that keeps the shown run."""
    run = query.pop("run", context["layout"].run)
    asked = {} if run == LIVE else {"run": run}
    asked |= {name: value for name, value in query.items() if value is not None}
    return f"{quote(path)}?{urlencode(asked)}" if asked else quote(path)


def _data(value: object) -> Markup:
    """Values for a script, in a `template` element: escaped like any text."""
    return Markup("<template data-json>{}</template>").format(msgspec.json.encode(value).decode())


def _environment() -> Environment:
    # Text from clients is escaped; a misspelt name is an error, not an empty string.
    environment = Environment(
        loader=PackageLoader("service.web.console"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(FILTERS)
    environment.globals.update(to=_to, data=_data, version=__version__)
    return environment


_ENVIRONMENT = _environment()


def rendered(template: str, layout: Layout, status: int = 200, **values: Any) -> Response:
    """A page of the console."""
    text = _ENVIRONMENT.get_template(template).render(layout=layout, **values)
    return HTMLResponse(text, status, headers=dict(HEADERS))


def rendered_part(template: str, **values: Any) -> Markup:
    """A part of a page that depends on neither reader nor run, so that it can be kept."""
    return Markup(_ENVIRONMENT.get_template(template).render(**values))


_OWN_ADDRESS = re.compile(rb'\b(href|src|action)="/(?!/)')


def below_path(request: Request, page: Response) -> Response:
    """A page whose addresses begin with the path below which a proxy serves the service."""
    root = root_path(request).encode()
    if not root or not isinstance(page, HTMLResponse):
        return page
    body = _OWN_ADDRESS.sub(rb'\1="' + root + b"/", bytes(page.body))
    page.body = body.replace(b"<html ", b'<html data-root="' + root + b'" ', 1)
    page.headers["Content-Length"] = str(len(page.body))
    return page


class PageRoute(APIRoute):
    """A route whose errors are pages for people."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler, with every expected error turned into a page."""
        inner = super().get_route_handler()

        async def handler(request: Request) -> Response:
            try:
                return below_path(request, await inner(request))
            except RequestValidationError as error:
                page = _error_page(
                    PROBLEM_TYPES[BadInput], problem_of_faults(faults_in_query(error))
                )
                return below_path(request, page)
            except AcquisitionError as error:
                if (kind := problem_type_of(error)) is INTERNAL_ERROR:
                    raise
                answer = _error_page(kind, problem_of(error))
                if isinstance(error, Busy):
                    answer.headers["Retry-After"] = str(error.retry_after_s)
                return below_path(request, answer)

        return handler


async def page_or_problem(request: Request, error: Exception) -> Response:
    """What a browser that follows a link to no page gets is a page; all others get a problem."""
    is_page = not request.url.path.startswith(("/api/", "/static/"))
    asks_for_page = "text/html" in request.headers.get("accept", "")
    if not (isinstance(error, HTTPException) and error.status_code == 404):
        return await on_http_error(request, error)
    if not (is_page and asks_for_page and request.method in ("GET", "HEAD")):
        return await on_http_error(request, error)
    detail = f"There is no page at {request.url.path[:200]}."
    page = _error_page(ProblemType(404, "Not found"), {"detail": detail})
    return below_path(request, page)


def _error_page(kind: ProblemType, problem: Mapping[str, Any]) -> Response:
    return rendered(
        "error.html.jinja",
        dataclasses.replace(EMPTY_LAYOUT, now=present()),
        kind.status,
        kind=kind,
        problem=problem,
    )
