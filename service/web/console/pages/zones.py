"""The page of the cache of zones: size, build time and use of each."""

from typing import Annotated

from fastapi import Query as InQuery
from starlette.responses import Response

from service.web.console.page_context import ContextDep, PageQuery
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import READ

MOST_SHOWN = 60


@console_page("/zones", "Zones", READ, position=60)
def zones_page(query: Annotated[PageQuery, InQuery()], context: ContextDep) -> Response:
    """Cached zones and run catalogs, the most recently used first."""
    cache = context.app.zones.state()
    epochs = {each.digest: each.epoch_year for each in cache.run_catalogs}
    return rendered(
        "zones.html.jinja",
        context.layout(query.run),
        cache=cache,
        zones=cache.items[::-1][:MOST_SHOWN],
        epochs=epochs,
        spacecraft=context.spacecraft,
    )
