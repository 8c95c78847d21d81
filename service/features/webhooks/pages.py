"""Console page of webhooks; lines about them for the overview and the page of the service."""

from collections.abc import Iterator

from starlette.responses import Response

from service.features.webhooks.part import Webhooks
from service.storage.recording.events import EVENT_KINDS
from service.web.console.formatting import plural
from service.web.console.page import ContextDep, FromQuery, PageContext, PageQuery, console_page
from service.web.console.pages.about import Check
from service.web.console.pages.overview import Notice
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


def notices(context: PageContext) -> Iterator[Notice]:
    """Line of the overview about webhooks that fail, for callers who may see their page."""
    if context.caller.spacecraft is not None or not context.may_operate:
        return
    found = []
    for each in context.app.part(Webhooks).all():
        if each.state == "disabled" or (each.state == "paused" and each.waiting):
            found.append(f"{each.name} is {each.state}, {each.waiting} events wait")
        elif each.failing_since is not None:
            found.append(f"{each.name} fails, {each.waiting} events wait")
        if each.dead:
            found.append(f"{each.name} has {each.dead} dead letters")
    if found:
        yield Notice(f"Webhooks: {'; '.join(found)}.", "/webhooks", "Webhooks")


def checks(context: PageContext) -> Iterator[Check]:
    """Line with the state of all webhooks, for operators."""
    if not context.may_operate:
        return
    webhooks = context.app.part(Webhooks).all()
    dead = sum(each.dead for each in webhooks)
    waiting = sum(each.waiting for each in webhooks)
    yield Check(
        "webhooks",
        f"{len(webhooks)}; {plural(waiting, 'event')} waiting, {plural(dead, 'dead letter')}",
        not dead and all(each.failing_since is None for each in webhooks),
        "Open Webhooks: correct the address of the receiver, then send the dead letters again.",
    )


PANELS = {"overview_page": notices, "about_page": checks}
