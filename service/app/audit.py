"""The list of changes and who made them."""

from service.access import audit
from service.app.context import Context
from service.storage.models.access import AuditEntry
from service.storage.models.base import Page


class Audit:
    """Reads the audit list."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def page(self, limit: int = 100, cursor: str | None = None) -> Page[AuditEntry]:
        """The audit list of changes, newest first."""
        with self._context.reading() as connection:
            return audit.list_entries(connection, limit, cursor)
