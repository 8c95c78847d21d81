"""Batches: submit, list, look at one, try it with other options."""

from typing import Annotated

from fastapi import APIRouter, Path
from fastapi import Query as InQuery
from pydantic import Field, StrictBool
from starlette.requests import Request
from starlette.responses import Response

from service.errors import BadInput
from service.observe.wire import BatchIn, OptionsIn, Wire
from service.web.access import Asking, Audited, require_scope
from service.web.bodies import BINARY, JsonBody, json_body, read_model, refused
from service.web.describe import IDEMPOTENCY_KEY, LINK, LOCATION, REPLAYED, Gives, described
from service.web.headers import NO_IDEMPOTENCY_KEY, idempotency_key
from service.web.holding import Held, answer_response, json_response, page_response
from service.web.queries import NO_QUERY, BatchQuery, require_no_query
from service.web.schemas.answers import Answer, BatchPage, Record

router = APIRouter(prefix="/api/v1/batches", tags=["batches"])

PNG = "image/png"

ResultId = Annotated[str, Path(description="The `id` of a recorded result.")]


class WhatIfIn(Wire):
    """The same batch with other options."""

    options: Annotated[
        OptionsIn, Field(description="In place of what they name of the result's own options.")
    ] = OptionsIn()
    record: Annotated[StrictBool, Field(description="Keep the result beside the first one.")] = (
        False
    )
    adopt: Annotated[
        StrictBool, Field(description="Keep the result and let it be the current one of its batch.")
    ] = False


@router.post(
    "",
    **described(
        {
            201: Gives("The answer, now recorded.", Answer, LOCATION),
            200: Gives("The answer as it was recorded before.", Answer, REPLAYED),
        },
        body=BatchIn,
        problems=(409, 503),
        parameters=(IDEMPOTENCY_KEY,),
    ),
)
async def submit_batch(request: Request) -> Response:
    """Identify the stars of a batch, solve for the attitude, and record both."""
    await require_no_query(request)
    body = await json_body(request)
    key = await idempotency_key(request)
    held = request.app.state
    try:
        answered = await held.operations.answered(body, key, request.state.caller)
    except BadInput as error:
        raise refused(body, error) from None
    if answered.replayed:
        held.metrics.count_repeat()
    return answer_response(answered)


@router.get("", **described({200: Gives("A page of results.", BatchPage, LINK)}))
def list_batches(
    request: Request, query: Annotated[BatchQuery, InQuery()], operations: Held
) -> Response:
    """The current results of recorded batches, newest first by batch time."""
    return page_response(request, operations.batches(**query.asked()))


@router.get(
    "/{id}",
    dependencies=[NO_QUERY],
    **described({200: Gives("The result and its batch.", Record)}, problems=(404,)),
)
def get_batch(id: ResultId, operations: Held) -> Response:
    """One recorded result with the batch it was made of."""
    return json_response(operations.batch(id))


@router.get(
    "/{id}/overlay",
    dependencies=[NO_QUERY],
    **described(
        {200: Gives("The picture.", media_type=PNG, also=BINARY)},
        problems=(404,),
    ),
)
def get_overlay(request: Request, id: ResultId, operations: Held) -> Response:
    """The frame that a result was made of: its stars, their names, and residual arrows.

    The PNG has the media type of any bytes where `Accept` asks for that one.
    """
    # Clients that are generated from the description know no type of pictures.
    media_type = BINARY if BINARY in request.headers.get("accept", "").lower() else PNG
    return Response(operations.overlay(id), media_type=media_type, headers={"Vary": "Accept"})


@router.post(
    "/{id}/what-if",
    dependencies=[NO_QUERY, NO_IDEMPOTENCY_KEY],
    **described(
        {
            200: Gives("The answer, which was not recorded.", Answer),
            201: Gives("The answer, now recorded beside the first one.", Answer, LOCATION),
        },
        body=WhatIfIn,
        problems=(404, 503),
    ),
)
def what_if(
    request: Request,
    id: ResultId,
    body: JsonBody,
    operations: Held,
    caller: Asking,
    audited: Audited,
) -> Response:
    """Run a recorded batch again with other options; to keep the result needs `operate`."""
    asked = read_model(WhatIfIn, body)
    record, entry = asked.record or asked.adopt, None
    if record:
        require_scope(caller, "operate")
        request.state.changes = "what_if"
        entry = audited.entry(201)
    answered = operations.what_if(id, asked.options, record=record, adopt=asked.adopt, entry=entry)
    return answer_response(answered, recorded=record)
