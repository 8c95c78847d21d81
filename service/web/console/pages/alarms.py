"""The pages of alarms: the list of a run by state, and one with its history."""

from typing import Annotated, Literal

from fastapi import Path
from fastapi import Query as InQuery
from starlette.responses import Response

from service.errors import NotFound, shown_value
from service.observations.schema import Key
from service.times import recorded_utc, shifted
from service.web.console.page_context import ContextDep, PageQuery
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import Policy
from service.web.requests.query_parameters import Cursor

ROWS = 50
STATES = ("active", "open", "acknowledged", "shelved", "cleared", "all")
BEFORE_S, AFTER_S = 1800.0, 1800.0
"""The period of the trend that is shown around the time at which an alarm was raised."""


class AlarmsQuery(PageQuery):
    """Which alarms; an empty spacecraft stands for every one."""

    state: Literal["active", "open", "acknowledged", "shelved", "cleared", "all"] = "active"
    spacecraft: Key | Literal[""] = ""
    cursor: Cursor = None


@console_page("/alarms", "Alarms", Policy("read", "nothing"), position=20)
def alarms_page(query: Annotated[AlarmsQuery, InQuery()], context: ContextDep) -> Response:
    """The alarms of a run, newest first."""
    if query.spacecraft:
        context.caller.require(query.spacecraft)
    elif context.caller.spacecraft is not None:
        query = query.model_copy(update={"spacecraft": context.spacecraft[0]})
    page = context.app.alarms.page(
        run=query.run,
        spacecraft=query.spacecraft or None,
        state=query.state,
        limit=ROWS,
        cursor=query.cursor,
    )
    return rendered(
        "alarms.html.jinja",
        context.layout(query.run),
        query=query,
        page=page,
        states=STATES,
        spacecraft=context.spacecraft,
    )


@console_page("/alarms/{id}", "Alarm", Policy("read", "nothing"), section="/alarms")
def alarm_page(id: Annotated[str, Path()], context: ContextDep) -> Response:
    """One alarm: how it was raised, its state, and what operators did about it."""
    alarm = context.app.alarms.get(id)
    if not context.caller.may_see(alarm.spacecraft):
        # As if it did not exist: probing for ids of others must tell nothing.
        raise NotFound(f"there is no alarm with the id {shown_value(id)}")
    raised = recorded_utc(alarm.raised.time)
    return rendered(
        "alarm.html.jinja",
        context.layout(alarm.run),
        alarm=alarm,
        around={
            "start": shifted(raised, -BEFORE_S).text,
            "end": shifted(raised, AFTER_S).text,
        },
    )
