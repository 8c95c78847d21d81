"""What came of a replay's lines, counted as it goes."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0002"


def upgrade() -> None:
    op.add_column("replays", sa.Column("counts", sa.Text(), nullable=True))


def downgrade() -> None:
    op.drop_column("replays", "counts")
