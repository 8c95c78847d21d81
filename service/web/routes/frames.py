"""Frames: a picture in, identification and attitude out."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import IO, Annotated, Any

from fastapi import APIRouter, Depends
from fastapi import Query as InQuery
from pydantic import Field
from pydantic_core import from_json
from starlette.requests import Request
from starlette.responses import Response

from service.errors import BadBatch, Fault, shown_value
from service.imaging.submit import FrameIn, read_known
from service.missions.mission import mission_named
from service.web.access import Asking
from service.web.bodies import frame_body
from service.web.describe import IDEMPOTENCY_KEY, LOCATION, REPLAYED, Gives, described
from service.web.headers import IdempotencyKey
from service.web.holding import Counted, Held, answer_response
from service.web.queries import Query
from service.web.routes.spacecraft import Name
from service.web.schemas.answers import Answer

router = APIRouter(prefix="/api/v1/spacecraft", tags=["frames"])

_A_PRIORI = '{"quaternion": [0.1, 0.2, 0.3, 0.9273618495495703]}'


class FrameQuery(Query):
    """What is told of a frame: the fields of a batch, those that are no plain text as JSON."""

    batch: Annotated[
        str | None, Field(description="The batch id; by default made from the frame's digest.")
    ] = None
    time: Annotated[
        str | None,
        Field(description="UTC of mid exposure; by default a FITS file's DATE-AVG, or DATE-OBS."),
    ] = None
    run: Annotated[str, Field(description="The run; `live` is what pipelines send.")] = "live"
    tracker: Annotated[
        str | None, Field(description="By default the first one that has a camera.")
    ] = None
    a_priori: Annotated[
        str | None,
        Field(description="JSON, as in a batch; without it: lost in space.", examples=[_A_PRIORI]),
    ] = None
    body_rates_deg_per_s: Annotated[
        str | None, Field(description="JSON, as in a batch.", examples=["[0.01, 0, 0]"])
    ] = None
    velocity_km_per_s: Annotated[str | None, Field(description="JSON, as in a batch.")] = None
    sun_vector: Annotated[str | None, Field(description="JSON, as in a batch.")] = None
    position_km: Annotated[str | None, Field(description="JSON, as in a batch.")] = None
    aberration: Annotated[str, Field(description="As in a batch.")] = "to_correct"
    exposure_s: Annotated[
        str | None, Field(description="By default the file's EXPTIME, else the mission's.")
    ] = None
    centroid: Annotated[
        str | None,
        Field(description="window, scan, matched or recursive; by default the mission's."),
    ] = None
    options: Annotated[str | None, Field(description="JSON, as in a batch.")] = None

    def known(self) -> FrameIn:
        """The same, checked as a batch's fields are; raises `BadBatch` with every fault."""
        given = {name: text for name, text in self.asked().items() if text is not None}
        return read_known({name: _value(name, text) for name, text in given.items()})


_TEXTS = ("batch", "time", "run", "tracker", "aberration", "centroid")


def _value(name: str, text: str) -> Any:
    if name in _TEXTS:
        return text
    try:
        return from_json(text)
    except ValueError:
        raise BadBatch(Fault(name, "must be JSON, as in a batch", shown_value(text))) from None


@dataclass(frozen=True)
class Sent:
    """A frame's file and what is told of it."""

    known: FrameIn
    file: IO[bytes]

    @contextmanager
    def opened(self) -> Iterator[IO[bytes]]:
        """The file, which is gone afterwards."""
        with self.file:
            yield self.file


async def _frame(
    request: Request, query: Annotated[FrameQuery, InQuery()], operations: Held
) -> Sent:
    # Asks for name and query first, so that no frame is taken in only to refuse these.
    mission_named(operations.missions, request.path_params["name"])
    known = query.known()
    return Sent(known, await frame_body(request, operations.settings.frame_mb << 20))


@router.post(
    "/{name}/frames",
    **described(
        {
            201: Gives("The answer, now recorded.", Answer, LOCATION),
            200: Gives("The answer as it was recorded before.", Answer, REPLAYED),
        },
        frame=True,
        problems=(404, 409, 503),
        parameters=(IDEMPOTENCY_KEY,),
    ),
)
def submit_frame(
    name: Name,
    sent: Annotated[Sent, Depends(_frame)],
    key: IdempotencyKey,
    operations: Held,
    metrics: Counted,
    caller: Asking,
) -> Response:
    """Find the stars on a frame, identify them, solve for the attitude, and record it all."""
    with sent.opened() as file:
        answered = operations.submit_frame(name, sent.known, file, key, caller)
    if answered.replayed:
        metrics.count_repeat()
    return answer_response(answered)
