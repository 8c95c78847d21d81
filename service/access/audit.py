"""The audit list: who changed what; entries are only added."""

from dataclasses import dataclass

from sqlalchemy import Connection, insert, select

from service.storage.models.access import AuditEntry
from service.storage.models.base import Page
from service.storage.sql.access_tables import audit
from service.storage.sql.columns import Row

MAX_BODY_KEPT = 4_000


@dataclass(frozen=True)
class Entry:
    """One entry: who did what to what, with what body, and the status of the answer.

    Handed to the operation that makes the change, it becomes part of the change's own
    transaction: neither is stored without the other.
    """

    id: str
    moment: str
    who: str
    action: str
    about: str
    body: str | None = None
    status: int | None = None

    def row(self) -> Row:
        """The entry as a row of the table, its body shortened."""
        return vars(self) | {"body": _kept(self.body)}

    def add_to(self, connection: Connection) -> None:
        """Add the entry to the list."""
        connection.execute(insert(audit).values(self.row()))


def _kept(body: str | None) -> str | None:
    if body is None or len(body) <= MAX_BODY_KEPT:
        return body
    return body[: MAX_BODY_KEPT - 1] + "…"


def list_entries(connection: Connection, limit: int, cursor: str | None) -> Page[AuditEntry]:
    """The entries, newest first; a cursor is the id of the last one shown."""
    query = select(audit).order_by(audit.c.id.desc()).limit(limit + 1)
    if cursor is not None:
        query = query.where(audit.c.id < cursor)
    rows = [AuditEntry(**row) for row in connection.execute(query).mappings()]
    return Page(rows[:limit], rows[limit - 1].id if len(rows) > limit else None)
