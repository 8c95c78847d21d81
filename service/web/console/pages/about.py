"""The page about the service: versions, catalog, missions, credits."""

from typing import Annotated

from fastapi import Query as InQuery
from starlette.responses import Response

from service.web.console.page_context import ContextDep, PageQuery
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import Policy


@console_page("/about", "About", Policy("read", "nothing"), position=80)
def about_page(query: Annotated[PageQuery, InQuery()], context: ContextDep) -> Response:
    """Version, catalog, missions, database and credits."""
    about = context.app.service.about(context.caller.spacecraft)
    return rendered("about.html.jinja", context.layout(query.run), about=about)
