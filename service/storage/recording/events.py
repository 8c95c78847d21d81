"""Recent events in order of commit, for clients that reconnect.

An event is noted in the transaction of the change that it reports.  Its number
comes from one row whose lock is held until the commit: in no process does an
event become visible after one with a higher number, and no number is left out.
"""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, get_args

import msgspec
from sqlalchemy import Connection, delete, func, select

from service.storage.sql.columns import Row
from service.storage.sql.heard_events import CHANNEL
from service.storage.sql.statements import execute, insert_all
from service.storage.sql.tables import event_counter, events
from service.times import Utc, utc_now

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
]
EVENT_KINDS: tuple[EventKind, ...] = get_args(EventKind)
KEPT = 20_000
"""Events that are kept; a client that missed more starts anew."""
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
    """None: an earlier version recorded it."""

    def concerns(self, run: str | None, spacecraft: Collection[str] | None) -> bool:
        """Whether the event passes a filter by run and spacecraft; None: every one passes.

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
    """Add an event to the transaction; it gets its number at the end of the transaction."""
    text = msgspec.json.encode(data).decode()
    row = {"kind": kind, "run": run, "spacecraft": spacecraft, "data": text}
    connection.info.setdefault(_OUTBOX, []).append(row)


@contextmanager
def numbered(connection: Connection) -> Iterator[None]:
    """Number the events of a transaction when everything else in it is done.

    The later the lock on the numbers is taken, the less others wait for it.
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
    if connection.dialect.name == "postgresql":
        # Other services wake at the commit, and read the table.
        execute(connection, f"SELECT pg_notify('{CHANNEL}', '')")
    if first // PRUNED_EVERY != (last + 1) // PRUNED_EVERY:
        connection.execute(delete(events).where(events.c.id <= last - KEPT))


def undone(connection: Connection, length: int) -> None:
    """Drop the events noted since the outbox had that length: their changes were rolled back."""
    del connection.info.get(_OUTBOX, [])[length:]


def noted(connection: Connection) -> int:
    """How many events wait for their numbers."""
    return len(connection.info.get(_OUTBOX, []))


def last_event(connection: Connection) -> int:
    """The number of the latest event; zero before the first."""
    return int(connection.execute(select(event_counter.c.last)).scalar_one())


def last_event_about(connection: Connection, spacecraft: Collection[str]) -> int:
    """The number of the latest event about one of these; none before those that are kept."""
    found = select(func.max(events.c.id)).where(events.c.spacecraft.in_(spacecraft))
    return max(connection.scalar(found) or 0, (first_event(connection) or 1) - 1)


def events_after(connection: Connection, last: int, limit: int) -> Sequence[Event] | None:
    """The events after a number, oldest first; None if some of them are no longer kept.

    None too for a number that was never assigned: it is another database's.
    """
    query = select(events).where(events.c.id > last).order_by(events.c.id).limit(limit)
    found = [_event(row) for row in connection.execute(query).mappings()]
    if found:
        return found if found[0].id == last + 1 else None
    return [] if last_event(connection) == last else None


def first_event(connection: Connection) -> int | None:
    """The number of the oldest event that is kept."""
    first: int | None = connection.scalar(select(func.min(events.c.id)))
    return first


def events_between(connection: Connection, since: Utc, until: Utc) -> Sequence[Event]:
    """The kept events that were recorded from `since` to before `until`, oldest first."""
    recorded = events.c.at >= since.text, events.c.at < until.text
    query = select(events).where(*recorded).order_by(events.c.id)
    return [_event(row) for row in connection.execute(query).mappings()]


def _event(row: Any) -> Event:
    return Event(**row)
