"""The tables of gyro blocks, and of filtered and smoothed attitudes: samples packed in blocks.

A day that is computed again from other facts gets a new row with the next revision, which is
then the current one.  Rows of earlier revisions stay, without their samples.
"""

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
    text,
)

from service.storage.sql.columns import Digest, Id, Moment, Name, RunName, metadata
from service.storage.sql.tables import runs

INNOVATIONS = "innovations"
"""In the place of a grade: the block has measurements, as they met the filter."""

graded_days = Table(
    "graded_days",
    metadata,
    Column("id", Id, primary_key=True),
    Column("spacecraft", Name, nullable=False),
    Column("run", RunName, ForeignKey(runs.c.name), nullable=False),
    # The UTC day, counted as `Utc.bucket`, and its bounds.
    Column("day", Integer, nullable=False),
    Column("start_ns", BigInteger, nullable=False),
    Column("end_ns", BigInteger, nullable=False),
    Column("revision", Integer, nullable=False),
    Column("current", Boolean, nullable=False),
    Column("created", Moment, nullable=False),
    # Of all that it was computed from, and of what was computed.
    Column("inputs", Digest, nullable=False),
    Column("digest", Digest, nullable=False),
    # Of one grade.
    Column("samples", Integer, nullable=False),
    # JSON: what became of the measurements and of the gyro.
    Column("summary", Text, nullable=False),
    UniqueConstraint("spacecraft", "run", "day", "revision"),
)
Index(
    "uq_graded_days_current",
    graded_days.c.spacecraft,
    graded_days.c.run,
    graded_days.c.day,
    unique=True,
    sqlite_where=text("current = 1"),
    postgresql_where=text("current"),
)
Index("ix_graded_days_by_end", graded_days.c.end_ns)

graded_blocks = Table(
    "graded_blocks",
    metadata,
    Column("day_id", Id, ForeignKey(graded_days.c.id), primary_key=True),
    # filtered, smoothed, or innovations.
    Column("grade", String(16), primary_key=True),
    Column("position", SmallInteger, primary_key=True),
    # gyro or constant_rate.
    Column("model", String(16), nullable=False),
    # Of the first sample and of the last.
    Column("start_ns", BigInteger, nullable=False),
    Column("end_ns", BigInteger, nullable=False),
    Column("samples", Integer, nullable=False),
    # See service/grades/day.py.
    Column("packed", LargeBinary, nullable=False),
)


gyro_blocks = Table(
    "gyro_blocks",
    metadata,
    Column("id", Id, primary_key=True),
    Column("spacecraft", Name, nullable=False),
    Column("run", RunName, ForeignKey(runs.c.name), nullable=False),
    Column("block", Name, nullable=False),
    # Of the first sample and of the last.
    Column("start", Moment, nullable=False),
    Column("end", Moment, nullable=False),
    Column("start_ns", BigInteger, nullable=False),
    Column("end_ns", BigInteger, nullable=False),
    Column("received", Moment, nullable=False),
    Column("fingerprint", String(64), nullable=False),
    Column("samples", Integer, nullable=False),
    # Null where the block has times of its own.
    Column("step_s", Double),
    # Packed: see service/gyro.py.
    Column("times_s", LargeBinary),
    Column("rates_rad_per_s", LargeBinary, nullable=False),
    UniqueConstraint("spacecraft", "run", "block"),
)
# Periods, and blocks that may share a time with another: no block spans more than a day.
Index(
    "ix_gyro_blocks_by_start",
    gyro_blocks.c.spacecraft,
    gyro_blocks.c.run,
    gyro_blocks.c.start_ns,
    gyro_blocks.c.end_ns,
)
# What is pruned is found by its end, in all runs or in one.
Index("ix_gyro_blocks_by_end", gyro_blocks.c.end_ns)
