"""Service for webhooks: registration, changes, tests, retries and replays."""

from collections.abc import Sequence

from sqlalchemy import Connection

from service.access import Access, Caller, Entry
from service.app.context import Context, known_id
from service.app.factory import App
from service.contract.base import Page
from service.errors import WrongState
from service.features.webhooks import records as webhooks
from service.features.webhooks.addresses import require_http_allowed, require_url
from service.features.webhooks.messages import delivery_row, new_webhook_secret, wants
from service.features.webhooks.records import (
    Webhook,
    WebhookDelivery,
    WebhookQueued,
    WebhookTest,
    WebhookWithSecret,
)
from service.features.webhooks.sender import WebhookSender
from service.ingest.solver_pool import mission_in_input
from service.settings import networks
from service.storage.recording.events import events_between, last_event
from service.storage.recording.ids import Ulids
from service.storage.sql.columns import Row
from service.times import HOUR_S, Utc, shifted, utc_now

MAX_WEBHOOKS = 50


class Webhooks:
    """Reads and changes webhooks, and delivers events to them.

    `entry` is the audit entry written with a change.
    """

    def __init__(self, context: Context, access: Access) -> None:
        self._context = context
        self._access = access
        self._ids = Ulids()
        self._allowed = networks(context.settings.webhook_networks)
        self.sender = WebhookSender(context.store, self._allowed, lambda: access.is_open)

    def close(self) -> None:
        """Stop the delivery of events."""
        self.sender.stop()

    def all(self) -> list[Webhook]:
        """All webhooks, oldest first."""
        is_open = self._access.is_open
        with self._context.reading() as connection:
            return webhooks.list_webhooks(connection, utc_now().text, is_open)

    def get(self, id: str) -> Webhook:
        """The webhook with an id; raises `NotFound`."""
        is_open = self._access.is_open
        with self._context.reading() as connection:
            return webhooks.read_webhook(connection, _known(id), utc_now().text, is_open)

    def add(self, settings: Row, caller: Caller, entry: Entry | None = None) -> WebhookWithSecret:
        """Register a webhook, which receives events from now on.

        `settings` are name, url, kinds, spacecraft, severity, run and enabled.  Raises `BadInput`
        for a URL that must not be reached and for a spacecraft without a mission file, `WrongState`
        if there are too many webhooks.
        """
        self._require(settings)
        id, now, secret = self._ids.new(), utc_now().text, new_webhook_secret()
        is_open = self._access.is_open
        row = settings | _of(caller) | {"id": id, "created": now, "secret": secret}

        def change(connection: Connection) -> Webhook:
            if webhooks.count_webhooks(connection) >= MAX_WEBHOOKS:
                raise WrongState(f"there are {MAX_WEBHOOKS} webhooks already; delete one first")
            position = last_event(connection)
            webhooks.add_webhook(connection, row | {"position": position})
            return webhooks.read_webhook(connection, id, now, is_open)

        added = self._context.change_audited(change, entry)
        self.sender.changed()
        return _with_secret(added, secret)

    def change(self, id: str, settings: Row, caller: Caller, entry: Entry | None = None) -> Webhook:
        """Replace the settings of a webhook, with the read permissions of the caller from now on.

        A paused or disabled webhook continues with the next event of its queue.
        """
        known, now, is_open = _known(id), utc_now().text, self._access.is_open
        self._require(settings)
        changes = settings | _of(caller) | {"gone_at": None, "held_until": None}

        def change(connection: Connection) -> Webhook:
            webhooks.change_webhook(connection, known, changes)
            webhooks.resume(connection, known, now)
            return webhooks.read_webhook(connection, known, now, is_open)

        changed = self._context.change_audited(change, entry)
        self.sender.changed()
        return changed

    def delete(self, id: str, entry: Entry | None = None) -> Webhook:
        """Delete a webhook with its queued deliveries and dead letters."""
        known, now, is_open = _known(id), utc_now().text, self._access.is_open

        def change(connection: Connection) -> Webhook:
            found = webhooks.read_webhook(connection, known, now, is_open)
            webhooks.delete_webhook(connection, known)
            return found

        deleted = self._context.change_audited(change, entry)
        self.sender.changed()
        return deleted

    def rotate(self, id: str, hours: int, entry: Entry | None = None) -> WebhookWithSecret:
        """Create a new signing secret for a webhook; the previous one stays valid for `hours`.

        Raises `WrongState` while an earlier secret is still valid, except with 0 hours.
        """
        known, now, is_open = _known(id), utc_now(), self._access.is_open
        secret, until = new_webhook_secret(), shifted(now, hours * HOUR_S).text

        def change(connection: Connection) -> Webhook:
            before = webhooks.registered_webhook(connection, known, now.text, is_open)
            if hours and len(before.secrets(now.text)) > 1:
                raise WrongState(
                    f"the secret before the present one signs until {before.previous_until}: make "
                    "a new one after that, or with `previous_hours` 0, which ends both at once"
                )
            changes = {"secret": secret, "previous_secret": before.secret, "previous_until": until}
            webhooks.change_webhook(connection, known, changes)
            return webhooks.read_webhook(connection, known, now.text, is_open)

        rotated = self._context.change_audited(change, entry)
        self.sender.changed()
        return _with_secret(rotated, secret)

    def try_out(self, id: str) -> WebhookTest:
        """Send a test event at once, before any queued event, and return the outcome.

        Raises `WrongState` for a webhook that is not active.
        """
        is_open = self._access.is_open
        with self._context.reading() as connection:
            webhook = webhooks.registered_webhook(connection, _known(id), utc_now().text, is_open)
        if webhook.state != "active":
            raise WrongState(f"the webhook is {webhook.state}: {webhook.reason}")
        message_id, outcome = self.sender.try_out(webhook)
        return WebhookTest(
            delivered=outcome.delivered,
            message_id=message_id,
            status=outcome.status,
            fault=outcome.fault,
            duration_ms=round(1e3 * outcome.duration_s, 1),
        )

    def deliveries(
        self,
        id: str,
        dead: bool | None = None,
        limit: int = 100,
        cursor: str | None = None,
        *,
        oldest_first: bool = False,
    ) -> Page[WebhookDelivery]:
        """One page of a webhook's waiting deliveries, dead letters or both, latest first."""
        known, is_open = _known(id), self._access.is_open
        with self._context.reading() as connection:
            webhooks.read_webhook(connection, known, utc_now().text, is_open)
            return webhooks.list_deliveries(
                connection,
                known,
                dead=dead,
                limit=limit,
                cursor=cursor,
                oldest_first=oldest_first,
            )

    def retry(
        self, id: str, numbers: Sequence[int] | None, entry: Entry | None = None
    ) -> WebhookQueued:
        """Queue dead letters again, for some events or all.

        Raises `BadInput` for an event that is not a dead letter.
        """
        known, now, is_open = _known(id), utc_now().text, self._access.is_open

        def change(connection: Connection) -> int:
            webhooks.registered_webhook(connection, known, now, is_open)
            return webhooks.retry_dead(connection, known, numbers, now)

        return WebhookQueued(queued=self._context.change_audited(change, entry))

    def replay(
        self, id: str, since: Utc, until: Utc | None, entry: Entry | None = None
    ) -> WebhookQueued:
        """Queue stored events of a period again, if they pass the filters of the webhook."""
        known, now, is_open = _known(id), utc_now().text, self._access.is_open
        end = utc_now() if until is None else until
        # Read outside the writer, which other changes would wait for.
        with self._context.reading() as connection:
            webhook = webhooks.registered_webhook(connection, known, now, is_open)
            kept = events_between(connection, since, end)
        # Events that were not queued yet are delivered in any case.
        found = [each for each in kept if each.id <= webhook.position]
        wanted = [each for each in found if wants(webhook, each)]
        rows = [delivery_row(known, each, now, again=True) for each in wanted]

        def change(connection: Connection) -> int:
            webhooks.registered_webhook(connection, known, now, is_open)
            return webhooks.queue_again(connection, known, rows)

        return WebhookQueued(queued=self._context.change_audited(change, entry))

    def _require(self, settings: Row) -> None:
        require_url(settings["url"], self._allowed)
        require_http_allowed(settings["url"], self._allowed)
        for name in settings["spacecraft"] or ():
            mission_in_input(self._context.missions, name)


def _known(id: str) -> str:
    return known_id(id, "webhook")


def _of(caller: Caller) -> Row:
    return {"token_id": caller.token_id, "who": caller.name}


def _with_secret(webhook: Webhook, secret: str) -> WebhookWithSecret:
    fields = {name: getattr(webhook, name) for name in Webhook.__struct_fields__}
    return WebhookWithSecret(**fields, secret=secret)


def open_part(app: App) -> Webhooks:
    """Create the webhook service of an open app."""
    return Webhooks(app.context, app.access)
