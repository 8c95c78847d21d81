"""Frames: what was found on them, and a small picture, beside the batches made of them."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0005"


def upgrade() -> None:
    op.create_table(
        "frames",
        sa.Column("batch_id", sa.String(length=26), nullable=False),
        sa.Column("digest", sa.String(length=80), nullable=False),
        sa.Column("summary", sa.Text(), nullable=False),
        sa.Column("detections", sa.Text(), nullable=False),
        sa.Column("preview", sa.LargeBinary(), nullable=False),
        sa.Column("preview_step", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["batch_id"], ["batches.id"], name=op.f("fk_frames_batch_id_batches")
        ),
        sa.PrimaryKeyConstraint("batch_id", name=op.f("pk_frames")),
    )
    op.create_index(op.f("ix_frames_digest"), "frames", ["digest"], unique=False)


def downgrade() -> None:
    op.drop_index(op.f("ix_frames_digest"), table_name="frames")
    op.drop_table("frames")
