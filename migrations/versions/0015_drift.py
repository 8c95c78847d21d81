"""Scale and alignment offsets of batches and trackers, and their rollups."""

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"

ADDED = ("scale_offset_ppm", "alignment_offset_arcsec")
ROLLUPS = ("rollups_hourly", "rollups_daily", "tracker_rollups_hourly", "tracker_rollups_daily")
BY_SPACECRAFT = (
    "spacecraft",
    "run",
    "time_ns",
    "batch_id",
    "status",
    "unique",
    "ambiguous",
    "unmatched",
    "residual_rms_arcsec",
    "predicted_rms_arcsec",
    "magnitude_offset_mag",
    "a_priori_angle_deg",
)
CURRENT = {"sqlite_where": sa.text("current = 1"), "postgresql_where": sa.text("current")}


def upgrade() -> None:
    for table in ("results", "tracker_values"):
        for name in ADDED:
            op.add_column(table, sa.Column(name, sa.Double(), nullable=True))
    for table in ROLLUPS:
        for name in ADDED:
            for part, kind in (("n", sa.BigInteger()), ("sum", sa.Double())):
                zero = {"server_default": sa.text("0"), "nullable": False}
                op.add_column(table, sa.Column(f"{name}_{part}", kind, **zero))
            for end in ("min", "max"):
                op.add_column(table, sa.Column(f"{name}_{end}", sa.Double(), nullable=True))
    _index((*BY_SPACECRAFT, *ADDED))


def downgrade() -> None:
    _index(BY_SPACECRAFT)
    for table in ROLLUPS:
        for name in ADDED:
            for part in ("n", "sum", "min", "max"):
                op.drop_column(table, f"{name}_{part}")
    for table in ("results", "tracker_values"):
        for name in ADDED:
            op.drop_column(table, name)


def _index(columns: tuple[str, ...]) -> None:
    """Make the index that trends are read from anew, with these columns."""
    op.drop_index("ix_results_current_by_spacecraft", "results")
    op.create_index("ix_results_current_by_spacecraft", "results", list(columns), **CURRENT)
