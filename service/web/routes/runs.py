"""Named runs, and replays of telemetry files into them."""

from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Depends, Path
from fastapi import Query as InQuery
from pydantic import Field, StrictBool
from starlette.requests import Request
from starlette.responses import Response

from service.observe.wire import BatchIn, RunName, Wire
from service.web.access import Asking, Audited, require_unbound
from service.web.bodies import (
    MAX_JSON_BYTES,
    JsonBody,
    Spooled,
    ndjson_body,
    read_model,
)
from service.web.describe import LOCATION, Gives, described
from service.web.holding import Held, json_response
from service.web.queries import NO_QUERY, Query
from service.web.schemas.runs import ReplayList, ReplayState, RunList, RunState

router = APIRouter(prefix="/api/v1", tags=["runs and replays"])

Run = Annotated[str, Path(description="The run's name.")]
ReplayId = Annotated[str, Path(description="The `id` of a replay.")]


class RunIn(Wire):
    """What holds for a run."""

    alarms: Annotated[
        StrictBool,
        Field(description="Hold limits against its batches from now on; live ones always are."),
    ]


class _ReplayQuery(Query):
    """Where the batches of a replay go."""

    run: Annotated[
        RunName, Field(description="The run that takes every batch, in place of its own.")
    ]
    alarms: Annotated[bool, Field(description="Hold limits against the run.")] = False


ReplayQuery = Annotated[_ReplayQuery, InQuery()]


@dataclass(frozen=True)
class Sent:
    """A telemetry file and the run it goes to."""

    run: str
    alarms: bool
    body: Spooled


async def _telemetry(request: Request, query: ReplayQuery, caller: Asking) -> Sent:
    # Asks for the query first, so that no gigabyte is taken in only to refuse its run.
    if query.alarms:
        # As `watch_run`: the run may hold batches of every spacecraft.
        require_unbound(caller)
        request.state.changes = request.scope["route"].name
    return Sent(query.run, query.alarms, await ndjson_body(request))


@router.get("/runs", dependencies=[NO_QUERY], **described({200: Gives("Every run.", RunList)}))
def list_runs(operations: Held) -> Response:
    """Every run that holds batches."""
    return json_response({"items": operations.runs()})


@router.put(
    "/runs/{run}",
    dependencies=[NO_QUERY],
    **described({200: Gives("The run.", RunState)}, body=RunIn),
)
def watch_run(run: Run, body: JsonBody, operations: Held, audited: Audited) -> Response:
    """Say whether limits are held against a run; it is made where there is none."""
    asked = read_model(RunIn, body)
    return json_response(operations.watch_run(run, asked.alarms, audited.entry()))


@router.get(
    "/replays",
    dependencies=[NO_QUERY],
    **described({200: Gives("The latest hundred.", ReplayList)}),
)
def list_replays(operations: Held) -> Response:
    """The latest replays and how far they are, newest first."""
    return json_response({"items": operations.replays()})


@router.post(
    "/replays",
    **described(
        {202: Gives("The replay, which has begun.", ReplayState, LOCATION)},
        lines_of=BatchIn,
        problems=(503,),
    ),
)
def start_replay(
    sent: Annotated[Sent, Depends(_telemetry)],
    operations: Held,
    caller: Asking,
    audited: Audited,
) -> Response:
    """Take a telemetry file, a batch a line, and work through it in the background."""
    id = operations.start_replay_of(
        sent.body.file,
        sent.body.coding,
        sent.run,
        name=sent.run,
        total=sent.body.lines,
        longest_bytes=MAX_JSON_BYTES,
        check=caller.require,
        alarms=sent.alarms,
        owner=caller.token_id,
        entry=audited.entry(202) if sent.alarms else None,
    )
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


@router.delete(
    "/replays/{id}",
    dependencies=[NO_QUERY],
    **described(
        {
            200: Gives("The replay, which is cancelled.", ReplayState),
            202: Gives("The replay, which ends as soon as it can.", ReplayState),
        },
        problems=(404, 409, 503),
    ),
)
def cancel_replay(id: ReplayId, operations: Held, caller: Asking) -> Response:
    """End a replay before its end; the batches that it recorded stay."""
    state = operations.cancel_replay(id, caller)
    return json_response(state, 202 if state["state"] == "running" else 200)
