"""The tables of limits, alarms and annotations: what the service watches and what people note."""

from typing import Any

from sqlalchemy import (
    BigInteger,
    Column,
    Double,
    ForeignKey,
    Index,
    Integer,
    String,
    Table,
    Text,
    text,
)

from service.storage.sql.columns import Id, Moment, Name, RunName, metadata

limits = Table(
    "limits",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("spacecraft", Name, nullable=False),
    Column("quantity", String(32), nullable=False),
    # Empty: of the spacecraft as a whole.
    Column("tracker", Name, nullable=False, server_default=text("''")),
    # JSON; null: the shipped ones hold again.
    Column("settings", Text),
    Column("who", String(64), nullable=False),
    Column("comment", Text),
    Column("since", Moment, nullable=False),
    Column("until", Moment),
)
_OPEN_LIMIT: dict[str, Any] = {
    "sqlite_where": limits.c.until.is_(None),
    "postgresql_where": limits.c.until.is_(None),
}
_LIMITED = (limits.c.spacecraft, limits.c.quantity, limits.c.tracker)
Index("uq_limits_open", *_LIMITED, unique=True, **_OPEN_LIMIT)
Index("ix_limits_history", *_LIMITED, limits.c.id)

watches = Table(
    "watches",
    metadata,
    Column("spacecraft", Name, primary_key=True),
    Column("run", RunName, primary_key=True),
    # The latest batch looked at: its time, its id, and when it came.
    Column("time", Moment, nullable=False),
    Column("time_ns", BigInteger, nullable=False),
    Column("batch_id", Id, nullable=False),
    Column("received", Moment, nullable=False),
    # The latest batches' values, and since when each quantity is out of its limits.
    Column("state", Text, nullable=False),
)

alarms = Table(
    "alarms",
    metadata,
    Column("id", Id, primary_key=True),
    Column("spacecraft", Name, nullable=False),
    Column("run", RunName, nullable=False),
    Column("quantity", String(32), nullable=False),
    # Empty: of the spacecraft as a whole.
    Column("tracker", Name, nullable=False, server_default=text("''")),
    # The worst so far, and that of now: null is back in limits.
    Column("severity", String(16), nullable=False),
    Column("current_severity", String(16)),
    Column("raised_at", Moment, nullable=False),
    Column("bound", Double, nullable=False),
    *(
        Column(f"{which}_{name}", kind, nullable=name == "batch_id")
        for which in ("raised", "worst", "latest")
        for name, kind in (("value", Double), ("time", Moment), ("batch_id", Id))
    ),
    Column("returned_at", Moment),
    Column("acknowledged_at", Moment),
    Column("acknowledged_by", String(64)),
    Column("shelved_at", Moment),
    Column("shelved_by", String(64)),
    Column("shelved_until", Moment),
    Column("cleared_at", Moment),
)
_ACTIVE: dict[str, Any] = {
    "sqlite_where": alarms.c.cleared_at.is_(None),
    "postgresql_where": alarms.c.cleared_at.is_(None),
}
Index(
    "uq_alarms_active",
    alarms.c.run,
    alarms.c.spacecraft,
    alarms.c.quantity,
    alarms.c.tracker,
    unique=True,
    **_ACTIVE,
)
Index("ix_alarms_run", alarms.c.run, alarms.c.id)

alarm_actions = Table(
    "alarm_actions",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("alarm_id", Id, ForeignKey(alarms.c.id), nullable=False, index=True),
    Column("at", Moment, nullable=False),
    Column("action", String(16), nullable=False),
    Column("who", String(64)),
    Column("comment", Text),
    Column("severity", String(16)),
    Column("value", Double),
    Column("time", Moment),
)

annotations = Table(
    "annotations",
    metadata,
    Column("id", Id, primary_key=True),
    # Null: about every spacecraft.
    Column("spacecraft", Name),
    # In telemetry time, as a batch has it; without an end it is about a moment.
    Column("start", Moment, nullable=False),
    Column("start_ns", BigInteger, nullable=False),
    Column("end", Moment),
    Column("end_ns", BigInteger, nullable=False),
    Column("text", Text, nullable=False),
    Column("who", String(64), nullable=False),
    Column("created", Moment, nullable=False),
)
