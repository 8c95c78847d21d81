"""API routes for named runs, and for replays of telemetry files into them."""

from dataclasses import dataclass
from functools import partial
from typing import Annotated

from fastapi import Depends, Path
from pydantic import AfterValidator, Field, StrictBool
from starlette.requests import Request
from starlette.responses import Response

from service.app.replays import UploadForm, discard_upload
from service.contract.runs import Forgotten, Replay, ReplayList, RunList, RunState
from service.errors import BadBatch, Fault, shown_value
from service.observations.schema import BatchIn, Key, RunName, Wire
from service.storage.upkeep.forget import MOST_NAMES, ForgetFilter
from service.web.openapi import LOCATION, ApiRouter, ClientMethod, Returns
from service.web.requests import request_body
from service.web.requests.access import (
    AppDep,
    CallerDep,
    ChangeDep,
    Policy,
    json_response,
    require_all_spacecraft,
)
from service.web.requests.query_parameters import FromQuery, Query, without_nul

router = ApiRouter("runs and replays")

RunPath = Annotated[str, Path(description="The run's name.")]
ReplayId = Annotated[str, Path(description="The `id` of a replay.")]


class RunIn(Wire):
    """Request body with the settings of a run."""

    alarms: Annotated[
        StrictBool,
        Field(description="Whether its new batches can raise alarms. Live batches always can."),
    ]


class ForgetIn(Wire):
    """Request body that selects batches and gyro blocks to remove from a run."""

    spacecraft: Annotated[Key | None, Field(description="Only of this one; null: of all.")] = None
    batches: Annotated[
        tuple[Key, ...],
        Field(
            max_length=MOST_NAMES,
            description="Names of batches. Without batches and gyro blocks: the whole run.",
        ),
    ] = ()
    gyro_blocks: Annotated[tuple[Key, ...], Field(max_length=MOST_NAMES)] = ()
    confirm: Annotated[
        StrictBool, Field(description="false: answer what would be removed, and remove nothing.")
    ] = False


class _ReplayQuery(Query):
    """Query of a replay: the run to record into, and the spacecraft of a packet archive."""

    run: Annotated[
        RunName, Field(description="The run for every batch, in place of the batch's own.")
    ]
    name: Annotated[
        str | None,
        Field(min_length=1, max_length=200, description="The file's name; without it the run's."),
        AfterValidator(without_nul),
    ] = None
    alarms: Annotated[bool, Field(description="Raise alarms for the run.")] = False
    spacecraft: Annotated[
        Key | None,
        Field(
            description="Of space packets: the mission whose table `packets` maps them. Without "
            "it the only mission with such a table."
        ),
    ] = None


ReplayQuery = FromQuery[_ReplayQuery]


@dataclass(frozen=True)
class ReplayUpload:
    """An uploaded telemetry file with the query of its replay."""

    query: _ReplayQuery
    body: request_body.Spooled


async def _telemetry(
    request: Request, query: ReplayQuery, caller: CallerDep, app: AppDep
) -> ReplayUpload:
    # The query is checked before the file is read.
    if query.alarms:
        # Like `watch_run`: the run may hold batches of every spacecraft.
        require_all_spacecraft(caller)
        request.state.changes = request.scope["route"].name
    body = await request_body.telemetry_body(
        request,
        partial(app.replays.new_upload, caller),
        discard_upload,
        app.replays.formats,
    )
    return ReplayUpload(query, body)


@ClientMethod("runs")
@router.serves("GET /runs", Policy("read", "nothing"), Returns("Every run.", RunList))
def list_runs(app: AppDep, caller: CallerDep) -> Response:
    """All runs with batches; for a token bound to spacecraft, runs with their batches."""
    return json_response({"items": app.runs.all(caller.spacecraft)})


@ClientMethod("watch_run", defaults={"alarms": True})
@router.serves(
    "PUT /runs/{run}",
    Policy("submit", audited=True),
    Returns("The run.", RunState),
    body=RunIn,
    may_create=True,
)
def watch_run(
    run: RunPath, body: request_body.JsonBody, app: AppDep, change: ChangeDep
) -> Response:
    """Switch the alarms of a run on or off; creates the run if it does not exist."""
    asked = request_body.read_model(RunIn, body)
    return json_response(app.runs.watch(run, asked.alarms, change.entry()))


@router.serves(
    "POST /runs/{run}/forget",
    Policy("operate", "body"),
    Returns("What was removed, or would be removed.", Forgotten),
    body=ForgetIn,
)
def forget_run(
    run: RunPath, body: request_body.JsonBody, app: AppDep, change: ChangeDep
) -> Response:
    """Remove wrongly recorded batches with trends and archived batches; it cannot be undone.

    The same batches can be recorded again afterwards. Alarms, events, notes and the audit list
    stay.
    """
    asked = request_body.read_model(ForgetIn, body)
    if asked.spacecraft is None:
        require_all_spacecraft(change.caller)
    else:
        change.caller.require(asked.spacecraft)
    selected = ForgetFilter(run, asked.spacecraft, asked.batches, asked.gyro_blocks)
    if not asked.confirm:
        return json_response(app.runs.would_forget(selected))
    return json_response(app.runs.forget(selected, change.entry()))


@ClientMethod("replays")
@router.serves(
    "GET /replays", Policy("read", "nothing"), Returns("The latest hundred replays.", ReplayList)
)
def list_replays(app: AppDep, caller: CallerDep) -> Response:
    """The latest replays and their progress, newest first.

    A token that is bound to spacecraft sees those into runs with batches of these alone.
    """
    return json_response(ReplayList(items=app.replays.all(caller.spacecraft)))


@router.serves(
    "POST /replays",
    Policy("submit", "body"),
    Returns("The replay, now running.", Replay, LOCATION, status=202),
    lines_of=BatchIn,
    problems=(503,),
)
def start_replay(
    upload: Annotated[ReplayUpload, Depends(_telemetry)], app: AppDep, change: ChangeDep
) -> Response:
    """Accept a telemetry file and process it in the background.

    The body has one batch per line, or one star per row of a CSV table, or is a tar archive of
    CCSDS space packets and the XTCE file that describes them. A file of which nothing is recorded
    ends as `failed`.
    """
    query, body = upload.query, upload.body
    if query.spacecraft is not None and app.replays.formats[body.form].read is not None:
        discard_upload(body.file)
        message = "goes with space packets; a batch names its own spacecraft"
        raise BadBatch(Fault("spacecraft", message, shown_value(query.spacecraft)))
    form = UploadForm(body.coding, request_body.MAX_JSON_BYTES, body.form, query.spacecraft)
    id = app.replays.start_upload(
        body.file,
        form,
        query.run,
        name=query.name or query.run,
        total=body.lines,
        caller=change.caller,
        alarms=query.alarms,
        entry=change.entry(202) if query.alarms else None,
    )
    location = {"Location": f"/api/v1/replays/{id}"}
    return json_response(app.replays.get(id), 202, location)


@router.serves(
    "GET /replays/{id}",
    # Its id is unguessable: only the client that started it and readers of everything know it.
    Policy("read", "nothing", or_scope="submit"),
    Returns("The replay.", Replay),
)
def get_replay(id: ReplayId, app: AppDep) -> Response:
    """State and progress of a replay."""
    return json_response(app.replays.get(id))


@ClientMethod("cancel_replay")
@router.serves(
    "DELETE /replays/{id}",
    # Of tokens that are bound to spacecraft only the one that started it: see the handler.
    Policy("submit", "nothing", audited=True),
    Returns("The replay, now cancelled.", Replay),
    Returns("The replay, which will end soon.", Replay, status=202),
    problems=(409, 503),
)
def cancel_replay(id: ReplayId, app: AppDep, caller: CallerDep) -> Response:
    """Cancel a replay; the batches that it recorded stay."""
    replay = app.replays.cancel(id, caller)
    return json_response(replay, 202 if replay.state in ("running", "waiting") else 200)
