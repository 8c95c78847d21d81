"""Pruning: deletes old batches with their results and trends, gyro blocks, and definitive days.

Each transaction of the writer deletes one hour of a run, or a part of a dense hour: other writes
run between transactions, and the trends always match the stored batches.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from sqlalchemy import ColumnElement, Connection, Table, delete, select

from service.storage.projections import rollups, seals
from service.storage.recording import chain
from service.storage.sql.definitive_tables import graded_blocks, graded_days
from service.storage.sql.statements import count, portions
from service.storage.sql.tables import (
    batches,
    frames,
    gyro_blocks,
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
"""Largest number of batches deleted in one transaction, which delays other writers."""
_BLOCKS_AT_ONCE = 100
"""Number of gyro blocks deleted in one transaction, of up to 240 kB each."""
_DAYS_AT_ONCE = 10
"""Number of definitive days deleted in one transaction, of about 12 MB each."""

Conditions = list[ColumnElement[bool]]


@dataclass
class Pruned:
    """Progress of pruning: numbers of batches, gyro blocks and attitude days, total and deleted."""

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
    attitudes, with all their revisions, that end by then.  Missions, catalogs, alarms and the audit
    list stay.  Data are deleted oldest first; after an interruption the same call continues.
    """
    with store.reading() as connection:
        # A batch has exactly one current result, and current results have an index by time.
        is_old = _of_run(run, results, results.c.time_ns < before.tai_ns)
        old_blocks = _of_run(run, gyro_blocks, gyro_blocks.c.end_ns < before.tai_ns)
        old_days = _of_run(run, graded_days, graded_days.c.end_ns <= before.tai_ns)
        pruned = Pruned(
            count(connection, results, results.c.current, *is_old),
            total_gyro_blocks=count(connection, gyro_blocks, *old_blocks),
            total_graded_days=count(connection, graded_days, *old_days),
        )
        hourly = rollups_hourly.c
        hours = select(hourly.bucket, hourly.spacecraft, hourly.run).where(
            *_of_run(run, rollups_hourly, hourly.bucket <= before.bucket(HOUR_S))
        )
        keys = sorted(map(tuple, connection.execute(hours)))
    step(pruned)
    if dry_run:
        return pruned
    for hour, spacecraft, name in keys:
        deletion = partial(
            _delete_oldest, spacecraft=spacecraft, run=name, hour=hour, before=before
        )
        deleted = MOST_BATCHES
        while deleted == MOST_BATCHES:
            deleted = store.writer.change(deletion)
            pruned.batches += deleted
            step(pruned)
    while deleted := store.writer.change(partial(delete_blocks, chosen=old_blocks)):
        pruned.gyro_blocks += deleted
    while deleted := store.writer.change(partial(delete_days, chosen=old_days)):
        pruned.graded_days += deleted
    return pruned


def _of_run(run: str | None, table: Table, chosen: ColumnElement[bool]) -> Conditions:
    """SQL conditions for a table's rows: the given one, and that of a run unless it is None."""
    return [chosen] if run is None else [chosen, table.c.run == run]


def delete_days(connection: Connection, chosen: Conditions) -> int:
    """Delete a portion of the chosen definitive days with their samples; returns its size."""
    ids = list(connection.scalars(select(graded_days.c.id).where(*chosen).limit(_DAYS_AT_ONCE)))
    connection.execute(delete(graded_blocks).where(graded_blocks.c.day_id.in_(ids)))
    chain.note_removed(connection, graded_days, ids)
    connection.execute(delete(graded_days).where(graded_days.c.id.in_(ids)))
    return len(ids)


def delete_blocks(connection: Connection, chosen: Conditions) -> int:
    """Delete a portion of the chosen gyro blocks; returns its size."""
    chunk = select(gyro_blocks.c.id).where(*chosen).limit(_BLOCKS_AT_ONCE)
    ids = list(connection.scalars(chunk))
    chain.note_removed(connection, gyro_blocks, ids)
    connection.execute(delete(gyro_blocks).where(gyro_blocks.c.id.in_(ids)))
    return len(ids)


def _delete_oldest(
    connection: Connection, spacecraft: str, run: str, hour: int, before: Utc
) -> int:
    """Delete a portion of an hour's batches, oldest first; returns its size."""
    end_ns = min(bucket_start(hour + 1, HOUR_S).tai_ns, before.tai_ns)
    oldest = select(results.c.batch_id).where(
        results.c.current,
        results.c.spacecraft == spacecraft,
        results.c.run == run,
        results.c.time_ns >= bucket_start(hour, HOUR_S).tai_ns,
        results.c.time_ns < end_ns,
    )
    oldest = oldest.order_by(results.c.time_ns, results.c.batch_id).limit(MOST_BATCHES)
    ids = list(connection.scalars(oldest))
    delete_batches(connection, ids)
    rollups.renew(connection, [(spacecraft, run, hour)])
    return len(ids)


def delete_batches(connection: Connection, batch_ids: Sequence[str]) -> None:
    """Delete batches with all their results, referring rows first."""
    for ids in portions(batch_ids):
        seals.take_out(connection, ids)
        chain.note_results_removed(connection, ids)
        made = list(connection.scalars(select(results.c.id).where(results.c.batch_id.in_(ids))))
        for table in OF_A_RESULT:
            connection.execute(delete(table).where(table.c.result_id.in_(made)))
        for table in OF_A_BATCH:
            connection.execute(delete(table).where(table.c.batch_id.in_(ids)))
        connection.execute(delete(results).where(results.c.batch_id.in_(ids)))
        connection.execute(delete(batches).where(batches.c.id.in_(ids)))
