"""The tables of calibrations, and of what an operator adopted of them."""

from sqlalchemy import Column, ForeignKey, Index, Integer, String, Table, Text

from service.storage.sql.columns import Digest, Id, Moment, Name, RunName, metadata
from service.storage.sql.tables import missions

calibrations = Table(
    "calibrations",
    metadata,
    Column("id", Id, primary_key=True),
    Column("spacecraft", Name, nullable=False),
    # From 1 for each spacecraft.
    Column("version", Integer, nullable=False),
    Column("run", RunName, nullable=False),
    Column("created", Moment, nullable=False),
    Column("ended", Moment),
    Column("who", String(64), nullable=False),
    Column("state", String(16), nullable=False),
    Column("done", Integer, nullable=False),
    Column("total", Integer, nullable=False),
    # The settings that it started from.
    Column("mission_digest", Digest, ForeignKey(missions.c.digest), nullable=False),
    # JSON: what was asked, what was found, and the covariance, which is large, by itself.
    Column("request", Text, nullable=False),
    Column("result", Text),
    Column("covariance", Text),
    Column("fault", Text),
)
Index(
    "uq_calibrations_version",
    calibrations.c.spacecraft,
    calibrations.c.version,
    unique=True,
)

calibration_adoptions = Table(
    "calibration_adoptions",
    metadata,
    Column("id", Id, primary_key=True),
    Column("spacecraft", Name, nullable=False),
    Column("adopted", Moment, nullable=False),
    Column("who", String(64), nullable=False),
    Column("note", Text, nullable=False),
    # Null: back to the mission file.
    Column("calibration_id", Id, ForeignKey(calibrations.c.id)),
    # The settings of the mission file that it lies over, and those of both together.
    Column("file_digest", Digest, nullable=False),
    Column("mission_digest", Digest, ForeignKey(missions.c.digest), nullable=False),
    # JSON: alignment and focal plane of every tracker.  Null: as the mission file has them.
    Column("trackers", Text),
)
Index(
    "ix_calibration_adoptions_spacecraft",
    calibration_adoptions.c.spacecraft,
    calibration_adoptions.c.id,
)
