"""Annotations: notes that people write on a time or a period, of one spacecraft or of all."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"

MOMENT = sa.String(length=30)


def upgrade() -> None:
    op.create_table(
        "annotations",
        sa.Column("id", sa.String(length=26), nullable=False),
        sa.Column("spacecraft", sa.String(length=128), nullable=True),
        sa.Column("start", MOMENT, nullable=False),
        sa.Column("start_ns", sa.BigInteger(), nullable=False),
        sa.Column("end", MOMENT, nullable=True),
        sa.Column("end_ns", sa.BigInteger(), nullable=False),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("who", sa.String(length=64), nullable=False),
        sa.Column("created", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_annotations")),
    )


def downgrade() -> None:
    op.drop_table("annotations")
