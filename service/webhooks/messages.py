"""Which events a webhook wants, the messages that they become, and their signatures."""

import base64
import hashlib
import hmac
import secrets
from collections.abc import Sequence

import msgspec

from service.alarms.limits import Severity
from service.storage.recording.events import Event
from service.storage.sql.columns import Row
from service.storage.webhooks.registered import Registered

TEST_KIND = "test"


class _AlarmData(msgspec.Struct):
    """The part of an alarm's data that a filter looks at."""

    severity: str


class _Message(msgspec.Struct):
    """The body of a message: `type`, `timestamp` and `data` as Standard Webhooks has them."""

    type: str
    timestamp: str
    event: int
    run: str | None
    spacecraft: str | None
    data: msgspec.Raw


def wants(webhook: Registered, event: Event) -> bool:
    """Whether an event passes the filters of a webhook."""
    if webhook.kinds is not None and event.kind not in webhook.kinds:
        return False
    if not event.concerns(webhook.run, webhook.spacecraft):
        return False
    if event.kind != "alarm" or webhook.severity is None:
        return True
    severity = msgspec.json.decode(event.data, type=_AlarmData).severity
    return Severity[severity.upper()] >= Severity[webhook.severity.upper()]


def delivery_row(webhook_id: str, event: Event, now: str, *, again: bool = False) -> Row:
    """An event as a row of `webhook_deliveries`."""
    return {
        "webhook_id": webhook_id,
        "event_id": event.id,
        "message_id": message_id(event),
        "kind": event.kind,
        "spacecraft": event.spacecraft or "",
        "body": message_body(event, now).decode(),
        "again": again,
        "dead": False,
        "queued": now,
        "due": now,
        "attempts": 0,
        "last_attempt": None,
        "last_status": None,
        "last_fault": None,
    }


def message_id(event: Event) -> str:
    """The id of an event for receivers: the same for every webhook, attempt and replay.

    The number alone is not enough: where a database is restored from a backup, numbers are
    assigned again to other events.
    """
    digest = hashlib.sha256(f"{event.kind} {event.at} {event.data}".encode()).hexdigest()
    return f"evt_{event.id}_{digest[:16]}"


def message_body(event: Event, now: str) -> bytes:
    """The body of an event's message; `now` stands in for a time that was not recorded."""
    return msgspec.json.encode(
        _Message(
            type=event.kind,
            timestamp=event.at or now,
            event=event.id,
            run=event.run,
            spacecraft=event.spacecraft,
            data=msgspec.Raw(event.data.encode()),
        )
    )


def test_message(id: str, now: str) -> tuple[str, bytes]:
    """The id and the body of a test event of a webhook."""
    body = {"type": TEST_KIND, "timestamp": now, "data": {"webhook": id}}
    digest = hashlib.sha256(f"{id} {now}".encode()).hexdigest()
    return f"test_{digest[:16]}", msgspec.json.encode(body)


PREFIX = "whsec_"
SECRET_BYTES = 32


def new_webhook_secret() -> str:
    """A new random secret, as receivers are given it."""
    return PREFIX + base64.b64encode(secrets.token_bytes(SECRET_BYTES)).decode()


def signed_headers(
    secrets: Sequence[str], message_id: str, unix_s: int, body: bytes
) -> dict[str, str]:
    """The headers of an attempt at a time, with a signature by each secret."""
    signed = f"{message_id}.{unix_s}.".encode() + body
    return {
        "webhook-id": message_id,
        "webhook-timestamp": str(unix_s),
        "webhook-signature": " ".join(_signature(secret, signed) for secret in secrets),
    }


def _signature(secret: str, signed: bytes) -> str:
    key = base64.b64decode(secret.removeprefix(PREFIX))
    return "v1," + base64.b64encode(hmac.digest(key, signed, hashlib.sha256)).decode()
