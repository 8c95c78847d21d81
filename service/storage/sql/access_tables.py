"""The tables of access: tokens, sessions, and the audit list."""

from sqlalchemy import Column, Double, ForeignKey, SmallInteger, String, Table, Text

from service.storage.sql.columns import Id, Moment, metadata

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
