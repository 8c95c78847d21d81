"""All spacecraft at a glance."""

from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from starlette.responses import Response

from service.storage.models.overview import About, Overview
from service.web.openapi.route import ResponseDoc, route_docs
from service.web.requests.access import CallerDep
from service.web.requests.dependencies import AppDep, json_response
from service.web.requests.query_parameters import NO_QUERY, RunQuery

router = APIRouter(prefix="/api/v1", tags=["spacecraft"])


@router.get("/overview", **route_docs({200: ResponseDoc("Every spacecraft in the run.", Overview)}))
def get_overview(query: Annotated[RunQuery, InQuery()], app: AppDep, caller: CallerDep) -> Response:
    """Every spacecraft in a run: state, last attitude, the last hour and day, active alarms."""
    return json_response(app.spacecraft.overview(query.run, caller.spacecraft))


@router.get(
    "/about",
    dependencies=[NO_QUERY],
    **route_docs({200: ResponseDoc("The version of the service and its data.", About)}),
)
def get_about(app: AppDep, caller: CallerDep) -> Response:
    """Version, catalog, missions, database and credits."""
    return json_response(app.service.about(caller.spacecraft))
