"""API routes for webhooks, which send events to receivers."""

from typing import Annotated, Any, Literal, Self

from fastapi import Depends, Path
from pydantic import Field, StringConstraints, model_validator
from starlette.requests import Request
from starlette.responses import Response

from service.access import Caller
from service.contract.alarms import SeverityName
from service.features.webhooks import records
from service.features.webhooks.part import Webhooks
from service.missions.faults import VISIBLE_PATTERN
from service.observations.schema import Key, RunName, Wire
from service.storage.recording.events import EventKind
from service.web.openapi import LINK, LOCATION, ApiRouter, Returns
from service.web.requests.access import (
    OPERATE,
    AppDep,
    ChangeDep,
    json_response,
    page_response,
    require_scope,
)
from service.web.requests.query_parameters import Cursor, FromQuery, PageLimit, Query, Time
from service.web.requests.request_body import JsonBody, OptionalJsonBody, read_model

router = ApiRouter("webhooks")
ROUTERS = (router,)

WebhookId = Annotated[str, Path(description="The `id` of a webhook.")]
ALL = "*"


async def _webhooks(app: AppDep) -> Webhooks:
    return app.part(Webhooks)


WebhooksDep = Annotated[Webhooks, Depends(_webhooks)]


class WebhookIn(Wire):
    """Request body with the settings of a webhook."""

    name: Annotated[
        str,
        StringConstraints(strip_whitespace=True, min_length=1, max_length=64),
        Field(pattern=VISIBLE_PATTERN, description="For people and for metrics."),
    ]
    url: Annotated[
        str,
        Field(
            min_length=1,
            max_length=2_000,
            pattern=r"^[\x21-\x7e]+$",
            description="https://...; port 80, 443 or one from 1024 on.",
            examples=["https://receiver.example/acquire"],
        ),
    ]
    kinds: Annotated[
        list[EventKind] | None,
        Field(min_length=1, max_length=20, description="Only events of these kinds; null: all."),
    ] = None
    spacecraft: Annotated[
        list[Key] | None,
        Field(min_length=1, max_length=200, description="Only events about these; null: all."),
    ] = None
    severity: Annotated[
        SeverityName | None, Field(description="Of alarms only those that were at least as severe.")
    ] = None
    run: Annotated[
        RunName | Literal["*"],
        Field(description="Only events of this run, and those of none; `*`: of every run."),
    ] = "live"
    enabled: Annotated[bool, Field(description="false: it is paused.")] = True

    def settings(self) -> dict[str, Any]:
        """Settings of a webhook in the form of the database."""
        return self.model_dump() | {"run": None if self.run == ALL else self.run}


class SecretIn(Wire):
    """Request body for a new secret: hours for which the previous one stays valid."""

    previous_hours: Annotated[
        int, Field(ge=0, le=168, strict=True, description="0: it signs no more.")
    ] = 24


class RetryIn(Wire):
    """Request body that selects dead letters to send again."""

    events: Annotated[
        list[Annotated[int, Field(ge=1, lt=1 << 63, strict=True)]] | None,
        Field(min_length=1, max_length=500, description="Numbers of events; null: all."),
    ] = None


class ReplayEventsIn(Wire):
    """Request body that selects events to send again, by their time of recording."""

    since: Annotated[Time, Field(description="By the service's clock, included.")]
    until: Annotated[Time | None, Field(description="Excluded; null: now.")] = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.until is not None and self.until.tai_ns <= self.since.tai_ns:
            raise ValueError(f"until {self.until} must be after since {self.since}")
        return self


class DeliveryQuery(Query):
    """Query that selects deliveries of a webhook by state."""

    state: Annotated[
        Literal["waiting", "dead"] | None, Field(description="Only these; default: both.")
    ] = None
    order: Annotated[
        Literal["newest", "oldest"],
        Field(
            description="`oldest`: in the order of delivery, the one that others wait for first."
        ),
    ] = "newest"
    limit: PageLimit = 100
    cursor: Cursor = None


@router.serves("GET /webhooks", OPERATE, Returns("All webhooks.", records.WebhookList))
def list_webhooks(webhooks: WebhooksDep) -> Response:
    """All webhooks, with their state and last failure."""
    return json_response({"items": webhooks.all()})


@router.serves("GET /webhooks/{id}", OPERATE, Returns("The webhook.", records.Webhook))
def get_webhook(id: WebhookId, webhooks: WebhooksDep) -> Response:
    """One webhook with its state and last failure."""
    return json_response(webhooks.get(id))


@router.serves(
    "POST /webhooks",
    OPERATE,
    Returns(
        "The webhook, and its secret this once.", records.WebhookWithSecret, LOCATION, status=201
    ),
    body=WebhookIn,
    problems=(409,),
)
def add_webhook(body: JsonBody, webhooks: WebhooksDep, change: ChangeDep) -> Response:
    """Register a receiver for events, signed as in Standard Webhooks, from now on."""
    _require_reader(change.caller)
    asked = read_model(WebhookIn, body)
    added = webhooks.add(asked.settings(), change.caller, change.entry(201))
    return json_response(added, 201, {"Location": f"/api/v1/webhooks/{added.id}"})


@router.serves(
    "PUT /webhooks/{id}", OPERATE, Returns("The webhook.", records.Webhook), body=WebhookIn
)
def change_webhook(
    id: WebhookId, body: JsonBody, webhooks: WebhooksDep, change: ChangeDep
) -> Response:
    """Replace all settings of a webhook; if paused or disabled it continues where it stopped."""
    _require_reader(change.caller)
    asked = read_model(WebhookIn, body)
    return json_response(webhooks.change(id, asked.settings(), change.caller, change.entry()))


@router.serves(
    "DELETE /webhooks/{id}",
    OPERATE,
    Returns("The webhook that was deleted.", records.Webhook),
    problems=(503,),
)
def delete_webhook(id: WebhookId, webhooks: WebhooksDep, change: ChangeDep) -> Response:
    """Delete a webhook with its queue and its dead letters."""
    return json_response(webhooks.delete(id, change.entry()))


@router.serves(
    "POST /webhooks/{id}/secret",
    OPERATE,
    Returns("The webhook, and its new secret this once.", records.WebhookWithSecret),
    body=SecretIn,
    body_required=False,
    problems=(409,),
)
def rotate_webhook_secret(
    id: WebhookId, body: OptionalJsonBody, webhooks: WebhooksDep, change: ChangeDep
) -> Response:
    """Create a new signing secret; the previous one stays valid for some hours.

    A second time within these hours only with `previous_hours` 0, which ends both.
    """
    asked = read_model(SecretIn, body)
    return json_response(webhooks.rotate(id, asked.previous_hours, change.entry()))


@router.serves(
    "POST /webhooks/{id}/test",
    OPERATE,
    Returns("What came of the attempt.", records.WebhookTest),
    problems=(409, 503),
)
def test_webhook(id: WebhookId, webhooks: WebhooksDep) -> Response:
    """Send a webhook a test event at once, and wait for the receiver's answer."""
    return json_response(webhooks.try_out(id))


@router.serves(
    "GET /webhooks/{id}/deliveries",
    OPERATE,
    Returns("A page of deliveries.", records.WebhookDeliveryPage, LINK),
)
def list_webhook_deliveries(
    id: WebhookId, request: Request, query: FromQuery[DeliveryQuery], webhooks: WebhooksDep
) -> Response:
    """Queued events and dead letters of a webhook; by default the latest event first."""
    dead = None if query.state is None else query.state == "dead"
    page = webhooks.deliveries(
        id, dead, query.limit, query.cursor, oldest_first=query.order == "oldest"
    )
    return page_response(request, page)


@router.serves(
    "POST /webhooks/{id}/retry",
    OPERATE,
    Returns("How many were queued.", records.WebhookQueued),
    body=RetryIn,
    body_required=False,
)
def retry_dead_letters(
    id: WebhookId, body: OptionalJsonBody, webhooks: WebhooksDep, change: ChangeDep
) -> Response:
    """Queue dead letters again; new events of the spacecraft do not wait for them."""
    asked = read_model(RetryIn, body)
    return json_response(webhooks.retry(id, asked.events, change.entry()))


@router.serves(
    "POST /webhooks/{id}/replay",
    OPERATE,
    Returns("How many were queued.", records.WebhookQueued),
    body=ReplayEventsIn,
)
def replay_events(
    id: WebhookId, body: JsonBody, webhooks: WebhooksDep, change: ChangeDep
) -> Response:
    """Queue stored events of a period again, with their original message ids."""
    asked = read_model(ReplayEventsIn, body)
    return json_response(webhooks.replay(id, asked.since, asked.until, change.entry()))


def _require_reader(caller: Caller) -> None:
    """Raise `Forbidden` unless the caller may read the events sent to the webhook."""
    require_scope(caller, "read")
