"""API routes for the zone cache: state, building in advance, dropping."""

from typing import Annotated

from pydantic import Field
from starlette.responses import Response

from service.contract.spacecraft import Dropped, ZoneCache, ZoneList
from service.observations.schema import APrioriIn, Key, Wire
from service.web.openapi import ApiRouter, Returns
from service.web.requests.access import READ, AppDep, CallerDep, Policy, json_response
from service.web.requests.query_parameters import FromQuery, Query, SpacecraftFilter, Time
from service.web.requests.request_body import JsonBody, read_model

router = ApiRouter("zones")


class WarmIn(Wire):
    """Request body that selects zones to build before a batch needs them."""

    spacecraft: Key
    time: Annotated[
        Time, Field(description="UTC; determines the epoch and the direction of the Sun.")
    ]
    a_priori: Annotated[list[APrioriIn], Field(min_length=1, max_length=1000)]


class DropQuery(Query):
    """Query that selects cached zones to drop."""

    spacecraft: SpacecraftFilter = None


@router.serves("GET /zones", READ, Returns("The cache.", ZoneCache))
def list_zones(app: AppDep) -> Response:
    """Cached zones with sizes, hits, misses and build times.

    The worker processes for replays have their own caches, which are not included.
    """
    return json_response(app.zones.state())


@router.serves(
    "POST /zones",
    Policy("operate", "body"),
    Returns("The zones, now cached.", ZoneList),
    body=WarmIn,
)
def warm_zones(body: JsonBody, app: AppDep, caller: CallerDep) -> Response:
    """Build the zones that batches with these a priori attitudes will use."""
    asked = read_model(WarmIn, body)
    caller.require(asked.spacecraft)
    warmed = app.zones.warm(asked.spacecraft, asked.a_priori, asked.time)
    return json_response(ZoneList(items=warmed))


@router.serves(
    "DELETE /zones", Policy("operate", "query"), Returns("The number of dropped zones.", Dropped)
)
def drop_zones(query: FromQuery[DropQuery], app: AppDep) -> Response:
    """Drop cached zones; the next batch builds its zones again."""
    return json_response(Dropped(dropped=app.zones.drop(query.spacecraft)))
