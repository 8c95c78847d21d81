"""Webhook lines for the overview and for the page of the service's state."""

from collections.abc import Iterator

from service.features.webhooks.part import Webhooks
from service.web.console.formatting import plural
from service.web.console.page import PageContext
from service.web.console.pages.about import Check
from service.web.console.pages.overview import Notice


def notices(context: PageContext) -> Iterator[Notice]:
    """Line of the overview about failing webhooks, for callers who may see their page."""
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
