"""Route of the API for tracks."""

from typing import Annotated, Literal

from fastapi import Depends
from pydantic import Field
from starlette.responses import Response

from service.features.tracks.part import Tracks
from service.features.tracks.records import TrackList
from service.web.openapi import ApiRouter, ClientMethod, Example, Returns
from service.web.requests.access import AppDep, Policy, json_response
from service.web.requests.query_parameters import FromQuery, PeriodQuery, SpacecraftPath

TDM_MEDIA_TYPE = "text/plain"

router = ApiRouter("products")
ROUTERS = (router,)


async def _tracks(app: AppDep) -> Tracks:
    return app.part(Tracks)


TracksDep = Annotated[Tracks, Depends(_tracks)]


class TracksQuery(PeriodQuery):
    """Query for the tracks in a period, in an output format."""

    format: Annotated[
        Literal["json", "tdm"],
        Field(description="`json`: every track; `tdm`: the moving ones as a file, a CCSDS TDM."),
    ] = "json"


@ClientMethod(
    "tracks",
    example="""
    >>> [each.kind for each in client.tracks("XTE").items]
    []
    """,
)
@ClientMethod("tracks_tdm", format="tdm")
@Example("format", "run=none&format=aem")
@router.serves(
    "GET /spacecraft/{name}/tracks",
    Policy("read", "path"),
    Returns("The tracks.", TrackList, also=TDM_MEDIA_TYPE),
    problems=(503,),
)
def list_tracks(name: SpacecraftPath, query: FromQuery[TracksQuery], tracks: TracksDep) -> Response:
    """The tracks in a period: points without a catalog star that move together.

    They are computed from the record: unmatched stars of the batches with an attitude, of at most
    2,000 batches. As `tdm` the moving ones are a CCSDS TDM of right ascensions and declinations;
    404 if there are none.
    """
    found = tracks.of_period(name, **query.run_and_times)
    if query.format == "json":
        return json_response(found)
    attached = {"Content-Disposition": f'attachment; filename="{name}-{query.run}-tracks.tdm"'}
    return Response(b"".join(tracks.tdm(found)), 200, attached, TDM_MEDIA_TYPE)
