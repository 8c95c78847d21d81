"""Schema of version 0.2.0.

Development versions before it had the schemas 0001 to 0017, which this version does not read.
"""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = None

ID = sa.String(26)
NAME = sa.String(128)
RUN = sa.String(64)
MOMENT = sa.String(30)
DIGEST = sa.String(80)
NUMBER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

COUNTS = ("batches", "observed", "unique", "ambiguous", "unmatched", "solved", "suspect")
SHARES = ("ambiguous_share", "unmatched_share")
VALUES = (
    "residual_rms_arcsec",
    "predicted_rms_arcsec",
    "residual_ratio",
    "magnitude_offset_mag",
    "a_priori_angle_deg",
)
OFFSETS = ("scale_offset_ppm", "alignment_offset_arcsec")


def _where(condition: str, sqlite: str | None = None) -> dict[str, Any]:
    """Options of an index over some of the rows."""
    return {
        "sqlite_where": sa.text(sqlite or condition),
        "postgresql_where": sa.text(condition),
    }


CURRENT = _where("current", "current = 1")
WHAT_IFS = _where("parent_id IS NOT NULL")
WITHOUT_DIGEST = _where("digest IS NULL")
OPEN = _where("until IS NULL")
NOT_CLEARED = _where("cleared_at IS NULL")


def upgrade() -> None:
    _record()
    _chain()
    _trends()
    _alarms()
    _access()
    _webhooks()
    _gyro()
    _archive()
    _calibrations()


def _record() -> None:
    """Batches with their results, and what these were computed with."""
    op.create_table(
        "runs",
        sa.Column("name", RUN, nullable=False),
        sa.Column("created", MOMENT, nullable=False),
        sa.Column("alarms", sa.Boolean(), server_default=sa.false(), nullable=False),
        sa.Column("tracked", sa.Boolean(), server_default=sa.false(), nullable=False),
        sa.PrimaryKeyConstraint("name", name="pk_runs"),
    )
    op.create_table(
        "missions",
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("settings", sa.Text(), nullable=False),
        sa.Column("first_used", MOMENT, nullable=False),
        sa.Column("row_digest", sa.BigInteger()),
        sa.PrimaryKeyConstraint("digest", name="pk_missions"),
    )
    op.create_index("ix_missions_spacecraft", "missions", ["spacecraft"])
    op.create_table(
        "mission_uses",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("since", MOMENT, nullable=False),
        sa.Column("row_digest", sa.BigInteger()),
        sa.PrimaryKeyConstraint("id", name="pk_mission_uses"),
        sa.ForeignKeyConstraint(
            ["digest"], ["missions.digest"], name="fk_mission_uses_digest_missions"
        ),
    )
    op.create_index("ix_mission_uses_spacecraft", "mission_uses", ["spacecraft"])
    op.create_table(
        "catalogs",
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("first_used", MOMENT, nullable=False),
        sa.Column("row_digest", sa.BigInteger()),
        sa.PrimaryKeyConstraint("digest", name="pk_catalogs"),
    )
    op.create_table(
        "batches",
        sa.Column("id", ID, nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("batch", NAME, nullable=False),
        sa.Column("time", MOMENT, nullable=False),
        sa.Column("time_ns", sa.BigInteger(), nullable=False),
        sa.Column("received", MOMENT, nullable=False),
        sa.Column("fingerprint", sa.String(64), nullable=False),
        sa.Column("input", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_batches"),
        sa.ForeignKeyConstraint(["run"], ["runs.name"], name="fk_batches_run_runs"),
        sa.UniqueConstraint("spacecraft", "run", "batch", name="uq_batches_spacecraft_run_batch"),
    )
    op.create_table(
        "results",
        sa.Column("id", ID, nullable=False),
        sa.Column("batch_id", ID, nullable=False),
        sa.Column("parent_id", ID),
        sa.Column("current", sa.Boolean(), nullable=False),
        sa.Column("created", MOMENT, nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("time_ns", sa.BigInteger(), nullable=False),
        sa.Column("identifier", sa.String(32), nullable=False),
        sa.Column("options", sa.Text(), nullable=False),
        sa.Column("mission_digest", DIGEST, nullable=False),
        sa.Column("catalog_digest", DIGEST, nullable=False),
        sa.Column("observed", sa.Integer(), nullable=False),
        sa.Column("unique", sa.Integer(), nullable=False),
        sa.Column("ambiguous", sa.Integer(), nullable=False),
        sa.Column("unmatched", sa.Integer(), nullable=False),
        sa.Column("status", sa.String(16)),
        sa.Column("reason", sa.String(64)),
        sa.Column("answer", sa.Text(), nullable=False),
        sa.Column("residual_rms_arcsec", sa.Double()),
        sa.Column("predicted_rms_arcsec", sa.Double()),
        sa.Column("magnitude_offset_mag", sa.Double()),
        sa.Column("a_priori_angle_deg", sa.Double()),
        sa.Column("scale_offset_ppm", sa.Double()),
        sa.Column("alignment_offset_arcsec", sa.Double()),
        sa.Column("seq", sa.BigInteger(), server_default=sa.text("0"), nullable=False),
        sa.Column("digest", sa.BigInteger()),
        sa.PrimaryKeyConstraint("id", name="pk_results"),
        sa.ForeignKeyConstraint(["batch_id"], ["batches.id"], name="fk_results_batch_id_batches"),
        sa.ForeignKeyConstraint(
            ["catalog_digest"], ["catalogs.digest"], name="fk_results_catalog_digest_catalogs"
        ),
        sa.ForeignKeyConstraint(
            ["mission_digest"], ["missions.digest"], name="fk_results_mission_digest_missions"
        ),
        sa.ForeignKeyConstraint(["parent_id"], ["results.id"], name="fk_results_parent_id_results"),
    )
    op.create_index("ix_results_batch_id", "results", ["batch_id"])
    op.create_index(
        "ix_results_current_by_run",
        "results",
        ["run", "time_ns", "batch_id", "status", "unique", "ambiguous", "unmatched"],
        **CURRENT,
    )
    op.create_index(
        "ix_results_current_by_spacecraft",
        "results",
        [
            "spacecraft",
            "run",
            "time_ns",
            "batch_id",
            "status",
            "unique",
            "ambiguous",
            "unmatched",
            "residual_rms_arcsec",
            "predicted_rms_arcsec",
            "magnitude_offset_mag",
            "a_priori_angle_deg",
            "scale_offset_ppm",
            "alignment_offset_arcsec",
        ],
        **CURRENT,
    )
    op.create_index(
        "ix_results_current_by_time",
        "results",
        ["time_ns", "batch_id", "spacecraft", "status", "unique", "ambiguous", "unmatched"],
        **CURRENT,
    )
    op.create_index("ix_results_parent", "results", ["parent_id"], **WHAT_IFS)
    op.create_index("ix_results_seq", "results", ["seq"])
    op.create_index("ix_results_what_ifs", "results", ["batch_id"], **WHAT_IFS)
    op.create_index("ix_results_without_digest", "results", ["id"], **WITHOUT_DIGEST)
    op.create_index("uq_results_current", "results", ["batch_id"], unique=True, **CURRENT)
    op.create_table(
        "star_results",
        sa.Column("result_id", ID, nullable=False),
        sa.Column("tracker", NAME, nullable=False),
        sa.Column("position", sa.SmallInteger(), nullable=False),
        sa.Column("outcome", sa.String(16), nullable=False),
        sa.Column("star_id", sa.Text()),
        sa.Column("votes", sa.Integer(), nullable=False),
        sa.Column("runner_up", sa.Integer(), nullable=False),
        sa.Column("probability", sa.Double()),
        sa.Column("residual_arcsec", sa.Double()),
        sa.PrimaryKeyConstraint("result_id", "tracker", "position", name="pk_star_results"),
        sa.ForeignKeyConstraint(
            ["result_id"], ["results.id"], name="fk_star_results_result_id_results"
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "solutions",
        sa.Column("result_id", ID, nullable=False),
        sa.Column("q1", sa.Double(), nullable=False),
        sa.Column("q2", sa.Double(), nullable=False),
        sa.Column("q3", sa.Double(), nullable=False),
        sa.Column("qc", sa.Double(), nullable=False),
        sa.Column("frame", sa.String(16), nullable=False),
        sa.Column("p11", sa.Double(), nullable=False),
        sa.Column("p12", sa.Double(), nullable=False),
        sa.Column("p13", sa.Double(), nullable=False),
        sa.Column("p22", sa.Double(), nullable=False),
        sa.Column("p23", sa.Double(), nullable=False),
        sa.Column("p33", sa.Double(), nullable=False),
        sa.Column("residual_rms_arcsec", sa.Double(), nullable=False),
        sa.Column("predicted_rms_arcsec", sa.Double(), nullable=False),
        sa.Column("taste", sa.Double(), nullable=False),
        sa.Column("method", sa.String(32), nullable=False),
        sa.Column("status", sa.String(16), nullable=False),
        sa.PrimaryKeyConstraint("result_id", name="pk_solutions"),
        sa.ForeignKeyConstraint(
            ["result_id"], ["results.id"], name="fk_solutions_result_id_results"
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "tracker_values",
        sa.Column("batch_id", ID, nullable=False),
        sa.Column("tracker", NAME, nullable=False),
        sa.Column("observed", sa.Integer(), nullable=False),
        sa.Column("unique", sa.Integer(), nullable=False),
        sa.Column("ambiguous", sa.Integer(), nullable=False),
        sa.Column("unmatched", sa.Integer(), nullable=False),
        sa.Column("status", sa.String(16)),
        sa.Column("residual_rms_arcsec", sa.Double()),
        sa.Column("predicted_rms_arcsec", sa.Double()),
        sa.Column("magnitude_offset_mag", sa.Double()),
        sa.Column("a_priori_angle_deg", sa.Double()),
        sa.Column("scale_offset_ppm", sa.Double()),
        sa.Column("alignment_offset_arcsec", sa.Double()),
        sa.Column("row_digest", sa.BigInteger()),
        sa.PrimaryKeyConstraint("batch_id", "tracker", name="pk_tracker_values"),
        sa.ForeignKeyConstraint(
            ["batch_id"], ["batches.id"], name="fk_tracker_values_batch_id_batches"
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "tracker_splits",
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("time_ns", sa.BigInteger()),
        sa.Column("batch_id", ID),
        sa.PrimaryKeyConstraint("spacecraft", "run", name="pk_tracker_splits"),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "frames",
        sa.Column("batch_id", ID, nullable=False),
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("summary", sa.Text(), nullable=False),
        sa.Column("detections", sa.Text(), nullable=False),
        sa.Column("preview", sa.LargeBinary(), nullable=False),
        sa.Column("preview_step", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint("batch_id", name="pk_frames"),
        sa.ForeignKeyConstraint(["batch_id"], ["batches.id"], name="fk_frames_batch_id_batches"),
    )
    op.create_index("ix_frames_digest", "frames", ["digest"])
    op.create_table(
        "idempotency_keys",
        sa.Column("key", sa.String(255), nullable=False),
        sa.Column("fingerprint", sa.String(64), nullable=False),
        sa.Column("result_id", ID, nullable=False),
        sa.Column("token_id", ID, server_default=sa.text("''"), nullable=False),
        sa.PrimaryKeyConstraint("token_id", "key", name="pk_idempotency_keys"),
        sa.ForeignKeyConstraint(
            ["result_id"], ["results.id"], name="fk_idempotency_keys_result_id_results"
        ),
    )
    op.create_index("ix_idempotency_keys_result_id", "idempotency_keys", ["result_id"])
    op.create_table(
        "replays",
        sa.Column("id", ID, nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("lines_total", sa.BigInteger()),
        sa.Column("lines_done", sa.BigInteger(), nullable=False),
        sa.Column("lines_refused", sa.BigInteger(), nullable=False),
        sa.Column("errors", sa.Text(), nullable=False),
        sa.Column("started", MOMENT, nullable=False),
        sa.Column("finished", MOMENT),
        sa.Column("counts", sa.Text()),
        sa.PrimaryKeyConstraint("id", name="pk_replays"),
    )
    if op.get_bind().dialect.name == "postgresql":
        op.execute("CREATE SEQUENCE IF NOT EXISTS results_seq")


def _chain() -> None:
    """What shows that the record was changed: seals of hours, leaves, facts and heads."""
    op.create_table(
        "seals",
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("hour", sa.BigInteger(), nullable=False),
        sa.Column("results", sa.Integer(), nullable=False),
        sa.Column("digests", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("spacecraft", "run", "hour", name="pk_seals"),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "record_leaves",
        sa.Column("seq", NUMBER, autoincrement=False, nullable=False),
        sa.Column("leaf", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("seq", name="pk_record_leaves"),
    )
    op.create_table(
        "record_facts",
        sa.Column("id", NUMBER, nullable=False),
        sa.Column("kind", sa.String(64), nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("head", sa.BigInteger()),
        sa.PrimaryKeyConstraint("id", name="pk_record_facts"),
    )
    op.create_index("ix_record_facts_head", "record_facts", ["head"])
    op.create_index("ix_record_facts_kind", "record_facts", ["kind", "key"])
    op.create_table(
        "record_heads",
        sa.Column("number", NUMBER, autoincrement=False, nullable=False),
        sa.Column("made", MOMENT, nullable=False),
        sa.Column("statement", sa.Text(), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("signature", NAME),
        sa.PrimaryKeyConstraint("number", name="pk_record_heads"),
    )


def _trends() -> None:
    """Sums by hour and day, and how far the projector has come."""
    for table in ("rollups_hourly", "rollups_daily"):
        _rollup(table, "spacecraft", "run")
    for table in ("tracker_rollups_hourly", "tracker_rollups_daily"):
        _rollup(table, "spacecraft", "run", "tracker")
    table = op.create_table(
        "projector",
        sa.Column("id", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("seq", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_projector"),
    )
    op.bulk_insert(table, [{"id": 1, "seq": 0}])
    op.create_table(
        "annotations",
        sa.Column("id", ID, nullable=False),
        sa.Column("spacecraft", NAME),
        sa.Column("start", MOMENT, nullable=False),
        sa.Column("start_ns", sa.BigInteger(), nullable=False),
        sa.Column("end", MOMENT),
        sa.Column("end_ns", sa.BigInteger(), nullable=False),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("who", sa.String(64), nullable=False),
        sa.Column("created", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_annotations"),
    )


def _rollup(table: str, *owner: str) -> None:
    """Sums of the batches of an hour or a day, with the extremes of their values."""
    zero = {"server_default": sa.text("0"), "nullable": False}
    op.create_table(
        table,
        *(sa.Column(name, RUN if name == "run" else NAME, nullable=False) for name in owner),
        sa.Column("bucket", sa.Integer(), nullable=False),
        *(sa.Column(name, sa.BigInteger(), nullable=False) for name in COUNTS),
        *(
            sa.Column(f"{name}_{part}", kind, **zero)
            for name in VALUES
            for part, kind in (("n", sa.BigInteger()), ("sum", sa.Double()))
        ),
        *(
            sa.Column(f"{name}_{end}", sa.Double())
            for end in ("min", "max")
            for name in (*SHARES, *VALUES)
        ),
        *(
            column
            for name in OFFSETS
            for column in (
                sa.Column(f"{name}_n", sa.BigInteger(), **zero),
                sa.Column(f"{name}_sum", sa.Double(), **zero),
                sa.Column(f"{name}_min", sa.Double()),
                sa.Column(f"{name}_max", sa.Double()),
            )
        ),
        sa.PrimaryKeyConstraint(*owner, "bucket", name=f"pk_{table}"),
        sqlite_with_rowid=False,
    )


def _alarms() -> None:
    """Limits, alarms, and the events that tell of them."""
    op.create_table(
        "limits",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("quantity", sa.String(32), nullable=False),
        sa.Column("settings", sa.Text()),
        sa.Column("who", sa.String(64), nullable=False),
        sa.Column("comment", sa.Text()),
        sa.Column("since", MOMENT, nullable=False),
        sa.Column("until", MOMENT),
        sa.Column("tracker", NAME, server_default=sa.text("''"), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_limits"),
    )
    op.create_index("ix_limits_history", "limits", ["spacecraft", "quantity", "tracker", "id"])
    op.create_index(
        "uq_limits_open", "limits", ["spacecraft", "quantity", "tracker"], unique=True, **OPEN
    )
    op.create_table(
        "watches",
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("time", MOMENT, nullable=False),
        sa.Column("time_ns", sa.BigInteger(), nullable=False),
        sa.Column("batch_id", ID, nullable=False),
        sa.Column("received", MOMENT, nullable=False),
        sa.Column("state", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("spacecraft", "run", name="pk_watches"),
    )
    op.create_table(
        "alarms",
        sa.Column("id", ID, nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("quantity", sa.String(32), nullable=False),
        sa.Column("severity", sa.String(16), nullable=False),
        sa.Column("current_severity", sa.String(16)),
        sa.Column("raised_at", MOMENT, nullable=False),
        sa.Column("bound", sa.Double(), nullable=False),
        sa.Column("raised_value", sa.Double(), nullable=False),
        sa.Column("raised_time", MOMENT, nullable=False),
        sa.Column("raised_batch_id", ID),
        sa.Column("worst_value", sa.Double(), nullable=False),
        sa.Column("worst_time", MOMENT, nullable=False),
        sa.Column("worst_batch_id", ID),
        sa.Column("latest_value", sa.Double(), nullable=False),
        sa.Column("latest_time", MOMENT, nullable=False),
        sa.Column("latest_batch_id", ID),
        sa.Column("returned_at", MOMENT),
        sa.Column("acknowledged_at", MOMENT),
        sa.Column("acknowledged_by", sa.String(64)),
        sa.Column("shelved_at", MOMENT),
        sa.Column("shelved_by", sa.String(64)),
        sa.Column("shelved_until", MOMENT),
        sa.Column("cleared_at", MOMENT),
        sa.Column("tracker", NAME, server_default=sa.text("''"), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_alarms"),
    )
    op.create_index("ix_alarms_run", "alarms", ["run", "id"])
    op.create_index(
        "uq_alarms_active",
        "alarms",
        ["run", "spacecraft", "quantity", "tracker"],
        unique=True,
        **NOT_CLEARED,
    )
    op.create_table(
        "alarm_actions",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("alarm_id", ID, nullable=False),
        sa.Column("at", MOMENT, nullable=False),
        sa.Column("action", sa.String(16), nullable=False),
        sa.Column("who", sa.String(64)),
        sa.Column("comment", sa.Text()),
        sa.Column("severity", sa.String(16)),
        sa.Column("value", sa.Double()),
        sa.Column("time", MOMENT),
        sa.PrimaryKeyConstraint("id", name="pk_alarm_actions"),
        sa.ForeignKeyConstraint(
            ["alarm_id"], ["alarms.id"], name="fk_alarm_actions_alarm_id_alarms"
        ),
    )
    op.create_index("ix_alarm_actions_alarm_id", "alarm_actions", ["alarm_id"])
    op.create_table(
        "events",
        sa.Column("id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("run", RUN),
        sa.Column("spacecraft", NAME),
        sa.Column("data", sa.Text(), nullable=False),
        sa.Column("at", MOMENT),
        sa.PrimaryKeyConstraint("id", name="pk_events"),
    )
    table = op.create_table(
        "event_counter",
        sa.Column("id", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("last", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_event_counter"),
    )
    op.bulk_insert(table, [{"id": 1, "last": 0}])


def _access() -> None:
    """Tokens, sessions, and the audit trail."""
    op.create_table(
        "access_tokens",
        sa.Column("id", ID, nullable=False),
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("digest", sa.String(64), nullable=False),
        sa.Column("scopes", sa.Text(), nullable=False),
        sa.Column("spacecraft", sa.Text()),
        sa.Column("rate_per_s", sa.Double()),
        sa.Column("created", MOMENT, nullable=False),
        sa.Column("expires", MOMENT, nullable=False),
        sa.Column("revoked", MOMENT),
        sa.PrimaryKeyConstraint("id", name="pk_access_tokens"),
        sa.UniqueConstraint("digest", name="uq_access_tokens_digest"),
        sa.UniqueConstraint("name", name="uq_access_tokens_name"),
    )
    op.create_table(
        "access_sessions",
        sa.Column("digest", sa.String(64), nullable=False),
        sa.Column("token_id", ID, nullable=False),
        sa.Column("created", MOMENT, nullable=False),
        sa.Column("expires", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("digest", name="pk_access_sessions"),
        sa.ForeignKeyConstraint(
            ["token_id"], ["access_tokens.id"], name="fk_access_sessions_token_id_access_tokens"
        ),
    )
    op.create_table(
        "audit",
        sa.Column("id", ID, nullable=False),
        sa.Column("moment", MOMENT, nullable=False),
        sa.Column("who", DIGEST, nullable=False),
        sa.Column("action", sa.String(64), nullable=False),
        sa.Column("about", sa.Text(), nullable=False),
        sa.Column("body", sa.Text()),
        sa.Column("status", sa.SmallInteger()),
        sa.PrimaryKeyConstraint("id", name="pk_audit"),
    )


def _webhooks() -> None:
    """Webhooks, and the deliveries that wait."""
    op.create_table(
        "webhooks",
        sa.Column("id", ID, nullable=False),
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("url", sa.Text(), nullable=False),
        sa.Column("kinds", sa.Text()),
        sa.Column("spacecraft", sa.Text()),
        sa.Column("severity", sa.String(16)),
        sa.Column("run", RUN),
        sa.Column("enabled", sa.Boolean(), nullable=False),
        sa.Column("token_id", ID),
        sa.Column("who", sa.String(64), nullable=False),
        sa.Column("created", MOMENT, nullable=False),
        sa.Column("secret", sa.Text(), nullable=False),
        sa.Column("previous_secret", sa.Text()),
        sa.Column("previous_until", MOMENT),
        sa.Column("position", sa.BigInteger(), nullable=False),
        sa.Column("missed", sa.BigInteger(), server_default=sa.text("0"), nullable=False),
        sa.Column("gone_at", MOMENT),
        sa.Column("held_until", MOMENT),
        sa.Column("failing_since", MOMENT),
        sa.Column("last_attempt", MOMENT),
        sa.Column("last_delivered", MOMENT),
        sa.Column("last_status", sa.SmallInteger()),
        sa.Column("last_fault", sa.Text()),
        sa.PrimaryKeyConstraint("id", name="pk_webhooks"),
        sa.ForeignKeyConstraint(
            ["token_id"], ["access_tokens.id"], name="fk_webhooks_token_id_access_tokens"
        ),
    )
    op.create_table(
        "webhook_deliveries",
        sa.Column("webhook_id", ID, nullable=False),
        sa.Column("event_id", sa.BigInteger(), nullable=False),
        sa.Column("message_id", sa.String(48), nullable=False),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("body", sa.Text(), nullable=False),
        sa.Column("again", sa.Boolean(), nullable=False),
        sa.Column("dead", sa.Boolean(), nullable=False),
        sa.Column("queued", MOMENT, nullable=False),
        sa.Column("due", MOMENT, nullable=False),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("last_attempt", MOMENT),
        sa.Column("last_status", sa.SmallInteger()),
        sa.Column("last_fault", sa.Text()),
        sa.PrimaryKeyConstraint("webhook_id", "event_id", name="pk_webhook_deliveries"),
        sa.ForeignKeyConstraint(
            ["webhook_id"], ["webhooks.id"], name="fk_webhook_deliveries_webhook_id_webhooks"
        ),
    )
    op.create_index(
        "ix_webhook_deliveries_queue",
        "webhook_deliveries",
        ["webhook_id", "dead", "again", "spacecraft", "event_id"],
    )
    table = op.create_table(
        "webhook_sender",
        sa.Column("id", sa.SmallInteger(), autoincrement=False, nullable=False),
        sa.Column("holder", ID),
        sa.Column("beat", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_webhook_sender"),
    )
    op.bulk_insert(table, [{"id": 1, "holder": None, "beat": 0}])


def _gyro() -> None:
    """Gyro blocks, and the filtered and smoothed attitudes."""
    op.create_table(
        "gyro_blocks",
        sa.Column("id", ID, nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("block", NAME, nullable=False),
        sa.Column("start", MOMENT, nullable=False),
        sa.Column("end", MOMENT, nullable=False),
        sa.Column("start_ns", sa.BigInteger(), nullable=False),
        sa.Column("end_ns", sa.BigInteger(), nullable=False),
        sa.Column("received", MOMENT, nullable=False),
        sa.Column("fingerprint", sa.String(64), nullable=False),
        sa.Column("samples", sa.Integer(), nullable=False),
        sa.Column("step_s", sa.Double()),
        sa.Column("times_s", sa.LargeBinary()),
        sa.Column("rates_rad_per_s", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_gyro_blocks"),
        sa.ForeignKeyConstraint(["run"], ["runs.name"], name="fk_gyro_blocks_run_runs"),
        sa.UniqueConstraint(
            "spacecraft", "run", "block", name="uq_gyro_blocks_spacecraft_run_block"
        ),
    )
    op.create_index("ix_gyro_blocks_by_end", "gyro_blocks", ["end_ns"])
    op.create_index(
        "ix_gyro_blocks_by_start", "gyro_blocks", ["spacecraft", "run", "start_ns", "end_ns"]
    )
    op.create_table(
        "graded_days",
        sa.Column("id", ID, nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("day", sa.Integer(), nullable=False),
        sa.Column("start_ns", sa.BigInteger(), nullable=False),
        sa.Column("end_ns", sa.BigInteger(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("current", sa.Boolean(), nullable=False),
        sa.Column("created", MOMENT, nullable=False),
        sa.Column("inputs", DIGEST, nullable=False),
        sa.Column("digest", DIGEST, nullable=False),
        sa.Column("samples", sa.Integer(), nullable=False),
        sa.Column("summary", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_graded_days"),
        sa.ForeignKeyConstraint(["run"], ["runs.name"], name="fk_graded_days_run_runs"),
        sa.UniqueConstraint(
            "spacecraft",
            "run",
            "day",
            "revision",
            name="uq_graded_days_spacecraft_run_day_revision",
        ),
    )
    op.create_index("ix_graded_days_by_end", "graded_days", ["end_ns"])
    op.create_index(
        "uq_graded_days_current",
        "graded_days",
        ["spacecraft", "run", "day"],
        unique=True,
        **CURRENT,
    )
    op.create_table(
        "graded_blocks",
        sa.Column("day_id", ID, nullable=False),
        sa.Column("grade", sa.String(16), nullable=False),
        sa.Column("position", sa.SmallInteger(), nullable=False),
        sa.Column("model", sa.String(16), nullable=False),
        sa.Column("start_ns", sa.BigInteger(), nullable=False),
        sa.Column("end_ns", sa.BigInteger(), nullable=False),
        sa.Column("samples", sa.Integer(), nullable=False),
        sa.Column("packed", sa.LargeBinary(), nullable=False),
        sa.PrimaryKeyConstraint("day_id", "grade", "position", name="pk_graded_blocks"),
        sa.ForeignKeyConstraint(
            ["day_id"], ["graded_days.id"], name="fk_graded_blocks_day_id_graded_days"
        ),
    )


def _archive() -> None:
    """Batches that left the database for the archive."""
    op.create_table(
        "archived_parts",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("path", sa.Text(), nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("first_ns", sa.BigInteger(), nullable=False),
        sa.Column("last_ns", sa.BigInteger(), nullable=False),
        sa.Column("batches", sa.Integer(), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_archived_parts"),
        sa.UniqueConstraint("path", name="uq_archived_parts_path"),
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
        sa.Column("fingerprint", sa.String(64), nullable=False),
        sa.Column("part_id", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_archived_batches"),
        sa.UniqueConstraint(
            "spacecraft", "run", "batch", name="uq_archived_batches_spacecraft_run_batch"
        ),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "archived_what_ifs",
        sa.Column("id", ID, nullable=False),
        sa.Column("batch_id", ID, nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_archived_what_ifs"),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "archived_hours",
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("bucket", sa.Integer(), nullable=False),
        sa.Column("tracker", NAME, nullable=False),
        sa.Column("part_id", sa.Integer(), nullable=False),
        sa.Column("sums", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint(
            "spacecraft", "run", "bucket", "tracker", "part_id", name="pk_archived_hours"
        ),
        sqlite_with_rowid=False,
    )


def _calibrations() -> None:
    """Calibrations of trackers, and which of them were adopted when."""
    op.create_table(
        "calibrations",
        sa.Column("id", ID, nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("run", RUN, nullable=False),
        sa.Column("created", MOMENT, nullable=False),
        sa.Column("ended", MOMENT),
        sa.Column("who", sa.String(64), nullable=False),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("done", sa.Integer(), nullable=False),
        sa.Column("total", sa.Integer(), nullable=False),
        sa.Column("mission_digest", DIGEST, nullable=False),
        sa.Column("request", sa.Text(), nullable=False),
        sa.Column("result", sa.Text()),
        sa.Column("covariance", sa.Text()),
        sa.Column("fault", sa.Text()),
        sa.PrimaryKeyConstraint("id", name="pk_calibrations"),
        sa.ForeignKeyConstraint(
            ["mission_digest"], ["missions.digest"], name="fk_calibrations_mission_digest_missions"
        ),
    )
    op.create_index(
        "uq_calibrations_version", "calibrations", ["spacecraft", "version"], unique=True
    )
    op.create_table(
        "calibration_adoptions",
        sa.Column("id", ID, nullable=False),
        sa.Column("spacecraft", NAME, nullable=False),
        sa.Column("adopted", MOMENT, nullable=False),
        sa.Column("who", sa.String(64), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("calibration_id", ID),
        sa.Column("file_digest", DIGEST, nullable=False),
        sa.Column("mission_digest", DIGEST, nullable=False),
        sa.Column("trackers", sa.Text()),
        sa.PrimaryKeyConstraint("id", name="pk_calibration_adoptions"),
        sa.ForeignKeyConstraint(
            ["calibration_id"],
            ["calibrations.id"],
            name="fk_calibration_adoptions_calibration_id_calibrations",
        ),
        sa.ForeignKeyConstraint(
            ["mission_digest"],
            ["missions.digest"],
            name="fk_calibration_adoptions_mission_digest_missions",
        ),
    )
    op.create_index(
        "ix_calibration_adoptions_spacecraft", "calibration_adoptions", ["spacecraft", "id"]
    )


def downgrade() -> None:
    tables = (
        "calibration_adoptions",
        "calibrations",
        "archived_hours",
        "archived_what_ifs",
        "archived_batches",
        "archived_parts",
        "graded_blocks",
        "graded_days",
        "gyro_blocks",
        "webhook_sender",
        "webhook_deliveries",
        "webhooks",
        "audit",
        "access_sessions",
        "access_tokens",
        "event_counter",
        "events",
        "alarm_actions",
        "alarms",
        "watches",
        "limits",
        "annotations",
        "projector",
        "tracker_rollups_daily",
        "tracker_rollups_hourly",
        "rollups_daily",
        "rollups_hourly",
        "record_heads",
        "record_facts",
        "record_leaves",
        "seals",
        "replays",
        "idempotency_keys",
        "frames",
        "tracker_splits",
        "tracker_values",
        "solutions",
        "star_results",
        "results",
        "batches",
        "catalogs",
        "mission_uses",
        "missions",
        "runs",
    )
    for table in tables:
        op.drop_table(table)
    if op.get_bind().dialect.name == "postgresql":
        op.execute("DROP SEQUENCE results_seq")
