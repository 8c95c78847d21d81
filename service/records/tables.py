"""The tables, the same on SQLite and PostgreSQL.

    runs ── batches ── results ── star_results
                         │    └── solutions        no attitude, no row
    missions, catalogs ──┘
    idempotency_keys ── results
    rollups_hourly, rollups_daily                  of current results, by batch time
    replays

A batch is what was sent; a result is what was made of it.  The first result of
a batch has the batch's own id; recorded what-ifs add others, and exactly one
result of a batch is current.  Results repeat the spacecraft, run and time of
their batch, so that one index answers a list, a history or a trend.

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
    MetaData,
    SmallInteger,
    String,
    Table,
    Text,
    UniqueConstraint,
    text,
)

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s_%(referred_table_name)s",
        "pk": "pk_%(table_name)s",
    }
)

Id = String(26)
Name = String(128)
RunName = String(64)
Digest = String(80)
Moment = String(30)

runs = Table(
    "runs",
    metadata,
    Column("name", RunName, primary_key=True),
    Column("created", Moment, nullable=False),
)

missions = Table(
    "missions",
    metadata,
    Column("digest", Digest, primary_key=True),
    Column("spacecraft", Name, nullable=False, index=True),
    Column("settings", Text, nullable=False),
    Column("first_used", Moment, nullable=False),
)

catalogs = Table(
    "catalogs",
    metadata,
    Column("digest", Digest, primary_key=True),
    Column("name", Text, nullable=False),
    Column("first_used", Moment, nullable=False),
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
    Column("input", Text, nullable=False),
    UniqueConstraint("spacecraft", "run", "batch"),
)

results = Table(
    "results",
    metadata,
    Column("id", Id, primary_key=True),
    Column("batch_id", Id, ForeignKey(batches.c.id), nullable=False),
    Column("parent_id", Id, ForeignKey("results.id")),
    Column("current", Boolean, nullable=False),
    Column("created", Moment, nullable=False),
    Column("spacecraft", Name, nullable=False),
    Column("run", RunName, nullable=False),
    Column("time_ns", BigInteger, nullable=False),
    Column("identifier", String(32), nullable=False),
    Column("options", Text, nullable=False),
    Column("mission_digest", Digest, ForeignKey(missions.c.digest), nullable=False),
    Column("catalog_digest", Digest, ForeignKey(catalogs.c.digest), nullable=False),
    Column("observed", Integer, nullable=False),
    Column("unique", Integer, nullable=False),
    Column("ambiguous", Integer, nullable=False),
    Column("unmatched", Integer, nullable=False),
    # Of the attitude: good or suspect; null where there is none, and then a reason.
    Column("status", String(16)),
    Column("reason", String(64)),
    # The answer's JSON, byte for byte as it was sent.
    Column("answer", Text, nullable=False),
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
Index("uq_results_current", results.c.batch_id, unique=True, **_CURRENT)
Index(
    "ix_results_what_ifs",
    results.c.batch_id,
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

COUNTS = ("batches", "observed", "unique", "ambiguous", "unmatched", "solved", "suspect")


def _rollup(name: str) -> Table:
    """Sums over the current results of each spacecraft, run and bucket (see `Utc.bucket`)."""
    return Table(
        name,
        metadata,
        Column("spacecraft", Name, primary_key=True),
        Column("run", RunName, primary_key=True),
        Column("bucket", Integer, primary_key=True, autoincrement=False),
        *(Column(count, BigInteger, nullable=False) for count in COUNTS),
        sqlite_with_rowid=False,
    )


rollups_hourly = _rollup("rollups_hourly")
rollups_daily = _rollup("rollups_daily")

idempotency_keys = Table(
    "idempotency_keys",
    metadata,
    Column("key", String(255), primary_key=True),
    Column("fingerprint", String(64), nullable=False),
    Column("result_id", Id, ForeignKey(results.c.id), nullable=False),
)

replays = Table(
    "replays",
    metadata,
    Column("id", Id, primary_key=True),
    Column("run", RunName, nullable=False),
    Column("name", Text, nullable=False),
    Column("state", String(16), nullable=False),
    Column("lines_total", BigInteger),
    Column("lines_done", BigInteger, nullable=False),
    Column("lines_refused", BigInteger, nullable=False),
    Column("errors", Text, nullable=False),
    Column("started", Moment, nullable=False),
    Column("finished", Moment),
)
