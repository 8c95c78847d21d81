"""Products: attitudes in the formats that other programs read."""

from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from starlette.responses import Response

from service.products.formats import JSON_FORMAT, attitude_formats, write_attitudes
from service.storage.models.products import AttitudeProduct
from service.web.openapi.route import ResponseDoc, route_docs
from service.web.requests.access import CallerDep
from service.web.requests.dependencies import AppDep
from service.web.requests.exports import ExportsDep
from service.web.requests.history_files import attached_as
from service.web.requests.path_parameters import SpacecraftPath
from service.web.requests.query_parameters import AttitudeQuery

router = APIRouter(prefix="/api/v1/spacecraft", tags=["products"])


@router.get(
    "/{name}/attitude",
    **route_docs(
        {
            200: ResponseDoc(
                "The attitudes, in the requested format.", AttitudeProduct, attitudes=True
            )
        },
        problems=(404, 503),
    ),
)
def get_attitude(
    name: SpacecraftPath,
    query: Annotated[AttitudeQuery, InQuery()],
    app: AppDep,
    exports: ExportsDep,
    caller: CallerDep,
) -> Response:
    """The attitudes of a period, oldest first: as JSON, a table, or a file of flight dynamics."""
    asked = query.asked()
    format = asked.pop("format")
    written = attitude_formats()[format]
    series = app.products.attitudes(name, **asked, most_batches=written.most_batches)
    return exports.response(
        caller,
        lambda: write_attitudes(format, series),
        written.media_type,
        None if format == JSON_FORMAT else attached_as(f"{name}-{query.run}-attitude", format),
    )
