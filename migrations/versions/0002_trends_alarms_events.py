"""Trends of every quantity, limits, alarms, events; which settings were in use when."""

from datetime import date

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0004"

MEASURED = (
    "residual_rms_arcsec",
    "predicted_rms_arcsec",
    "magnitude_offset_mag",
    "a_priori_angle_deg",
)
SHARES = ("ambiguous_share", "unmatched_share")
VALUES = (
    "residual_rms_arcsec",
    "predicted_rms_arcsec",
    "residual_ratio",
    "magnitude_offset_mag",
    "a_priori_angle_deg",
)
EXTREMES = [f"{name}_{end}" for end in ("min", "max") for name in (*SHARES, *VALUES)]
FILTERS = ["status", "unique", "ambiguous", "unmatched"]
CURRENT = {"sqlite_where": sa.text("current = 1"), "postgresql_where": sa.text("current")}
BY_SPACECRAFT = ["spacecraft", "run", "time_ns", "batch_id", *FILTERS]
MJD_ZERO = date(1858, 11, 17).toordinal()


def upgrade() -> None:
    op.add_column(
        "runs", sa.Column("alarms", sa.Boolean(), server_default=sa.false(), nullable=False)
    )
    _mission_uses()
    _measures()
    _rollups()
    _limits_and_alarms()
    _events()


def _mission_uses() -> None:
    op.create_table(
        "mission_uses",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("spacecraft", sa.String(length=128), nullable=False),
        sa.Column("digest", sa.String(length=80), nullable=False),
        sa.Column("since", sa.String(length=30), nullable=False),
        sa.ForeignKeyConstraint(
            ["digest"], ["missions.digest"], name=op.f("fk_mission_uses_digest_missions")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_mission_uses")),
    )
    op.create_index(
        op.f("ix_mission_uses_spacecraft"), "mission_uses", ["spacecraft"], unique=False
    )
    op.execute(
        "INSERT INTO mission_uses (spacecraft, digest, since) "
        "SELECT spacecraft, digest, first_used FROM missions ORDER BY first_used, digest"
    )


def _measures() -> None:
    for name in MEASURED:
        op.add_column("results", sa.Column(name, sa.Double(), nullable=True))
    op.execute(
        "UPDATE results SET residual_rms_arcsec = (SELECT s.residual_rms_arcsec FROM solutions s "
        "WHERE s.result_id = results.id), predicted_rms_arcsec = (SELECT s.predicted_rms_arcsec "
        "FROM solutions s WHERE s.result_id = results.id) WHERE status IS NOT NULL"
    )
    op.drop_index("ix_results_current_by_spacecraft", "results")
    op.create_index(
        "ix_results_current_by_spacecraft", "results", [*BY_SPACECRAFT, *MEASURED], **CURRENT
    )
    op.create_index(
        "ix_results_current_by_time",
        "results",
        ["time_ns", "batch_id", "spacecraft", *FILTERS],
        **CURRENT,
    )


def _rollups() -> None:
    for table in ("rollups_hourly", "rollups_daily"):
        for name in VALUES:
            for part, kind in (("n", sa.BigInteger()), ("sum", sa.Double())):
                column = sa.Column(
                    f"{name}_{part}", kind, server_default=sa.text("0"), nullable=False
                )
                op.add_column(table, column)
        for name in EXTREMES:
            op.add_column(table, sa.Column(name, sa.Double(), nullable=True))
        _fill(table)


def _fill(table: str) -> None:
    """What the results that are there tell: angles and magnitudes of old ones are not known."""
    stars = "CASE WHEN r.observed > 0 THEN 1.0 * r.{0} / r.observed END"
    of_a_batch = {
        "ambiguous_share": stars.format("ambiguous"),
        "unmatched_share": stars.format("unmatched"),
        "residual_rms_arcsec": "r.residual_rms_arcsec",
        "predicted_rms_arcsec": "r.predicted_rms_arcsec",
        "residual_ratio": "r.residual_rms_arcsec / NULLIF(r.predicted_rms_arcsec, 0)",
    }
    parts = {}
    for name, value in of_a_batch.items():
        parts |= {f"{name}_min": f"MIN({value})", f"{name}_max": f"MAX({value})"}
        if name not in SHARES:
            parts |= {f"{name}_n": f"COUNT({value})", f"{name}_sum": f"COALESCE(SUM({value}), 0)"}
    digits = 13 if table == "rollups_hourly" else 10
    found = op.get_bind().execute(
        sa.text(
            f"SELECT r.spacecraft, r.run, SUBSTR(b.time, 1, {digits}) AS moment, "
            + ", ".join(f"{sql} AS {name}" for name, sql in parts.items())
            + " FROM results r JOIN batches b ON b.id = r.batch_id WHERE r.current"
            f" GROUP BY r.spacecraft, r.run, SUBSTR(b.time, 1, {digits})"
        )
    )
    rows = [
        {f"new_{name}": row[name] for name in parts}
        | {"at_spacecraft": row["spacecraft"], "at_run": row["run"]}
        | {"at_bucket": _bucket(row["moment"])}
        for row in found.mappings()
    ]
    if rows:
        op.get_bind().execute(
            sa.text(
                f"UPDATE {table} SET "
                + ", ".join(f"{name} = :new_{name}" for name in parts)
                + " WHERE spacecraft = :at_spacecraft AND run = :at_run AND bucket = :at_bucket"
            ),
            rows,
        )


def _bucket(moment: str) -> int:
    """The number of the UTC day, or of the hour where the text names one, from MJD 0."""
    days = date.fromisoformat(moment[:10]).toordinal() - MJD_ZERO
    return days * 24 + int(moment[11:13]) if len(moment) > 10 else days


def _limits_and_alarms() -> None:
    op.create_table(
        "limits",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("spacecraft", sa.String(length=128), nullable=False),
        sa.Column("quantity", sa.String(length=32), nullable=False),
        sa.Column("settings", sa.Text(), nullable=True),
        sa.Column("who", sa.String(length=64), nullable=False),
        sa.Column("comment", sa.Text(), nullable=True),
        sa.Column("since", sa.String(length=30), nullable=False),
        sa.Column("until", sa.String(length=30), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_limits")),
    )
    still_open = sa.text("until IS NULL")
    op.create_index(
        "uq_limits_open",
        "limits",
        ["spacecraft", "quantity"],
        unique=True,
        sqlite_where=still_open,
        postgresql_where=still_open,
    )
    op.create_index("ix_limits_history", "limits", ["spacecraft", "quantity", "id"])
    op.create_table(
        "watches",
        sa.Column("spacecraft", sa.String(length=128), nullable=False),
        sa.Column("run", sa.String(length=64), nullable=False),
        sa.Column("time", sa.String(length=30), nullable=False),
        sa.Column("time_ns", sa.BigInteger(), nullable=False),
        sa.Column("batch_id", sa.String(length=26), nullable=False),
        sa.Column("received", sa.String(length=30), nullable=False),
        sa.Column("state", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("spacecraft", "run", name=op.f("pk_watches")),
    )
    points = [
        sa.Column(f"{which}_{name}", kind, nullable=name == "batch_id")
        for which in ("raised", "worst", "latest")
        for name, kind in (
            ("value", sa.Double()),
            ("time", sa.String(length=30)),
            ("batch_id", sa.String(length=26)),
        )
    ]
    op.create_table(
        "alarms",
        sa.Column("id", sa.String(length=26), nullable=False),
        sa.Column("spacecraft", sa.String(length=128), nullable=False),
        sa.Column("run", sa.String(length=64), nullable=False),
        sa.Column("quantity", sa.String(length=32), nullable=False),
        sa.Column("severity", sa.String(length=16), nullable=False),
        sa.Column("current_severity", sa.String(length=16), nullable=True),
        sa.Column("raised_at", sa.String(length=30), nullable=False),
        sa.Column("bound", sa.Double(), nullable=False),
        *points,
        sa.Column("returned_at", sa.String(length=30), nullable=True),
        sa.Column("acknowledged_at", sa.String(length=30), nullable=True),
        sa.Column("acknowledged_by", sa.String(length=64), nullable=True),
        sa.Column("shelved_at", sa.String(length=30), nullable=True),
        sa.Column("shelved_by", sa.String(length=64), nullable=True),
        sa.Column("shelved_until", sa.String(length=30), nullable=True),
        sa.Column("cleared_at", sa.String(length=30), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_alarms")),
    )
    active = sa.text("cleared_at IS NULL")
    op.create_index(
        "uq_alarms_active",
        "alarms",
        ["run", "spacecraft", "quantity"],
        unique=True,
        sqlite_where=active,
        postgresql_where=active,
    )
    op.create_index("ix_alarms_run", "alarms", ["run", "id"])
    op.create_table(
        "alarm_actions",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("alarm_id", sa.String(length=26), nullable=False),
        sa.Column("at", sa.String(length=30), nullable=False),
        sa.Column("action", sa.String(length=16), nullable=False),
        sa.Column("who", sa.String(length=64), nullable=True),
        sa.Column("comment", sa.Text(), nullable=True),
        sa.Column("severity", sa.String(length=16), nullable=True),
        sa.Column("value", sa.Double(), nullable=True),
        sa.Column("time", sa.String(length=30), nullable=True),
        sa.ForeignKeyConstraint(
            ["alarm_id"], ["alarms.id"], name=op.f("fk_alarm_actions_alarm_id_alarms")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_alarm_actions")),
    )
    op.create_index(op.f("ix_alarm_actions_alarm_id"), "alarm_actions", ["alarm_id"])


def _events() -> None:
    op.create_table(
        "events",
        sa.Column("id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("run", sa.String(length=64), nullable=True),
        sa.Column("spacecraft", sa.String(length=128), nullable=True),
        sa.Column("data", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_events")),
    )
    op.create_table(
        "event_counter",
        sa.Column("id", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("last", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_event_counter")),
    )
    op.execute("INSERT INTO event_counter (id, last) VALUES (1, 0)")


def downgrade() -> None:
    for table in ("event_counter", "events", "alarm_actions", "alarms", "watches", "limits"):
        op.drop_table(table)
    for table in ("rollups_daily", "rollups_hourly"):
        with op.batch_alter_table(table) as changed:
            for name in (*EXTREMES, *(f"{v}_{part}" for v in VALUES for part in ("n", "sum"))):
                changed.drop_column(name)
    op.drop_index("ix_results_current_by_time", "results")
    op.drop_index("ix_results_current_by_spacecraft", "results")
    for name in MEASURED:
        op.drop_column("results", name)
    op.create_index("ix_results_current_by_spacecraft", "results", BY_SPACECRAFT, **CURRENT)
    op.drop_table("mission_uses")
    op.drop_column("runs", "alarms")
