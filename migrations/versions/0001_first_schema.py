"""First schema: batches, results, solutions, trends, replays."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    op.create_table(
        "runs",
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("created", sa.String(length=30), nullable=False),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_runs")),
    )
    op.create_table(
        "missions",
        sa.Column("digest", sa.String(length=80), nullable=False),
        sa.Column("spacecraft", sa.String(length=128), nullable=False),
        sa.Column("settings", sa.Text(), nullable=False),
        sa.Column("first_used", sa.String(length=30), nullable=False),
        sa.PrimaryKeyConstraint("digest", name=op.f("pk_missions")),
    )
    op.create_index(op.f("ix_missions_spacecraft"), "missions", ["spacecraft"], unique=False)
    op.create_table(
        "catalogs",
        sa.Column("digest", sa.String(length=80), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("first_used", sa.String(length=30), nullable=False),
        sa.PrimaryKeyConstraint("digest", name=op.f("pk_catalogs")),
    )
    op.create_table(
        "batches",
        sa.Column("id", sa.String(length=26), nullable=False),
        sa.Column("spacecraft", sa.String(length=128), nullable=False),
        sa.Column("run", sa.String(length=64), nullable=False),
        sa.Column("batch", sa.String(length=128), nullable=False),
        sa.Column("time", sa.String(length=30), nullable=False),
        sa.Column("time_ns", sa.BigInteger(), nullable=False),
        sa.Column("received", sa.String(length=30), nullable=False),
        sa.Column("fingerprint", sa.String(length=64), nullable=False),
        sa.Column("input", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["run"], ["runs.name"], name=op.f("fk_batches_run_runs")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_batches")),
        sa.UniqueConstraint(
            "spacecraft", "run", "batch", name=op.f("uq_batches_spacecraft_run_batch")
        ),
    )
    op.create_table(
        "results",
        sa.Column("id", sa.String(length=26), nullable=False),
        sa.Column("batch_id", sa.String(length=26), nullable=False),
        sa.Column("parent_id", sa.String(length=26), nullable=True),
        sa.Column("current", sa.Boolean(), nullable=False),
        sa.Column("created", sa.String(length=30), nullable=False),
        sa.Column("spacecraft", sa.String(length=128), nullable=False),
        sa.Column("run", sa.String(length=64), nullable=False),
        sa.Column("time_ns", sa.BigInteger(), nullable=False),
        sa.Column("identifier", sa.String(length=32), nullable=False),
        sa.Column("options", sa.Text(), nullable=False),
        sa.Column("mission_digest", sa.String(length=80), nullable=False),
        sa.Column("catalog_digest", sa.String(length=80), nullable=False),
        sa.Column("observed", sa.Integer(), nullable=False),
        sa.Column("unique", sa.Integer(), nullable=False),
        sa.Column("ambiguous", sa.Integer(), nullable=False),
        sa.Column("unmatched", sa.Integer(), nullable=False),
        sa.Column("status", sa.String(length=16), nullable=True),
        sa.Column("reason", sa.String(length=64), nullable=True),
        sa.Column("answer", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(
            ["batch_id"], ["batches.id"], name=op.f("fk_results_batch_id_batches")
        ),
        sa.ForeignKeyConstraint(
            ["catalog_digest"], ["catalogs.digest"], name=op.f("fk_results_catalog_digest_catalogs")
        ),
        sa.ForeignKeyConstraint(
            ["mission_digest"], ["missions.digest"], name=op.f("fk_results_mission_digest_missions")
        ),
        sa.ForeignKeyConstraint(
            ["parent_id"], ["results.id"], name=op.f("fk_results_parent_id_results")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_results")),
    )
    op.create_index(
        "ix_results_current_by_run",
        "results",
        ["run", "time_ns", "batch_id", "status", "unique", "ambiguous", "unmatched"],
        unique=False,
        sqlite_where=sa.text("current = 1"),
        postgresql_where=sa.text("current"),
    )
    op.create_index(
        "ix_results_current_by_spacecraft",
        "results",
        ["spacecraft", "run", "time_ns", "batch_id", "status", "unique", "ambiguous", "unmatched"],
        unique=False,
        sqlite_where=sa.text("current = 1"),
        postgresql_where=sa.text("current"),
    )
    op.create_index(
        "ix_results_what_ifs",
        "results",
        ["batch_id"],
        unique=False,
        sqlite_where=sa.text("parent_id IS NOT NULL"),
        postgresql_where=sa.text("parent_id IS NOT NULL"),
    )
    op.create_index(
        "uq_results_current",
        "results",
        ["batch_id"],
        unique=True,
        sqlite_where=sa.text("current = 1"),
        postgresql_where=sa.text("current"),
    )
    op.create_table(
        "star_results",
        sa.Column("result_id", sa.String(length=26), nullable=False),
        sa.Column("tracker", sa.String(length=128), nullable=False),
        sa.Column("position", sa.SmallInteger(), nullable=False),
        sa.Column("outcome", sa.String(length=16), nullable=False),
        sa.Column("star_id", sa.Text(), nullable=True),
        sa.Column("votes", sa.Integer(), nullable=False),
        sa.Column("runner_up", sa.Integer(), nullable=False),
        sa.Column("probability", sa.Double(), nullable=True),
        sa.Column("residual_arcsec", sa.Double(), nullable=True),
        sa.ForeignKeyConstraint(
            ["result_id"], ["results.id"], name=op.f("fk_star_results_result_id_results")
        ),
        sa.PrimaryKeyConstraint("result_id", "tracker", "position", name=op.f("pk_star_results")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "solutions",
        sa.Column("result_id", sa.String(length=26), nullable=False),
        sa.Column("q1", sa.Double(), nullable=False),
        sa.Column("q2", sa.Double(), nullable=False),
        sa.Column("q3", sa.Double(), nullable=False),
        sa.Column("qc", sa.Double(), nullable=False),
        sa.Column("frame", sa.String(length=16), nullable=False),
        sa.Column("p11", sa.Double(), nullable=False),
        sa.Column("p12", sa.Double(), nullable=False),
        sa.Column("p13", sa.Double(), nullable=False),
        sa.Column("p22", sa.Double(), nullable=False),
        sa.Column("p23", sa.Double(), nullable=False),
        sa.Column("p33", sa.Double(), nullable=False),
        sa.Column("residual_rms_arcsec", sa.Double(), nullable=False),
        sa.Column("predicted_rms_arcsec", sa.Double(), nullable=False),
        sa.Column("taste", sa.Double(), nullable=False),
        sa.Column("method", sa.String(length=32), nullable=False),
        sa.Column("status", sa.String(length=16), nullable=False),
        sa.ForeignKeyConstraint(
            ["result_id"], ["results.id"], name=op.f("fk_solutions_result_id_results")
        ),
        sa.PrimaryKeyConstraint("result_id", name=op.f("pk_solutions")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "rollups_hourly",
        sa.Column("spacecraft", sa.String(length=128), nullable=False),
        sa.Column("run", sa.String(length=64), nullable=False),
        sa.Column("bucket", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("batches", sa.BigInteger(), nullable=False),
        sa.Column("observed", sa.BigInteger(), nullable=False),
        sa.Column("unique", sa.BigInteger(), nullable=False),
        sa.Column("ambiguous", sa.BigInteger(), nullable=False),
        sa.Column("unmatched", sa.BigInteger(), nullable=False),
        sa.Column("solved", sa.BigInteger(), nullable=False),
        sa.Column("suspect", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("spacecraft", "run", "bucket", name=op.f("pk_rollups_hourly")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "rollups_daily",
        sa.Column("spacecraft", sa.String(length=128), nullable=False),
        sa.Column("run", sa.String(length=64), nullable=False),
        sa.Column("bucket", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("batches", sa.BigInteger(), nullable=False),
        sa.Column("observed", sa.BigInteger(), nullable=False),
        sa.Column("unique", sa.BigInteger(), nullable=False),
        sa.Column("ambiguous", sa.BigInteger(), nullable=False),
        sa.Column("unmatched", sa.BigInteger(), nullable=False),
        sa.Column("solved", sa.BigInteger(), nullable=False),
        sa.Column("suspect", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("spacecraft", "run", "bucket", name=op.f("pk_rollups_daily")),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "idempotency_keys",
        sa.Column("key", sa.String(length=255), nullable=False),
        sa.Column("fingerprint", sa.String(length=64), nullable=False),
        sa.Column("result_id", sa.String(length=26), nullable=False),
        sa.ForeignKeyConstraint(
            ["result_id"], ["results.id"], name=op.f("fk_idempotency_keys_result_id_results")
        ),
        sa.PrimaryKeyConstraint("key", name=op.f("pk_idempotency_keys")),
    )
    op.create_table(
        "replays",
        sa.Column("id", sa.String(length=26), nullable=False),
        sa.Column("run", sa.String(length=64), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("lines_total", sa.BigInteger(), nullable=True),
        sa.Column("lines_done", sa.BigInteger(), nullable=False),
        sa.Column("lines_refused", sa.BigInteger(), nullable=False),
        sa.Column("errors", sa.Text(), nullable=False),
        sa.Column("started", sa.String(length=30), nullable=False),
        sa.Column("finished", sa.String(length=30), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_replays")),
    )


def downgrade() -> None:
    op.drop_table("replays")
    op.drop_table("idempotency_keys")
    op.drop_table("rollups_daily")
    op.drop_table("rollups_hourly")
    op.drop_table("solutions")
    op.drop_table("star_results")
    op.drop_table("results")
    op.drop_table("batches")
    op.drop_table("catalogs")
    op.drop_table("missions")
    op.drop_table("runs")
