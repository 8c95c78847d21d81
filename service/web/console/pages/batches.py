"""The list of batches of a run, filtered by spacecraft, outcome and attitude."""

from typing import Annotated, Literal

from fastapi import Query as InQuery
from pydantic import Field
from starlette.responses import Response

from service.observations.schema import Key
from service.storage.queries.results import OutcomeName, StatusName
from service.times import parse_utc
from service.web.console.page_context import ContextDep, PageQuery
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import Policy
from service.web.requests.query_parameters import Cursor

ROWS = 50
Any_ = Literal[""]
"""An empty field of a form: any value."""


class BatchesQuery(PageQuery):
    """Which batches; empty fields of the form are left out."""

    spacecraft: Key | Any_ = ""
    outcome: OutcomeName | Any_ = ""
    status: StatusName | Any_ = ""
    start: Annotated[str, Field(max_length=40)] = ""
    end: Annotated[str, Field(max_length=40)] = ""
    cursor: Cursor = None

    @property
    def filters(self) -> dict[str, str | None]:
        """The filters, without the run and the cursor."""
        names = ("spacecraft", "outcome", "status", "start", "end")
        return {name: getattr(self, name) or None for name in names}


@console_page("/batches", "Batches", Policy("read", "nothing"), position=30)
def batches_page(query: Annotated[BatchesQuery, InQuery()], context: ContextDep) -> Response:
    """The batches of a run, newest first."""
    if query.spacecraft:
        context.caller.require(query.spacecraft)
    elif context.caller.spacecraft is not None:
        query = query.model_copy(update={"spacecraft": context.first_spacecraft})
    page = context.app.results.page(
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
        context.layout(query.run),
        query=query,
        page=page,
        spacecraft=context.spacecraft,
    )
