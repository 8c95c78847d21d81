"""Webhooks and their deliveries as records; the registered ones written and read."""

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import Field
from sqlalchemy import Connection, case, delete, func, insert, select, update

from service.errors import NotFound, shown_value
from service.storage.models.alarms import SeverityName
from service.storage.models.base import Count, Id, Record, Stamp, doc, list_record, page_record
from service.storage.recording.events import EventKind
from service.storage.sql.access_tables import access_tokens, webhook_deliveries, webhooks
from service.storage.sql.columns import Row

_SHOWN = (
    "id",
    "name",
    "url",
    "severity",
    "run",
    "enabled",
    "who",
    "created",
    "missed",
    "failing_since",
    "last_attempt",
    "last_delivered",
    "last_status",
    "last_fault",
)


WebhookStateName = Literal["active", "paused", "disabled"]
DeliveryStateName = Literal["waiting", "dead"]
HttpStatus = Annotated[int | None, Field(ge=100, le=999), doc("null: there was no answer.")]
Fault = Annotated[str | None, doc("null: it succeeded, or was not tried yet.")]


class Webhook(Record, frozen=True, kw_only=True):
    """A receiver of events, and how its deliveries go."""

    id: Id
    name: str
    url: str
    kinds: Annotated[list[EventKind] | None, doc("Only events of these kinds; null: of all.")]
    spacecraft: Annotated[list[str] | None, doc("Only events about these; null: about all.")]
    severity: Annotated[
        SeverityName | None, doc("Of alarms only those that were at least as severe.")
    ]
    run: Annotated[str | None, doc("Only events of this run; null: of every run.")]
    enabled: bool
    state: WebhookStateName
    reason: Annotated[str | None, doc("Why nothing is sent; null: it is active.")]
    who: Annotated[str, doc("The token that made or last changed it: what it may read is sent.")]
    created: Stamp
    waiting: Annotated[Count, doc("Events that are queued.")]
    oldest: Annotated[Stamp | None, doc("When the oldest of them was queued.")]
    dead: Annotated[Count, doc("Dead letters: events that were not delivered within a day.")]
    missed: Annotated[
        Count, doc("Events that were no longer kept when their turn to be queued came.")
    ]
    failing_since: Annotated[Stamp | None, doc("null: the last delivery succeeded.")]
    last_attempt: Stamp | None
    last_delivered: Stamp | None
    last_status: HttpStatus
    last_fault: Fault
    previous_until: Annotated[
        Stamp | None, doc("Until then every delivery has a signature by the previous secret too.")
    ]


class WebhookWithSecret(Webhook, frozen=True, kw_only=True):
    """A webhook with the secret that signs its deliveries: it is shown this once."""

    secret: Annotated[str, Field(pattern=r"^whsec_[A-Za-z0-9+/]+=*$")]


WebhookList = list_record("WebhookList", Webhook, "All webhooks, the oldest first.")


class WebhookDelivery(Record, frozen=True, kw_only=True):
    """An event that waits to be delivered, or a dead letter."""

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
    """How many events were queued."""

    queued: Count


class WebhookTest(Record, frozen=True, kw_only=True):
    """The outcome of a test event."""

    delivered: bool
    message_id: str
    status: HttpStatus
    fault: Fault
    duration_ms: float


@dataclass(frozen=True)
class Registered:
    """A webhook as it is stored, with its secrets, which its text leaves out."""

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
        """The secrets that sign at a time: the present one, then the one before it."""
        if self.previous_secret is None or self.previous_until is None:
            return [self.secret]
        return [self.secret] + [self.previous_secret] * (now < self.previous_until)


def add_webhook(connection: Connection, row: Row) -> None:
    """Store a webhook."""
    connection.execute(insert(webhooks).values(_stored(row)))


def change_webhook(connection: Connection, id: str, changes: Row) -> None:
    """Change a webhook; raises `NotFound`."""
    changed = connection.execute(
        update(webhooks).where(webhooks.c.id == id).values(_stored(changes))
    )
    if not changed.rowcount:
        raise _unknown(id)


def delete_webhook(connection: Connection, id: str) -> None:
    """Delete a webhook with its deliveries; raises `NotFound`."""
    connection.execute(delete(webhook_deliveries).where(webhook_deliveries.c.webhook_id == id))
    if not connection.execute(delete(webhooks).where(webhooks.c.id == id)).rowcount:
        raise _unknown(id)


def count_webhooks(connection: Connection) -> int:
    """How many webhooks there are."""
    return int(connection.scalar(select(func.count()).select_from(webhooks)) or 0)


def list_webhooks(
    connection: Connection, now: str, is_open: bool, id: str | None = None
) -> list[Webhook]:
    """Every webhook, or one, as the API shows it; the oldest first.

    `is_open`: whether access is open, so that a webhook needs no token.
    """
    of_each = {row["webhook_id"]: row for row in connection.execute(_counts()).mappings()}
    return [
        _shown(row, of_each.get(row["id"], {}), now, is_open)
        for row in connection.execute(_with_token(id)).mappings()
    ]


def read_webhook(connection: Connection, id: str, now: str, is_open: bool) -> Webhook:
    """One webhook as the API shows it; raises `NotFound`."""
    for found in list_webhooks(connection, now, is_open, id):
        return found
    raise _unknown(id)


def registered_webhooks(
    connection: Connection, now: str, is_open: bool, id: str | None = None
) -> Sequence[Registered]:
    """Every webhook, or one, as it is sent to."""
    return [
        _registered(row, now, is_open) for row in connection.execute(_with_token(id)).mappings()
    ]


def registered_webhook(connection: Connection, id: str, now: str, is_open: bool) -> Registered:
    """One webhook as it is sent to; raises `NotFound`."""
    for found in registered_webhooks(connection, now, is_open, id):
        return found
    raise _unknown(id)


def _with_token(id: str | None) -> Any:
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
    return query if id is None else query.where(webhooks.c.id == id)


def _counts() -> Any:
    row = webhook_deliveries.c
    waits = ~row.dead
    return select(
        row.webhook_id,
        func.sum(case((waits, 1), else_=0)).label("waiting"),
        func.sum(case((row.dead, 1), else_=0)).label("dead"),
        func.min(case((waits, row.queued), else_=None)).label("oldest"),
    ).group_by(row.webhook_id)


def _state(row: Any, now: str, is_open: bool) -> tuple[WebhookStateName, str | None]:
    """The state of a webhook, and the reason where nothing is sent."""
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


def _shown(row: Any, counted: Any, now: str, is_open: bool) -> Webhook:
    state, reason = _state(row, now, is_open)
    until = row["previous_until"]
    return Webhook(
        **{name: row[name] for name in _SHOWN},
        kinds=_listed(row["kinds"]),
        spacecraft=_listed(row["spacecraft"]),
        state=state,
        reason=reason,
        previous_until=until if until is not None and until > now else None,
        waiting=int(counted.get("waiting", 0)),
        dead=int(counted.get("dead", 0)),
        oldest=counted.get("oldest"),
    )


def _registered(row: Any, now: str, is_open: bool) -> Registered:
    state, reason = _state(row, now, is_open)
    return Registered(
        id=row["id"],
        name=row["name"],
        url=row["url"],
        kinds=_listed(row["kinds"]),
        spacecraft=_listed(row["spacecraft"]),
        severity=row["severity"],
        run=row["run"],
        secret=row["secret"],
        previous_secret=row["previous_secret"],
        previous_until=row["previous_until"],
        position=row["position"],
        held_until=row["held_until"],
        state=state,
        reason=reason,
    )


def _stored(row: Row) -> Row:
    lists = {name: row[name] for name in ("kinds", "spacecraft") if row.get(name) is not None}
    return row | {name: json.dumps(sorted(set(value))) for name, value in lists.items()}


def _listed(text: str | None) -> list[Any] | None:
    return None if text is None else list(json.loads(text))


def _unknown(id: str) -> NotFound:
    return NotFound(f"there is no webhook with the id {shown_value(id)}")
