"""The list of batches of a run, filtered by spacecraft, outcome and attitude."""

from typing import Annotated, Literal

from fastapi import APIRouter
from fastapi import Query as InQuery
from pydantic import Field
from starlette.responses import Response

from service.observe.wire import Key
from service.records.reading import OutcomeName, Status
from service.times import parse_utc
from service.web.dashboard.rendering import PageRoute, rendered
from service.web.dashboard.shell import AtDesk, RunQuery
from service.web.queries import Cursor

router = APIRouter(include_in_schema=False, route_class=PageRoute)

ROWS = 50
Any_ = Literal[""]
"""An empty field of a form: no matter which."""


class BatchesQuery(RunQuery):
    """Which batches; an empty field of the form asks for nothing."""

    spacecraft: Key | Any_ = ""
    outcome: OutcomeName | Any_ = ""
    status: Status | Any_ = ""
    start: Annotated[str, Field(max_length=40)] = ""
    end: Annotated[str, Field(max_length=40)] = ""
    cursor: Cursor = None

    @property
    def filters(self) -> dict[str, str | None]:
        """What is asked for besides the run and the place in the list."""
        names = ("spacecraft", "outcome", "status", "start", "end")
        return {name: getattr(self, name) or None for name in names}


@router.get("/batches")
def batches_page(query: Annotated[BatchesQuery, InQuery()], desk: AtDesk) -> Response:
    """The batches of a run, newest first."""
    if query.spacecraft:
        desk.caller.require(query.spacecraft)
    elif desk.caller.spacecraft is not None:
        query = query.model_copy(update={"spacecraft": desk.spacecraft[0]})
    page = desk.operations.batches(
        spacecraft=query.spacecraft or None,
        run=query.run,
        start=parse_utc(query.start, "start") if query.start else None,
        end=parse_utc(query.end, "end") if query.end else None,
        outcome=query.outcome or None,
        status=query.status or None,
        limit=ROWS,
        cursor=query.cursor,
    )
    return rendered(
        "batches.html.jinja",
        desk.shell(query.run, "/batches"),
        query=query,
        page=page,
        spacecraft=desk.spacecraft,
    )
