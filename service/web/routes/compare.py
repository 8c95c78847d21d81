"""Two sets of options over the same recorded batches, side by side."""

from typing import Annotated

from fastapi import APIRouter
from pydantic import Field
from starlette.responses import Response

from service.errors import BadBatch, Fault
from service.observe.wire import Key, OptionsIn, RunName, Wire
from service.web.access import Asking
from service.web.bodies import JsonBody, read_model
from service.web.describe import Gives, described
from service.web.holding import Held, json_response
from service.web.queries import NO_QUERY, Time
from service.web.schemas.compare import Comparison

router = APIRouter(prefix="/api/v1", tags=["batches"])

WORK_S = 10.0
"""Of one comparison; what is not done by then is left out, and said to be."""

Options = Annotated[
    OptionsIn, Field(description="In place of what they name of each batch's own options.")
]


class CompareIn(Wire):
    """Which batches, and the two sets of options; none is as recorded."""

    spacecraft: Key
    run: RunName = "live"
    start: Annotated[Time | None, Field(description="The first moment, itself included.")] = None
    end: Annotated[Time | None, Field(description="The last moment, itself excluded.")] = None
    sample: Annotated[
        int, Field(ge=1, le=500, description="The most batches, drawn evenly from the stretch.")
    ] = 100
    a: Options = OptionsIn()
    b: Options = OptionsIn()


@router.post(
    "/compare",
    dependencies=[NO_QUERY],
    **described({200: Gives("Both sides.", Comparison)}, body=CompareIn, problems=(404, 503)),
)
def compare(body: JsonBody, operations: Held, caller: Asking) -> Response:
    """Run recorded batches again with two sets of options, side by side; nothing is kept."""
    asked = read_model(CompareIn, body)
    caller.require(asked.spacecraft)
    if asked.start and asked.end and asked.start.tai_ns > asked.end.tai_ns:
        raise BadBatch(Fault("start", f"must not be after end {asked.end}", repr(str(asked.start))))
    found = operations.compare(
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
