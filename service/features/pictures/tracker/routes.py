"""API routes for frames of star trackers: submission, and overlays of recorded frames."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, Annotated, Any

from fastapi import Depends
from pydantic import Field
from pydantic_core import from_json
from starlette.requests import Request
from starlette.responses import Response

from service.contract.answers import Answer
from service.errors import BadBatch, Fault, shown_value
from service.features.pictures.part import Pictures
from service.features.pictures.tracker.submit import FrameIn, read_known
from service.features.pictures.upload import FRAMES, frame_body
from service.missions.mission import mission_named
from service.web.api.batches import ResultId, answer_response
from service.web.openapi import IDEMPOTENCY_KEY, LOCATION, REPLAYED, ApiRouter, Returns
from service.web.requests.access import AppDep, CallerDep, MetricsDep, Policy
from service.web.requests.query_parameters import TIME_SCHEMA, FromQuery, Query, SpacecraftPath
from service.web.requests.request_body import BINARY, IdempotencyKey

router = ApiRouter("frames")
overlay_router = ApiRouter("batches")

PNG = "image/png"

_A_PRIORI = '{"quaternion": [0.1, 0.2, 0.3, 0.9273618495495703]}'


class FrameQuery(Query):
    """Query with the fields of a frame's batch, as JSON unless plain text."""

    batch: Annotated[
        str | None, Field(description="The batch id. Default: made from the digest of the frame.")
    ] = None
    time: Annotated[
        str | None,
        Field(
            description="UTC of mid exposure. Default: of a FITS file's header, or EXIF.",
            examples=TIME_SCHEMA["examples"],
        ),
    ] = None
    run: Annotated[str, Field(description="The run; `live` for the batches of pipelines.")] = "live"
    tracker: Annotated[
        str | None, Field(description="The tracker. Default: the first tracker with a camera.")
    ] = None
    a_priori: Annotated[
        str | None,
        Field(
            description="JSON, as in a batch. Default: none (lost in space).", examples=[_A_PRIORI]
        ),
    ] = None
    body_rates_deg_per_s: Annotated[
        str | None, Field(description="JSON, as in a batch.", examples=["[0.01, 0, 0]"])
    ] = None
    velocity_km_per_s: Annotated[str | None, Field(description="JSON, as in a batch.")] = None
    sun_vector: Annotated[str | None, Field(description="JSON, as in a batch.")] = None
    position_km: Annotated[str | None, Field(description="JSON, as in a batch.")] = None
    aberration: Annotated[str, Field(description="As in a batch.")] = "to_correct"
    exposure_s: Annotated[
        str | None,
        Field(description="Exposure time. Default: EXPTIME of the file, else the mission's value."),
    ] = None
    centroid: Annotated[
        str | None,
        Field(description="window, scan, matched or recursive. Default: the mission's method."),
    ] = None
    image: Annotated[
        str | None,
        Field(
            description="Which image of a file with several: the name or number of a FITS unit, "
            "`:2` for the second plane of a cube, the number from 1 of a page or plane of TIFF "
            "(also of ImageJ and OME), of PNG, GIF, JPEG (MPO) or .npy. Default: the first of a "
            "FITS file; another file with several is refused.",
            examples=["SCI"],
        ),
    ] = None
    options: Annotated[str | None, Field(description="JSON, as in a batch.")] = None

    def known(self) -> FrameIn:
        """Checked fields of the frame's batch; raises `BadBatch` with every fault."""
        texts = {name: text for name, text in self.asked().items() if text is not None}
        return read_known({name: _value(name, text) for name, text in texts.items()})


_TEXTS = ("batch", "time", "run", "tracker", "aberration", "centroid", "image")


def _value(name: str, text: str) -> Any:
    if name in _TEXTS:
        return text
    try:
        return from_json(text)
    except ValueError:
        raise BadBatch(Fault(name, "must be JSON, as in a batch", shown_value(text))) from None


@dataclass(frozen=True)
class FrameUpload:
    """An uploaded frame: its file and the fields of its batch."""

    known: FrameIn
    file: IO[bytes]

    @contextmanager
    def opened(self) -> Iterator[IO[bytes]]:
        """Context manager of the uploaded file, which is deleted afterwards."""
        with self.file:
            yield self.file


async def _frame(request: Request, query: FromQuery[FrameQuery], app: AppDep) -> FrameUpload:
    # Name and query are checked before the frame is read.
    mission_named(app.missions, request.path_params["name"])
    known = query.known()
    return FrameUpload(known, await frame_body(request, app.settings))


@router.serves(
    "POST /spacecraft/{name}/frames",
    Policy("submit", "path"),
    Returns("The answer, now recorded.", Answer, LOCATION, status=201),
    Returns("The answer that was recorded before.", Answer, REPLAYED),
    files=FRAMES,
    problems=(409, 503),
    parameters=(IDEMPOTENCY_KEY,),
)
def submit_frame(
    name: SpacecraftPath,
    upload: Annotated[FrameUpload, Depends(_frame)],
    key: IdempotencyKey,
    app: AppDep,
    metrics: MetricsDep,
    caller: CallerDep,
) -> Response:
    """Detect the stars in a frame, identify them, solve for the attitude, and record everything."""
    with upload.opened() as file:
        answered = app.part(Pictures).frames.submit(name, upload.known, file, key, caller)
    if answered.replayed:
        metrics.count_repeat()
    return answer_response(answered)


@overlay_router.serves(
    "GET /batches/{id}/overlay",
    Policy("read", "result"),
    Returns("The image.", media_type=PNG, also=BINARY),
)
def get_overlay(request: Request, id: ResultId, app: AppDep) -> Response:
    """An image of a frame's result: the stars, their names, and residual arrows.

    The PNG is sent as `application/octet-stream` if `Accept` asks for that type.
    """
    # Generated clients know no media type of pictures.
    media_type = BINARY if BINARY in request.headers.get("accept", "").lower() else PNG
    drawn = app.part(Pictures).frames.overlay(id)
    return Response(drawn, media_type=media_type, headers={"Vary": "Accept"})
