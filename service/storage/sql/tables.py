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
    limits, watches, alarms ── alarm_actions       limits and alarms (alarm_tables.py)
    annotations                                    notes of people (alarm_tables.py)
    archived_parts, archived_batches, ...          batches that left it (see their figure below)
    events, event_counter                          recent events in order of commit
    replays
    access_tokens ── access_sessions, audit        who may ask, who changed what (access_tables.py)

A batch is what was sent; a result is what was made of it.  The first result of
a batch has the batch's own id; recorded what-ifs add others, and exactly one
result of a batch is current.  Results repeat the spacecraft, run and time of
their batch, so that one index answers a list, a history or a trend.

A batch that was made of a frame has a row in `frames`: what was found on it, and a
small picture.  The frame itself is not kept.

A batch's time is kept as the text of its UTC and as `time_ns`, nanoseconds of
TAI from 2000-01-01T12:00:00 TAI, for order and ranges.
"""

from typing import Any

from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Double,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    SmallInteger,
    String,
    Table,
    Text,
    UniqueConstraint,
    false,
    text,
)

from service.alarms.quantities import QUANTITIES, Measured
from service.storage.sql.alarm_tables import alarm_actions, alarms, watches
from service.storage.sql.columns import Digest, Id, Moment, Name, PackedText, RunName, metadata

# The rollups: sums and extremes of current results by hour and day, for trends.
#
# Of spacecraft, and of the trackers of spacecraft that have several.

COUNTS = ("batches", "observed", "unique", "ambiguous", "unmatched", "solved", "suspect")
_ROLLED_UP = [each for each in QUANTITIES.values() if each.rolled_up]
SHARES = tuple(each.name for each in _ROLLED_UP if each.is_share)
"""Shares of a batch's stars; their means follow from the counts."""
VALUES = tuple(each.name for each in _ROLLED_UP if not each.is_share)
SUMS = tuple(f"{name}_{part}" for name in VALUES for part in ("n", "sum"))
MINIMA = tuple(f"{name}_min" for name in (*SHARES, *VALUES))
MAXIMA = tuple(f"{name}_max" for name in (*SHARES, *VALUES))
ROLLED_UP = (*COUNTS, *SUMS, *MINIMA, *MAXIMA)
"""The columns of a rollup without its key."""


def _rollup(name: str, *trackers: Column[str]) -> Table:
    """Sums and extremes over the current results of each spacecraft, run, tracker and bucket.

    A bucket is a UTC hour or day (see `Utc.bucket`).  `_n` batches have the
    value whose `_sum` stands beside it; an extreme of none is null.
    """
    return Table(
        name,
        metadata,
        Column("spacecraft", Name, primary_key=True),
        Column("run", RunName, primary_key=True),
        *trackers,
        Column("bucket", Integer, primary_key=True, autoincrement=False),
        *(Column(count, BigInteger, nullable=False) for count in COUNTS),
        *(Column(each, _type_of(each), nullable=False, server_default=text("0")) for each in SUMS),
        *(Column(each, Double) for each in (*MINIMA, *MAXIMA)),
        sqlite_with_rowid=False,
    )


def _type_of(sum_name: str) -> type[BigInteger] | type[Double[float]]:
    return BigInteger if sum_name.endswith("_n") else Double


rollups_hourly = _rollup("rollups_hourly")
rollups_daily = _rollup("rollups_daily")
tracker_rollups_hourly = _rollup(
    "tracker_rollups_hourly", Column("tracker", Name, primary_key=True)
)
tracker_rollups_daily = _rollup("tracker_rollups_daily", Column("tracker", Name, primary_key=True))

tracker_splits = Table(
    "tracker_splits",
    metadata,
    # A run of a spacecraft whose older batches are not split by tracker yet; no row: all are.
    Column("spacecraft", Name, primary_key=True),
    Column("run", RunName, primary_key=True),
    # Batches before this one, in order of time, are still to be split; null: none was.
    Column("time_ns", BigInteger),
    Column("batch_id", Id),
    sqlite_with_rowid=False,
)


runs = Table(
    "runs",
    metadata,
    Column("name", RunName, primary_key=True),
    Column("created", Moment, nullable=False),
    # Whether limits are held against the run; live batches are watched in any case.
    Column("alarms", Boolean, nullable=False, server_default=false()),
    # Whether it was reprocessed with tracking: it must not continue without, nor another with.
    Column("tracked", Boolean, nullable=False, server_default=false()),
)

missions = Table(
    "missions",
    metadata,
    Column("digest", Digest, primary_key=True),
    Column("spacecraft", Name, nullable=False, index=True),
    Column("settings", Text, nullable=False),
    Column("first_used", Moment, nullable=False),
    Column("row_digest", BigInteger),
)

mission_uses = Table(
    "mission_uses",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("spacecraft", Name, nullable=False, index=True),
    Column("digest", Digest, ForeignKey(missions.c.digest), nullable=False),
    Column("since", Moment, nullable=False),
    Column("row_digest", BigInteger),
)

catalogs = Table(
    "catalogs",
    metadata,
    Column("digest", Digest, primary_key=True),
    Column("name", Text, nullable=False),
    Column("first_used", Moment, nullable=False),
    Column("row_digest", BigInteger),
)

batches = Table(
    "batches",
    metadata,
    Column("id", Id, primary_key=True),
    Column("spacecraft", Name, nullable=False),
    Column("run", RunName, ForeignKey(runs.c.name), nullable=False),
    Column("batch", Name, nullable=False),
    Column("time", Moment, nullable=False),
    Column("time_ns", BigInteger, nullable=False),
    Column("received", Moment, nullable=False),
    Column("fingerprint", String(64), nullable=False),
    Column("input", PackedText, nullable=False),
    UniqueConstraint("spacecraft", "run", "batch"),
)

frames = Table(
    "frames",
    metadata,
    Column("batch_id", Id, ForeignKey(batches.c.id), primary_key=True),
    Column("digest", Digest, nullable=False, index=True),
    # JSON: what the answer says of the frame, and what was found on it.
    Column("summary", Text, nullable=False),
    Column("detections", Text, nullable=False),
    # PNG; so many pixels a side of the frame make one of it.
    Column("preview", LargeBinary, nullable=False),
    Column("preview_step", Integer, nullable=False),
)

MEASURED = tuple(n for n, each in QUANTITIES.items() if isinstance(each.source, Measured))
"""The columns of measured quantities."""
COUNTED = ("observed", "unique", "ambiguous", "unmatched")
"""The columns that count stars."""

results = Table(
    "results",
    metadata,
    Column("id", Id, primary_key=True),
    Column("batch_id", Id, ForeignKey(batches.c.id), nullable=False),
    Column("parent_id", Id, ForeignKey("results.id")),
    Column("current", Boolean, nullable=False),
    # The order in which results were recorded; zero: before there was one, or from an archive.
    Column("seq", BigInteger, nullable=False, server_default=text("0")),
    Column("created", Moment, nullable=False),
    Column("spacecraft", Name, nullable=False),
    Column("run", RunName, nullable=False),
    Column("time_ns", BigInteger, nullable=False),
    Column("identifier", String(32), nullable=False),
    Column("options", Text, nullable=False),
    Column("mission_digest", Digest, ForeignKey(missions.c.digest), nullable=False),
    Column("catalog_digest", Digest, ForeignKey(catalogs.c.digest), nullable=False),
    *(Column(name, Integer, nullable=False) for name in COUNTED),
    # Of the attitude: good or suspect; null where there is none, and then a reason.
    Column("status", String(16)),
    Column("reason", String(64)),
    # Null where the quantity is not known.
    *(Column(name, Double) for name in MEASURED),
    # The answer's JSON, byte for byte as it was sent.
    Column("answer", PackedText, nullable=False),
    # Of all that is kept of the result.  Null: an earlier version recorded it, and the service has
    # not come to it yet; negative: then it was made, after the result.
    Column("digest", BigInteger),
)

# Lists, histories and trends look at current results alone, newest or oldest first; what they
# filter by stands in the index, so that a page touches the table only for the rows it shows.
_FILTERS = [results.c[name] for name in ("status", "unique", "ambiguous", "unmatched")]
# SQLite uses a partial index only where the query repeats its words.
_CURRENT: dict[str, Any] = {
    "sqlite_where": text("current = 1"),
    "postgresql_where": text("current"),
}
Index(
    "ix_results_current_by_spacecraft",
    results.c.spacecraft,
    results.c.run,
    results.c.time_ns,
    results.c.batch_id,
    *_FILTERS,
    # A trend over batches is drawn from the index alone.
    *(results.c[name] for name in MEASURED),
    **_CURRENT,
)
Index(
    "ix_results_current_by_run",
    results.c.run,
    results.c.time_ns,
    results.c.batch_id,
    *_FILTERS,
    **_CURRENT,
)
Index(
    "ix_results_current_by_time",
    results.c.time_ns,
    results.c.batch_id,
    results.c.spacecraft,
    *_FILTERS,
    **_CURRENT,
)
Index("uq_results_current", results.c.batch_id, unique=True, **_CURRENT)
Index(
    "ix_results_what_ifs",
    results.c.batch_id,
    sqlite_where=results.c.parent_id.is_not(None),
    postgresql_where=results.c.parent_id.is_not(None),
)

# The projector takes results in their order.
Index("ix_results_seq", results.c.seq)

# Empty, or what `upkeep.older_digests` still has to do.
Index(
    "ix_results_without_digest",
    results.c.id,
    sqlite_where=results.c.digest.is_(None),
    postgresql_where=results.c.digest.is_(None),
)

# Deleting a batch checks the foreign key of its results, and finds them.
Index("ix_results_batch_id", results.c.batch_id)

# Deleting a result checks the foreign key of its what-ifs.
Index(
    "ix_results_parent",
    results.c.parent_id,
    sqlite_where=results.c.parent_id.is_not(None),
    postgresql_where=results.c.parent_id.is_not(None),
)

star_results = Table(
    "star_results",
    metadata,
    Column("result_id", Id, ForeignKey(results.c.id), primary_key=True),
    Column("tracker", Name, primary_key=True),
    Column("position", SmallInteger, primary_key=True),
    Column("outcome", String(16), nullable=False),
    Column("star_id", Text),
    Column("votes", Integer, nullable=False),
    Column("runner_up", Integer, nullable=False),
    Column("probability", Double),
    Column("residual_arcsec", Double),
    sqlite_with_rowid=False,
)

# Only of spacecraft with several trackers: of one alone the result has the same values.
tracker_values = Table(
    "tracker_values",
    metadata,
    Column("batch_id", Id, ForeignKey(batches.c.id), primary_key=True),
    Column("tracker", Name, primary_key=True),
    *(Column(name, Integer, nullable=False) for name in COUNTED),
    # Of the attitude: good, or suspect if this is the tracker that disagrees; null without.
    Column("status", String(16)),
    *(Column(name, Double) for name in MEASURED),
    # Null: an earlier version recorded it.
    Column("row_digest", BigInteger),
    sqlite_with_rowid=False,
)

solutions = Table(
    "solutions",
    metadata,
    Column("result_id", Id, ForeignKey(results.c.id), primary_key=True),
    *(Column(name, Double, nullable=False) for name in ("q1", "q2", "q3", "qc")),
    Column("frame", String(16), nullable=False),
    # The upper triangle of the covariance, arcsec^2 about the body axes.
    *(Column(name, Double, nullable=False) for name in ("p11", "p12", "p13", "p22", "p23", "p33")),
    Column("residual_rms_arcsec", Double, nullable=False),
    Column("predicted_rms_arcsec", Double, nullable=False),
    Column("taste", Double, nullable=False),
    Column("method", String(32), nullable=False),
    Column("status", String(16), nullable=False),
    sqlite_with_rowid=False,
)

idempotency_keys = Table(
    "idempotency_keys",
    metadata,
    # The token whose key it is; empty: none, for keys sent while access was open.
    Column("token_id", String(26), primary_key=True, server_default=text("''")),
    Column("key", String(255), primary_key=True),
    Column("fingerprint", String(64), nullable=False),
    Column("result_id", Id, ForeignKey(results.c.id), nullable=False, index=True),
)

replays = Table(
    "replays",
    metadata,
    Column("id", Id, primary_key=True),
    Column("run", RunName, nullable=False),
    Column("name", Text, nullable=False),
    Column("state", String(16), nullable=False),
    Column("lines_total", BigInteger),
    *(Column(name, BigInteger, nullable=False) for name in ("lines_done", "lines_refused")),
    Column("errors", Text, nullable=False),
    Column("counts", Text),
    Column("started", Moment, nullable=False),
    Column("finished", Moment),
)

# Of each hour of TAI, up to the projector's position; see `projections.seals`.
seals = Table(
    "seals",
    metadata,
    Column("spacecraft", Name, primary_key=True),
    Column("run", RunName, primary_key=True),
    Column("hour", BigInteger, primary_key=True, autoincrement=False),
    Column("results", Integer, nullable=False),
    Column("digests", BigInteger, nullable=False),
    sqlite_with_rowid=False,
)

projector = Table(
    "projector",
    metadata,
    # One row: every result up to this one is in the projections, and none after it.
    Column("id", SmallInteger, primary_key=True, autoincrement=False),
    Column("seq", BigInteger, nullable=False),
)

events = Table(
    "events",
    metadata,
    Column("id", BigInteger, primary_key=True, autoincrement=False),
    Column("kind", String(16), nullable=False),
    Column("run", RunName),
    Column("spacecraft", Name),
    Column("data", Text, nullable=False),
    # Null: recorded by an earlier version.
    Column("at", Moment),
)

event_counter = Table(
    "event_counter",
    metadata,
    # One row, whose lock orders the events of several processes as they are committed.
    Column("id", SmallInteger, primary_key=True, autoincrement=False),
    Column("last", BigInteger, nullable=False),
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
    watches,
    alarms,
    alarm_actions,
    events,
    event_counter,
)
"""The tables that a batch is written to, by its post and by the projector."""


# The tables of the archive: which batches left the database, and where they are.
#
# archived_parts ── archived_batches ── archived_what_ifs
#          └── archived_hours
#
# A batch has a row in `batches` or in `archived_batches`, never in both: one transaction takes it
# from one to the other, and so (spacecraft, run, batch) stays unique after archiving.

archived_parts = Table(
    "archived_parts",
    metadata,
    Column("id", Integer, primary_key=True),
    # Below the folder of the archive.
    Column("path", Text, nullable=False, unique=True),
    Column("spacecraft", Name, nullable=False),
    Column("run", RunName, nullable=False),
    # Of the first batch and of the last.
    Column("first_ns", BigInteger, nullable=False),
    Column("last_ns", BigInteger, nullable=False),
    Column("batches", Integer, nullable=False),
    Column("sha256", String(64), nullable=False),
)
# A part spans no more than a day: those of a period are found by their end.
Index(
    "ix_archived_parts_by_spacecraft",
    archived_parts.c.spacecraft,
    archived_parts.c.run,
    archived_parts.c.last_ns,
)
Index("ix_archived_parts_by_time", archived_parts.c.last_ns)

# No foreign key names the part: to delete a part, each would be looked for without an index.
archived_batches = Table(
    "archived_batches",
    metadata,
    Column("id", Id, primary_key=True),
    Column("spacecraft", Name, nullable=False),
    Column("run", RunName, nullable=False),
    Column("batch", Name, nullable=False),
    Column("fingerprint", String(64), nullable=False),
    Column("part_id", Integer, nullable=False),
    UniqueConstraint("spacecraft", "run", "batch"),
    sqlite_with_rowid=False,
)

# The results of archived batches that do not have the id of their batch.
archived_what_ifs = Table(
    "archived_what_ifs",
    metadata,
    Column("id", Id, primary_key=True),
    Column("batch_id", Id, nullable=False),
    sqlite_with_rowid=False,
)

# The share of a part in the trends of an hour: extremes cannot be subtracted from those of others.
archived_hours = Table(
    "archived_hours",
    metadata,
    Column("spacecraft", Name, primary_key=True),
    Column("run", RunName, primary_key=True),
    Column("bucket", Integer, primary_key=True, autoincrement=False),
    # Empty: of the spacecraft as a whole.
    Column("tracker", Name, primary_key=True),
    Column("part_id", Integer, primary_key=True, autoincrement=False),
    # JSON: the columns of a rollup.
    Column("sums", Text, nullable=False),
    sqlite_with_rowid=False,
)
