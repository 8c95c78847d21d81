"""Database tables of webhooks, their deliveries, and the delivering process."""

import sqlalchemy as sa

from service.storage.sql.columns import (
    BOUND,
    HAS_FIRST_ROW,
    Bound,
    Id,
    Moment,
    Name,
    RunName,
    metadata,
)
from service.storage.sql.tables import access_tokens

_OF_DELIVERIES = frozenset(
    (
        *("previous_secret", "previous_until", "position", "missed", "gone_at", "held_until"),
        *("failing_since", "last_attempt", "last_delivered", "last_status", "last_fault"),
    )
)

webhooks = sa.Table(
    "webhooks",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("name", sa.String(64), nullable=False),
    sa.Column("url", sa.Text, nullable=False),
    # The filters; lists as JSON.  Null: no filter.
    sa.Column("kinds", sa.Text),
    sa.Column("spacecraft", sa.Text),
    sa.Column("severity", sa.String(16)),
    sa.Column("run", RunName),
    sa.Column("enabled", sa.Boolean, nullable=False),
    # The token that made or last changed it; null: access was open.
    sa.Column("token_id", Id, sa.ForeignKey(access_tokens.c.id)),
    sa.Column("who", sa.String(64), nullable=False),
    sa.Column("created", Moment, nullable=False),
    # Not a digest: a signature needs the secret itself.
    sa.Column("secret", sa.Text, nullable=False),
    sa.Column("previous_secret", sa.Text),
    sa.Column("previous_until", Moment),
    # The number of the last event that was queued or passed over.
    sa.Column("position", sa.BigInteger, nullable=False),
    sa.Column("missed", sa.BigInteger, nullable=False, server_default=sa.text("0")),
    sa.Column("gone_at", Moment),
    sa.Column("held_until", Moment),
    sa.Column("failing_since", Moment),
    sa.Column("last_attempt", Moment),
    sa.Column("last_delivered", Moment),
    sa.Column("last_status", sa.SmallInteger),
    sa.Column("last_fault", sa.Text),
    info={BOUND: Bound(_OF_DELIVERIES)},
)

webhook_deliveries = sa.Table(
    "webhook_deliveries",
    metadata,
    sa.Column("webhook_id", Id, sa.ForeignKey(webhooks.c.id), primary_key=True),
    sa.Column("event_id", sa.BigInteger, primary_key=True, autoincrement=False),
    sa.Column("message_id", sa.String(48), nullable=False),
    sa.Column("kind", sa.String(16), nullable=False),
    # Empty text: the event is about no spacecraft or about all of them.
    sa.Column("spacecraft", Name, nullable=False),
    sa.Column("body", sa.Text, nullable=False),
    # Repeated on request: new events of the spacecraft do not wait for it.
    sa.Column("again", sa.Boolean, nullable=False),
    sa.Column("dead", sa.Boolean, nullable=False),
    sa.Column("queued", Moment, nullable=False),
    sa.Column("due", Moment, nullable=False),
    sa.Column("attempts", sa.Integer, nullable=False),
    sa.Column("last_attempt", Moment),
    sa.Column("last_status", sa.SmallInteger),
    sa.Column("last_fault", sa.Text),
    sa.Index(
        "ix_webhook_deliveries_queue", "webhook_id", "dead", "again", "spacecraft", "event_id"
    ),
    info={BOUND: "what waits for receivers"},
)

webhook_sender = sa.Table(
    "webhook_sender",
    metadata,
    # One row: the process that delivers, and a number that it raises every few seconds.
    sa.Column("id", sa.SmallInteger, primary_key=True, autoincrement=False),
    sa.Column("holder", Id),
    sa.Column("beat", sa.BigInteger, nullable=False),
    info={HAS_FIRST_ROW: True, BOUND: "which process delivers"},
)
