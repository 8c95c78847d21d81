"""Attitude over time: the live filter, the definitive attitude, and what the filter met."""

from typing import Annotated, ClassVar, Self
from urllib.parse import quote

from fastapi import APIRouter, Path
from fastapi import Query as InQuery
from pydantic import ConfigDict, model_validator
from starlette.requests import Request
from starlette.responses import Response

from service.observations.schema import RunName, Wire
from service.storage.grades.models import DefinitiveJob, DefinitiveJobList, InnovationPage
from service.storage.grades.rows import LiveAttitude
from service.web.openapi.route import LINK, LOCATION, ResponseDoc, route_docs
from service.web.requests.access import CallerDep, author
from service.web.requests.dependencies import AppDep, json_response, page_response
from service.web.requests.path_parameters import SpacecraftPath
from service.web.requests.query_parameters import (
    NO_QUERY,
    End,
    PeriodPageQuery,
    Start,
    require_order,
)
from service.web.requests.request_body import JsonBody, read_model
from service.web.requests.statements import Who

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


class DefinitiveIn(Wire):
    """Which days get a definitive attitude."""

    component: ClassVar[str] = "DefinitiveIn"
    model_config = ConfigDict(title=component)

    run: RunName = "live"
    start: Start = None
    end: End = None
    who: Who = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        require_order(self.start, self.end)
        return self


@router.post(
    "/{name}/definitive-attitude",
    dependencies=[NO_QUERY],
    **route_docs(
        {202: ResponseDoc("The job, which is queued.", DefinitiveJob, LOCATION)},
        body=DefinitiveIn,
        problems=(404, 503),
    ),
)
def make_definitive_attitude(
    name: SpacecraftPath, body: JsonBody, app: AppDep, caller: CallerDep
) -> Response:
    """Filter and smooth recorded days beside other work, and record both grades.

    A day whose record has not changed stays as it is; one with later batches gets a new revision.
    """
    asked = read_model(DefinitiveIn, body)
    job = app.definitive.begin(
        name, run=asked.run, start=asked.start, end=asked.end, who=author(caller, asked.who)
    )
    location = f"/api/v1/spacecraft/{quote(name)}/definitive-attitude/{job.id}"
    return json_response(job, 202, headers={"Location": location})


@router.get(
    "/{name}/definitive-attitude",
    dependencies=[NO_QUERY],
    **route_docs({200: ResponseDoc("The jobs.", DefinitiveJobList)}, problems=(404,)),
)
def list_definitive_attitudes(name: SpacecraftPath, app: AppDep) -> Response:
    """The jobs of a spacecraft since the start of the service, the newest first."""
    return json_response(app.definitive.all(name))


@router.get(
    "/{name}/definitive-attitude/{id}",
    dependencies=[NO_QUERY],
    **route_docs({200: ResponseDoc("The job.", DefinitiveJob)}, problems=(404,)),
)
def get_definitive_attitude(
    name: SpacecraftPath, id: Annotated[str, Path(description="The `id` of a job.")], app: AppDep
) -> Response:
    """How far a job is."""
    return json_response(app.definitive.get(name, id))
