"""API routes of the definitive attitude: the live one, innovations, and jobs."""

from typing import Annotated, Self
from urllib.parse import quote

from fastapi import Path
from pydantic import model_validator
from starlette.requests import Request
from starlette.responses import Response

from service.features.definitive import records
from service.features.definitive.part import Definitive
from service.observations.schema import LIVE, RunName, Wire
from service.web.openapi import LINK, LOCATION, ApiRouter, ClientMethod, Example, Returns
from service.web.requests import query_parameters as params
from service.web.requests.access import (
    AppDep,
    CallerDep,
    Policy,
    author,
    json_response,
    page_response,
)
from service.web.requests.query_parameters import FromQuery, SpacecraftPath, Who
from service.web.requests.request_body import JsonBody, read_model

router = ApiRouter("products")
ROUTERS = (router,)


@ClientMethod("live_attitude")
@Example("not_kept_up")
@router.serves(
    "GET /spacecraft/{name}/attitude/latest",
    Policy("read", "path"),
    Returns("The attitude.", records.LiveAttitude),
)
def get_live_attitude(name: SpacecraftPath, app: AppDep) -> Response:
    """The filtered attitude at the last epoch of live data, for missions with a live filter.

    404 if the mission has no live filter, or if there is no attitude yet, or it is lost.
    """
    return json_response(app.part(Definitive).live_filter.latest(name))


@ClientMethod(
    "innovations",
    example="""
    >>> [row.chi_square for row in client.innovations("XTE")]
    []
    """,
)
@Example("none_smoothed")
@router.serves(
    "GET /spacecraft/{name}/innovations",
    Policy("read", "path"),
    Returns("A page of innovations.", records.InnovationPage, LINK),
)
def list_innovations(
    request: Request, name: SpacecraftPath, query: FromQuery[params.PeriodPageQuery], app: AppDep
) -> Response:
    """Differences of measured attitudes from the filter's prediction and the smoothed attitude.

    They are of the days that `acquire smooth` recorded, the latest revision of each.
    """
    return page_response(request, app.part(Definitive).days.innovations(name, **query.asked()))


class DefinitiveIn(Wire):
    """Request body for definitive attitudes: run, period and author."""

    run: RunName = LIVE
    start: params.Start = None
    end: params.End = None
    who: Who = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        params.require_order(self.start, self.end)
        return self


@ClientMethod("make_definitive_attitude")
@router.serves(
    "POST /spacecraft/{name}/definitive-attitude",
    Policy("operate", "path"),
    Returns("The job, which is queued.", records.DefinitiveJob, LOCATION, status=202),
    body=DefinitiveIn,
)
def make_definitive_attitude(
    name: SpacecraftPath, body: JsonBody, app: AppDep, caller: CallerDep
) -> Response:
    """Queue a job that filters and smooths recorded days, and records both results.

    A day whose record has not changed stays as it is; one with later batches gets a new revision.
    """
    asked = read_model(DefinitiveIn, body)
    job = app.part(Definitive).jobs.begin(
        name, run=asked.run, start=asked.start, end=asked.end, who=author(caller, asked.who)
    )
    location = f"/api/v1/spacecraft/{quote(name)}/definitive-attitude/{job.id}"
    return json_response(job, 202, headers={"Location": location})


@router.serves(
    "GET /spacecraft/{name}/definitive-attitude",
    Policy("read", "path"),
    Returns("The jobs.", records.DefinitiveJobList),
)
def list_definitive_attitudes(name: SpacecraftPath, app: AppDep) -> Response:
    """The definitive-attitude jobs of a spacecraft since the start of the service, newest first."""
    return json_response(records.DefinitiveJobList(items=app.part(Definitive).jobs.all(name)))


@ClientMethod("definitive_attitude")
@router.serves(
    "GET /spacecraft/{name}/definitive-attitude/{id}",
    Policy("read", "path"),
    Returns("The job.", records.DefinitiveJob),
)
def get_definitive_attitude(
    name: SpacecraftPath, id: Annotated[str, Path(description="The `id` of a job.")], app: AppDep
) -> Response:
    """State and progress of a definitive-attitude job."""
    return json_response(app.part(Definitive).jobs.get(name, id))
