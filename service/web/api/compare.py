"""Two sets of options over the same recorded batches, side by side."""

from typing import Annotated

from fastapi import APIRouter
from pydantic import Field
from starlette.responses import Response

from service.errors import BadBatch, Fault
from service.observations.schema import Key, OptionsIn, RunName, Wire
from service.storage.models.compare import Comparison
from service.web.openapi.route import ResponseDoc, route_docs
from service.web.requests.access import CallerDep
from service.web.requests.dependencies import AppDep, json_response
from service.web.requests.query_parameters import NO_QUERY, Time
from service.web.requests.request_body import JsonBody, read_model

router = APIRouter(prefix="/api/v1", tags=["batches"])

WORK_S = 10.0
"""Of one comparison; the rest is left out, and the answer says so."""

SideOptions = Annotated[OptionsIn, Field(description="Options that replace each batch's own.")]


class CompareIn(Wire):
    """A choice of batches, and two sets of options; an omitted option stays as recorded."""

    spacecraft: Key
    run: RunName = "live"
    start: Annotated[Time | None, Field(description="Start of the period, included.")] = None
    end: Annotated[Time | None, Field(description="End of the period, excluded.")] = None
    sample: Annotated[
        int,
        Field(ge=1, le=500, description="Maximum number of batches, taken evenly from the period."),
    ] = 100
    a: SideOptions = OptionsIn()
    b: SideOptions = OptionsIn()


@router.post(
    "/compare",
    dependencies=[NO_QUERY],
    **route_docs(
        {200: ResponseDoc("The results of both sides.", Comparison)},
        body=CompareIn,
        problems=(404, 503),
    ),
)
def compare(body: JsonBody, app: AppDep, caller: CallerDep) -> Response:
    """Process recorded batches again with two sets of options; nothing is recorded."""
    asked = read_model(CompareIn, body)
    caller.require(asked.spacecraft)
    if asked.start and asked.end and asked.start.tai_ns > asked.end.tai_ns:
        raise BadBatch(Fault("start", f"must not be after end {asked.end}", repr(str(asked.start))))
    found = app.comparisons.of_options(
        asked.spacecraft,
        asked.a,
        asked.b,
        run=asked.run,
        start=asked.start,
        end=asked.end,
        sample=asked.sample,
        limit_s=WORK_S,
    )
    return json_response(found)
