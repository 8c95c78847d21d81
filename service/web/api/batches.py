"""API routes for batches and gyro blocks: submit, list, read, process again, compare."""

from typing import Annotated

from fastapi import Path
from msgspec import Raw
from pydantic import Field, StrictBool
from starlette.requests import Request
from starlette.responses import Response

from service.contract.answers import Answer, BatchOutcome, BatchOutcomes, BatchPage, Result
from service.contract.runs import Comparison
from service.contract.spacecraft import GyroBlockPage, GyroBlockRow, GyroSamples
from service.errors import BadBatch, BadInput, Fault
from service.gyro.blocks import GyroBlockIn
from service.ingest.submit import MAX_ARRAY, Outcome
from service.observations.schema import LIVE, BatchIn, Key, OptionsIn, RunName, Wire
from service.storage.recording.unsaved_result import Answered
from service.web.openapi import (
    IDEMPOTENCY_KEY,
    LINK,
    LOCATION,
    REPLAYED,
    ApiRouter,
    ClientMethod,
    Example,
    Returns,
)
from service.web.requests import query_parameters as params
from service.web.requests.access import (
    AppDep,
    CallerDep,
    ChangeDep,
    MetricsDep,
    Policy,
    json_response,
    page_response,
    require_scope,
)
from service.web.requests.problems import problem_within
from service.web.requests.query_parameters import FromQuery, PeriodPageQuery, SpacecraftPath, Who
from service.web.requests.request_body import (
    JSON,
    NO_IDEMPOTENCY_KEY,
    NO_KEY_OF_A_BLOCK,
    NO_KEY_OF_MANY,
    JsonBody,
    idempotency_key,
    read_json,
    read_model,
    refused,
    require_no_query,
)

router = ApiRouter("batches")

ResultId = Annotated[str, Path(description="The `id` of a recorded result.")]


class WhatIfIn(Wire):
    """Request body to process a batch again with other options."""

    options: Annotated[
        OptionsIn, Field(description="Options that replace those of the result.")
    ] = OptionsIn()
    record: Annotated[
        StrictBool, Field(description="Record the result in addition to the first one.")
    ] = False
    adopt: Annotated[
        StrictBool,
        Field(description="Record the result, and make it the current one of its batch."),
    ] = False
    who: Who = None
    comment: params.Comment = None


def answer_response(answered: Answered, recorded: bool = True) -> Response:
    """HTTP response to a batch: newly recorded, recorded before, or not recorded."""
    if not recorded:
        return Response(answered.body, media_type=JSON)
    if answered.replayed:
        return Response(answered.body, 200, {"Replayed": "true"}, JSON)
    return Response(answered.body, 201, {"Location": f"/api/v1/batches/{answered.id}"}, JSON)


@router.serves(
    "POST /batches",
    Policy("submit", "body"),
    Returns("The answer, now recorded.", Answer, LOCATION, status=201),
    Returns("The answer that was recorded before.", Answer, REPLAYED),
    body=BatchIn,
    problems=(409,),
    parameters=(IDEMPOTENCY_KEY,),
)
async def submit_batch(request: Request) -> Response:
    """Identify the stars of a batch, solve for the attitude, and record both."""
    await require_no_query(request)
    body = await read_json(request, request.app.state.limits.json_bytes)
    key = await idempotency_key(request)
    held = request.app.state
    try:
        answered = await held.app.submissions.answered(body, key, request.state.caller)
    except BadInput as error:
        raise refused(body, error) from None
    if answered.replayed:
        held.metrics.count_repeat()
    return answer_response(answered)


@router.serves(
    "POST /batches/many",
    Policy("submit", "body"),
    Returns("An outcome for each batch, in the order sent.", BatchOutcomes),
    array_of=(BatchIn, MAX_ARRAY),
    dependencies=[NO_KEY_OF_MANY],
)
async def submit_batches(
    request: Request, body: JsonBody, app: AppDep, caller: CallerDep, metrics: MetricsDep
) -> Response:
    """Submit an array of batches; each is recorded or refused by itself.

    The answer comes when every batch has its outcome. An array counts as many requests as it has
    batches. To repeat it after a lost connection, send it again.
    """
    try:
        read = await app.submissions.read_array(body)
    except BadInput as error:
        raise refused(body, error) from None
    # One request is counted already.
    app.access.count_request(caller, len(read) - 1)
    outcomes = await app.submissions.answered_each(read, caller)
    for each in outcomes:
        if isinstance(each, Answered) and each.replayed:
            metrics.count_repeat()
    return json_response(BatchOutcomes(items=[_outcome(request, each) for each in outcomes]))


def _outcome(request: Request, outcome: Outcome) -> BatchOutcome:
    if isinstance(outcome, Answered):
        status = 200 if outcome.replayed else 201
        return BatchOutcome(status=status, answer=Raw(outcome.body), problem=None)
    problem = problem_within(request, outcome)
    return BatchOutcome(status=problem.status, answer=None, problem=problem)


@ClientMethod(
    "batches",
    by_place=("spacecraft",),
    example="""
    >>> [found.batch for found in client.batches("XTE")]
    ['1996-010-0110']
    """,
)
@Example("first_page", "spacecraft=XTE&limit=1")
@Example("by_batch_id", "spacecraft=XTE&batch=1999-060-0003")
@Example("limit", "limit=ten")
@router.serves(
    "GET /batches", Policy("read", "query"), Returns("A page of results.", BatchPage, LINK)
)
def list_batches(request: Request, query: FromQuery[params.BatchQuery], app: AppDep) -> Response:
    """The current results of recorded batches, newest first by batch time."""
    return page_response(request, app.results.page(**query.asked()))


@ClientMethod("batch")
@router.serves(
    "GET /batches/{id}", Policy("read", "result"), Returns("The result and its batch.", Result)
)
def get_batch(id: ResultId, app: AppDep) -> Response:
    """One recorded result with its batch."""
    return json_response(app.results.get(id))


@router.serves(
    "POST /batches/{id}/what-if",
    Policy("read", "result"),
    Returns("The answer, which was not recorded.", Answer),
    Returns("The answer, now recorded in addition to the first one.", Answer, LOCATION, status=201),
    body=WhatIfIn,
    dependencies=[NO_IDEMPOTENCY_KEY],
)
def what_if(
    request: Request, id: ResultId, body: JsonBody, app: AppDep, change: ChangeDep
) -> Response:
    """Process a recorded batch again with other options; recording the result needs `operate`."""
    asked = read_model(WhatIfIn, body)
    record, entry = asked.record or asked.adopt, None
    if record:
        require_scope(change.caller, "operate")
        request.state.changes = "adopt_what_if" if asked.adopt else "what_if"
        entry = change.entry(201)
    answered = app.results.what_if(id, asked.options, record=record, adopt=asked.adopt, entry=entry)
    return answer_response(answered, recorded=record)


compare_router = ApiRouter("batches")

COMPARISON_S = 10.0
"""Time limit of a comparison in seconds; the rest is left out, and the answer says so."""

SideOptions = Annotated[OptionsIn, Field(description="Options that replace each batch's own.")]
SampleSize = Annotated[
    int,
    Field(ge=1, le=5_000, description="Maximum number of batches, taken evenly from the period."),
]


class CompareIn(Wire):
    """Request body that selects batches and two sets of options; omitted ones stay as recorded."""

    spacecraft: Key
    run: RunName = LIVE
    start: params.Start = None
    end: params.End = None
    sample: SampleSize = 100
    a: SideOptions = OptionsIn()
    b: SideOptions = OptionsIn()


@Example(
    "tighter",
    body={
        "spacecraft": "XTE",
        "sample": 5,
        "b": {"identifier": "starid", "tolerances": {"separation_deg": 1e-5}},
    },
)
@compare_router.serves(
    "POST /compare",
    Policy("read", "body"),
    Returns("The results of both sides.", Comparison),
    body=CompareIn,
    problems=(404,),
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
        limit_s=COMPARISON_S,
    )
    return json_response(found)


gyro_router = ApiRouter("gyro")

BlockId = Annotated[str, Path(description="The `id` of a recorded gyro block.")]


@ClientMethod(
    "submit_gyro",
    body="block",
    repeatable=True,
    example="""
    >>> sorted(block)
    ['block', 'rates_rad_per_s', 'start', 'step_s']
    >>> recorded = client.submit_gyro("XTE", block)
    >>> recorded.end, recorded.samples
    ('1996-01-10T12:00:00.500Z', 2)
    """,
)
@gyro_router.serves(
    "POST /spacecraft/{name}/gyro",
    Policy("submit", "path"),
    Returns("The block, now recorded.", GyroBlockRow, LOCATION, status=201),
    Returns("The block that was recorded before.", GyroBlockRow, REPLAYED),
    body=GyroBlockIn,
    problems=(409,),
    dependencies=[NO_KEY_OF_A_BLOCK],
)
def submit_gyro(name: SpacecraftPath, body: JsonBody, app: AppDep, metrics: MetricsDep) -> Response:
    """Record a block of gyro samples.

    The same block again is answered with 200 and `Replayed`. 409 if another body has its name, or
    if another block of the run holds one of its times.
    """
    try:
        recorded = app.gyro.submit(name, body)
    except BadInput as error:
        raise refused(body, error) from None
    if recorded.replayed:
        metrics.count_repeat()
        return json_response(recorded.row, 200, {"Replayed": "true"})
    location = f"/api/v1/spacecraft/{name}/gyro/{recorded.row.id}"
    return json_response(recorded.row, 201, {"Location": location})


@ClientMethod(
    "gyro",
    example="""
    >>> recorded = client.submit_gyro("XTE", block)
    >>> [found.block for found in client.gyro("XTE")]
    ['g1']
    """,
)
@gyro_router.serves(
    "GET /spacecraft/{name}/gyro",
    Policy("read", "path"),
    Returns("A page of blocks.", GyroBlockPage, LINK),
)
def list_gyro(
    request: Request, name: SpacecraftPath, query: FromQuery[PeriodPageQuery], app: AppDep
) -> Response:
    """The gyro blocks that touch a period, without their samples, the earliest first.

    The samples of a period are the table `gyro`.
    """
    return page_response(request, app.gyro.page(name, **query.asked()))


@ClientMethod(
    "gyro_samples",
    example="""
    >>> recorded = client.submit_gyro("XTE", block)
    >>> samples = client.gyro_samples("XTE", recorded.id)
    >>> samples.times_s, samples.rates_rad_per_s[1]
    ([0.0, 0.5], [0.0011, 0.0, 1e-05])
    """,
)
@gyro_router.serves(
    "GET /spacecraft/{name}/gyro/{id}",
    Policy("read", "path"),
    Returns("The block and its samples.", GyroSamples),
)
def get_gyro(name: SpacecraftPath, id: BlockId, app: AppDep) -> Response:
    """One gyro block with its samples."""
    return json_response(app.gyro.get(name, id))
