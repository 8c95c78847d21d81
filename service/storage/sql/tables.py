"""The tables, the same on SQLite and PostgreSQL.

    frames ──┐
    runs ── batches ── results ── star_results
                         │    └── solutions        no attitude, no row
    missions, catalogs ──┘
    idempotency_keys ── results
    mission_uses ── missions                       from when each settings were in use
    tracker_values ── batches                      its current result, tracker by tracker
    rollups_hourly, rollups_daily                  of current results
    projector                                      how far projections have come
    annotations                                    notes of people
    archived_parts, archived_batches, ...          batches that left it (see their figure below)
    events, event_counter                          recent events in order of commit
    calibrations ── calibration_adoptions          of trackers, and what holds of them
    replays
    access_tokens ── access_sessions, audit        who may ask, who changed what

A batch is what was sent; a result is what was made of it.  The first result of
a batch has the batch's own id; recorded what-ifs add others, and exactly one
result of a batch is current.  Results repeat the spacecraft, run and time of
their batch, so that one index answers a list, a history or a trend.

A batch that was made of a frame has a row in `frames`: what was found on it, and a
small picture.  The frame itself is not kept.

A batch's time is kept as the text of its UTC and as `time_ns`, nanoseconds of
TAI from 2000-01-01T12:00:00 TAI, for order and ranges.
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
# Of spacecraft, and of the trackers of spacecraft that have several.

COUNTS = ("batches", "observed", "unique", "ambiguous", "unmatched", "solved", "suspect")
_ROLLED_UP = {name: source for name, source in STORED.items() if source.rolled_up}
SHARES = tuple(name for name, source in _ROLLED_UP.items() if isinstance(source, StarShare))
"""Shares of a batch's stars; their means follow from the counts."""
VALUES = tuple(name for name in _ROLLED_UP if name not in SHARES)
SUMS = tuple(f"{name}_{part}" for name in VALUES for part in ("n", "sum"))
MINIMA = tuple(f"{name}_min" for name in (*SHARES, *VALUES))
MAXIMA = tuple(f"{name}_max" for name in (*SHARES, *VALUES))
ROLLED_UP = (*COUNTS, *SUMS, *MINIMA, *MAXIMA)
"""The columns of a rollup without its key."""


def _rollup(name: str, *key: str) -> sa.Table:
    """Sums and extremes over the current results of each spacecraft, run, tracker and bucket.

    A bucket is a UTC hour or day (see `Utc.bucket`).  `_n` batches have the
    value whose `_sum` stands beside it; an extreme of none is null.
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
    # A run of a spacecraft whose older batches are not split by tracker yet; no row: all are.
    sa.Column("spacecraft", Name, primary_key=True),
    sa.Column("run", RunName, primary_key=True),
    # Batches before this one, in order of time, are still to be split; null: none was.
    sa.Column("time_ns", sa.BigInteger),
    sa.Column("batch_id", Id),
    sqlite_with_rowid=False,
)


runs = sa.Table(
    "runs",
    metadata,
    sa.Column("name", RunName, primary_key=True),
    sa.Column("created", Moment, nullable=False),
    # Whether limits are held against the run; live batches are watched in any case.
    sa.Column("alarms", sa.Boolean, nullable=False, server_default=sa.false()),
    # Whether it was reprocessed with tracking: it must not continue without, nor another with.
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

# Calibrations of the trackers, and what an operator adopted of them in the place of the settings.
calibrations = sa.Table(
    "calibrations",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("spacecraft", Name, nullable=False),
    # From 1 for each spacecraft.
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("run", RunName, nullable=False),
    sa.Column("created", Moment, nullable=False),
    sa.Column("ended", Moment),
    sa.Column("who", sa.String(64), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("done", sa.Integer, nullable=False),
    sa.Column("total", sa.Integer, nullable=False),
    # The settings that it started from.
    sa.Column("mission_digest", Digest, sa.ForeignKey(missions.c.digest), nullable=False),
    # JSON: what was asked, what was found, and the covariance, which is large, by itself.
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
    # Null: back to the mission file.
    sa.Column("calibration_id", Id, sa.ForeignKey(calibrations.c.id)),
    # The settings of the mission file that it lies over, and those of both together.
    sa.Column("file_digest", Digest, nullable=False),
    sa.Column("mission_digest", Digest, sa.ForeignKey(missions.c.digest), nullable=False),
    # JSON: alignment and focal plane of every tracker.  Null: as the mission file has them.
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
    # JSON: what the answer says of the frame, and what was found on it.
    sa.Column("summary", sa.Text, nullable=False),
    sa.Column("detections", sa.Text, nullable=False),
    # PNG; so many pixels a side of the frame make one of it.
    sa.Column("preview", sa.LargeBinary, nullable=False),
    sa.Column("preview_step", sa.Integer, nullable=False),
)

MEASURED = tuple(
    name for name, source in STORED.items() if isinstance(source, Measured | MeasuredOfBatch)
)
"""The columns of measured quantities."""
COUNTED = ("observed", "unique", "ambiguous", "unmatched")
"""The columns that count stars."""
_FILTERS = ("status", "unique", "ambiguous", "unmatched")

results = sa.Table(
    "results",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("batch_id", Id, sa.ForeignKey(batches.c.id), nullable=False),
    sa.Column("parent_id", Id, sa.ForeignKey("results.id")),
    sa.Column("current", sa.Boolean, nullable=False),
    # The order in which results were recorded; zero: before there was one, or from an archive.
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
    # Of the attitude: good or suspect; null where there is none, and then a reason.
    sa.Column("status", sa.String(16)),
    sa.Column("reason", sa.String(64)),
    # Null where the quantity is not known.
    *(sa.Column(name, sa.Double) for name in MEASURED),
    # The answer's JSON, byte for byte as it was sent.
    sa.Column("answer", PackedText, nullable=False),
    # Of all that is kept of the result.  Null: an earlier version recorded it, and the service has
    # not come to it yet; negative: then it was made, after the result.
    sa.Column("digest", sa.BigInteger),
    # Lists, histories and trends look at current results alone, newest or oldest first; what they
    # filter by stands in the index, so that a page touches the table only for the rows it shows.
    sa.Index(
        "ix_results_current_by_spacecraft",
        *("spacecraft", "run", "time_ns", "batch_id"),
        *_FILTERS,
        # A trend over batches is drawn from the index alone.
        *MEASURED,
        **CURRENT,
    ),
    sa.Index("ix_results_current_by_run", "run", "time_ns", "batch_id", *_FILTERS, **CURRENT),
    sa.Index(
        "ix_results_current_by_time", "time_ns", "batch_id", "spacecraft", *_FILTERS, **CURRENT
    ),
    sa.Index("uq_results_current", "batch_id", unique=True, **CURRENT),
    sa.Index("ix_results_what_ifs", "batch_id", **rows_where("parent_id IS NOT NULL")),
    # The projector takes results in their order.
    sa.Index("ix_results_seq", "seq"),
    # Empty, or what `OlderDigests` still has to do.
    sa.Index("ix_results_without_digest", "id", **rows_where("digest IS NULL")),
    # Deleting a batch checks the foreign key of its results, and finds them.
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

# Only of spacecraft with several trackers: of one alone the result has the same values.
tracker_values = sa.Table(
    "tracker_values",
    metadata,
    sa.Column("batch_id", Id, sa.ForeignKey(batches.c.id), primary_key=True),
    sa.Column("tracker", Name, primary_key=True),
    *(sa.Column(name, sa.Integer, nullable=False) for name in COUNTED),
    # Of the attitude: good, or suspect if this is the tracker that disagrees; null without.
    sa.Column("status", sa.String(16)),
    *(sa.Column(name, sa.Double) for name in MEASURED),
    # Null: an earlier version recorded it.
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
    # The token whose key it is; empty: none, for keys sent while access was open.
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

# Of each hour of TAI, up to the projector's position; see `projections.seals`.
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
    # One row: every result up to this one is in the projections, and none after it.
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
    # Null: recorded by an earlier version.
    sa.Column("at", Moment),
)

event_counter = sa.Table(
    "event_counter",
    metadata,
    # One row, whose lock orders the events of several processes as they are committed.
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
"""The tables that a batch is written to, by its post and by the projector, without features'."""

annotations = sa.Table(
    "annotations",
    metadata,
    sa.Column("id", Id, primary_key=True),
    # Null: about every spacecraft.
    sa.Column("spacecraft", Name),
    # In telemetry time, as a batch has it; without an end it is about a moment.
    sa.Column("start", Moment, nullable=False),
    sa.Column("start_ns", sa.BigInteger, nullable=False),
    sa.Column("end", Moment),
    sa.Column("end_ns", sa.BigInteger, nullable=False),
    sa.Column("text", sa.Text, nullable=False),
    sa.Column("who", sa.String(64), nullable=False),
    sa.Column("created", Moment, nullable=False),
)


# The tables of the archive: which batches left the database, and where they are.
#
# archived_parts ── archived_batches ── archived_what_ifs
#          └── archived_hours
#
# A batch has a row in `batches` or in `archived_batches`, never in both: one transaction takes it
# from one to the other, and so (spacecraft, run, batch) stays unique after archiving.

archived_parts = sa.Table(
    "archived_parts",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    # Below the folder of the archive.
    sa.Column("path", sa.Text, nullable=False, unique=True),
    sa.Column("spacecraft", Name, nullable=False),
    sa.Column("run", RunName, nullable=False),
    # Of the first batch and of the last.
    sa.Column("first_ns", sa.BigInteger, nullable=False),
    sa.Column("last_ns", sa.BigInteger, nullable=False),
    sa.Column("batches", sa.Integer, nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False),
    # A part spans no more than a day: those of a period are found by their end.
    sa.Index("ix_archived_parts_by_spacecraft", "spacecraft", "run", "last_ns"),
    sa.Index("ix_archived_parts_by_time", "last_ns"),
)

# No foreign key names the part: to delete a part, each would be looked for without an index.
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

# The results of archived batches that do not have the id of their batch.
archived_what_ifs = sa.Table(
    "archived_what_ifs",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("batch_id", Id, nullable=False),
    sqlite_with_rowid=False,
)

# The share of a part in the trends of an hour: extremes cannot be subtracted from those of others.
archived_hours = sa.Table(
    "archived_hours",
    metadata,
    sa.Column("spacecraft", Name, primary_key=True),
    sa.Column("run", RunName, primary_key=True),
    sa.Column("bucket", sa.Integer, primary_key=True, autoincrement=False),
    # Empty: of the spacecraft as a whole.
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
    # Of the first sample and of the last.
    sa.Column("start", Moment, nullable=False),
    sa.Column("end", Moment, nullable=False),
    sa.Column("start_ns", sa.BigInteger, nullable=False),
    sa.Column("end_ns", sa.BigInteger, nullable=False),
    sa.Column("received", Moment, nullable=False),
    sa.Column("fingerprint", sa.String(64), nullable=False),
    sa.Column("samples", sa.Integer, nullable=False),
    # Null where the block has times of its own.
    sa.Column("step_s", sa.Double),
    # Packed: see service/gyro/blocks.py.
    sa.Column("times_s", sa.LargeBinary),
    sa.Column("rates_rad_per_s", sa.LargeBinary, nullable=False),
    sa.UniqueConstraint("spacecraft", "run", "block"),
    # Periods, and blocks that may share a time with another: no block spans more than a day.
    sa.Index("ix_gyro_blocks_by_start", "spacecraft", "run", "start_ns", "end_ns"),
    # Pruning finds blocks by their end, in all runs or in one.
    sa.Index("ix_gyro_blocks_by_end", "end_ns"),
)
