"""Deletes old batches with their results and their part in the trends.

One hour of a run at a time, each in one transaction of the writer: other writes
run between two of them, and the trends always match the stored batches.
"""

from collections.abc import Callable
from dataclasses import dataclass

from sqlalchemy import Connection, delete, func, select

from service.storage.recording import rollups
from service.storage.sql.database import Store
from service.storage.sql.rollup_tables import rollups_hourly
from service.storage.sql.tables import (
    batches,
    frames,
    idempotency_keys,
    results,
    solutions,
    star_results,
    tracker_values,
)
from service.times import HOUR_S, Utc, bucket_start

OF_A_RESULT = (star_results, solutions, idempotency_keys)
OF_A_BATCH = (frames, tracker_values)
_AT_ONCE = 1_000


@dataclass
class Pruned:
    """How many batches there are before the time, and how many of them are gone so far."""

    total: int
    batches: int = 0


def prune(
    store: Store,
    before: Utc,
    run: str | None = None,
    *,
    dry_run: bool = False,
    step: Callable[[Pruned], object] = lambda pruned: None,
) -> Pruned:
    """Delete the batches whose time is before `before`, of one run or of all.

    Missions, catalogs, alarms and the audit list stay.  Interrupted, it has
    deleted whole hours; the same call again goes on.
    """
    with store.reading() as connection:
        # A batch has exactly one current result, and those have the index by time.
        chosen = [results.c.current, results.c.time_ns < before.tai_ns]
        if run is not None:
            chosen.append(results.c.run == run)
        counted = select(func.count()).select_from(results).where(*chosen)
        pruned = Pruned(int(connection.scalar(counted) or 0))
        hours = select(rollups_hourly.c.bucket, rollups_hourly.c.spacecraft, rollups_hourly.c.run)
        hours = hours.where(rollups_hourly.c.bucket <= before.bucket(HOUR_S))
        if run is not None:
            hours = hours.where(rollups_hourly.c.run == run)
        keys = sorted(
            (hour, spacecraft, name) for hour, spacecraft, name in connection.execute(hours)
        )
    step(pruned)
    if dry_run:
        return pruned
    for hour, spacecraft, name in keys:
        pruned.batches += store.writer.change(_of_an_hour(spacecraft, name, hour, before)).result()
        step(pruned)
    return pruned


def _of_an_hour(spacecraft: str, run: str, hour: int, before: Utc) -> Callable[[Connection], int]:
    start = bucket_start(hour, HOUR_S).tai_ns
    end = min(bucket_start(hour + 1, HOUR_S).tai_ns, before.tai_ns)

    def change(connection: Connection) -> int:
        chosen = select(results.c.batch_id).where(
            results.c.current,
            results.c.spacecraft == spacecraft,
            results.c.run == run,
            results.c.time_ns >= start,
            results.c.time_ns < end,
        )
        ids = list(connection.scalars(chosen))
        for first in range(0, len(ids), _AT_ONCE):
            _delete(connection, ids[first : first + _AT_ONCE])
        rollups.renew(connection, [(spacecraft, run, hour)])
        return len(ids)

    return change


def _delete(connection: Connection, batch_ids: list[str]) -> None:
    """Delete batches with all that was made of them, what refers to others first."""
    made = select(results.c.id).where(results.c.batch_id.in_(batch_ids))
    for table in OF_A_RESULT:
        connection.execute(delete(table).where(table.c.result_id.in_(made)))
    for table in OF_A_BATCH:
        connection.execute(delete(table).where(table.c.batch_id.in_(batch_ids)))
    connection.execute(delete(results).where(results.c.batch_id.in_(batch_ids)))
    connection.execute(delete(batches).where(batches.c.id.in_(batch_ids)))
