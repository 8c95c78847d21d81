"""Batches: submit, list, look at one, try it with other options."""

from typing import Annotated

from fastapi import APIRouter, Path
from fastapi import Query as InQuery
from pydantic import Field, StrictBool
from starlette.requests import Request
from starlette.responses import Response

from service.observe.wire import BatchIn, OptionsIn, Wire
from service.operations import Answered
from service.web.bodies import JSON, JsonBody, read_model, read_submission
from service.web.describe import IDEMPOTENCY_KEY, LINK, LOCATION, REPLAYED, Gives, described
from service.web.headers import NO_IDEMPOTENCY_KEY, IdempotencyKey
from service.web.holding import Counted, Held, json_response, page_response
from service.web.queries import NO_QUERY, BatchQuery
from service.web.schemas.answers import Answer, BatchPage, Record

router = APIRouter(prefix="/api/v1/batches", tags=["batches"])

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
    dependencies=[NO_QUERY],
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
def submit_batch(
    body: JsonBody, key: IdempotencyKey, operations: Held, metrics: Counted
) -> Response:
    """Identify the stars of a batch, solve for the attitude, and record both."""
    answered = operations.submit(read_submission(body), key)
    if answered.replayed:
        metrics.count_repeat()
    return _answer(answered)


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
def what_if(id: ResultId, body: JsonBody, operations: Held) -> Response:
    """Run a recorded batch again with other options."""
    asked = read_model(WhatIfIn, body)
    answered = operations.what_if(
        id, asked.options, record=asked.record or asked.adopt, adopt=asked.adopt
    )
    return _answer(answered, recorded=asked.record or asked.adopt)


def _answer(answered: Answered, recorded: bool = True) -> Response:
    if not recorded:
        return Response(answered.body, media_type=JSON)
    if answered.replayed:
        return Response(answered.body, 200, {"Replayed": "true"}, JSON)
    return Response(answered.body, 201, {"Location": f"/api/v1/batches/{answered.id}"}, JSON)
