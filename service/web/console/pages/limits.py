"""The page of a spacecraft's limits: their bounds, their history, and who set them."""

from typing import Annotated

from fastapi import Path
from fastapi import Query as InQuery
from starlette.responses import Response

from service.web.console.page_context import ContextDep, PageQuery
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import Policy

SEVERITIES = ("watch", "warning", "critical")


@console_page("/spacecraft/{name}/limits", "Limits", Policy("read", "path"), section="/alarms")
def limits_page(
    name: Annotated[str, Path()], query: Annotated[PageQuery, InQuery()], context: ContextDep
) -> Response:
    """The bounds of every quantity, which can be changed, with their history."""
    limits = context.app.limits.all(name)
    return rendered(
        "limits.html.jinja",
        context.layout(query.run),
        name=name,
        limits=[context.app.limits.get(name, each.quantity) for each in limits],
        severities=SEVERITIES,
    )
