"""Innovations: how the measured attitudes of a spacecraft met its filter."""

from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from starlette.requests import Request
from starlette.responses import Response

from service.storage.grades.models import InnovationPage
from service.web.openapi.route import LINK, ResponseDoc, route_docs
from service.web.requests.dependencies import AppDep, page_response
from service.web.requests.path_parameters import SpacecraftPath
from service.web.requests.query_parameters import PeriodPageQuery

router = APIRouter(prefix="/api/v1/spacecraft", tags=["products"])


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
