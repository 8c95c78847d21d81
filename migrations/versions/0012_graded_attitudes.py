"""Filtered and smoothed attitudes: a row a day, and its samples packed in blocks."""

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"

MOMENT = sa.String(length=30)


def upgrade() -> None:
    op.create_table(
        "graded_days",
        sa.Column("id", sa.String(length=26), nullable=False),
        sa.Column("spacecraft", sa.String(length=128), nullable=False),
        sa.Column("run", sa.String(length=64), nullable=False),
        sa.Column("day", sa.Integer(), nullable=False),
        sa.Column("start_ns", sa.BigInteger(), nullable=False),
        sa.Column("end_ns", sa.BigInteger(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("current", sa.Boolean(), nullable=False),
        sa.Column("created", MOMENT, nullable=False),
        sa.Column("inputs", sa.String(length=80), nullable=False),
        sa.Column("digest", sa.String(length=80), nullable=False),
        sa.Column("samples", sa.Integer(), nullable=False),
        sa.Column("summary", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["run"], ["runs.name"], name=op.f("fk_graded_days_run_runs")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_graded_days")),
        sa.UniqueConstraint(
            "spacecraft",
            "run",
            "day",
            "revision",
            name=op.f("uq_graded_days_spacecraft_run_day_revision"),
        ),
    )
    op.create_index(
        "uq_graded_days_current",
        "graded_days",
        ["spacecraft", "run", "day"],
        unique=True,
        sqlite_where=sa.text("current = 1"),
        postgresql_where=sa.text("current"),
    )
    op.create_index("ix_graded_days_by_end", "graded_days", ["end_ns"])
    op.create_table(
        "graded_blocks",
        sa.Column("day_id", sa.String(length=26), nullable=False),
        sa.Column("grade", sa.String(length=16), nullable=False),
        sa.Column("position", sa.SmallInteger(), nullable=False),
        sa.Column("model", sa.String(length=16), nullable=False),
        sa.Column("start_ns", sa.BigInteger(), nullable=False),
        sa.Column("end_ns", sa.BigInteger(), nullable=False),
        sa.Column("samples", sa.Integer(), nullable=False),
        sa.Column("packed", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(
            ["day_id"], ["graded_days.id"], name=op.f("fk_graded_blocks_day_id_graded_days")
        ),
        sa.PrimaryKeyConstraint("day_id", "grade", "position", name=op.f("pk_graded_blocks")),
    )


def downgrade() -> None:
    op.drop_table("graded_blocks")
    op.drop_index("ix_graded_days_by_end", "graded_days")
    op.drop_index("uq_graded_days_current", "graded_days")
    op.drop_table("graded_days")
