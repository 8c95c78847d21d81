"""Gyro blocks: submit one, list them, read one with its samples."""

from typing import Annotated

from fastapi import Path
from starlette.requests import Request
from starlette.responses import Response

from service.errors import BadInput
from service.gyro import GyroBlockIn
from service.storage.models.spacecraft import GyroBlockPage, GyroBlockRow, GyroSamples
from service.web.openapi import LINK, LOCATION, REPLAYED, ApiRouter, Returns
from service.web.requests.dependencies import AppDep, MetricsDep, json_response, page_response
from service.web.requests.query_parameters import FromQuery, PeriodPageQuery, SpacecraftPath
from service.web.requests.request_body import NO_KEY_OF_A_BLOCK, JsonBody, refused

router = ApiRouter("gyro")

BlockId = Annotated[str, Path(description="The `id` of a recorded gyro block.")]


@router.serves(
    "POST /spacecraft/{name}/gyro",
    Returns("The block, now recorded.", GyroBlockRow, LOCATION, status=201),
    Returns("The block that was recorded before.", GyroBlockRow, REPLAYED),
    body=GyroBlockIn,
    problems=(404, 409),
    dependencies=[NO_KEY_OF_A_BLOCK],
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


@router.serves(
    "GET /spacecraft/{name}/gyro",
    Returns("A page of blocks.", GyroBlockPage, LINK),
    problems=(404,),
)
def list_gyro(
    request: Request, name: SpacecraftPath, query: FromQuery[PeriodPageQuery], app: AppDep
) -> Response:
    """The gyro blocks that touch a period, without their samples, the earliest first.

    The samples of a period are the table `gyro`.
    """
    return page_response(request, app.gyro.page(name, **query.asked()))


@router.serves(
    "GET /spacecraft/{name}/gyro/{id}",
    Returns("The block and its samples.", GyroSamples),
    problems=(404,),
)
def get_gyro(name: SpacecraftPath, id: BlockId, app: AppDep) -> Response:
    """One gyro block with its samples."""
    return json_response(app.gyro.get(name, id))
