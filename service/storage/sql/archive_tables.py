"""The tables of the archive: which batches left the database, and where they are.

    archived_parts ── archived_batches ── archived_what_ifs
         └── archived_hours

A batch has a row in `batches` or in `archived_batches`, never in both: one transaction takes it
from one to the other, and so (spacecraft, run, batch) stays unique after archiving.
"""

from sqlalchemy import BigInteger, Column, Index, Integer, String, Table, Text, UniqueConstraint

from service.storage.sql.columns import Id, Name, RunName, metadata

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
