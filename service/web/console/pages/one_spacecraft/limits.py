"""The page of a spacecraft's limits: their bounds, their history, and who set them."""

from typing import Annotated

from fastapi import Path
from fastapi import Query as InQuery
from starlette.responses import Response

from service.alarms.subjects import limited_trackers
from service.observations.schema import Key
from service.web.console.page_context import ContextDep, PageQuery
from service.web.console.pages.one_spacecraft.trend_charts import charts_by_quantity
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import Policy

SEVERITIES = ("watch", "warning", "critical")
PREVIEW_DAYS = (1, 7, 30)


class LimitsQuery(PageQuery):
    """Whose limits: those of the spacecraft as a whole, or of one of its trackers."""

    tracker: Key | None = None


@console_page("/spacecraft/{name}/limits", "Limits", Policy("read", "path"), section="/alarms")
def limits_page(
    name: Annotated[str, Path()], query: Annotated[LimitsQuery, InQuery()], context: ContextDep
) -> Response:
    """The bounds of every quantity, which can be previewed and changed, with their history."""
    app, tracker = context.app, query.tracker
    limits = app.limits.all(name, tracker)
    return rendered(
        "limits.html.jinja",
        context.layout(query.run),
        name=name,
        tracker=tracker,
        trackers=limited_trackers(app.context.known[name]),
        limits=[app.limits.get(name, each.quantity, tracker) for each in limits],
        severities=SEVERITIES,
        days=PREVIEW_DAYS,
        charts=charts_by_quantity(),
        may_write="operate" in context.caller.scopes,
    )
