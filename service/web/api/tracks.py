"""Tracks of points that no catalog star explains."""

from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from starlette.responses import Response

from service.storage.tracks import TrackList
from service.web.openapi.route import ResponseDoc, route_docs
from service.web.requests.dependencies import AppDep, json_response
from service.web.requests.query_parameters import TDM_MEDIA_TYPE, SpacecraftPath, TracksQuery

router = APIRouter(prefix="/api/v1/spacecraft", tags=["products"])


@router.get(
    "/{name}/tracks",
    **route_docs(
        {200: ResponseDoc("The tracks.", TrackList, also=TDM_MEDIA_TYPE)}, problems=(404, 503)
    ),
)
def list_tracks(
    name: SpacecraftPath,
    query: Annotated[TracksQuery, InQuery()],
    app: AppDep,
) -> Response:
    """Tracks of a period: points that no catalog star explains and that move together.

    They are computed from the record: unmatched stars of the batches with an attitude, of at most
    2,000 batches. As `tdm` the moving ones are a CCSDS TDM of right ascensions and declinations;
    404 if there are none.
    """
    found = app.tracks.of_period(name, **query.run_and_times)
    if query.format == "json":
        return json_response(found)
    attached = {"Content-Disposition": f'attachment; filename="{name}-{query.run}-tracks.tdm"'}
    return Response(b"".join(app.tracks.tdm(found)), 200, attached, TDM_MEDIA_TYPE)
