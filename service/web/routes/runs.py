"""Named runs, and replays of telemetry files into them."""

from contextlib import ExitStack
from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Depends, Path
from fastapi import Query as InQuery
from pydantic import Field
from starlette.requests import Request
from starlette.responses import Response

from service.observe.wire import BatchIn, RunName
from service.web.bodies import MAX_JSON_BYTES, Spooled, lines_of, ndjson_body
from service.web.describe import LOCATION, Gives, described
from service.web.holding import Held, json_response
from service.web.queries import NO_QUERY, Query
from service.web.schemas.runs import ReplayState, RunList

router = APIRouter(prefix="/api/v1", tags=["runs and replays"])

ReplayId = Annotated[str, Path(description="The `id` of a replay.")]


class _ReplayQuery(Query):
    """Where the batches of a replay go."""

    run: Annotated[
        RunName, Field(description="The run that takes every batch, in place of its own.")
    ]


ReplayQuery = Annotated[_ReplayQuery, InQuery()]


@dataclass(frozen=True)
class Sent:
    """A telemetry file and the run it goes to."""

    run: str
    body: Spooled


async def _telemetry(request: Request, query: ReplayQuery) -> Sent:
    # Asks for the query first, so that no gigabyte is taken in only to refuse its run.
    return Sent(query.run, await ndjson_body(request))


@router.get("/runs", dependencies=[NO_QUERY], **described({200: Gives("Every run.", RunList)}))
def list_runs(operations: Held) -> Response:
    """Every run that holds batches."""
    return json_response({"items": operations.runs()})


@router.post(
    "/replays",
    **described(
        {202: Gives("The replay, which has begun.", ReplayState, LOCATION)},
        lines_of=BatchIn,
        problems=(503,),
    ),
)
def start_replay(sent: Annotated[Sent, Depends(_telemetry)], operations: Held) -> Response:
    """Take a telemetry file, a batch a line, and work through it in the background."""
    with ExitStack() as on_failure:
        on_failure.callback(sent.body.file.close)
        lines = lines_of(sent.body.file, MAX_JSON_BYTES)
        id = operations.start_replay(lines, sent.run, name=sent.run, total=sent.body.lines)
        on_failure.pop_all()
    location = {"Location": f"/api/v1/replays/{id}"}
    return json_response(operations.replay(id), 202, location)


@router.get(
    "/replays/{id}",
    dependencies=[NO_QUERY],
    **described({200: Gives("The replay.", ReplayState)}, problems=(404,)),
)
def get_replay(id: ReplayId, operations: Held) -> Response:
    """A replay and how far it is."""
    return json_response(operations.replay(id))
