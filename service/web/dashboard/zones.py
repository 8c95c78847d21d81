"""The page of the cache: which zones are kept, what they cost and how they are used."""

from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from starlette.responses import Response

from service.web.dashboard.rendering import PageRoute, rendered
from service.web.dashboard.shell import AtDesk, RunQuery

router = APIRouter(include_in_schema=False, route_class=PageRoute)

MOST_SHOWN = 60


@router.get("/zones")
def zones_page(query: Annotated[RunQuery, InQuery()], desk: AtDesk) -> Response:
    """Cached zones and run catalogs, the most recently used first."""
    cache = desk.operations.zones()
    epochs = {each["digest"]: each["epoch_year"] for each in cache["run_catalogs"]}
    return rendered(
        "zones.html.jinja",
        desk.shell(query.run, "/zones"),
        cache=cache,
        zones=list(reversed(cache["items"]))[:MOST_SHOWN],
        epochs=epochs,
        spacecraft=desk.spacecraft,
    )
