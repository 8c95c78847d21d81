"""Gyro blocks: rates of a spacecraft, up to ten thousand samples a row."""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"

MOMENT = sa.String(length=30)


def upgrade() -> None:
    op.create_table(
        "gyro_blocks",
        sa.Column("id", sa.String(length=26), nullable=False),
        sa.Column("spacecraft", sa.String(length=128), nullable=False),
        sa.Column("run", sa.String(length=64), nullable=False),
        sa.Column("block", sa.String(length=128), nullable=False),
        sa.Column("start", MOMENT, nullable=False),
        sa.Column("end", MOMENT, nullable=False),
        sa.Column("start_ns", sa.BigInteger(), nullable=False),
        sa.Column("end_ns", sa.BigInteger(), nullable=False),
        sa.Column("received", MOMENT, nullable=False),
        sa.Column("fingerprint", sa.String(length=64), nullable=False),
        sa.Column("samples", sa.Integer(), nullable=False),
        sa.Column("step_s", sa.Double(), nullable=True),
        sa.Column("times_s", sa.LargeBinary(), nullable=True),
        sa.Column("rates_rad_per_s", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["run"], ["runs.name"], name=op.f("fk_gyro_blocks_run_runs")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_gyro_blocks")),
        sa.UniqueConstraint(
            "spacecraft", "run", "block", name=op.f("uq_gyro_blocks_spacecraft_run_block")
        ),
    )
    op.create_index(
        "ix_gyro_blocks_by_start", "gyro_blocks", ["spacecraft", "run", "start_ns", "end_ns"]
    )
    op.create_index("ix_gyro_blocks_by_end", "gyro_blocks", ["end_ns"])


def downgrade() -> None:
    op.drop_index("ix_gyro_blocks_by_end", "gyro_blocks")
    op.drop_index("ix_gyro_blocks_by_start", "gyro_blocks")
    op.drop_table("gyro_blocks")
