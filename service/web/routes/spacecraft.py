"""Spacecraft: their settings and state, attitude history, and star rates."""

from typing import Annotated

from fastapi import APIRouter, Path
from fastapi import Query as InQuery
from starlette.requests import Request
from starlette.responses import Response

from service.web.access import Asking
from service.web.describe import LINK, Gives, described
from service.web.holding import Held, json_response, page_response
from service.web.queries import HistoryQuery, RatesQuery, RunQuery, StretchPage, WorstQuery
from service.web.schemas.spacecraft import (
    AttitudePage,
    RateList,
    SpacecraftList,
    SpacecraftState,
)
from service.web.schemas.trends import History, WorstList
from service.web.tables import CSV, THINNED, batches_csv, history_csv, thinned

router = APIRouter(prefix="/api/v1/spacecraft", tags=["spacecraft"])

DEFAULT_SIZE = 500

Name = Annotated[str, Path(description="The spacecraft's name, such as `XTE`.")]


@router.get("", **described({200: Gives("Every spacecraft.", SpacecraftList)}))
def list_spacecraft(
    query: Annotated[RunQuery, InQuery()], operations: Held, caller: Asking
) -> Response:
    """Every spacecraft there is a mission file for, with its state in a run."""
    theirs = [each for each in operations.spacecraft(query.run) if caller.may_see(each["name"])]
    return json_response({"items": theirs})


@router.get(
    "/{name}",
    **described({200: Gives("The spacecraft.", SpacecraftState)}, problems=(404,)),
)
def get_spacecraft(name: Name, query: Annotated[RunQuery, InQuery()], operations: Held) -> Response:
    """One spacecraft: state in a run, mission settings and their history."""
    return json_response(operations.spacecraft_state(name, query.run))


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
    """Stars by outcome over all observed stars, in at most 20,000 buckets by batch time."""
    return json_response({"items": operations.rates(name, **query.asked())})


@router.get(
    "/{name}/history",
    **described(
        {200: Gives("The history; as CSV where that was asked for.", History, THINNED, also=CSV)},
        problems=(404,),
    ),
)
def get_history(
    name: Name, query: Annotated[HistoryQuery, InQuery()], operations: Held
) -> Response:
    """How quantities went over a stretch of time.

    Thinned out to as many points as can be drawn, or as a table of every batch.
    """
    where = query.stretch
    if query.of_every_batch:
        pages = operations.every_batch(name, quantities=query.quantity, **where)
        return batches_csv(name, query.run, pages)
    history = operations.history(
        name,
        quantities=query.quantity,
        strategy=query.strategy or "minmax",
        size=query.size or DEFAULT_SIZE,
        **where,
    )
    if query.format == "csv":
        return history_csv(history)
    return json_response(history, headers=thinned(history["thinned"]))


@router.get(
    "/{name}/worst",
    **described({200: Gives("The worst batches.", WorstList)}, problems=(404,)),
)
def list_worst(name: Name, query: Annotated[WorstQuery, InQuery()], operations: Held) -> Response:
    """The batches of a stretch that are worst by a quantity, the worst first."""
    return json_response({"by": query.by, "items": operations.worst_batches(name, **query.asked())})
