"""Serving the page and its static files; nothing is loaded from anywhere else."""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter
from fastapi import Query as InQuery
from jinja2 import Environment, PackageLoader, StrictUndefined
from starlette.responses import HTMLResponse, Response

from service.observe.wire import RunName
from service.records.rollups import Bucket
from service.times import parse_utc
from service.web.dashboard.view import LIVE, view_of
from service.web.holding import Held
from service.web.queries import Query

router = APIRouter(include_in_schema=False)

PLOT_TOP, PLOT_HEIGHT = 8, 104
"""Pixels of the chart's plot, within the height that the style sheet gives it."""

HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class PageQuery(Query):
    """Which run, and how wide the bars."""

    run: RunName = LIVE
    bucket: Bucket = "hour"


def _share(part: int, whole: int) -> str:
    return f"{100 * part / whole:.2g} %" if whole else "–"


def _environment() -> Environment:
    # Whatever came from a client is escaped; a misspelt name is an error and no empty string.
    environment = Environment(
        loader=PackageLoader("service.web.dashboard"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters: dict[str, Any] = {"share": _share}
    environment.filters.update(filters)
    environment.globals.update(plot_top=PLOT_TOP, plot_height=PLOT_HEIGHT)
    return environment


_PAGE = _environment().get_template("page.html.jinja")


@router.get("/")
def page(query: Annotated[PageQuery, InQuery()], operations: Held) -> Response:
    """How well stars are identified, spacecraft by spacecraft."""
    now = parse_utc(datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"))
    view = view_of(operations, query.run, query.bucket, now)
    return HTMLResponse(_PAGE.render(view=view), headers=dict(HEADERS))
