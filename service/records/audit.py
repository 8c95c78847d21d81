"""Who changed what: a list that is only ever added to."""

from sqlalchemy import Connection, insert, select

from service.records.draft import Row
from service.records.pages import Page
from service.records.tables import audit

MAX_BODY_KEPT = 4_000


def note(
    connection: Connection,
    *,
    id: str,
    moment: str,
    who: str,
    action: str,
    about: str,
    body: str | None = None,
    status: int | None = None,
) -> None:
    """Add an entry: who did what to what, with what body, and the status of the answer."""
    kept = body if body is None or len(body) <= MAX_BODY_KEPT else body[: MAX_BODY_KEPT - 1] + "…"
    connection.execute(
        insert(audit).values(
            id=id, moment=moment, who=who, action=action, about=about, body=kept, status=status
        )
    )


def list_entries(connection: Connection, limit: int, cursor: str | None) -> Page:
    """The entries, newest first; a cursor is the id of the last one shown."""
    query = select(audit).order_by(audit.c.id.desc()).limit(limit + 1)
    if cursor is not None:
        query = query.where(audit.c.id < cursor)
    rows: list[Row] = [dict(row) for row in connection.execute(query).mappings()]
    return Page(rows[:limit], rows[limit - 1]["id"] if len(rows) > limit else None)
