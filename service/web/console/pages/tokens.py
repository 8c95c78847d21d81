"""The page of tokens: who may use the service, the form for a new token, and revocation."""

from typing import Annotated

from fastapi import Query as InQuery
from starlette.responses import Response

from service.access.administration import MAX_DAYS
from service.access.tokens import SCOPES
from service.web.console.page_context import ContextDep, PageQuery
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import OPERATE


@console_page("/tokens", "Tokens", OPERATE, section="/about")
def tokens_page(query: Annotated[PageQuery, InQuery()], context: ContextDep) -> Response:
    """Every token without its secret."""
    return rendered(
        "tokens.html.jinja",
        context.layout(query.run),
        tokens=context.app.tokens.all(),
        scopes=SCOPES,
        max_days=MAX_DAYS,
        spacecraft=context.spacecraft,
        is_open=context.caller.token_id is None,
    )
