"""The log of events that the records keep, and the audit list of changes."""

from collections.abc import Callable, Collection, Sequence

from service.access import audit
from service.app.context import Context
from service.storage.models.access import AuditEntry
from service.storage.models.base import Page
from service.storage.recording import events
from service.storage.recording.events import Event


class Events:
    """Reads events, and calls listeners when something was written."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def last(self, spacecraft: Collection[str] | None = None) -> int:
        """The number of the latest event; with `spacecraft`, of the latest about one of these."""
        with self._context.reading() as connection:
            if spacecraft is None:
                return events.last_event(connection)
            return events.last_event_about(connection, spacecraft)

    def after(self, last: int, limit: int) -> Sequence[Event] | None:
        """The events after a number, oldest first; None where some of them are no longer kept."""
        with self._context.reading_record() as connection:
            return events.events_after(connection, last, limit)

    def listen(self, listener: Callable[[], object]) -> None:
        """Call a function, from any thread, after each commit that has events."""
        self._context.store.writer.after_events.append(listener)

    def unlisten(self, listener: Callable[[], object]) -> None:
        """Stop calling a function after each commit that has events."""
        self._context.store.writer.after_events.remove(listener)


class Audit:
    """Reads the audit list."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def page(self, limit: int = 100, cursor: str | None = None) -> Page[AuditEntry]:
        """The audit list of changes, newest first."""
        with self._context.reading() as connection:
            return audit.list_entries(connection, limit, cursor)
