"""The tables of access (tokens, sessions, audit list) and of webhooks with their deliveries."""

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Double,
    ForeignKey,
    Index,
    Integer,
    SmallInteger,
    String,
    Table,
    Text,
    text,
)

from service.storage.sql.columns import Id, Moment, Name, RunName, metadata

access_tokens = Table(
    "access_tokens",
    metadata,
    Column("id", Id, primary_key=True),
    Column("name", String(64), nullable=False, unique=True),
    # Only the digest of a token is stored: a reader of the database cannot use it.
    Column("digest", String(64), nullable=False, unique=True),
    Column("scopes", Text, nullable=False),
    Column("spacecraft", Text),
    Column("rate_per_s", Double),
    Column("created", Moment, nullable=False),
    Column("expires", Moment, nullable=False),
    Column("revoked", Moment),
)

access_sessions = Table(
    "access_sessions",
    metadata,
    Column("digest", String(64), primary_key=True),
    Column("token_id", Id, ForeignKey(access_tokens.c.id), nullable=False),
    Column("created", Moment, nullable=False),
    Column("expires", Moment, nullable=False),
)

audit = Table(
    "audit",
    metadata,
    Column("id", Id, primary_key=True),
    Column("moment", Moment, nullable=False),
    Column("who", String(80), nullable=False),
    Column("action", String(64), nullable=False),
    Column("about", Text, nullable=False),
    Column("body", Text),
    Column("status", SmallInteger),
)


webhooks = Table(
    "webhooks",
    metadata,
    Column("id", Id, primary_key=True),
    Column("name", String(64), nullable=False),
    Column("url", Text, nullable=False),
    # The filters; lists as JSON.  Null: no filter.
    Column("kinds", Text),
    Column("spacecraft", Text),
    Column("severity", String(16)),
    Column("run", RunName),
    Column("enabled", Boolean, nullable=False),
    # The token that made or last changed it; null: access was open.
    Column("token_id", Id, ForeignKey(access_tokens.c.id)),
    Column("who", String(64), nullable=False),
    Column("created", Moment, nullable=False),
    # Not a digest: a signature needs the secret itself.
    Column("secret", Text, nullable=False),
    Column("previous_secret", Text),
    Column("previous_until", Moment),
    # The number of the last event that was queued or passed over.
    Column("position", BigInteger, nullable=False),
    Column("missed", BigInteger, nullable=False, server_default=text("0")),
    Column("gone_at", Moment),
    Column("held_until", Moment),
    Column("failing_since", Moment),
    Column("last_attempt", Moment),
    Column("last_delivered", Moment),
    Column("last_status", SmallInteger),
    Column("last_fault", Text),
)

webhook_deliveries = Table(
    "webhook_deliveries",
    metadata,
    Column("webhook_id", Id, ForeignKey(webhooks.c.id), primary_key=True),
    Column("event_id", BigInteger, primary_key=True, autoincrement=False),
    Column("message_id", String(48), nullable=False),
    Column("kind", String(16), nullable=False),
    # Empty: the event is about no spacecraft or about every one.
    Column("spacecraft", Name, nullable=False),
    Column("body", Text, nullable=False),
    # Asked for again: new events of the spacecraft do not wait for it.
    Column("again", Boolean, nullable=False),
    Column("dead", Boolean, nullable=False),
    Column("queued", Moment, nullable=False),
    Column("due", Moment, nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("last_attempt", Moment),
    Column("last_status", SmallInteger),
    Column("last_fault", Text),
)
Index(
    "ix_webhook_deliveries_queue",
    webhook_deliveries.c.webhook_id,
    webhook_deliveries.c.dead,
    webhook_deliveries.c.again,
    webhook_deliveries.c.spacecraft,
    webhook_deliveries.c.event_id,
)

webhook_sender = Table(
    "webhook_sender",
    metadata,
    # One row: the process that delivers, and a number that it raises every few seconds.
    Column("id", SmallInteger, primary_key=True, autoincrement=False),
    Column("holder", Id),
    Column("beat", BigInteger, nullable=False),
)
