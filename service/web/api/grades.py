"""Grades: the live filtered attitude, and how the measured attitudes met the filter."""

from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from starlette.requests import Request
from starlette.responses import Response

from service.storage.grades.live import LiveAttitude
from service.storage.grades.models import InnovationPage
from service.web.openapi.route import LINK, ResponseDoc, route_docs
from service.web.requests.dependencies import AppDep, json_response, page_response
from service.web.requests.path_parameters import SpacecraftPath
from service.web.requests.query_parameters import PeriodPageQuery

router = APIRouter(prefix="/api/v1/spacecraft", tags=["products"])


@router.get(
    "/{name}/attitude/latest",
    **route_docs({200: ResponseDoc("The attitude.", LiveAttitude)}, problems=(404,)),
)
def get_live_attitude(name: SpacecraftPath, app: AppDep) -> Response:
    """The filtered attitude at the last epoch of live data, where the mission keeps it up.

    404 if the mission has no live filter, or if there is no attitude yet, or it is lost.
    """
    return json_response(app.live_filter.latest(name))


@router.get(
    "/{name}/innovations",
    **route_docs(
        {200: ResponseDoc("A page of innovations.", InnovationPage, LINK)}, problems=(404,)
    ),
)
def list_innovations(
    request: Request,
    name: SpacecraftPath,
    query: Annotated[PeriodPageQuery, InQuery()],
    app: AppDep,
) -> Response:
    """How each measured attitude met the filter, and how far it is from the smoothed one.

    They are of the days that `acquire smooth` recorded, the latest revision of each.
    """
    return page_response(request, app.grades.innovations(name, **query.asked()))
