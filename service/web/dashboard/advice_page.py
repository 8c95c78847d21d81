"""The advice for a spacecraft as a page: what its batches say of its mission file."""

from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from starlette.responses import Response

from service.web.dashboard.rendering import PageRoute, rendered
from service.web.dashboard.shell import AtDesk
from service.web.routes.advice import ADVICE_LIMIT_S, AdviceQuery

router = APIRouter(include_in_schema=False, route_class=PageRoute)


@router.get("/advice/{name}")
def advice_page(name: str, query: Annotated[AdviceQuery, InQuery()], desk: AtDesk) -> Response:
    """Tolerances, noise, magnitudes, alignment, and what other settings would have come to."""
    advice = desk.operations.advise(name, **query.asked(), limit_s=ADVICE_LIMIT_S)
    return rendered("advice.html.jinja", desk.shell(query.run, "/"), advice=advice)
