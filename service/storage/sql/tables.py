"""Database tables of the service, the same on SQLite and PostgreSQL.

    frames ──┐
    runs ── batches ── results ── star_results
                         │    └── solutions        no attitude, no row
    missions, catalogs ──┘
    idempotency_keys ── results
    mission_uses ── missions                       periods in which settings were in use
    tracker_values ── batches                      current result of each tracker
    rollups_hourly, rollups_daily                  sums over current results
    projector                                      position of the projections
    annotations                                    notes of people
    archived_parts, archived_batches, ...          archived batches (see their figure below)
    events, event_counter                          recent events in order of commit
    calibrations ── calibration_adoptions          of trackers, and the adopted ones
    replays
    access_tokens ── access_sessions, audit        permissions, and the log of changes

A batch holds the observations sent; a result is one evaluation of a batch.  The first result of a
batch has the batch's own id; recorded what-ifs add others, and exactly one result of a batch is
current.  Results repeat the spacecraft, run and time of their batch, so that one index answers a
list, a history or a trend.

A batch made from a frame has a row in `frames`: the detections and a small picture.  The frame
itself is not kept.

A batch's time is kept as the text of its UTC and as `time_ns`, nanoseconds of TAI from
2000-01-01T12:00:00 TAI, for order and ranges.
"""

import sqlalchemy as sa

from service.storage.sql.columns import (
    CURRENT,
    HAS_FIRST_ROW,
    Digest,
    Id,
    Moment,
    Name,
    PackedText,
    RunName,
    metadata,
    rows_where,
)
from service.trends.measures import STORED, Measured, MeasuredOfBatch, StarShare

access_tokens = sa.Table(
    "access_tokens",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("name", sa.String(64), nullable=False, unique=True),
    # Only the digest of a token is stored: a reader of the database cannot use it.
    sa.Column("digest", sa.String(64), nullable=False, unique=True),
    sa.Column("scopes", sa.Text, nullable=False),
    sa.Column("spacecraft", sa.Text),
    sa.Column("rate_per_s", sa.Double),
    sa.Column("created", Moment, nullable=False),
    sa.Column("expires", Moment, nullable=False),
    sa.Column("revoked", Moment),
)

access_sessions = sa.Table(
    "access_sessions",
    metadata,
    sa.Column("digest", sa.String(64), primary_key=True),
    sa.Column("token_id", Id, sa.ForeignKey(access_tokens.c.id), nullable=False),
    sa.Column("created", Moment, nullable=False),
    sa.Column("expires", Moment, nullable=False),
)

audit = sa.Table(
    "audit",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("moment", Moment, nullable=False),
    sa.Column("who", sa.String(80), nullable=False),
    sa.Column("action", sa.String(64), nullable=False),
    sa.Column("about", sa.Text, nullable=False),
    sa.Column("body", sa.Text),
    sa.Column("status", sa.SmallInteger),
)


# The rollups: sums and extremes of current results by hour and day, for trends.
#
# One pair is by spacecraft; the other also by tracker, for spacecraft with several.

COUNTS = ("batches", "observed", "unique", "ambiguous", "unmatched", "solved", "suspect")
_ROLLED_UP = {name: source for name, source in STORED.items() if source.rolled_up}
SHARES = tuple(name for name, source in _ROLLED_UP.items() if isinstance(source, StarShare))
"""Rollup columns of shares of a batch's stars, whose means follow from the counts."""
VALUES = tuple(name for name in _ROLLED_UP if name not in SHARES)
SUMS = tuple(f"{name}_{part}" for name in VALUES for part in ("n", "sum"))
MINIMA = tuple(f"{name}_min" for name in (*SHARES, *VALUES))
MAXIMA = tuple(f"{name}_max" for name in (*SHARES, *VALUES))
ROLLED_UP = (*COUNTS, *SUMS, *MINIMA, *MAXIMA)
"""Columns of a rollup without its key."""


def _rollup(name: str, *key: str) -> sa.Table:
    """Create a table of sums and extremes over current results by spacecraft, run and bucket.

    A bucket is a UTC hour or day (see `Utc.bucket`).  `_n` counts the batches with a value, whose
    sum is `_sum`; an extreme of no values is null.
    """
    return sa.Table(
        name,
        metadata,
        sa.Column("spacecraft", Name, primary_key=True),
        sa.Column("run", RunName, primary_key=True),
        *(sa.Column(name, Name, primary_key=True) for name in key),
        sa.Column("bucket", sa.Integer, primary_key=True, autoincrement=False),
        *(sa.Column(count, sa.BigInteger, nullable=False) for count in COUNTS),
        *(
            sa.Column(f"{name}_{part}", kind, nullable=False, server_default=sa.text("0"))
            for name in VALUES
            for part, kind in (("n", sa.BigInteger), ("sum", sa.Double))
        ),
        *(sa.Column(each, sa.Double) for each in (*MINIMA, *MAXIMA)),
        sqlite_with_rowid=False,
    )


rollups_hourly, rollups_daily = _rollup("rollups_hourly"), _rollup("rollups_daily")
tracker_rollups_hourly = _rollup("tracker_rollups_hourly", "tracker")
tracker_rollups_daily = _rollup("tracker_rollups_daily", "tracker")

tracker_splits = sa.Table(
    "tracker_splits",
    metadata,
    # A run of a spacecraft with older batches that are not split by tracker; no row: all are split.
    sa.Column("spacecraft", Name, primary_key=True),
    sa.Column("run", RunName, primary_key=True),
    # Batches before this one, in order of time, remain to be split; null: none is split yet.
    sa.Column("time_ns", sa.BigInteger),
    sa.Column("batch_id", Id),
    sqlite_with_rowid=False,
)


runs = sa.Table(
    "runs",
    metadata,
    sa.Column("name", RunName, primary_key=True),
    sa.Column("created", Moment, nullable=False),
    # True if limits are evaluated for the run; for live batches they always are.
    sa.Column("alarms", sa.Boolean, nullable=False, server_default=sa.false()),
    # True if reprocessed with tracking; the run must continue in the same mode.
    sa.Column("tracked", sa.Boolean, nullable=False, server_default=sa.false()),
)

missions = sa.Table(
    "missions",
    metadata,
    sa.Column("digest", Digest, primary_key=True),
    sa.Column("spacecraft", Name, nullable=False, index=True),
    sa.Column("settings", sa.Text, nullable=False),
    sa.Column("first_used", Moment, nullable=False),
    sa.Column("row_digest", sa.BigInteger),
)

mission_uses = sa.Table(
    "mission_uses",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("spacecraft", Name, nullable=False, index=True),
    sa.Column("digest", Digest, sa.ForeignKey(missions.c.digest), nullable=False),
    sa.Column("since", Moment, nullable=False),
    sa.Column("row_digest", sa.BigInteger),
)

# Calibrations of the trackers, and those that an operator adopted in place of the settings.
calibrations = sa.Table(
    "calibrations",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("spacecraft", Name, nullable=False),
    # Number of the calibration, from 1 for each spacecraft.
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("run", RunName, nullable=False),
    sa.Column("created", Moment, nullable=False),
    sa.Column("ended", Moment),
    sa.Column("who", sa.String(64), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("done", sa.Integer, nullable=False),
    sa.Column("total", sa.Integer, nullable=False),
    # Settings that the calibration started from.
    sa.Column("mission_digest", Digest, sa.ForeignKey(missions.c.digest), nullable=False),
    # JSON: the request, the result, and, since it is large, the covariance by itself.
    sa.Column("request", sa.Text, nullable=False),
    sa.Column("result", sa.Text),
    sa.Column("covariance", sa.Text),
    sa.Column("fault", sa.Text),
    sa.Index("uq_calibrations_version", "spacecraft", "version", unique=True),
)

calibration_adoptions = sa.Table(
    "calibration_adoptions",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("spacecraft", Name, nullable=False),
    sa.Column("adopted", Moment, nullable=False),
    sa.Column("who", sa.String(64), nullable=False),
    sa.Column("note", sa.Text, nullable=False),
    # Null: a return to the mission file.
    sa.Column("calibration_id", Id, sa.ForeignKey(calibrations.c.id)),
    # Settings of the mission file below the adoption, and those of both combined.
    sa.Column("file_digest", Digest, nullable=False),
    sa.Column("mission_digest", Digest, sa.ForeignKey(missions.c.digest), nullable=False),
    # JSON: alignment and focal plane of every tracker.  Null: those of the mission file.
    sa.Column("trackers", sa.Text),
    sa.Index("ix_calibration_adoptions_spacecraft", "spacecraft", "id"),
)

catalogs = sa.Table(
    "catalogs",
    metadata,
    sa.Column("digest", Digest, primary_key=True),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("first_used", Moment, nullable=False),
    sa.Column("row_digest", sa.BigInteger),
)

batches = sa.Table(
    "batches",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("spacecraft", Name, nullable=False),
    sa.Column("run", RunName, sa.ForeignKey(runs.c.name), nullable=False),
    sa.Column("batch", Name, nullable=False),
    sa.Column("time", Moment, nullable=False),
    sa.Column("time_ns", sa.BigInteger, nullable=False),
    sa.Column("received", Moment, nullable=False),
    sa.Column("fingerprint", sa.String(64), nullable=False),
    sa.Column("input", PackedText, nullable=False),
    sa.UniqueConstraint("spacecraft", "run", "batch"),
)

frames = sa.Table(
    "frames",
    metadata,
    sa.Column("batch_id", Id, sa.ForeignKey(batches.c.id), primary_key=True),
    sa.Column("digest", Digest, nullable=False, index=True),
    # JSON: the answer's part about the frame, and the detections.
    sa.Column("summary", sa.Text, nullable=False),
    sa.Column("detections", sa.Text, nullable=False),
    # PNG; `preview_step` frame pixels a side make one pixel of the preview.
    sa.Column("preview", sa.LargeBinary, nullable=False),
    sa.Column("preview_step", sa.Integer, nullable=False),
)

MEASURED = tuple(
    name for name, source in STORED.items() if isinstance(source, Measured | MeasuredOfBatch)
)
"""Names of the measured quantities that are columns in the table of results."""
COUNTED = ("observed", "unique", "ambiguous", "unmatched")
"""Names of the columns that count stars by outcome."""
_FILTERS = ("status", "unique", "ambiguous", "unmatched")

results = sa.Table(
    "results",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("batch_id", Id, sa.ForeignKey(batches.c.id), nullable=False),
    sa.Column("parent_id", Id, sa.ForeignKey("results.id")),
    sa.Column("current", sa.Boolean, nullable=False),
    # The order of recording; zero: recorded before orders were kept, or from an archive.
    sa.Column("seq", sa.BigInteger, nullable=False, server_default=sa.text("0")),
    sa.Column("created", Moment, nullable=False),
    sa.Column("spacecraft", Name, nullable=False),
    sa.Column("run", RunName, nullable=False),
    sa.Column("time_ns", sa.BigInteger, nullable=False),
    sa.Column("identifier", sa.String(32), nullable=False),
    sa.Column("options", sa.Text, nullable=False),
    sa.Column("mission_digest", Digest, sa.ForeignKey(missions.c.digest), nullable=False),
    sa.Column("catalog_digest", Digest, sa.ForeignKey(catalogs.c.digest), nullable=False),
    *(sa.Column(name, sa.Integer, nullable=False) for name in COUNTED),
    # Status of the attitude: good or suspect; null without an attitude, which has a reason then.
    sa.Column("status", sa.String(16)),
    sa.Column("reason", sa.String(64)),
    # Null where the quantity is not known.
    *(sa.Column(name, sa.Double) for name in MEASURED),
    # The answer's JSON, byte for byte as sent.
    sa.Column("answer", PackedText, nullable=False),
    # Digest of all that is kept of the result.  Null: recorded by an earlier version and not
    # digested yet; negative: digested later than recorded.
    sa.Column("digest", sa.BigInteger),
    # Lists, histories and trends read current results only, newest or oldest first; the columns of
    # their filters stand in the index, so that a page reads only its own rows from the table.
    sa.Index(
        "ix_results_current_by_spacecraft",
        *("spacecraft", "run", "time_ns", "batch_id"),
        *_FILTERS,
        # With these columns a trend over batches reads the index only.
        *MEASURED,
        **CURRENT,
    ),
    sa.Index("ix_results_current_by_run", "run", "time_ns", "batch_id", *_FILTERS, **CURRENT),
    sa.Index(
        "ix_results_current_by_time", "time_ns", "batch_id", "spacecraft", *_FILTERS, **CURRENT
    ),
    sa.Index("uq_results_current", "batch_id", unique=True, **CURRENT),
    sa.Index("ix_results_what_ifs", "batch_id", **rows_where("parent_id IS NOT NULL")),
    # The projector reads results in this order.
    sa.Index("ix_results_seq", "seq"),
    # Results that `OlderDigests` still has to digest; empty when it is done.
    sa.Index("ix_results_without_digest", "id", **rows_where("digest IS NULL")),
    # Deleting a batch checks the foreign key of its results.
    sa.Index("ix_results_batch_id", "batch_id"),
    # Deleting a result checks the foreign key of its what-ifs.
    sa.Index("ix_results_parent", "parent_id", **rows_where("parent_id IS NOT NULL")),
)

star_results = sa.Table(
    "star_results",
    metadata,
    sa.Column("result_id", Id, sa.ForeignKey(results.c.id), primary_key=True),
    sa.Column("tracker", Name, primary_key=True),
    sa.Column("position", sa.SmallInteger, primary_key=True),
    sa.Column("outcome", sa.String(16), nullable=False),
    sa.Column("star_id", sa.Text),
    sa.Column("votes", sa.Integer, nullable=False),
    sa.Column("runner_up", sa.Integer, nullable=False),
    sa.Column("probability", sa.Double),
    sa.Column("residual_arcsec", sa.Double),
    sqlite_with_rowid=False,
)

# Only for spacecraft with several trackers: with one tracker the result has the same values.
tracker_values = sa.Table(
    "tracker_values",
    metadata,
    sa.Column("batch_id", Id, sa.ForeignKey(batches.c.id), primary_key=True),
    sa.Column("tracker", Name, primary_key=True),
    *(sa.Column(name, sa.Integer, nullable=False) for name in COUNTED),
    # Status of the attitude: good, or suspect if this tracker disagrees; null without an attitude.
    sa.Column("status", sa.String(16)),
    *(sa.Column(name, sa.Double) for name in MEASURED),
    # Null for rows recorded by an earlier version.
    sa.Column("row_digest", sa.BigInteger),
    sqlite_with_rowid=False,
)

solutions = sa.Table(
    "solutions",
    metadata,
    sa.Column("result_id", Id, sa.ForeignKey(results.c.id), primary_key=True),
    *(sa.Column(name, sa.Double, nullable=False) for name in ("q1", "q2", "q3", "qc")),
    sa.Column("frame", sa.String(16), nullable=False),
    # The upper triangle of the covariance, arcsec^2 about the body axes.
    *(
        sa.Column(name, sa.Double, nullable=False)
        for name in ("p11", "p12", "p13", "p22", "p23", "p33")
    ),
    sa.Column("residual_rms_arcsec", sa.Double, nullable=False),
    sa.Column("predicted_rms_arcsec", sa.Double, nullable=False),
    sa.Column("taste", sa.Double, nullable=False),
    sa.Column("method", sa.String(32), nullable=False),
    sa.Column("status", sa.String(16), nullable=False),
    sqlite_with_rowid=False,
)

idempotency_keys = sa.Table(
    "idempotency_keys",
    metadata,
    # Token that sent the key; empty for keys sent while access was open.
    sa.Column("token_id", sa.String(26), primary_key=True, server_default=sa.text("''")),
    sa.Column("key", sa.String(255), primary_key=True),
    sa.Column("fingerprint", sa.String(64), nullable=False),
    sa.Column("result_id", Id, sa.ForeignKey(results.c.id), nullable=False, index=True),
)

replays = sa.Table(
    "replays",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("run", RunName, nullable=False),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("lines_total", sa.BigInteger),
    *(sa.Column(name, sa.BigInteger, nullable=False) for name in ("lines_done", "lines_refused")),
    sa.Column("errors", sa.Text, nullable=False),
    sa.Column("counts", sa.Text),
    sa.Column("started", Moment, nullable=False),
    sa.Column("finished", Moment),
)

# Digest of each hour of TAI, up to the projector's position; see `projections.seals`.
seals = sa.Table(
    "seals",
    metadata,
    sa.Column("spacecraft", Name, primary_key=True),
    sa.Column("run", RunName, primary_key=True),
    sa.Column("hour", sa.BigInteger, primary_key=True, autoincrement=False),
    sa.Column("results", sa.Integer, nullable=False),
    sa.Column("digests", sa.BigInteger, nullable=False),
    sqlite_with_rowid=False,
)

projector = sa.Table(
    "projector",
    metadata,
    # One row: every result up to this place is in the projections, and none after it.
    sa.Column("id", sa.SmallInteger, primary_key=True, autoincrement=False),
    sa.Column("seq", sa.BigInteger, nullable=False),
    info={HAS_FIRST_ROW: True},
)

events = sa.Table(
    "events",
    metadata,
    sa.Column("id", sa.BigInteger, primary_key=True, autoincrement=False),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("run", RunName),
    sa.Column("spacecraft", Name),
    sa.Column("data", sa.Text, nullable=False),
    # Null for events recorded by an earlier version.
    sa.Column("at", Moment),
)

event_counter = sa.Table(
    "event_counter",
    metadata,
    # One row; its lock orders the events of several processes by their commit.
    sa.Column("id", sa.SmallInteger, primary_key=True, autoincrement=False),
    sa.Column("last", sa.BigInteger, nullable=False),
    info={HAS_FIRST_ROW: True},
)

WRITTEN_BY_POSTS = (
    runs,
    batches,
    results,
    star_results,
    solutions,
    tracker_values,
    rollups_hourly,
    rollups_daily,
    tracker_rollups_hourly,
    tracker_rollups_daily,
    idempotency_keys,
    events,
    event_counter,
)
"""Tables written for a batch by its post and by the projector, without those of features."""

annotations = sa.Table(
    "annotations",
    metadata,
    sa.Column("id", Id, primary_key=True),
    # Null: about every spacecraft.
    sa.Column("spacecraft", Name),
    # Telemetry time, as a batch has; without an end the annotation is about a moment.
    sa.Column("start", Moment, nullable=False),
    sa.Column("start_ns", sa.BigInteger, nullable=False),
    sa.Column("end", Moment),
    sa.Column("end_ns", sa.BigInteger, nullable=False),
    sa.Column("text", sa.Text, nullable=False),
    sa.Column("who", sa.String(64), nullable=False),
    sa.Column("created", Moment, nullable=False),
)


# The tables of the archive: the batches that left the database, and the files that hold them.
#
# archived_parts ── archived_batches ── archived_what_ifs
#          └── archived_hours
#
# A batch has a row in `batches` or in `archived_batches`, never in both: one transaction moves it
# between them, and so (spacecraft, run, batch) stays unique after archiving.

archived_parts = sa.Table(
    "archived_parts",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    # Path below the folder of the archive.
    sa.Column("path", sa.Text, nullable=False, unique=True),
    sa.Column("spacecraft", Name, nullable=False),
    sa.Column("run", RunName, nullable=False),
    # Times of the first batch and of the last.
    sa.Column("first_ns", sa.BigInteger, nullable=False),
    sa.Column("last_ns", sa.BigInteger, nullable=False),
    sa.Column("batches", sa.Integer, nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False),
    # A part spans no more than a day, so those of a period are found by their end.
    sa.Index("ix_archived_parts_by_spacecraft", "spacecraft", "run", "last_ns"),
    sa.Index("ix_archived_parts_by_time", "last_ns"),
)

# No foreign key to the part: without an index, deleting a part would scan this table.
archived_batches = sa.Table(
    "archived_batches",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("spacecraft", Name, nullable=False),
    sa.Column("run", RunName, nullable=False),
    sa.Column("batch", Name, nullable=False),
    sa.Column("fingerprint", sa.String(64), nullable=False),
    sa.Column("part_id", sa.Integer, nullable=False),
    sa.UniqueConstraint("spacecraft", "run", "batch"),
    sqlite_with_rowid=False,
)

# Archived results that do not have the id of their batch.
archived_what_ifs = sa.Table(
    "archived_what_ifs",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("batch_id", Id, nullable=False),
    sqlite_with_rowid=False,
)

# Share of a part in the trends of an hour, kept since extremes cannot be subtracted afterwards.
archived_hours = sa.Table(
    "archived_hours",
    metadata,
    sa.Column("spacecraft", Name, primary_key=True),
    sa.Column("run", RunName, primary_key=True),
    sa.Column("bucket", sa.Integer, primary_key=True, autoincrement=False),
    # Empty for the spacecraft as a whole.
    sa.Column("tracker", Name, primary_key=True),
    sa.Column("part_id", sa.Integer, primary_key=True, autoincrement=False),
    # JSON: the columns of a rollup.
    sa.Column("sums", sa.Text, nullable=False),
    sqlite_with_rowid=False,
)

gyro_blocks = sa.Table(
    "gyro_blocks",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("spacecraft", Name, nullable=False),
    sa.Column("run", RunName, sa.ForeignKey(runs.c.name), nullable=False),
    sa.Column("block", Name, nullable=False),
    # Times of the first sample and of the last.
    sa.Column("start", Moment, nullable=False),
    sa.Column("end", Moment, nullable=False),
    sa.Column("start_ns", sa.BigInteger, nullable=False),
    sa.Column("end_ns", sa.BigInteger, nullable=False),
    sa.Column("received", Moment, nullable=False),
    sa.Column("fingerprint", sa.String(64), nullable=False),
    sa.Column("samples", sa.Integer, nullable=False),
    # Null where the block has a time for each sample.
    sa.Column("step_s", sa.Double),
    # Packed arrays: see service/gyro/blocks.py.
    sa.Column("times_s", sa.LargeBinary),
    sa.Column("rates_rad_per_s", sa.LargeBinary, nullable=False),
    sa.UniqueConstraint("spacecraft", "run", "block"),
    # For periods, and for blocks that may share a time: no block spans more than a day.
    sa.Index("ix_gyro_blocks_by_start", "spacecraft", "run", "start_ns", "end_ns"),
    # For pruning, which finds blocks by their end, in all runs or in one.
    sa.Index("ix_gyro_blocks_by_end", "end_ns"),
)
