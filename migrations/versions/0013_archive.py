"""The archive: which batches left the database, and an index to delete batches by."""

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"

ID = sa.String(length=26)
NAME = sa.String(length=128)
RUN = sa.String(length=64)


def upgrade() -> None:
    op.create_table(
        "archived_parts",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("path", sa.Text(), nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("first_ns", sa.BigInteger(), nullable=False),
        sa.Column("last_ns", sa.BigInteger(), nullable=False),
        sa.Column("batches", sa.Integer(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_archived_parts")),
        sa.UniqueConstraint("path", name=op.f("uq_archived_parts_path")),
    )
    op.create_index(
        "ix_archived_parts_by_spacecraft", "archived_parts", ["spacecraft", "run", "last_ns"]
    )
    op.create_index("ix_archived_parts_by_time", "archived_parts", ["last_ns"])
    op.create_table(
        "archived_batches",
        sa.Column("id", ID, nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("batch", NAME, nullable=False),
        sa.Column("fingerprint", sa.String(length=64), nullable=False),
        sa.Column("part_id", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_archived_batches")),
        sa.UniqueConstraint(
            "spacecraft", "run", "batch", name=op.f("uq_archived_batches_spacecraft_run_batch")
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "archived_what_ifs",
        sa.Column("id", ID, nullable=False),
        sa.Column("batch_id", ID, nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_archived_what_ifs")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "archived_hours",
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("bucket", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("tracker", NAME, nullable=False),
        sa.Column("part_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("sums", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint(
            "spacecraft", "run", "bucket", "tracker", "part_id", name=op.f("pk_archived_hours")
        ),
        sqlite_with_rowid=False,
    )
    # Without it each deleted batch is looked for in all results, for the foreign key.
    op.create_index("ix_results_batch_id", "results", ["batch_id"])


def downgrade() -> None:
    op.drop_index("ix_results_batch_id", "results")
    op.drop_table("archived_hours")
    op.drop_table("archived_what_ifs")
    op.drop_table("archived_batches")
    op.drop_index("ix_archived_parts_by_time", "archived_parts")
    op.drop_index("ix_archived_parts_by_spacecraft", "archived_parts")
    op.drop_table("archived_parts")
