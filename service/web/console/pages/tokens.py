"""Pages for operators: tokens, the audit list of changes, and sign-in."""

import re
from typing import Annotated
from urllib.parse import unquote

from pydantic import Field
from starlette.responses import Response

from service.access import MAX_DAYS, SCOPES, list_entries
from service.contract.access import AuditEntry
from service.storage.recording.signatures import result_in
from service.web.console.page import (
    EMPTY_LAYOUT,
    ContextDep,
    FromQuery,
    PageQuery,
    console_page,
    rendered,
)
from service.web.requests.access import OPEN, OPERATE
from service.web.requests.query_parameters import Cursor, Query

ROWS = 100


class AuditPageQuery(PageQuery):
    """Query that selects changes and the beginning of the list's page."""

    person: Annotated[str, Field(max_length=80)] = ""
    action: Annotated[str, Field(max_length=64)] = ""
    about: Annotated[str, Field(max_length=200)] = ""
    cursor: Cursor = None


@console_page("/audit", "Audit list", OPERATE, section="/about")
def audit_page(query: FromQuery[AuditPageQuery], context: ContextDep) -> Response:
    """Page of the audit list: who changed what and when, the newest first."""
    with context.app.context.reading() as connection:
        page = list_entries(
            connection,
            ROWS,
            query.cursor,
            person=query.person.strip(),
            # Accept an action as written on the page, or as named by the API.
            action=query.action.strip().replace(" ", "_"),
            about=query.about.strip(),
        )
    return context.rendered(
        "audit.html.jinja", query.run, page=page, query=query, object_of=_object
    )


_WITH_A_PAGE = re.compile(r"/api/v1/((batches|alarms|spacecraft|replays)/([^/?]+))")


def _object(entry: AuditEntry) -> tuple[str, str] | None:
    """Path and name of the page about the object of a change; None if it has no page.

    For a what-if it is the page of the recorded result, which leads to the former one.
    """
    if result := result_in(entry.body):
        return f"/batches/{result}", f"batch {result}"
    found = _WITH_A_PAGE.match(entry.about)
    if found is None:
        return None
    path, kind, name = found.groups()
    return f"/{unquote(path)}", f"{OBJECTS[kind]} {unquote(name)}".strip()


OBJECTS = {"batches": "batch", "alarms": "alarm", "spacecraft": "", "replays": "replay"}
"""Word before the name of an object, by the first part of its page's path."""


@console_page("/tokens", "Tokens", OPERATE, section="/about")
def tokens_page(query: FromQuery[PageQuery], context: ContextDep) -> Response:
    """Page of all tokens, without secrets."""
    return context.rendered(
        "tokens.html.jinja",
        query.run,
        tokens=context.app.tokens.all(),
        scopes=SCOPES,
        max_days=MAX_DAYS,
        spacecraft=context.spacecraft,
        is_open=context.caller.token_id is None,
    )


OWN_PATH = r"^/([^/\\\x00-\x20][^\\\x00-\x20]*)?$"
"""Pattern of a path of this service; a second slash or a backslash would name another host."""


class SignInQuery(Query):
    """Path of this service to open after sign-in; never another host's address."""

    next: Annotated[str, Field(max_length=2000, pattern=OWN_PATH)] = "/"


@console_page("/sign-in", "Sign in", OPEN)
def sign_in_page(query: FromQuery[SignInQuery]) -> Response:
    """Page that asks for a token."""
    return rendered("sign-in.html.jinja", EMPTY_LAYOUT, next=query.next)
