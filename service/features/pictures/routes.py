"""API routes for frames of star trackers, and the one that solves pictures of any camera."""

from typing import IO, Annotated

from fastapi import Depends
from pydantic import Field
from starlette.requests import Request
from starlette.responses import Response

from service.features.pictures.part import Pictures
from service.features.pictures.records import Picture
from service.features.pictures.tracker.routes import overlay_router
from service.features.pictures.tracker.routes import router as frames_router
from service.features.pictures.upload import FRAMES, frame_body
from service.vectors import Projection
from service.web.openapi import ApiRouter, ClientMethod, Returns
from service.web.requests.access import AppDep, CallerDep, Policy, json_response
from service.web.requests.query_parameters import FromQuery, Query

router = ApiRouter("frames")
ROUTERS = (frames_router, overlay_router, router)


class PictureQuery(Query):
    """Query with known properties of a picture's camera."""

    spacecraft: Annotated[
        str | None,
        Field(
            description="Whose camera took it. Default: a camera that the service does not know."
        ),
    ] = None
    field_of_view_deg: Annotated[
        float | None,
        Field(
            gt=0,
            le=180,
            description="Along the longer side; may be wrong by a quarter. From 120: with `lens`.",
        ),
    ] = None
    lens: Annotated[
        Projection | None,
        Field(description="How the lens projects the sky. Default: whatever fits."),
    ] = None
    pixel_ratio: Annotated[
        float | None,
        Field(
            ge=0.125,
            le=8,
            description="Width of a pixel over its height. Default: from the FITS header, else 1.",
        ),
    ] = None
    image: Annotated[str | None, Field(description="As of a frame.", examples=["SCI"])] = None
    overlay: Annotated[
        bool, Field(description="Whether the answer holds the picture with the stars.")
    ] = False


async def _picture(request: Request, query: FromQuery[PictureQuery], app: AppDep) -> IO[bytes]:
    return await frame_body(request, app.settings)


@ClientMethod("solve_picture", body="picture", repeatable=True)
@router.serves(
    "POST /pictures",
    # It records nothing; the handler asks for access to the spacecraft that is named.
    Policy("read", "nothing"),
    Returns("Attitude, lens and stars of the picture. The service records none of it.", Picture),
    files=FRAMES,
    problems=(404, 503),
)
def solve_picture(
    query: FromQuery[PictureQuery],
    file: Annotated[IO[bytes], Depends(_picture)],
    app: AppDep,
    caller: CallerDep,
) -> Response:
    """Find the stars, the attitude and the lens of a picture of any camera, and record nothing."""
    with file:
        if query.spacecraft is not None:
            caller.require(query.spacecraft)
        found = app.part(Pictures).solve(
            file,
            spacecraft=query.spacecraft,
            field_of_view_deg=query.field_of_view_deg,
            projection=query.lens,
            pixel_ratio=query.pixel_ratio,
            image=query.image,
            draws=query.overlay,
        )
    return json_response(found)
