"""The page of webhooks: their state, last failures and dead letters, and the form for new ones."""

from typing import Annotated

from fastapi import Query as InQuery
from starlette.responses import Response

from service.storage.recording.events import EVENT_KINDS
from service.web.console.page_context import ContextDep, PageQuery
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import OPERATE

SHOWN_DELIVERIES = 20
SEVERITIES = ("watch", "warning", "critical")


@console_page("/webhooks", "Webhooks", OPERATE, section="/about")
def webhooks_page(query: Annotated[PageQuery, InQuery()], context: ContextDep) -> Response:
    """Every webhook with what waits for it."""
    webhooks = context.app.webhooks.all()
    waiting = {
        each.id: context.app.webhooks.deliveries(
            each.id, limit=SHOWN_DELIVERIES, oldest_first=True
        ).items
        for each in webhooks
    }
    return rendered(
        "webhooks.html.jinja",
        context.layout(query.run),
        webhooks=webhooks,
        deliveries=waiting,
        most=SHOWN_DELIVERIES,
        kinds=EVENT_KINDS,
        severities=SEVERITIES,
        spacecraft=context.spacecraft,
        may_add="read" in context.caller.scopes,
    )
