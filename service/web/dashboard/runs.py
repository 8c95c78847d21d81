"""The page of runs and replays: what there is, what is being worked on, and how to add to it."""

from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from starlette.responses import Response

from service.web.dashboard.rendering import PageRoute, rendered
from service.web.dashboard.shell import AtDesk, RunQuery

router = APIRouter(include_in_schema=False, route_class=PageRoute)


@router.get("/runs")
def runs_page(query: Annotated[RunQuery, InQuery()], desk: AtDesk) -> Response:
    """Every run, and the replays with their progress."""
    return rendered(
        "runs.html.jinja",
        desk.shell(query.run, "/runs"),
        runs=desk.operations.runs(),
        replays=desk.operations.replays(),
    )


@router.get("/replays/{id}")
def replay_page(id: str, query: Annotated[RunQuery, InQuery()], desk: AtDesk) -> Response:
    """One replay: how far it is, and every line that was refused."""
    return rendered(
        "replay.html.jinja",
        desk.shell(query.run, "/runs"),
        replay=desk.operations.replay(id),
    )
