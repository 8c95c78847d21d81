"""Values, rollups, limits and alarms of each tracker, for spacecraft with several.

Batches that are there already are split by the service or by `acquire database
split-trackers`, some at a time: to read the answers of all of them here would keep
the service from starting for hours.
"""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"

COUNTS = ("batches", "observed", "unique", "ambiguous", "unmatched", "solved", "suspect")
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
ROLLUPS = ("tracker_rollups_hourly", "tracker_rollups_daily")
NAME = sa.String(length=128)
RUN_NAME = sa.String(length=64)
ID = sa.String(length=26)
NOT_CLEARED = sa.text("cleared_at IS NULL")
NOT_ENDED = sa.text("until IS NULL")


def upgrade() -> None:
    _values()
    for table in ROLLUPS:
        _rollup(table)
    _splits()
    for table in ("limits", "alarms"):
        column = sa.Column("tracker", NAME, server_default=sa.text("''"), nullable=False)
        op.add_column(table, column)
    _indexes(["tracker"])


def _values() -> None:
    op.create_table(
        "tracker_values",
        sa.Column("batch_id", ID, nullable=False),
        sa.Column("tracker", NAME, nullable=False),
        *(
            sa.Column(name, sa.Integer(), nullable=False)
            for name in ("observed", "unique", "ambiguous", "unmatched")
        ),
        sa.Column("status", sa.String(length=16), nullable=True),
        *(sa.Column(name, sa.Double(), nullable=True) for name in MEASURED),
        sa.ForeignKeyConstraint(
            ["batch_id"], ["batches.id"], name=op.f("fk_tracker_values_batch_id_batches")
        ),
        sa.PrimaryKeyConstraint("batch_id", "tracker", name=op.f("pk_tracker_values")),
        sqlite_with_rowid=False,
    )


def _rollup(table: str) -> None:
    zero = {"server_default": sa.text("0"), "nullable": False}
    op.create_table(
        table,
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN_NAME, nullable=False),
        sa.Column("tracker", NAME, nullable=False),
        sa.Column("bucket", sa.Integer(), autoincrement=False, nullable=False),
        *(sa.Column(name, sa.BigInteger(), nullable=False) for name in COUNTS),
        *(
            sa.Column(f"{name}_{part}", kind, **zero)
            for name in VALUES
            for part, kind in (("n", sa.BigInteger()), ("sum", sa.Double()))
        ),
        *(
            sa.Column(f"{name}_{end}", sa.Double(), nullable=True)
            for end in ("min", "max")
            for name in (*SHARES, *VALUES)
        ),
        sa.PrimaryKeyConstraint("spacecraft", "run", "tracker", "bucket", name=op.f(f"pk_{table}")),
        sqlite_with_rowid=False,
    )


def _splits() -> None:
    op.create_table(
        "tracker_splits",
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN_NAME, nullable=False),
        sa.Column("time_ns", sa.BigInteger(), nullable=True),
        sa.Column("batch_id", ID, nullable=True),
        sa.PrimaryKeyConstraint("spacecraft", "run", name=op.f("pk_tracker_splits")),
        sqlite_with_rowid=False,
    )
    op.execute(
        "INSERT INTO tracker_splits (spacecraft, run) "
        "SELECT DISTINCT spacecraft, run FROM rollups_daily"
    )


def _indexes(tracker: list[str]) -> None:
    """Make the indexes of limits and alarms anew, with these columns at the end of their keys."""
    for name, table in (
        ("uq_limits_open", "limits"),
        ("ix_limits_history", "limits"),
        ("uq_alarms_active", "alarms"),
    ):
        op.drop_index(name, table)
    limited = ["spacecraft", "quantity", *tracker]
    op.create_index(
        "uq_limits_open",
        "limits",
        limited,
        unique=True,
        sqlite_where=NOT_ENDED,
        postgresql_where=NOT_ENDED,
    )
    op.create_index("ix_limits_history", "limits", [*limited, "id"])
    op.create_index(
        "uq_alarms_active",
        "alarms",
        ["run", "spacecraft", "quantity", *tracker],
        unique=True,
        sqlite_where=NOT_CLEARED,
        postgresql_where=NOT_CLEARED,
    )


def downgrade() -> None:
    op.execute(
        "DELETE FROM alarm_actions WHERE alarm_id IN (SELECT id FROM alarms WHERE tracker <> '')"
    )
    for table in ("alarms", "limits"):
        op.execute(f"DELETE FROM {table} WHERE tracker <> ''")
    _indexes([])
    for table in ("limits", "alarms"):
        op.drop_column(table, "tracker")
    for table in ("tracker_splits", *ROLLUPS, "tracker_values"):
        op.drop_table(table)
