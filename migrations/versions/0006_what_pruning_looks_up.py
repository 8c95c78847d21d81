"""What refers to a result is found by an index: old ones are deleted without reading every row.

Revision ID: 0006
Revises: 0003
"""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0003"


def upgrade() -> None:
    op.create_index("ix_idempotency_keys_result_id", "idempotency_keys", ["result_id"])
    op.create_index(
        "ix_results_parent",
        "results",
        ["parent_id"],
        sqlite_where=sa.text("parent_id IS NOT NULL"),
        postgresql_where=sa.text("parent_id IS NOT NULL"),
    )


def downgrade() -> None:
    op.drop_index("ix_results_parent", "results")
    op.drop_index("ix_idempotency_keys_result_id", "idempotency_keys")
