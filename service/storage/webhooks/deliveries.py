"""Deliveries to webhooks: queued, settled, dead-lettered, queued again, and by which process.

A row is one event for one webhook.  It is deleted when it is delivered; a dead
letter stays until it is sent again, or until there are too many after it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, case, delete, func, select, tuple_, update

from service.errors import BadBatch, BadInput, Fault, shown_value
from service.storage.models.base import Page
from service.storage.sql.access_tables import webhook_deliveries, webhook_sender, webhooks
from service.storage.sql.columns import Row
from service.storage.sql.statements import insert_missing
from service.storage.webhooks.registered import WebhookDelivery

DEAD_KEPT = 10_000
"""Dead letters of one webhook; of more the oldest are deleted."""

NUMBERS_AT_ONCE = 500
"""The numbers in one statement."""

_row = webhook_deliveries.c


@dataclass(frozen=True)
class Queue:
    """The deliveries of a webhook that wait for each other: of one spacecraft, in order.

    `spacecraft` is empty for events about none or about all.  `again`: those that
    were asked for again.
    """

    webhook_id: str
    again: bool
    spacecraft: str


@dataclass(frozen=True)
class Waiting:
    """A delivery, as it is sent."""

    event_id: int
    message_id: str
    body: str
    queued: str
    attempts: int


@dataclass(frozen=True)
class Attempt:
    """What came of attempts in one queue, at a time.

    `failed` is the delivery that failed, if one did; with `due` None it is dead.
    `held_until`: the receiver asked that nothing be sent before.  `gone`: it asked that
    nothing be sent again.
    """

    queue: Queue
    at: str
    delivered: Sequence[int]
    failed: Waiting | None = None
    due: str | None = None
    status: int | None = None
    fault: str | None = None
    held_until: str | None = None
    gone: bool = False


def queue_events(
    connection: Connection, id: str, *, before: int, after: int, missed: int, rows: Sequence[Row]
) -> bool:
    """Queue the events from the position `before` to `after` that a webhook wants.

    Returns False, with nothing changed, where the webhook is no longer at `before`:
    another process moved it on, or it was deleted.
    """
    moved = connection.execute(
        update(webhooks)
        .where(webhooks.c.id == id, webhooks.c.position == before)
        .values(position=after, missed=webhooks.c.missed + missed)
    )
    if not moved.rowcount:
        return False
    if rows:
        insert_missing(connection, webhook_deliveries, rows)
    return True


def queue_again(connection: Connection, id: str, rows: Sequence[Row]) -> int:
    """Queue events anew, dead letters too; those that wait stay where they are.

    Returns how many there are.
    """
    numbers = [row["event_id"] for row in rows]
    for first in range(0, len(numbers), NUMBERS_AT_ONCE):
        part = numbers[first : first + NUMBERS_AT_ONCE]
        of_part = _row.webhook_id == id, _row.event_id.in_(part), _row.dead
        connection.execute(delete(webhook_deliveries).where(*of_part))
    if rows:
        insert_missing(connection, webhook_deliveries, rows)
    return len(rows)


def retry_dead(connection: Connection, id: str, numbers: Sequence[int] | None, now: str) -> int:
    """Queue dead letters again, some or all; returns how many.

    Raises `BadInput` for a number of another event.
    """
    chosen = [_row.webhook_id == id, _row.dead]
    if numbers is not None:
        chosen.append(_row.event_id.in_(numbers))
        dead = set(connection.scalars(select(_row.event_id).where(*chosen)))
        if others := sorted(set(numbers) - dead):
            raise BadInput(Fault("events", "must be dead letters", shown_value(others)))
    values = {"dead": False, "again": True, "attempts": 0, "queued": now, "due": now}
    return int(
        connection.execute(update(webhook_deliveries).where(*chosen).values(values)).rowcount
    )


def resume(connection: Connection, id: str, now: str) -> None:
    """Let what waits be tried at once, and for a whole day from now."""
    connection.execute(
        update(webhook_deliveries)
        .where(_row.webhook_id == id, ~_row.dead)
        .values(queued=now, due=now)
    )


def count_waiting(connection: Connection) -> dict[str, int]:
    """How many deliveries wait, by webhook."""
    query = select(_row.webhook_id, func.count()).where(~_row.dead).group_by(_row.webhook_id)
    return {row[0]: row[1] for row in connection.execute(query)}


def heads(connection: Connection) -> list[tuple[Queue, str]]:
    """Every queue, and when its first delivery is due; the one that is due first comes first."""
    first = (
        select(_row.webhook_id, func.min(_row.event_id).label("event_id"))
        .where(~_row.dead)
        .group_by(_row.webhook_id, _row.again, _row.spacecraft)
        .subquery()
    )
    query = (
        select(_row.webhook_id, _row.again, _row.spacecraft, _row.due)
        .where(tuple_(_row.webhook_id, _row.event_id).in_(select(first)))
        .order_by(_row.due)
    )
    return [
        (Queue(row["webhook_id"], row["again"], row["spacecraft"]), row["due"])
        for row in connection.execute(query).mappings()
    ]


def next_of(connection: Connection, queue: Queue, limit: int) -> list[Waiting]:
    """The first deliveries of a queue, in order."""
    query = (
        select(_row.event_id, _row.message_id, _row.body, _row.queued, _row.attempts)
        .where(
            _row.webhook_id == queue.webhook_id,
            ~_row.dead,
            _row.again == queue.again,
            _row.spacecraft == queue.spacecraft,
        )
        .order_by(_row.event_id)
        .limit(limit)
    )
    return [Waiting(**row) for row in connection.execute(query).mappings()]


def settle(connection: Connection, attempt: Attempt) -> None:
    """Delete what was delivered, note what failed, and both at the webhook.

    A failure is not noted where the delivery was queued again, resumed or tried since.
    """
    of_webhook = _row.webhook_id == attempt.queue.webhook_id
    noted: Row = {"last_attempt": attempt.at, "last_status": attempt.status}
    if attempt.delivered:
        connection.execute(
            delete(webhook_deliveries).where(of_webhook, _row.event_id.in_(attempt.delivered))
        )
        noted |= {"last_delivered": attempt.at, "failing_since": None, "last_fault": None}
    if attempt.failed is not None and _note_failure(connection, attempt, attempt.failed):
        noted["last_fault"] = attempt.fault
        noted["failing_since"] = (
            attempt.at if attempt.delivered else func.coalesce(webhooks.c.failing_since, attempt.at)
        )
        if attempt.held_until is not None:
            is_longer = func.coalesce(webhooks.c.held_until, "") < attempt.held_until
            noted["held_until"] = case((is_longer, attempt.held_until), else_=webhooks.c.held_until)
        if attempt.gone:
            noted["gone_at"] = attempt.at
    webhook = webhooks.c.id == attempt.queue.webhook_id
    connection.execute(update(webhooks).where(webhook).values(noted))


def _note_failure(connection: Connection, attempt: Attempt, failed: Waiting) -> bool:
    """Note a failure; False where the delivery is no longer as it was when it was sent."""
    of_webhook = _row.webhook_id == attempt.queue.webhook_id
    is_dead = attempt.due is None
    values = {
        "attempts": failed.attempts + 1,
        "last_attempt": attempt.at,
        "last_status": attempt.status,
        "last_fault": attempt.fault,
        "dead": is_dead,
        "due": attempt.due or attempt.at,
    }
    is_same = _row.queued == failed.queued, _row.attempts == failed.attempts, ~_row.dead
    noted = connection.execute(
        update(webhook_deliveries)
        .where(of_webhook, _row.event_id == failed.event_id, *is_same)
        .values(values)
    ).rowcount
    if noted and is_dead:
        kept = (
            select(_row.event_id)
            .where(of_webhook, _row.dead)
            .order_by(_row.event_id.desc())
            .limit(1)
            .offset(DEAD_KEPT)
            .scalar_subquery()
        )
        connection.execute(
            delete(webhook_deliveries).where(of_webhook, _row.dead, _row.event_id <= kept)
        )
    return bool(noted)


def list_deliveries(
    connection: Connection,
    id: str,
    *,
    dead: bool | None,
    limit: int,
    cursor: str | None,
    oldest_first: bool = False,
) -> Page[WebhookDelivery]:
    """Deliveries of a webhook, the latest event first; a cursor is the last number shown."""
    query = select(webhook_deliveries).where(_row.webhook_id == id)
    if dead is not None:
        query = query.where(_row.dead if dead else ~_row.dead)
    if cursor is not None:
        if not (cursor.isascii() and cursor.isdigit() and len(cursor) < 19):
            raise BadBatch(Fault("cursor", "is not a cursor of this list", shown_value(cursor)))
        last = int(cursor)
        query = query.where(_row.event_id > last if oldest_first else _row.event_id < last)
    order = _row.event_id if oldest_first else _row.event_id.desc()
    query = query.order_by(order).limit(limit + 1)
    rows = [_shown(row) for row in connection.execute(query).mappings()]
    return Page(rows[:limit], str(rows[limit - 1].event) if len(rows) > limit else None)


def _shown(row: Any) -> WebhookDelivery:
    same = ("message_id", "kind", "queued", "due", "attempts", "last_attempt")
    return WebhookDelivery(
        **{name: row[name] for name in (*same, "last_status", "last_fault")},
        event=row["event_id"],
        spacecraft=row["spacecraft"] or None,
        state="dead" if row["dead"] else "waiting",
    )


# Which process delivers: one of those that share a database.
#
# The process that delivers raises a number every few seconds.  Another takes over where
# the number has stood still for a while by its own clock, so the clocks of two machines
# are never compared.


def read_sender(connection: Connection) -> tuple[str | None, int]:
    """The process that delivers, None for none, and its number."""
    found = connection.execute(select(webhook_sender.c.holder, webhook_sender.c.beat)).one()
    return found.holder, found.beat


def hold_sender(connection: Connection, holder: str | None, beat: int) -> bool:
    """Deliver from now on, or go on to; False where the number is no longer `beat`.

    With None as holder no process delivers any more.
    """
    taken = connection.execute(
        update(webhook_sender)
        .where(webhook_sender.c.beat == beat)
        .values(holder=holder, beat=beat + 1)
    )
    return bool(taken.rowcount)
