"""Spacecraft: their settings and state, attitude history, and star rates."""

from typing import Annotated

from fastapi import APIRouter, Path
from fastapi import Query as InQuery
from starlette.requests import Request
from starlette.responses import Response

from service.web.describe import LINK, Gives, described
from service.web.holding import Held, json_response, page_response
from service.web.queries import NO_QUERY, RatesQuery, StretchPage
from service.web.schemas.spacecraft import AttitudePage, RateList, SpacecraftList, SpacecraftState

router = APIRouter(prefix="/api/v1/spacecraft", tags=["spacecraft"])

Name = Annotated[str, Path(description="The spacecraft's name, such as `XTE`.")]


@router.get(
    "", dependencies=[NO_QUERY], **described({200: Gives("Every spacecraft.", SpacecraftList)})
)
def list_spacecraft(operations: Held) -> Response:
    """Every spacecraft there is a mission file for, with its state."""
    return json_response({"items": operations.spacecraft()})


@router.get(
    "/{name}",
    dependencies=[NO_QUERY],
    **described({200: Gives("The spacecraft.", SpacecraftState)}, problems=(404,)),
)
def get_spacecraft(name: Name, operations: Held) -> Response:
    """One spacecraft: state, mission settings and their history."""
    return json_response(operations.spacecraft_state(name))


@router.get(
    "/{name}/attitudes",
    **described({200: Gives("A page of attitudes.", AttitudePage, LINK)}, problems=(404,)),
)
def list_attitudes(
    request: Request, name: Name, query: Annotated[StretchPage, InQuery()], operations: Held
) -> Response:
    """The attitudes of a run, oldest first by batch time."""
    return page_response(request, operations.attitudes(name, **query.asked()))


@router.get(
    "/{name}/rates",
    **described({200: Gives("The buckets that hold batches.", RateList)}, problems=(404,)),
)
def list_rates(name: Name, query: Annotated[RatesQuery, InQuery()], operations: Held) -> Response:
    """Stars by outcome over all observed stars, in buckets by batch time."""
    return json_response({"items": operations.rates(name, **query.asked())})
