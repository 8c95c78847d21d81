"""Products: attitudes and tables in the formats that other programs read."""

from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from starlette.responses import Response

from service.products.formats import (
    JSON_FORMAT,
    OUTPUT_FORMATS,
    attitude_formats,
    write_attitudes,
    write_table,
)
from service.storage.models.products import AttitudeAtMoment, AttitudeProduct
from service.web.openapi.route import ResponseDoc, route_docs
from service.web.requests.access import CallerDep
from service.web.requests.dependencies import AppDep, json_response
from service.web.requests.exports import ExportsDep
from service.web.requests.history_files import attached_as
from service.web.requests.path_parameters import SpacecraftPath
from service.web.requests.product_parameters import (
    AttitudeAtQuery,
    AttitudeQuery,
    TableKindPath,
    TableQuery,
)

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
    kind = "attitude" if query.grade == "raw" else f"attitude-{query.grade}"
    series = app.products.attitudes(name, **asked, most_batches=written.most_batches)
    return exports.response(
        caller,
        lambda: write_attitudes(format, series),
        written.media_type,
        None if format == JSON_FORMAT else attached_as(f"{name}-{query.run}-{kind}", format),
    )


@router.get(
    "/{name}/attitude/at",
    **route_docs({200: ResponseDoc("The attitude.", AttitudeAtMoment)}, problems=(404,)),
)
def get_attitude_at(
    name: SpacecraftPath, query: Annotated[AttitudeAtQuery, InQuery()], app: AppDep
) -> Response:
    """The attitude at a moment with its error: interpolated within a stretch, or the nearest.

    404 if no attitude lies within the largest gap, or if the moment to interpolate at lies
    within no stretch.
    """
    asked = query.asked()
    found = app.products.attitude_at(name, asked.pop("time"), asked.pop("method"), **asked)
    return json_response(AttitudeAtMoment(**asdict(found)))


@router.get(
    "/{name}/tables/{kind}",
    **route_docs(
        {
            200: ResponseDoc(
                "The table, in the requested format.",
                media_type=OUTPUT_FORMATS["csv"].media_type,
                tables=True,
            )
        },
        problems=(404, 503),
    ),
)
def get_table(
    name: SpacecraftPath,
    kind: TableKindPath,
    query: Annotated[TableQuery, InQuery()],
    app: AppDep,
    exports: ExportsDep,
    caller: CallerDep,
) -> Response:
    """A table of a period, oldest first.

    The batches with their quantities, their stars with outcomes, or the gyro samples.
    """
    written = OUTPUT_FORMATS[query.format]
    table = app.products.table(name, kind, **query.run_and_times, most_batches=written.most_batches)
    return exports.response(
        caller,
        lambda: write_table(query.format, table),
        written.media_type,
        attached_as(f"{name}-{query.run}-{kind}", query.format),
    )
