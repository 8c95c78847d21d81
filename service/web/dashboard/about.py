"""The page about the service: versions, catalog, missions, credits."""

from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from starlette.responses import Response

from service.web.dashboard.rendering import PageRoute, rendered
from service.web.dashboard.shell import AtDesk, RunQuery

router = APIRouter(include_in_schema=False, route_class=PageRoute)


@router.get("/about")
def about_page(query: Annotated[RunQuery, InQuery()], desk: AtDesk) -> Response:
    """What runs here and what it is made of."""
    about = desk.operations.about()
    about["missions"] = [each for each in about["missions"] if desk.caller.may_see(each["name"])]
    return rendered("about.html.jinja", desk.shell(query.run, "/about"), about=about)
