"""Idempotency-Keys belong to the token that they came with; those there are belong to none.

Revision ID: 0007
Revises: 0006
"""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"


def upgrade() -> None:
    # SQLite changes no primary key: the table is made anew there.
    with op.batch_alter_table("idempotency_keys") as table:
        table.add_column(
            sa.Column("token_id", sa.String(length=26), nullable=False, server_default="")
        )
        table.drop_constraint("pk_idempotency_keys", type_="primary")
        table.create_primary_key("pk_idempotency_keys", ["token_id", "key"])


def downgrade() -> None:
    # A key that several tokens used stays with one of them: there is room for one.
    op.execute(
        "DELETE FROM idempotency_keys WHERE EXISTS (SELECT 1 FROM idempotency_keys AS other "
        "WHERE other.key = idempotency_keys.key AND other.token_id < idempotency_keys.token_id)"
    )
    with op.batch_alter_table("idempotency_keys") as table:
        table.drop_constraint("pk_idempotency_keys", type_="primary")
        table.create_primary_key("pk_idempotency_keys", ["key"])
        table.drop_column("token_id")
