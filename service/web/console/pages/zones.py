"""The page of zones: the size that a mission needs, and the cache with its size and use."""

from typing import Annotated

from fastapi import Query as InQuery
from starlette.responses import Response

from service.advice.zone_size import LEAST_BATCHES, Verdict
from service.observations.schema import Key
from service.web.console.page_context import ContextDep, PageQuery
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import READ

MOST_SHOWN = 60
VERDICTS: dict[Verdict, str] = {
    "too_few": f"No advice on its size: that needs {LEAST_BATCHES} batches.",
    "fits": "The size fits.",
    "too_small": "The zone is too small.",
    "larger_than_needed": "The zone is larger than needed.",
}


class ZonesQuery(PageQuery):
    """Whose zone is weighed: by default the first spacecraft with batches in the run."""

    spacecraft: Key | None = None


@console_page("/zones", "Zones", READ, position=75)
def zones_page(query: Annotated[ZonesQuery, InQuery()], context: ContextDep) -> Response:
    """The size of a zone, and cached zones and run catalogs, the most recently used first."""
    name = query.spacecraft or context.filled_spacecraft(query.run)
    size, costs = context.app.zones.size(name, query.run)
    cache = context.app.zones.state()
    epochs = {each.digest: each.epoch_year for each in cache.run_catalogs}
    return rendered(
        "zones.html.jinja",
        context.layout(query.run),
        cache=cache,
        zones=cache.items[::-1][:MOST_SHOWN],
        epochs=epochs,
        spacecraft=context.spacecraft,
        name=name,
        size=size,
        costs=costs,
        verdicts=VERDICTS,
        may_write="operate" in context.caller.scopes,
    )
