"""Removal of wrongly recorded data: a whole run, or named batches and gyro blocks of it.

Trends, filtered attitudes and the archive follow.  Alarms, events, notes, replays and the audit
list stay: they document the history.  Batches are removed in portions, each in one transaction with
its part in the trends; after an interruption the same call continues.
"""

from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from sqlalchemy import ColumnElement, Connection, Table, delete, exists, or_, select
from sqlalchemy.exc import IntegrityError

from service.contract.runs import Forgotten
from service.errors import BadConfiguration, NotFound, shown_value
from service.feature import SETTING, feature_modules
from service.observations.schema import LIVE
from service.storage.projections import rollups
from service.storage.sql.definitive_tables import graded_days
from service.storage.sql.statements import count
from service.storage.sql.tables import (
    archived_batches,
    archived_parts,
    batches,
    gyro_blocks,
    runs,
)
from service.storage.store import Store
from service.storage.upkeep.prune import delete_batches, delete_blocks, delete_days
from service.times import DAY_S, HOUR_S, recorded_utc

_AT_ONCE = 1_000
"""Number of batches removed in one transaction, which other writers wait for."""
_DAY_NS = DAY_S * 10**9
MOST_NAMES = 1_000
"""Largest number of batches, or gyro blocks, named in one call."""


@dataclass(frozen=True)
class ForgetFilter:
    """Selection of data to forget: a whole run, or only its named batches and gyro blocks."""

    run: str
    spacecraft: str | None = None
    batches: tuple[str, ...] = ()
    gyro_blocks: tuple[str, ...] = ()

    @property
    def is_whole(self) -> bool:
        """True if the selection is a whole run, with no batch and no block named."""
        return not (self.batches or self.gyro_blocks)

    def of(self, table: Table, names: Collection[str] = (), name: str = "") -> list[Any]:
        """SQL conditions for the selected rows of a table: run, spacecraft and, if named, names."""
        chosen: list[ColumnElement[bool]] = [table.c.run == self.run]
        if self.spacecraft is not None:
            chosen.append(table.c.spacecraft == self.spacecraft)
        if not self.is_whole and name:
            chosen.append(table.c[name].in_(names))
        return chosen

    def of_batches(self, table: Table) -> list[Any]:
        """SQL conditions for the selected rows of `batches` or `archived_batches`."""
        return self.of(table, self.batches, "batch")

    def of_blocks(self) -> list[Any]:
        """SQL conditions for the selected rows of `gyro_blocks`."""
        return self.of(gyro_blocks, self.gyro_blocks, "block")


def found(connection: Connection, selected: ForgetFilter) -> Forgotten:
    """Count the selected data; raises `NotFound` for an empty selection or an unknown name."""
    _require_names(connection, selected)
    counts = {
        name: count(connection, table, *chosen)
        for name, table, chosen in (
            ("batches", batches, selected.of_batches(batches)),
            ("archived_batches", archived_batches, selected.of_batches(archived_batches)),
            ("gyro_blocks", gyro_blocks, selected.of_blocks()),
            ("graded_days", graded_days, _of_days(selected)),
        )
    }
    if not any(counts.values()):
        raise NotFound(f"nothing is recorded in run {selected.run}{_of(selected)}")
    return Forgotten(run=selected.run, spacecraft=selected.spacecraft, **counts)


def forget(
    store: Store,
    selected: ForgetFilter,
    archive: Path | None,
    *,
    note: Callable[[Connection, Forgotten], object] = lambda connection, total: None,
    step: Callable[[int, Forgotten], object] = lambda done, total: None,
) -> Forgotten:
    """Remove the selected data; returns the counts of the removed data.

    `note` is called in the first transaction, and `step` with the number of removed batches and all
    counts.  `archive` is the folder with the archived batches.  Raises `NotFound` as `found` does,
    and `BadConfiguration` where archived batches are selected and `archive` is not their folder, or
    the archive feature is off.
    """
    with store.reading() as connection:
        total = found(connection, selected)
    archives = feature_modules("archive", store.features_off)
    if total.archived_batches and not archives:
        raise BadConfiguration(
            f"{total.archived_batches} of the batches are archived, and {SETTING} leaves the "
            "feature `archive` out, which removes them"
        )
    if total.archived_batches and archive is None:
        raise BadConfiguration(
            f"{total.archived_batches} of the batches are archived: name the folder of the archive"
        )
    forget_recorded = partial(_forget_batches, selected=selected)

    def forget_days(connection: Connection) -> None:
        while delete_days(connection, _of_days(selected)):
            pass
        note(connection, total)

    # Delete the computed days first: they are computed again from the remaining batches.
    store.writer.change(forget_days)
    done = 0
    if total.archived_batches and archive is not None:
        chosen = selected.of_batches(archived_batches)
        done += archives[0].forget_archived(store, archive, chosen, forget_recorded)
        step(done, total)
    while forgotten := store.writer.change(forget_recorded):
        done += forgotten
        step(done, total)
    blocks = partial(delete_blocks, chosen=selected.of_blocks())
    while total.gyro_blocks and store.writer.change(blocks):
        pass
    if selected.is_whole and selected.spacecraft is None and selected.run != LIVE:
        _forget_run(store, selected.run)
    return total


def _require_names(connection: Connection, selected: ForgetFilter) -> None:
    """Raise `NotFound` for the first name that no batch, or no gyro block, has."""
    for what, names, columns in (
        ("batch", selected.batches, (batches.c.batch, archived_batches.c.batch)),
        ("gyro block", selected.gyro_blocks, (gyro_blocks.c.block,)),
    ):
        known: set[str] = set()
        for column in columns if names else ():
            chosen = selected.of(column.table, names, column.name)
            known.update(connection.scalars(select(column).where(*chosen)))
        for name in names:
            if name not in known:
                message = f"run {selected.run}{_of(selected)} has no {what} {shown_value(name)}"
                raise NotFound(message)


def _of(selected: ForgetFilter) -> str:
    return "" if selected.spacecraft is None else f" of {selected.spacecraft}"


def _of_days(selected: ForgetFilter) -> list[Any]:
    """SQL conditions for the days of filtered attitudes computed from the selected data."""
    chosen = selected.of(graded_days)
    if selected.is_whole:
        return chosen
    # A day depends on less than one day before and after it.
    begin, end = (graded_days.c.start_ns - _DAY_NS, graded_days.c.end_ns + _DAY_NS)
    overlapping: list[ColumnElement[bool]] = []
    if selected.batches:
        overlapping += [
            exists().where(
                *selected.of_batches(batches),
                batches.c.spacecraft == graded_days.c.spacecraft,
                batches.c.time_ns.between(begin, end),
            ),
            exists().where(
                *selected.of_batches(archived_batches),
                archived_batches.c.part_id == archived_parts.c.id,
                archived_parts.c.spacecraft == graded_days.c.spacecraft,
                archived_parts.c.last_ns >= begin,
                archived_parts.c.first_ns <= end,
            ),
        ]
    if selected.gyro_blocks:
        overlapping.append(
            exists().where(
                *selected.of_blocks(),
                gyro_blocks.c.spacecraft == graded_days.c.spacecraft,
                gyro_blocks.c.end_ns >= begin,
                gyro_blocks.c.start_ns <= end,
            )
        )
    return [*chosen, or_(*overlapping)]


def _forget_batches(connection: Connection, selected: ForgetFilter) -> int:
    """Delete a portion of the selected batches and recount their hours; returns its size."""
    if not selected.is_whole and not selected.batches:
        return 0
    query = select(batches.c.id, batches.c.spacecraft, batches.c.time)
    rows = list(connection.execute(query.where(*selected.of_batches(batches)).limit(_AT_ONCE)))
    delete_batches(connection, [row.id for row in rows])
    hours = {(row.spacecraft, recorded_utc(row.time).bucket(HOUR_S)) for row in rows}
    rollups.renew(connection, ((spacecraft, selected.run, hour) for spacecraft, hour in hours))
    return len(rows)


def _forget_run(store: Store, run: str) -> None:
    """Delete the row of a forgotten run, unless rows recorded meanwhile refer to it."""
    deletion = delete(runs).where(runs.c.name == run)
    with suppress(IntegrityError):
        store.writer.change(lambda connection: connection.execute(deletion))
