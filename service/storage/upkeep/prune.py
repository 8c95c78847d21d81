"""Deletes old batches with their results and their part in the trends, gyro blocks, grades.

One hour of a run at a time, of a dense hour a part, each in one transaction of the writer: other
writes run between two of them, and the trends always match the stored batches.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from sqlalchemy import ColumnElement, Connection, delete, func, select

from service.storage.projections import rollups, seals
from service.storage.sql.grade_tables import graded_blocks, graded_days, gyro_blocks
from service.storage.sql.tables import (
    batches,
    frames,
    idempotency_keys,
    results,
    rollups_hourly,
    solutions,
    star_results,
    tracker_values,
)
from service.storage.store import Store
from service.times import HOUR_S, Utc, bucket_start

OF_A_RESULT = (star_results, solutions, idempotency_keys)
OF_A_BATCH = (frames, tracker_values)
MOST_BATCHES = 10_000
"""The most batches that one transaction deletes: other writers of the hour, on SQLite all, wait."""
_AT_ONCE = 1_000
_BLOCKS_AT_ONCE = 100
"""Blocks that one transaction deletes, of up to 240 kB each."""
_DAYS_AT_ONCE = 10
"""Days that one transaction deletes, of about 12 MB each."""


@dataclass
class Pruned:
    """How many batches, gyro blocks and graded days there are before the time, and are gone."""

    total: int
    batches: int = 0
    total_gyro_blocks: int = 0
    gyro_blocks: int = 0
    total_graded_days: int = 0
    graded_days: int = 0


def prune(
    store: Store,
    before: Utc,
    run: str | None = None,
    *,
    dry_run: bool = False,
    step: Callable[[Pruned], object] = lambda pruned: None,
) -> Pruned:
    """Delete the batches whose time is before `before`, of one run or of all.

    Gyro blocks are deleted whose last sample is before it, and days of filtered and smoothed
    attitudes, with all their revisions, that end by then.  Missions, catalogs, alarms and the
    audit list stay.  Interrupted, it has deleted the oldest; the same call again goes on.
    """
    with store.reading() as connection:
        # A batch has exactly one current result, and those have the index by time.
        chosen = [results.c.current, results.c.time_ns < before.tai_ns]
        if run is not None:
            chosen.append(results.c.run == run)
        counted = select(func.count()).select_from(results).where(*chosen)
        pruned = Pruned(int(connection.scalar(counted) or 0))
        old_blocks = _old_blocks(before, run)
        blocks = select(func.count()).select_from(gyro_blocks).where(*old_blocks)
        pruned.total_gyro_blocks = int(connection.scalar(blocks) or 0)
        old_days = _old_days(before, run)
        days = select(func.count()).select_from(graded_days).where(*old_days)
        pruned.total_graded_days = int(connection.scalar(days) or 0)
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
        deletion = _of_an_hour(spacecraft, name, hour, before)
        deleted = MOST_BATCHES
        while deleted == MOST_BATCHES:
            deleted = store.writer.change(deletion).result()
            pruned.batches += deleted
            step(pruned)
    while deleted := store.writer.change(partial(delete_blocks, chosen=old_blocks)).result():
        pruned.gyro_blocks += deleted
    while deleted := store.writer.change(partial(delete_days, chosen=old_days)).result():
        pruned.graded_days += deleted
    return pruned


def _old_blocks(before: Utc, run: str | None) -> list[ColumnElement[bool]]:
    chosen: list[ColumnElement[bool]] = [gyro_blocks.c.end_ns < before.tai_ns]
    if run is not None:
        chosen.append(gyro_blocks.c.run == run)
    return chosen


def _old_days(before: Utc, run: str | None) -> list[ColumnElement[bool]]:
    chosen: list[ColumnElement[bool]] = [graded_days.c.end_ns <= before.tai_ns]
    if run is not None:
        chosen.append(graded_days.c.run == run)
    return chosen


def delete_days(connection: Connection, chosen: Sequence[ColumnElement[bool]]) -> int:
    """Delete some of the graded days that are chosen, with their samples; how many."""
    ids = list(connection.scalars(select(graded_days.c.id).where(*chosen).limit(_DAYS_AT_ONCE)))
    connection.execute(delete(graded_blocks).where(graded_blocks.c.day_id.in_(ids)))
    connection.execute(delete(graded_days).where(graded_days.c.id.in_(ids)))
    return len(ids)


def delete_blocks(connection: Connection, chosen: Sequence[ColumnElement[bool]]) -> int:
    """Delete some of the blocks that are chosen; how many."""
    chunk = select(gyro_blocks.c.id).where(*chosen).limit(_BLOCKS_AT_ONCE)
    ids = list(connection.scalars(chunk))
    connection.execute(delete(gyro_blocks).where(gyro_blocks.c.id.in_(ids)))
    return len(ids)


def _of_an_hour(spacecraft: str, run: str, hour: int, before: Utc) -> Callable[[Connection], int]:
    """A change that deletes the oldest batches of an hour, and returns how many."""
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
        oldest = chosen.order_by(results.c.time_ns, results.c.batch_id).limit(MOST_BATCHES)
        ids = list(connection.scalars(oldest))
        delete_batches(connection, ids)
        rollups.renew(connection, [(spacecraft, run, hour)])
        return len(ids)

    return change


def delete_batches(connection: Connection, batch_ids: Sequence[str]) -> None:
    """Delete batches with all that was made of them, what refers to others first."""
    for first in range(0, len(batch_ids), _AT_ONCE):
        ids = batch_ids[first : first + _AT_ONCE]
        seals.take_out(connection, ids)
        made = list(connection.scalars(select(results.c.id).where(results.c.batch_id.in_(ids))))
        for table in OF_A_RESULT:
            connection.execute(delete(table).where(table.c.result_id.in_(made)))
        for table in OF_A_BATCH:
            connection.execute(delete(table).where(table.c.batch_id.in_(ids)))
        connection.execute(delete(results).where(results.c.batch_id.in_(ids)))
        connection.execute(delete(batches).where(batches.c.id.in_(ids)))
