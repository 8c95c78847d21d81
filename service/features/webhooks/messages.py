"""Webhook messages: filters on events, message bodies and signatures, delivery outcomes."""

import base64
import hashlib
import hmac
import logging
import secrets
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec

from service.features.webhooks.records import Registered
from service.storage.recording.events import Event
from service.storage.sql.columns import Row
from service.trends.limits import Severity

log = logging.getLogger(__name__)

TEST_KIND = "test"
TOTAL_S = 10.0
"""Time limit of a delivery attempt in seconds, from name look-up to the end of the answer."""
GONE, TOO_MANY, UNAVAILABLE = 410, 429, 503


class _AlarmData(msgspec.Struct):
    """Fields of an alarm's data that webhook filters use."""

    severity: str


class _Message(msgspec.Struct):
    """Body of a webhook message: `type`, `timestamp` and `data` as in Standard Webhooks."""

    type: str
    timestamp: str
    event: int
    run: str | None
    spacecraft: str | None
    data: msgspec.Raw


@dataclass(frozen=True)
class Outcome:
    """Outcome of a delivery attempt: the HTTP status, or the fault that prevented an answer.

    `retry_after_s` is the delay that the receiver requested, in seconds.
    """

    status: int | None
    fault: str | None
    retry_after_s: float | None = None
    duration_s: float = 0.0

    @property
    def delivered(self) -> bool:
        """True if the receiver accepted the event."""
        return self.fault is None


def wants(webhook: Registered, event: Event) -> bool:
    """True if an event passes the filters of a webhook."""
    if webhook.kinds is not None and event.kind not in webhook.kinds:
        return False
    if not event.concerns(webhook.run, webhook.spacecraft):
        return False
    if event.kind != "alarm" or webhook.severity is None:
        return True
    severity = msgspec.json.decode(event.data, type=_AlarmData).severity
    return Severity[severity.upper()] >= Severity[webhook.severity.upper()]


def delivery_row(webhook_id: str, event: Event, now: str, *, again: bool = False) -> Row:
    """Database row of `webhook_deliveries` for an event."""
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
    """Message id of an event: the same for every webhook, attempt and replay.

    The event's number alone is not enough: after a database is restored from a backup, numbers are
    assigned again to other events.
    """
    digest = hashlib.sha256(f"{event.kind} {event.at} {event.data}".encode()).hexdigest()
    return f"evt_{event.id}_{digest[:16]}"


def message_body(event: Event, now: str) -> bytes:
    """Message body of an event; `now` replaces a time that was not recorded."""
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
    """Message id and body of a test event for a webhook."""
    body = {"type": TEST_KIND, "timestamp": now, "data": {"webhook": id}}
    digest = hashlib.sha256(f"{id} {now}".encode()).hexdigest()
    return f"test_{digest[:16]}", msgspec.json.encode(body)


PREFIX = "whsec_"


def new_webhook_secret() -> str:
    """Create a random signing secret, in the form shown to receivers."""
    return PREFIX + base64.b64encode(secrets.token_bytes(32)).decode()


def signed_headers(
    secrets: Sequence[str], message_id: str, unix_s: int, body: bytes
) -> dict[str, str]:
    """HTTP headers of a delivery attempt, with a signature by each secret."""
    signed = f"{message_id}.{unix_s}.".encode() + body
    return {
        "webhook-id": message_id,
        "webhook-timestamp": str(unix_s),
        "webhook-signature": " ".join(_signature(secret, signed) for secret in secrets),
    }


def _signature(secret: str, signed: bytes) -> str:
    key = base64.b64decode(secret.removeprefix(PREFIX))
    return "v1," + base64.b64encode(hmac.digest(key, signed, hashlib.sha256)).decode()


# Counts attempts by webhook, and logs where deliveries begin to fail, recover or stop.
#
# One line for each change: what fails for a day is tried hundreds of times.

Result = Literal["delivered", "failed", "dead"]
RESULTS: tuple[Result, ...] = ("delivered", "failed", "dead")


@dataclass
class _Failing:
    """Numbers of failed attempts and of dead letters since a webhook's last successful attempt."""

    failed: int = 0
    dead: int = 0


class DeliveryLog:
    """Counts delivery outcomes, and logs when deliveries to a webhook start to fail or recover."""

    def __init__(self) -> None:
        self.counts: Counter[tuple[str, str, Result]] = Counter()
        """Number of attempts by id and name of the webhook and by result."""
        self._failing: dict[str, _Failing] = {}
        self._states: dict[str, str] = {}

    def listed(self, webhooks: Iterable[Registered]) -> None:
        """Record the existing webhooks, and log changes of their state."""
        for webhook in webhooks:
            for result in RESULTS:
                self.counts[webhook.id, webhook.name, result] += 0
            before = self._states.get(webhook.id, "active")
            if webhook.state != before:
                if webhook.state == "active":
                    log.info("webhook %s: active again", webhook.name)
                else:
                    log.warning("webhook %s: %s: %s", webhook.name, webhook.state, webhook.reason)
            self._states[webhook.id] = webhook.state

    def delivered(self, webhook: Registered, events: int) -> None:
        """Count deliveries; after failures, log the recovery."""
        if not events:
            return
        self.counts[webhook.id, webhook.name, "delivered"] += events
        failing = self._failing.pop(webhook.id, None)
        if failing is not None:
            log.info(
                "webhook %s: delivers again after %d failed attempts; dead letters: %d",
                webhook.name,
                failing.failed + failing.dead,
                failing.dead,
            )

    def failed(self, webhook: Registered, event: int, fault: str | None, is_dead: bool) -> None:
        """Count a failed attempt; log the first failure, and the first dead letter."""
        self.counts[webhook.id, webhook.name, "dead" if is_dead else "failed"] += 1
        failing = self._failing.get(webhook.id)
        if failing is None:
            failing = self._failing[webhook.id] = _Failing()
            log.warning("webhook %s: event %d was not delivered: %s", webhook.name, event, fault)
        if is_dead:
            failing.dead += 1
            if failing.dead == 1:
                log.error("webhook %s: event %d is a dead letter: %s", webhook.name, event, fault)
        else:
            failing.failed += 1
