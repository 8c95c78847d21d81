"""The page on which a browser exchanges a token for a session."""

from typing import Annotated

from fastapi import Query as InQuery
from pydantic import Field
from starlette.responses import Response

from service.web.console.page_context import EMPTY_LAYOUT
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import OPEN
from service.web.requests.query_parameters import Query

OWN_PATH = r"^/([^/\\\x00-\x20][^\\\x00-\x20]*)?$"
"""A second slash, or a backslash that browsers take for one, would name another host."""


class SignInQuery(Query):
    """The page to open after sign-in: a path of this service, never another host's address."""

    next: Annotated[str, Field(max_length=2000, pattern=OWN_PATH)] = "/"


@console_page("/sign-in", "Sign in", OPEN)
def sign_in_page(query: Annotated[SignInQuery, InQuery()]) -> Response:
    """Ask for a token."""
    return rendered("sign-in.html.jinja", EMPTY_LAYOUT, next=query.next)
