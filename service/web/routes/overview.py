"""All spacecraft at a glance."""

from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from starlette.responses import Response

from service.records.alarms import summary
from service.web.access import Asking
from service.web.describe import Gives, described
from service.web.holding import Held, json_response
from service.web.queries import NO_QUERY, RunQuery
from service.web.schemas.overview import About, Overview

router = APIRouter(prefix="/api/v1", tags=["spacecraft"])


@router.get("/overview", **described({200: Gives("Every spacecraft in the run.", Overview)}))
def get_overview(
    query: Annotated[RunQuery, InQuery()], operations: Held, caller: Asking
) -> Response:
    """Every spacecraft in a run: state, last attitude, the last hour and day, and since when."""
    found = operations.overview(query.run)
    found["items"] = [each for each in found["items"] if caller.may_see(each["name"])]
    found["alarms"] = summary([alarm for each in found["items"] for alarm in each["alarms"]])
    return json_response(found)


@router.get("/about", dependencies=[NO_QUERY], **described({200: Gives("What answers.", About)}))
def get_about(operations: Held) -> Response:
    """Version, catalog, missions, database, and whom it is owed to."""
    return json_response(operations.about())
