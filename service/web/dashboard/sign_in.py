"""The page on which a browser exchanges a token for a session."""

from typing import Annotated

from fastapi import APIRouter
from fastapi import Query as InQuery
from pydantic import Field
from starlette.responses import Response

from service.web.dashboard.rendering import PageRoute, rendered
from service.web.dashboard.shell import BARE
from service.web.queries import Query

router = APIRouter(include_in_schema=False, route_class=PageRoute)


OWN_PATH = r"^/([^/\\\x00-\x20][^\\\x00-\x20]*)?$"
"""A second slash, or a backslash that browsers take for one, would name another host."""


class SignInQuery(Query):
    """Where to go once signed in: a path of this service, never another's address."""

    next: Annotated[
        str, Field(max_length=2000, pattern=r"^/([^/\\\x00-\x20][^\\\x00-\x20]*)?$")
    ] = "/"


@router.get("/sign-in")
def sign_in_page(query: Annotated[SignInQuery, InQuery()]) -> Response:
    """Ask for a token."""
    return rendered("sign-in.html.jinja", BARE, next=query.next)
