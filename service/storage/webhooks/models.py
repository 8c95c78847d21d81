"""Webhooks, their deliveries, and the answers of their routes."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from service.storage.models.alarms import SeverityName
from service.storage.models.base import Count, Id, Record, Stamp, doc
from service.storage.recording.events import EventKind

WebhookStateName = Literal["active", "paused", "disabled"]
DeliveryStateName = Literal["waiting", "dead"]
HttpStatus = Annotated[int | None, Field(ge=100, le=999), doc("null: there was no answer.")]
Fault = Annotated[str | None, doc("null: it succeeded, or was not tried yet.")]


class Webhook(Record, frozen=True, kw_only=True):
    """A receiver of events, and how its deliveries go."""

    component: ClassVar[str] = "Webhook"
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

    component: ClassVar[str] = "WebhookWithSecret"
    secret: Annotated[str, Field(pattern=r"^whsec_[A-Za-z0-9+/]+=*$")]


class WebhookList(Record, frozen=True, kw_only=True):
    """All webhooks, the oldest first."""

    component: ClassVar[str] = "WebhookList"
    items: list[Webhook]


class WebhookDelivery(Record, frozen=True, kw_only=True):
    """An event that waits to be delivered, or a dead letter."""

    component: ClassVar[str] = "WebhookDelivery"
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


class WebhookDeliveryPage(Record, frozen=True, kw_only=True):
    """A page of deliveries."""

    component: ClassVar[str] = "WebhookDeliveryPage"
    items: list[WebhookDelivery]
    next_cursor: str | None


class WebhookQueued(Record, frozen=True, kw_only=True):
    """How many events were queued."""

    component: ClassVar[str] = "WebhookQueued"
    queued: Count


class WebhookTest(Record, frozen=True, kw_only=True):
    """The outcome of a test event."""

    component: ClassVar[str] = "WebhookTest"
    delivered: bool
    message_id: str
    status: HttpStatus
    fault: Fault
    duration_ms: float
