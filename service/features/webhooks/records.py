"""Database access for webhooks: registrations, queued deliveries, and the delivering process.

A delivery is a row: one event for one webhook.  Delivered rows are deleted; a dead letter stays
until it is queued again, or until there are too many later ones.
"""

import json
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Literal

from pydantic import Field
from sqlalchemy import Connection, case, delete, func, insert, select, tuple_, update

from service import errors
from service.contract.alarms import SeverityName
from service.contract.base import (
    Count,
    Id,
    Page,
    Record,
    Stamp,
    doc,
    list_record,
    page_record,
)
from service.errors import BadBatch, BadInput, NotFound, shown_value
from service.features.webhooks.tables import webhook_deliveries, webhook_sender, webhooks
from service.storage.recording import chain
from service.storage.recording.events import EventKind
from service.storage.sql.columns import Row
from service.storage.sql.statements import insert_missing
from service.storage.sql.tables import access_tokens

_row = webhook_deliveries.c
_SHOWN = (
    *("id", "name", "url", "severity", "run", "enabled", "who", "created", "missed"),
    *("failing_since", "last_attempt", "last_delivered", "last_status", "last_fault"),
    *("kinds", "spacecraft", "state", "reason"),
)


WebhookStateName = Literal["active", "paused", "disabled"]
DeliveryStateName = Literal["waiting", "dead"]
HttpStatus = Annotated[int | None, Field(ge=100, le=999), doc("null: there was no answer.")]
Fault = Annotated[str | None, doc("null: it succeeded, or was not tried yet.")]


class Webhook(Record, frozen=True, kw_only=True):
    """A webhook: a receiver of events, with the state of its deliveries."""

    id: Id
    name: str
    url: str
    kinds: Annotated[list[EventKind] | None, doc("Only events of these kinds; null: of all.")]
    spacecraft: Annotated[list[str] | None, doc("Only events about these; null: about all.")]
    severity: SeverityName | None
    """Least severity of alarms to send; null: every alarm."""
    run: Annotated[str | None, doc("Only events of this run; null: of every run.")]
    enabled: bool
    state: WebhookStateName
    reason: Annotated[str | None, doc("Why nothing is sent; null: it is active.")]
    who: Annotated[str, doc("The token that made or last changed it: what it may read is sent.")]
    created: Stamp
    waiting: Annotated[Count, doc("Events that are queued.")]
    oldest: Annotated[Stamp | None, doc("When the oldest of them was queued.")]
    dead: Annotated[Count, doc("Dead letters: events that were not delivered within a day.")]
    missed: Count
    """Number of events that were deleted before they could be queued for the webhook."""
    failing_since: Annotated[Stamp | None, doc("null: the last delivery succeeded.")]
    last_attempt: Stamp | None
    last_delivered: Stamp | None
    last_status: HttpStatus
    last_fault: Fault
    previous_until: Stamp | None
    """Time until which deliveries are also signed with the previous secret."""


class WebhookWithSecret(Webhook, frozen=True, kw_only=True):
    """A webhook with its signing secret, which is shown only once."""

    secret: Annotated[str, Field(pattern=r"^whsec_[A-Za-z0-9+/]+=*$")]


WebhookList = list_record("WebhookList", Webhook, "All webhooks, the oldest first.")


class WebhookDelivery(Record, frozen=True, kw_only=True):
    """An event that is queued for a webhook, or a dead letter."""

    event: Annotated[int, doc("The number of the event.")]
    message_id: Annotated[str, doc("The `webhook-id` of every attempt.")]
    kind: EventKind
    spacecraft: str | None
    state: DeliveryStateName
    queued: Stamp
    due: Annotated[Stamp, doc("The next attempt is made no earlier.")]
    attempts: Count
    last_attempt: Stamp | None
    last_status: HttpStatus
    last_fault: Fault


WebhookDeliveryPage = page_record("WebhookDeliveryPage", WebhookDelivery, "A page of deliveries.")


class WebhookQueued(Record, frozen=True, kw_only=True):
    """Number of events that were queued."""

    queued: Count


class WebhookTest(Record, frozen=True, kw_only=True):
    """Outcome of a test event sent to a webhook."""

    delivered: bool
    message_id: str
    status: HttpStatus
    fault: Fault
    duration_ms: float


@dataclass(frozen=True)
class Registered:
    """Stored webhook with its secrets, which are left out of its text."""

    id: str
    name: str
    url: str
    kinds: Collection[EventKind] | None
    spacecraft: Collection[str] | None
    severity: SeverityName | None
    run: str | None
    secret: str = field(repr=False)
    previous_secret: str | None = field(repr=False)
    previous_until: str | None
    position: int
    held_until: str | None
    state: WebhookStateName
    reason: str | None

    def secrets(self, now: str) -> list[str]:
        """Secrets that sign messages at a time: the present one, then the previous one if valid."""
        if self.previous_secret is None or self.previous_until is None:
            return [self.secret]
        return [self.secret] + [self.previous_secret] * (now < self.previous_until)


def add_webhook(connection: Connection, row: Row) -> None:
    """Insert a webhook into the database."""
    connection.execute(insert(webhooks).values(_stored(row)))


def change_webhook(connection: Connection, id: str, changes: Row) -> None:
    """Update a webhook in the database; raises `NotFound`."""
    changed = connection.execute(
        update(webhooks).where(webhooks.c.id == id).values(_stored(changes))
    )
    if not changed.rowcount:
        raise _unknown(id)
    chain.note_changed(connection, webhooks, id)


def delete_webhook(connection: Connection, id: str) -> None:
    """Delete a webhook with its deliveries; raises `NotFound`."""
    connection.execute(delete(webhook_deliveries).where(webhook_deliveries.c.webhook_id == id))
    if not connection.execute(delete(webhooks).where(webhooks.c.id == id)).rowcount:
        raise _unknown(id)
    chain.note_removed(connection, webhooks, [id])


def count_webhooks(connection: Connection) -> int:
    """Number of webhooks in the database."""
    return int(connection.scalar(select(func.count()).select_from(webhooks)) or 0)


def list_webhooks(
    connection: Connection, now: str, is_open: bool, id: str | None = None
) -> list[Webhook]:
    """API records of all webhooks or one, oldest first.

    `is_open`: True if access is open, so that a webhook needs no token.
    """
    of_each = {row["webhook_id"]: row for row in connection.execute(_counts()).mappings()}
    return [
        _shown_webhook(row, of_each.get(row["id"], {}), now)
        for row in _rows(connection, now, is_open, id)
    ]


def read_webhook(connection: Connection, id: str, now: str, is_open: bool) -> Webhook:
    """API record of one webhook; raises `NotFound`."""
    for found in list_webhooks(connection, now, is_open, id):
        return found
    raise _unknown(id)


def registered_webhooks(
    connection: Connection, now: str, is_open: bool, id: str | None = None
) -> Sequence[Registered]:
    """Stored webhooks with secrets, all or one, for delivery."""
    names = [each.name for each in fields(Registered)]
    rows = _rows(connection, now, is_open, id)
    return [Registered(**{name: row[name] for name in names}) for row in rows]


def registered_webhook(connection: Connection, id: str, now: str, is_open: bool) -> Registered:
    """Stored webhook with secrets, for delivery; raises `NotFound`."""
    for found in registered_webhooks(connection, now, is_open, id):
        return found
    raise _unknown(id)


def _rows(connection: Connection, now: str, is_open: bool, id: str | None) -> Iterator[Row]:
    """Database rows of webhooks with decoded lists, state and reason of the state."""
    tokens = access_tokens.c
    query = (
        select(
            webhooks,
            tokens.name.label("token_name"),
            tokens.expires.label("token_expires"),
            tokens.revoked.label("token_revoked"),
        )
        .outerjoin(access_tokens, tokens.id == webhooks.c.token_id)
        .order_by(webhooks.c.id)
    )
    if id is not None:
        query = query.where(webhooks.c.id == id)
    for row in connection.execute(query).mappings():
        lists = {name: row[name] and json.loads(row[name]) for name in ("kinds", "spacecraft")}
        state, reason = _state(row, now, is_open)
        yield {**row, **lists, "state": state, "reason": reason}


def _counts() -> Any:
    waits = ~_row.dead
    return select(
        _row.webhook_id,
        func.sum(case((waits, 1), else_=0)).label("waiting"),
        func.sum(case((_row.dead, 1), else_=0)).label("dead"),
        func.min(case((waits, _row.queued), else_=None)).label("oldest"),
    ).group_by(_row.webhook_id)


def _state(row: Any, now: str, is_open: bool) -> tuple[WebhookStateName, str | None]:
    """State of a webhook, and the reason if it receives nothing."""
    if row["gone_at"] is not None:
        return "disabled", f"the receiver answered 410 Gone at {row['gone_at']}"
    if not row["enabled"]:
        return "paused", "it was paused; change it with `enabled` true to go on"
    if row["token_id"] is None:
        if is_open:
            return "active", None
        return "paused", "it was made without a token; change it with a token to go on"
    if row["token_revoked"] is not None:
        return "paused", f"the token {row['token_name']!r} was revoked at {row['token_revoked']}"
    if row["token_expires"] <= now:
        return "paused", f"the token {row['token_name']!r} has expired at {row['token_expires']}"
    return "active", None


def _shown_webhook(row: Row, counted: Any, now: str) -> Webhook:
    until = row["previous_until"]
    return Webhook(
        **{name: row[name] for name in _SHOWN},
        previous_until=until if until is not None and until > now else None,
        waiting=int(counted.get("waiting", 0)),
        dead=int(counted.get("dead", 0)),
        oldest=counted.get("oldest"),
    )


def _stored(row: Row) -> Row:
    lists = {name: row[name] for name in ("kinds", "spacecraft") if row.get(name) is not None}
    return row | {name: json.dumps(sorted(set(value))) for name, value in lists.items()}


def _unknown(id: str) -> NotFound:
    return NotFound(f"there is no webhook with the id {shown_value(id)}")


# Deliveries: queued, settled, dead-lettered, queued again.

DEAD_KEPT = 10_000
"""Greatest number of dead letters kept for a webhook; older ones are deleted."""

NUMBERS_AT_ONCE = 500
"""Greatest number of event numbers in one SQL statement."""


@dataclass(frozen=True)
class Queue:
    """A queue of deliveries that must stay in order: one webhook, one spacecraft.

    `spacecraft` is empty for events about none or about all.  `again` marks retries and replays,
    which form a queue of their own.
    """

    webhook_id: str
    again: bool
    spacecraft: str


@dataclass(frozen=True)
class Waiting:
    """A queued delivery with its message body."""

    event_id: int
    message_id: str
    body: str
    queued: str
    attempts: int


@dataclass(frozen=True)
class Attempt:
    """Result of delivery attempts in one queue.

    `failed` is the delivery that failed, if any; with `due` None it becomes a dead letter.
    `held_until` is the time before which the receiver wants no messages.  `gone`: the receiver
    wants no messages ever again.
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
    """Queue the events that a webhook wants, from position `before` to `after`.

    Returns False, without changes, if the webhook is no longer at `before`: another process
    advanced it, or it was deleted.
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
    """Queue events again, dead letters included; waiting deliveries keep their place.

    Returns the number of events.
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
    """Queue dead letters again, some or all; returns their number.

    Raises `BadInput` for a number that is not a dead letter's.
    """
    chosen = [_row.webhook_id == id, _row.dead]
    if numbers is not None:
        chosen.append(_row.event_id.in_(numbers))
        dead = set(connection.scalars(select(_row.event_id).where(*chosen)))
        if others := sorted(set(numbers) - dead):
            raise BadInput(errors.Fault("events", "must be dead letters", shown_value(others)))
    values = {"dead": False, "again": True, "attempts": 0, "queued": now, "due": now}
    return int(
        connection.execute(update(webhook_deliveries).where(*chosen).values(values)).rowcount
    )


def resume(connection: Connection, id: str, now: str) -> None:
    """Make all waiting deliveries of a webhook due now, with a full day of retries."""
    connection.execute(
        update(webhook_deliveries)
        .where(_row.webhook_id == id, ~_row.dead)
        .values(queued=now, due=now)
    )


def count_waiting(connection: Connection) -> dict[str, int]:
    """Number of waiting deliveries by webhook id."""
    query = select(_row.webhook_id, func.count()).where(~_row.dead).group_by(_row.webhook_id)
    return {row[0]: row[1] for row in connection.execute(query)}


def heads(connection: Connection) -> list[tuple[Queue, str]]:
    """All queues with the due time of their first delivery, the earliest first."""
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
    """First deliveries of a queue, in order."""
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
    """Delete delivered rows, record a failure, and update the webhook's state.

    A failure is ignored if the delivery was queued again, resumed or tried since.
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
    """Record a failed delivery; False if the row has changed since the attempt began."""
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
    """One page of a webhook's deliveries, latest event first; the cursor is the last event."""
    query = select(webhook_deliveries).where(_row.webhook_id == id)
    if dead is not None:
        query = query.where(_row.dead if dead else ~_row.dead)
    if cursor is not None:
        if not (cursor.isascii() and cursor.isdigit() and len(cursor) < 19):
            raise BadBatch(
                errors.Fault("cursor", "is not a cursor of this list", shown_value(cursor))
            )
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


# Choice of the process that delivers, among processes that share a database.
#
# The delivering process raises a number every few seconds.  Another process takes over if the
# number has not changed for a while by its own clock, so clocks of two machines are never compared.


def read_sender(connection: Connection) -> tuple[str | None, int]:
    """Name of the delivering process, None for none, and its heartbeat number."""
    found = connection.execute(select(webhook_sender.c.holder, webhook_sender.c.beat)).one()
    return found.holder, found.beat


def hold_sender(connection: Connection, holder: str | None, beat: int) -> bool:
    """Claim, keep or release the role of the delivering process; False if the beat differs.

    With None as holder the role is released.
    """
    taken = connection.execute(
        update(webhook_sender)
        .where(webhook_sender.c.beat == beat)
        .values(holder=holder, beat=beat + 1)
    )
    return bool(taken.rowcount)
