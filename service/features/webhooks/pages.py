"""Console page of webhooks."""

from starlette.responses import Response

from service.features.webhooks.part import Webhooks
from service.storage.recording.events import EVENT_KINDS
from service.web.console.page import ContextDep, FromQuery, PageQuery, console_page
from service.web.requests.access import OPERATE

SHOWN_DELIVERIES = 20
SEVERITIES = ("watch", "warning", "critical")


@console_page("/webhooks", "Webhooks", OPERATE, section="/about")
def webhooks_page(query: FromQuery[PageQuery], context: ContextDep) -> Response:
    """Console page with all webhooks and their waiting deliveries."""
    part = context.app.part(Webhooks)
    webhooks = part.all()
    waiting = {
        each.id: part.deliveries(each.id, limit=SHOWN_DELIVERIES, oldest_first=True).items
        for each in webhooks
    }
    return context.rendered(
        "webhooks.html.jinja",
        query.run,
        webhooks=webhooks,
        deliveries=waiting,
        most=SHOWN_DELIVERIES,
        kinds=EVENT_KINDS,
        severities=SEVERITIES,
        spacecraft=context.spacecraft,
        may_add="read" in context.caller.scopes,
    )
