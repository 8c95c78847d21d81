"""The list of batches of a run, filtered by spacecraft, outcome and attitude."""

from typing import Annotated, Literal
from urllib.parse import urlencode

from fastapi import Query as InQuery
from pydantic import Field
from starlette.responses import RedirectResponse, Response

from service.app.context import ALL_RUNS
from service.errors import BadInput
from service.observations.schema import Key
from service.storage.models.answers import Summary
from service.storage.models.base import Page
from service.storage.queries.results import OutcomeName, StatusName
from service.times import Utc, parse_utc, shifted
from service.web.console.page_context import ContextDep, PageContext, PageQuery
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
    find: Annotated[str, Field(max_length=200)] = ""
    """The id that a batch has of its sender, or of this service; or a time."""
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
    if text := query.find.strip():
        try:
            return _at(query, parse_utc(text, "find"))
        except BadInput:
            found = named(context, query, text)
        if len(found) == 1:
            address = f"/batches/{found[0].id}?{urlencode({'run': found[0].run})}"
            return RedirectResponse(address, 303)
        return rendered(
            "batches.html.jinja",
            context.layout(query.run),
            query=query,
            page=Page(found, None),
            spacecraft=context.spacecraft,
        )
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


def _at(query: BatchesQuery, moment: Utc) -> Response:
    """The list that begins with the latest batch at a time."""
    end = shifted(moment, 1.0).text
    asked = {"run": query.run, "spacecraft": query.spacecraft, "end": end}
    return RedirectResponse(f"/batches?{urlencode(asked)}", 303)


def named(context: PageContext, query: BatchesQuery, text: str) -> list[Summary]:
    """The batches with an id, first of the shown run, else of every run."""
    name = context.app.results.spacecraft_of(text)
    if name is not None and context.caller.may_see(name):
        answer = context.app.results.get(text).answer
        return _listed(context, answer.run, answer.spacecraft, answer.batch)
    # The database has an index of these ids for one spacecraft.
    names = [query.spacecraft] if query.spacecraft else context.spacecraft
    found = [each for name in names for each in _listed(context, ALL_RUNS, name, text)]
    return [each for each in found if each.run == query.run] or found


def _listed(context: PageContext, run: str, spacecraft: str | None, text: str) -> list[Summary]:
    page = context.app.results.page(spacecraft=spacecraft, run=run, batch=text, limit=ROWS)
    return [each for each in page.items if context.caller.may_see(each.spacecraft)]
