"""Database tables of limits, of their evaluation, and of alarms."""

import sqlalchemy as sa

from service.storage.sql.columns import (
    BOUND,
    Bound,
    Id,
    Moment,
    Name,
    RunName,
    metadata,
    rows_where,
)

limits = sa.Table(
    "limits",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("spacecraft", Name, nullable=False),
    sa.Column("quantity", sa.String(32), nullable=False),
    # Empty text: the limit is for the spacecraft as a whole.
    sa.Column("tracker", Name, nullable=False, server_default=sa.text("''")),
    # JSON; null: the shipped limits apply again.
    sa.Column("settings", sa.Text),
    sa.Column("who", sa.String(64), nullable=False),
    sa.Column("comment", sa.Text),
    sa.Column("since", Moment, nullable=False),
    sa.Column("until", Moment),
    sa.Index(
        "uq_limits_open",
        *("spacecraft", "quantity", "tracker"),
        unique=True,
        **rows_where("until IS NULL"),
    ),
    sa.Index("ix_limits_history", "spacecraft", "quantity", "tracker", "id"),
    info={BOUND: Bound(closed_by="until")},
)

watches = sa.Table(
    "watches",
    metadata,
    sa.Column("spacecraft", Name, primary_key=True),
    sa.Column("run", RunName, primary_key=True),
    # The latest evaluated batch: its time, its id, and its time of arrival.
    sa.Column("time", Moment, nullable=False),
    sa.Column("time_ns", sa.BigInteger, nullable=False),
    sa.Column("batch_id", Id, nullable=False),
    sa.Column("received", Moment, nullable=False),
    # Values of the latest batches, and the time since when each quantity is out of limits.
    sa.Column("state", sa.Text, nullable=False),
    info={BOUND: "how far the evaluation of limits is"},
)

alarms = sa.Table(
    "alarms",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("spacecraft", Name, nullable=False),
    sa.Column("run", RunName, nullable=False),
    sa.Column("quantity", sa.String(32), nullable=False),
    # Empty text: the alarm is for the spacecraft as a whole.
    sa.Column("tracker", Name, nullable=False, server_default=sa.text("''")),
    # Worst severity so far, and present severity: null is back in limits.
    sa.Column("severity", sa.String(16), nullable=False),
    sa.Column("current_severity", sa.String(16)),
    sa.Column("raised_at", Moment, nullable=False),
    sa.Column("bound", sa.Double, nullable=False),
    *(
        sa.Column(f"{which}_{name}", kind, nullable=name == "batch_id")
        for which in ("raised", "worst", "latest")
        for name, kind in (("value", sa.Double), ("time", Moment), ("batch_id", Id))
    ),
    sa.Column("returned_at", Moment),
    sa.Column("acknowledged_at", Moment),
    sa.Column("acknowledged_by", sa.String(64)),
    sa.Column("shelved_at", Moment),
    sa.Column("shelved_by", sa.String(64)),
    sa.Column("shelved_until", Moment),
    sa.Column("cleared_at", Moment),
    sa.Index(
        "uq_alarms_active",
        *("run", "spacecraft", "quantity", "tracker"),
        unique=True,
        **rows_where("cleared_at IS NULL"),
    ),
    sa.Index("ix_alarms_run", "run", "id"),
    info={BOUND: "made again from results, limits and actions"},
)

alarm_actions = sa.Table(
    "alarm_actions",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("alarm_id", Id, sa.ForeignKey(alarms.c.id), nullable=False, index=True),
    sa.Column("at", Moment, nullable=False),
    sa.Column("action", sa.String(16), nullable=False),
    sa.Column("who", sa.String(64)),
    sa.Column("comment", sa.Text),
    sa.Column("severity", sa.String(16)),
    sa.Column("value", sa.Double),
    sa.Column("time", Moment),
    info={BOUND: Bound()},
)
