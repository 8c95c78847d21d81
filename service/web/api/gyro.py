"""Gyro blocks: submit one, list them, read one with its samples."""

from typing import Annotated

from fastapi import APIRouter, Path
from fastapi import Query as InQuery
from starlette.requests import Request
from starlette.responses import Response

from service.errors import BadInput
from service.gyro import GyroBlockIn
from service.storage.models.spacecraft import GyroBlockPage, GyroBlockRow, GyroSamples
from service.web.openapi.route import LINK, LOCATION, REPLAYED, ResponseDoc, route_docs
from service.web.requests.dependencies import AppDep, MetricsDep, json_response, page_response
from service.web.requests.query_parameters import NO_QUERY, PeriodPageQuery, SpacecraftPath
from service.web.requests.request_body import NO_KEY_OF_A_BLOCK, JsonBody, refused

router = APIRouter(prefix="/api/v1/spacecraft", tags=["gyro"])

BlockId = Annotated[str, Path(description="The `id` of a recorded gyro block.")]


@router.post(
    "/{name}/gyro",
    dependencies=[NO_QUERY, NO_KEY_OF_A_BLOCK],
    **route_docs(
        {
            201: ResponseDoc("The block, now recorded.", GyroBlockRow, LOCATION),
            200: ResponseDoc("The block that was recorded before.", GyroBlockRow, REPLAYED),
        },
        body=GyroBlockIn,
        problems=(404, 409, 503),
    ),
)
def submit_gyro(name: SpacecraftPath, body: JsonBody, app: AppDep, metrics: MetricsDep) -> Response:
    """Record a block of gyro samples.

    The same block again is answered with 200 and `Replayed`. 409 if another body has its name, or
    if another block of the run holds one of its times.
    """
    try:
        recorded = app.gyro.submit(name, body)
    except BadInput as error:
        raise refused(body, error) from None
    if recorded.replayed:
        metrics.count_repeat()
        return json_response(recorded.row, 200, {"Replayed": "true"})
    location = f"/api/v1/spacecraft/{name}/gyro/{recorded.row.id}"
    return json_response(recorded.row, 201, {"Location": location})


@router.get(
    "/{name}/gyro",
    **route_docs({200: ResponseDoc("A page of blocks.", GyroBlockPage, LINK)}, problems=(404,)),
)
def list_gyro(
    request: Request,
    name: SpacecraftPath,
    query: Annotated[PeriodPageQuery, InQuery()],
    app: AppDep,
) -> Response:
    """The gyro blocks that touch a period, without their samples, the earliest first.

    The samples of a period are the table `gyro`.
    """
    return page_response(request, app.gyro.page(name, **query.asked()))


@router.get(
    "/{name}/gyro/{id}",
    dependencies=[NO_QUERY],
    **route_docs({200: ResponseDoc("The block and its samples.", GyroSamples)}, problems=(404,)),
)
def get_gyro(name: SpacecraftPath, id: BlockId, app: AppDep) -> Response:
    """One gyro block with its samples."""
    return json_response(app.gyro.get(name, id))
