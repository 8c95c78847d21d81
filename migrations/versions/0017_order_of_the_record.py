"""The order of results, and how far the projector has come in it."""

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"

WITH_DIGESTS = ("missions", "catalogs", "mission_uses", "tracker_values")


def upgrade() -> None:
    # Trends and alarms have all earlier results already; these get no place in the order: zero.
    op.add_column(
        "results", sa.Column("seq", sa.BigInteger(), server_default=sa.text("0"), nullable=False)
    )
    op.create_index("ix_results_seq", "results", ["seq"])
    op.add_column("results", sa.Column("digest", sa.BigInteger()))
    # The service gives earlier results theirs, after the upgrade.
    without = sa.text("digest IS NULL")
    op.create_index(
        "ix_results_without_digest",
        "results",
        ["id"],
        sqlite_where=without,
        postgresql_where=without,
    )
    for table in WITH_DIGESTS:
        op.add_column(table, sa.Column("row_digest", sa.BigInteger()))
    op.create_table(
        "seals",
        sa.Column("spacecraft", sa.String(128), nullable=False),
        sa.Column("run", sa.String(64), nullable=False),
        sa.Column("hour", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("results", sa.Integer(), nullable=False),
        sa.Column("digests", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("spacecraft", "run", "hour"),
        sqlite_with_rowid=False,
    )
    op.execute(
        "INSERT INTO seals SELECT spacecraft, run, time_ns / 3600000000000, count(*), 0 "
        "FROM results GROUP BY 1, 2, 3"
    )
    position = op.create_table(
        "projector",
        sa.Column("id", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("seq", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("id"),
    )
    op.bulk_insert(position, [{"id": 1, "seq": 0}])
    if op.get_bind().dialect.name == "postgresql":
        op.execute("CREATE SEQUENCE IF NOT EXISTS results_seq")


def downgrade() -> None:
    if op.get_bind().dialect.name == "postgresql":
        op.execute("DROP SEQUENCE results_seq")
    op.drop_table("projector")
    op.drop_table("seals")
    for table in WITH_DIGESTS:
        op.drop_column(table, "row_digest")
    op.drop_index("ix_results_without_digest", "results")
    op.drop_column("results", "digest")
    op.drop_index("ix_results_seq", "results")
    op.drop_column("results", "seq")
