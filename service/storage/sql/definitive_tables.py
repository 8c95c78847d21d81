"""The tables of the definitive attitude: filtered and smoothed samples packed in blocks.

A day that is computed again from other facts gets a new row with the next revision, which is
then the current one.  Rows of earlier revisions stay, without their samples.
"""

import sqlalchemy as sa

from service.storage.sql.columns import CURRENT, Digest, Id, Moment, Name, RunName, metadata
from service.storage.sql.tables import runs

INNOVATIONS = "innovations"
"""Stored word in place of an attitude's grade, for blocks of innovations of the filter."""

graded_days = sa.Table(
    "graded_days",
    metadata,
    sa.Column("id", Id, primary_key=True),
    sa.Column("spacecraft", Name, nullable=False),
    sa.Column("run", RunName, sa.ForeignKey(runs.c.name), nullable=False),
    # The UTC day, counted as `Utc.bucket`, and its bounds in nanoseconds.
    sa.Column("day", sa.Integer, nullable=False),
    sa.Column("start_ns", sa.BigInteger, nullable=False),
    sa.Column("end_ns", sa.BigInteger, nullable=False),
    sa.Column("revision", sa.Integer, nullable=False),
    sa.Column("current", sa.Boolean, nullable=False),
    sa.Column("created", Moment, nullable=False),
    # Digests of all inputs, and of the computed samples.
    sa.Column("inputs", Digest, nullable=False),
    sa.Column("digest", Digest, nullable=False),
    # Number of samples of one grade.
    sa.Column("samples", sa.Integer, nullable=False),
    # JSON: the use of the measurements and of the gyro data.
    sa.Column("summary", sa.Text, nullable=False),
    sa.UniqueConstraint("spacecraft", "run", "day", "revision"),
    sa.Index("uq_graded_days_current", "spacecraft", "run", "day", unique=True, **CURRENT),
    sa.Index("ix_graded_days_by_end", "end_ns"),
)

graded_blocks = sa.Table(
    "graded_blocks",
    metadata,
    sa.Column("day_id", Id, sa.ForeignKey(graded_days.c.id), primary_key=True),
    # Values: filtered, smoothed, or innovations.
    sa.Column("grade", sa.String(16), primary_key=True),
    sa.Column("position", sa.SmallInteger, primary_key=True),
    # Values: gyro or constant_rate.
    sa.Column("model", sa.String(16), nullable=False),
    # Times of the first and of the last sample.
    sa.Column("start_ns", sa.BigInteger, nullable=False),
    sa.Column("end_ns", sa.BigInteger, nullable=False),
    sa.Column("samples", sa.Integer, nullable=False),
    # Layout of the packed samples: see service/attitude/definitive.py.
    sa.Column("packed", sa.LargeBinary, nullable=False),
)
