"""Annotations, and recent events in order of commit, for clients that reconnect.

An event is noted in the transaction of the change that it reports.  Its number comes from one row
whose lock is held until the commit: in every process events become visible in the order of their
numbers, without a gap.
"""

import asyncio
import logging
import threading
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Literal, get_args

import msgspec
from sqlalchemy import URL, Connection, create_engine, delete, func, insert, or_, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.pool import NullPool

from service.contract.alarms import Annotation, AnnotationChange
from service.contract.base import Page
from service.errors import BadBatch, Fault, NotFound, shown_value
from service.storage.recording import chain
from service.storage.recording.ids import is_ulid
from service.storage.sql.columns import Row
from service.storage.sql.dialects import dialect_of
from service.storage.sql.statements import execute, insert_all, rows_of
from service.storage.sql.tables import annotations, event_counter, events
from service.times import Utc, utc_now

log = logging.getLogger(__name__)

EventKind = Literal[
    "batches",
    "adopted",
    "alarm",
    "limit",
    "annotation",
    "replay",
    "gyro",
    "tracking",
    "calibration",
    "head",
]
EVENT_KINDS: tuple[EventKind, ...] = get_args(EventKind)
KEPT = 20_000
"""Number of events kept; a client that missed more starts anew."""
PRUNED_EVERY = 500

_OUTBOX = "events"
_TAKE = "UPDATE event_counter SET last = last + {0} WHERE id = 1 RETURNING last"


@dataclass(frozen=True)
class Event:
    """One event: its number, kind, run, spacecraft, data as JSON, and when it was recorded."""

    id: int
    kind: str
    run: str | None
    spacecraft: str | None
    data: str
    at: str | None
    """Time of the event; None if an earlier version recorded it."""

    def concerns(self, run: str | None, spacecraft: Collection[str] | None) -> bool:
        """True if the event passes a filter by run and spacecraft; None: every one passes.

        An event without a run concerns every run, an annotation without a spacecraft every
        spacecraft.  A replay names no spacecraft: its lines may be about any, and its id gives
        access to their errors, so it passes only without a filter.
        """
        about_all = self.kind == "annotation" and self.spacecraft is None
        return (self.run is None or run is None or self.run == run) and (
            spacecraft is None or self.spacecraft in spacecraft or about_all
        )


def add_event(
    connection: Connection,
    kind: EventKind,
    data: object,
    *,
    run: str | None = None,
    spacecraft: str | None = None,
) -> None:
    """Add an event to a transaction; it is numbered at the end of the transaction."""
    text = msgspec.json.encode(data).decode()
    row = {"kind": kind, "run": run, "spacecraft": spacecraft, "data": text}
    connection.info.setdefault(_OUTBOX, []).append(row)


@contextmanager
def numbered(connection: Connection) -> Iterator[None]:
    """Context manager that numbers a transaction's events at its end, and drops the oldest ones.

    The later the lock on the numbers is taken, the less other transactions wait for it.
    """
    outbox: list[Row] = []
    connection.info[_OUTBOX] = outbox
    yield
    if not outbox:
        return
    ((last,),) = execute(connection, _TAKE.format(len(outbox)))
    first = last - len(outbox) + 1
    now = utc_now().text
    rows = [{"id": first + place, "at": now} | row for place, row in enumerate(outbox)]
    insert_all(connection, events, rows)
    dialect_of(connection).wake_listeners(connection, CHANNEL)
    if first // PRUNED_EVERY != (last + 1) // PRUNED_EVERY:
        connection.execute(delete(events).where(events.c.id <= last - KEPT))


def undone(connection: Connection, length: int) -> None:
    """Drop all but the first `length` noted events: the others' changes were rolled back."""
    del connection.info.get(_OUTBOX, [])[length:]


def noted(connection: Connection) -> int:
    """Count the events of a transaction that have no number yet."""
    return len(connection.info.get(_OUTBOX, []))


def last_event(connection: Connection) -> int:
    """The number of the latest event; zero before the first."""
    return int(connection.execute(select(event_counter.c.last)).scalar_one())


def last_event_about(connection: Connection, spacecraft: Collection[str]) -> int:
    """Number of the latest event about any given spacecraft, else one before the oldest kept."""
    found = select(func.max(events.c.id)).where(events.c.spacecraft.in_(spacecraft))
    return max(connection.scalar(found) or 0, (first_event(connection) or 1) - 1)


def events_after(connection: Connection, last: int, limit: int) -> Sequence[Event] | None:
    """Events after a number, oldest first; None if some are no longer kept, or it is unknown.

    None too for a number that was never assigned, which comes from another database.
    """
    query = select(events).where(events.c.id > last).order_by(events.c.id).limit(limit)
    found = [Event(**row) for row in rows_of(connection, query)]
    if found:
        return found if found[0].id == last + 1 else None
    return [] if last_event(connection) == last else None


def first_event(connection: Connection) -> int | None:
    """Number of the oldest event kept; None without events."""
    first: int | None = connection.scalar(select(func.min(events.c.id)))
    return first


def events_between(connection: Connection, since: Utc, until: Utc) -> Sequence[Event]:
    """Events recorded from `since` to before `until` and still kept, oldest first."""
    recorded = events.c.at >= since.text, events.c.at < until.text
    query = select(events).where(*recorded).order_by(events.c.id)
    return [Event(**row) for row in rows_of(connection, query)]


class Bell:
    """Notifier that wakes event loops waiting for events; rung from any thread after a commit."""

    def __init__(self) -> None:
        self._subscribed: dict[asyncio.Event, asyncio.AbstractEventLoop] = {}
        self._lock = threading.Lock()

    def subscribe(self) -> asyncio.Event:
        """Create an asyncio event in the running loop, set after each commit of events."""
        news = asyncio.Event()
        with self._lock:
            self._subscribed[news] = asyncio.get_running_loop()
        return news

    def unsubscribe(self, news: asyncio.Event) -> None:
        """Stop setting an asyncio event of a subscriber."""
        with self._lock:
            self._subscribed.pop(news, None)

    def ring(self) -> None:
        """Wake all event loops that wait for events."""
        with self._lock:
            subscribed = list(self._subscribed.items())
        for news, loop in subscribed:
            # The loop may be closed: its subscriber is gone.
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(news.set)


_SHOWN = ("id", "spacecraft", "start", "end", "text", "who", "created")


def add_annotation(connection: Connection, row: Row) -> Annotation:
    """Store an annotation, and add an event."""
    connection.execute(insert(annotations), row)
    shown = _shown_annotation(row)
    _add_annotation_event(connection, shown, deleted=False)
    return shown


def list_annotations(
    connection: Connection,
    *,
    spacecraft: str | None,
    start: Utc | None,
    end: Utc | None,
    limit: int,
    cursor: str | None,
) -> Page[Annotation]:
    """List annotations that overlap the period from `start` to before `end`, newest first.

    Those of a spacecraft include those about every spacecraft.
    """
    chosen = []
    if spacecraft is not None:
        of_all = annotations.c.spacecraft.is_(None)
        chosen.append(or_(annotations.c.spacecraft == spacecraft, of_all))
    if start is not None:
        chosen.append(annotations.c.end_ns >= start.tai_ns)
    if end is not None:
        chosen.append(annotations.c.start_ns < end.tai_ns)
    if cursor is not None:
        if not is_ulid(cursor):
            raise BadBatch(Fault("cursor", "is not a cursor of this list", shown_value(cursor)))
        chosen.append(annotations.c.id < cursor)
    query = select(annotations).where(*chosen).order_by(annotations.c.id.desc()).limit(limit + 1)
    rows = [_shown_annotation(row) for row in connection.execute(query).mappings()]
    return Page(rows[:limit], rows[limit - 1].id if len(rows) > limit else None)


def read_annotation(connection: Connection, id: str) -> Annotation:
    """Return the annotation with an id; raises `NotFound`."""
    query = select(annotations).where(annotations.c.id == id)
    row = connection.execute(query).mappings().first()
    if row is None:
        raise NotFound(f"there is no annotation with the id {shown_value(id)}")
    return _shown_annotation(row)


def delete_annotation(connection: Connection, id: str) -> Annotation:
    """Delete an annotation, and add an event; raises `NotFound`."""
    found = read_annotation(connection, id)
    chain.note_removed(connection, annotations, [id])
    connection.execute(delete(annotations).where(annotations.c.id == id))
    _add_annotation_event(connection, found, deleted=True)
    return found


def _shown_annotation(row: Any) -> Annotation:
    return Annotation(**{name: row[name] for name in _SHOWN})


def _add_annotation_event(connection: Connection, shown: Annotation, *, deleted: bool) -> None:
    data = AnnotationChange(**msgspec.structs.asdict(shown), deleted=deleted)
    add_event(connection, "annotation", data, spacecraft=shown.spacecraft)


CHANNEL = "acquire_events"
WAIT_S = 0.5
"""Seconds between two checks whether the listening thread should end."""


class HeardEvents:
    """Thread that wakes this service when another one has recorded events on PostgreSQL.

    It listens on a connection of its own until it is closed.  A notification only says that the
    table of events is worth reading.  A service whose connection is cut still reads the table each
    second.
    """

    def __init__(self, url: URL, bell: Bell) -> None:
        """Start listening; the `bell` rings after commits with events, also this service's own."""
        self._url, self._bell = url, bell
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heard-events", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread that listens for events of other services."""
        self._closed.set()
        self._thread.join()

    def _run(self) -> None:
        import psycopg

        engine = create_engine(
            self._url,
            poolclass=NullPool,
            isolation_level="AUTOCOMMIT",
            # A connection that was cut cannot be reset.
            pool_reset_on_return=None,
        )
        while not self._closed.is_set():
            try:
                with engine.connect() as connection:
                    driver = connection.connection.driver_connection
                    assert isinstance(driver, psycopg.Connection)
                    driver.execute(f"LISTEN {CHANNEL}")
                    while not self._closed.is_set():
                        if list(driver.notifies(timeout=WAIT_S, stop_after=1)):
                            self._bell.ring()
            except (SQLAlchemyError, psycopg.Error) as error:
                log.info("events of other services are read each second: %s", error)
                self._closed.wait(1.0)
