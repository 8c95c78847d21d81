"""Which older batches are still to be split by tracker; see `upkeep.split_trackers`."""

from sqlalchemy import Connection, delete, insert, select

from service.storage.sql.tables import results, rollups_daily, tracker_splits


def is_waiting(connection: Connection, spacecraft: str, run: str) -> bool:
    """Whether batches of a spacecraft's run are still to be split."""
    query = select(tracker_splits.c.run).where(
        tracker_splits.c.spacecraft == spacecraft, tracker_splits.c.run == run
    )
    return connection.execute(query).first() is not None


def split_anew(connection: Connection, spacecraft: str) -> None:
    """Have all batches of a spacecraft looked at: from now on it has several trackers."""
    connection.execute(delete(tracker_splits).where(tracker_splits.c.spacecraft == spacecraft))
    recorded, trends = (
        select(table.c.spacecraft, table.c.run).where(table.c.spacecraft == spacecraft)
        for table in (results, rollups_daily)
    )
    # Archived batches are in the trends alone, and the latest ones in the record alone.
    runs = recorded.union(trends)
    connection.execute(insert(tracker_splits).from_select(["spacecraft", "run"], runs))
