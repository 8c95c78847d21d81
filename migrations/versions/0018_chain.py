"""The chain: a leaf for each result, facts of other tables, and heads over both."""

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0017"


def upgrade() -> None:
    # The service gives earlier results their leaves, and those without a place one, afterwards.
    number = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
    op.create_table(
        "record_leaves",
        sa.Column("seq", number, autoincrement=False, nullable=False),
        sa.Column("leaf", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("seq"),
    )
    op.create_table(
        "record_facts",
        sa.Column("id", number, nullable=False),
        sa.Column("kind", sa.String(64), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("head", sa.BigInteger()),
        sa.PrimaryKeyConstraint("id"),
    )
    op.create_index("ix_record_facts_kind", "record_facts", ["kind", "key"])
    op.create_index("ix_record_facts_head", "record_facts", ["head"])
    op.create_table(
        "record_heads",
        sa.Column("number", number, autoincrement=False, nullable=False),
        sa.Column("made", sa.String(30), nullable=False),
        sa.Column("statement", sa.Text(), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("signature", sa.String(128)),
        sa.PrimaryKeyConstraint("number"),
    )


def downgrade() -> None:
    for table in ("record_heads", "record_facts", "record_leaves"):
        op.drop_table(table)
    op.execute("UPDATE results SET seq = 0 WHERE seq < 0")
