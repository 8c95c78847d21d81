"""The table of gyro blocks: one row per block, with its samples packed."""

from sqlalchemy import (
    BigInteger,
    Column,
    Double,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    String,
    Table,
    UniqueConstraint,
)

from service.storage.sql.columns import Id, Moment, Name, RunName, metadata
from service.storage.sql.tables import runs

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
    # Packed: see service/gyro/packing.py.
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
