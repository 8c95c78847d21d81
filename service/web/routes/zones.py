"""Zones: what is cached; build some ahead; drop them."""

from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from pydantic import Field
from starlette.responses import Response

from service.observe.wire import APrioriIn, Key, Wire
from service.web.access import Asking
from service.web.bodies import JsonBody, read_model
from service.web.describe import Gives, described
from service.web.holding import Held, json_response
from service.web.queries import NO_QUERY, Query, Spacecraft, Time
from service.web.schemas.zones import Dropped, ZoneCache, ZoneList

router = APIRouter(prefix="/api/v1/zones", tags=["zones"])

MAX_WARMED = 1000


class WarmIn(Wire):
    """Which zones to build before a batch asks for them."""

    spacecraft: Key
    time: Annotated[Time, Field(description="UTC; gives the epoch and the Sun.")]
    a_priori: Annotated[list[APrioriIn], Field(min_length=1, max_length=MAX_WARMED)]


class DropQuery(Query):
    """Which zones to drop."""

    spacecraft: Spacecraft = None


@router.get("", dependencies=[NO_QUERY], **described({200: Gives("The cache.", ZoneCache)}))
def list_zones(operations: Held) -> Response:
    """The cached zones, their size, hits, misses and build times.

    Processes that compute replays have caches of their own, which are not shown.
    """
    return json_response(operations.zones())


@router.post(
    "",
    dependencies=[NO_QUERY],
    **described({200: Gives("The zones, now cached.", ZoneList)}, body=WarmIn),
)
def warm_zones(body: JsonBody, operations: Held, caller: Asking) -> Response:
    """Build the zones that batches with these a priori attitudes will use."""
    asked = read_model(WarmIn, body)
    caller.require(asked.spacecraft)
    warmed = operations.warm_zones(asked.spacecraft, asked.a_priori, asked.time)
    return json_response({"items": warmed})


@router.delete("", **described({200: Gives("How many were dropped.", Dropped)}))
def drop_zones(query: Annotated[DropQuery, InQuery()], operations: Held) -> Response:
    """Drop cached zones; the next batch builds what it needs anew."""
    return json_response({"dropped": operations.drop_zones(query.spacecraft)})
