"""The page of a spacecraft's limits: what raises an alarm, since when, and who said so."""

from typing import Annotated

from fastapi import APIRouter, Path
from fastapi import Query as InQuery
from starlette.responses import Response

from service.web.dashboard.rendering import PageRoute, rendered
from service.web.dashboard.shell import AtDesk, RunQuery

router = APIRouter(include_in_schema=False, route_class=PageRoute)

SEVERITIES = ("watch", "warning", "critical")


@router.get("/spacecraft/{name}/limits")
def limits_page(
    name: Annotated[str, Path()], query: Annotated[RunQuery, InQuery()], desk: AtDesk
) -> Response:
    """Every watched quantity's bounds, open to change, with their history."""
    limits = desk.operations.limits(name)
    return rendered(
        "limits.html.jinja",
        desk.shell(query.run, "/alarms"),
        name=name,
        limits=[desk.operations.limit(name, each["quantity"]) for each in limits],
        severities=SEVERITIES,
    )
