"""Calibrations of trackers, and which of them were adopted when."""

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"

ID = sa.String(length=26)
NAME = sa.String(length=128)
MOMENT = sa.String(length=30)
DIGEST = sa.String(length=80)


def upgrade() -> None:
    op.create_table(
        "calibrations",
        sa.Column("id", ID, nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("run", sa.String(length=64), nullable=False),
        sa.Column("created", MOMENT, nullable=False),
        sa.Column("ended", MOMENT, nullable=True),
        sa.Column("who", sa.String(length=64), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("done", sa.Integer(), nullable=False),
        sa.Column("total", sa.Integer(), nullable=False),
        sa.Column("mission_digest", DIGEST, nullable=False),
        sa.Column("request", sa.Text(), nullable=False),
        sa.Column("result", sa.Text(), nullable=True),
        sa.Column("covariance", sa.Text(), nullable=True),
        sa.Column("fault", sa.Text(), nullable=True),
        sa.ForeignKeyConstraint(
            ["mission_digest"],
            ["missions.digest"],
            name=op.f("fk_calibrations_mission_digest_missions"),
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_calibrations")),
    )
    op.create_index(
        "uq_calibrations_version", "calibrations", ["spacecraft", "version"], unique=True
    )
    op.create_table(
        "calibration_adoptions",
        sa.Column("id", ID, nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("adopted", MOMENT, nullable=False),
        sa.Column("who", sa.String(length=64), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("calibration_id", ID, nullable=True),
        sa.Column("file_digest", DIGEST, nullable=False),
        sa.Column("mission_digest", DIGEST, nullable=False),
        sa.Column("trackers", sa.Text(), nullable=True),
        sa.ForeignKeyConstraint(
            ["calibration_id"],
            ["calibrations.id"],
            name=op.f("fk_calibration_adoptions_calibration_id_calibrations"),
        ),
        sa.ForeignKeyConstraint(
            ["mission_digest"],
            ["missions.digest"],
            name=op.f("fk_calibration_adoptions_mission_digest_missions"),
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_calibration_adoptions")),
    )
    op.create_index(
        "ix_calibration_adoptions_spacecraft", "calibration_adoptions", ["spacecraft", "id"]
    )


def downgrade() -> None:
    op.drop_index("ix_calibration_adoptions_spacecraft", "calibration_adoptions")
    op.drop_table("calibration_adoptions")
    op.drop_index("uq_calibrations_version", "calibrations")
    op.drop_table("calibrations")
