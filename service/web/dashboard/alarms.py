"""The pages of alarms: those of a run by their state, one with all that was done about it."""

from typing import Annotated, Literal

from fastapi import APIRouter, Path
from fastapi import Query as InQuery
from starlette.responses import Response

from service.errors import NotFound, shown_value
from service.observe.wire import Key
from service.times import recorded_utc, shifted
from service.web.dashboard.rendering import PageRoute, rendered
from service.web.dashboard.shell import AtDesk, RunQuery
from service.web.queries import Cursor

router = APIRouter(include_in_schema=False, route_class=PageRoute)

ROWS = 50
STATES = ("active", "open", "acknowledged", "shelved", "cleared", "all")
BEFORE_S, AFTER_S = 1800.0, 1800.0
"""How much of the trend is shown around the moment at which an alarm was raised."""


class AlarmsQuery(RunQuery):
    """Which alarms; an empty spacecraft stands for every one."""

    state: Literal["active", "open", "acknowledged", "shelved", "cleared", "all"] = "active"
    spacecraft: Key | Literal[""] = ""
    cursor: Cursor = None


@router.get("/alarms")
def alarms_page(query: Annotated[AlarmsQuery, InQuery()], desk: AtDesk) -> Response:
    """The alarms of a run, newest first."""
    if query.spacecraft:
        desk.caller.require(query.spacecraft)
    elif desk.caller.spacecraft is not None:
        query = query.model_copy(update={"spacecraft": desk.spacecraft[0]})
    page = desk.operations.alarms(
        run=query.run,
        spacecraft=query.spacecraft or None,
        state=query.state,
        limit=ROWS,
        cursor=query.cursor,
    )
    return rendered(
        "alarms.html.jinja",
        desk.shell(query.run, "/alarms"),
        query=query,
        page=page,
        states=STATES,
        spacecraft=desk.spacecraft,
    )


@router.get("/alarms/{id}")
def alarm_page(id: Annotated[str, Path()], desk: AtDesk) -> Response:
    """One alarm: how it came, how it stands, what was done about it and by whom."""
    alarm = desk.operations.alarm(id)
    if not desk.caller.may_see(alarm["spacecraft"]):
        # As if it were not there: ids of others are not to be tried out.
        raise NotFound(f"there is no alarm with the id {shown_value(id)}")
    raised = recorded_utc(alarm["raised"]["time"])
    return rendered(
        "alarm.html.jinja",
        desk.shell(alarm["run"], "/alarms"),
        alarm=alarm,
        around={
            "start": shifted(raised, -BEFORE_S).text,
            "end": shifted(raised, AFTER_S).text,
        },
    )
