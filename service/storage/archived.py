"""Archived batches: which file holds each, as the database knows, and the interface that reads it.

An archived batch keeps its identity, and its share in the trends, in the database.
"""

from collections.abc import Collection, Sequence, Set
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, Protocol

from sqlalchemy import ColumnElement, Connection, select

from service.errors import AcquisitionError, Fault, NotAvailable
from service.feature import SETTING, feature_modules
from service.storage.recording.identity import stored_answers
from service.storage.sql import tables
from service.storage.sql.columns import Row
from service.times import Utc


@dataclass(frozen=True)
class PlacedPart:
    """Record of an archive part: file, digest, number of batches, times of the first and last."""

    id: int
    path: str
    sha256: str
    first_ns: int
    last_ns: int
    batches: int


@dataclass(frozen=True)
class Block:
    """Place of one row group, the least that is read of an archive part, with its time span."""

    part: PlacedPart
    group: int
    first_ns: int
    last_ns: int


class OpenedBatches(Protocol):
    """Batches as a database in memory, which the queries of the record read unchanged."""

    def reading(self) -> AbstractContextManager[Connection]:
        """Context manager of a connection to the database in memory, for one thread at a time."""


class Archive:
    """Interface to the archived batches of a database; reads no file, for the feature is off.

    Methods that need a file raise `NotAvailable` here.  The archive feature overrides them with
    ones that read it.
    """

    def stored_answers(self, connection: Connection, ids: Collection[str]) -> dict[str, bytes]:
        """Answers of recorded or archived results by id, byte for byte; without unknown ids."""
        found = stored_answers(connection, ids)
        if len(found) == len(ids):
            return found
        for path, wanted in places(connection, set(ids) - found.keys()).items():
            found |= self.answers_in(path, wanted)
        return found

    def answers_or_faults(
        self, connection: Connection, ids: Set[str]
    ) -> dict[str, bytes | AcquisitionError]:
        """Answers of recorded or archived results by id, or the error that prevents reading one."""
        found: dict[str, bytes | AcquisitionError] = {**stored_answers(connection, ids)}
        if archived := ids - found.keys():
            try:
                found |= self.stored_answers(connection, archived)
            except AcquisitionError as error:
                found |= dict.fromkeys(archived, error)
        return found

    def batch(self, connection: Connection, id: str) -> OpenedBatches | None:
        """Open the batch of an archived result with all its results; None if it is not archived."""
        recorded = select(tables.results.c.id).where(tables.results.c.id == id)
        if connection.scalar(recorded) is not None:
            return None
        found = places(connection, [id])
        if not found:
            return None
        ((path, _),) = found.items()
        return self.batch_in(path, batch_of(connection, id))

    def answers_in(self, path: str, ids: Sequence[str]) -> dict[str, bytes]:
        """Answers of results in an archive part by id, byte for byte."""
        _refuse()

    def batch_in(self, path: str, batch_id: str) -> OpenedBatches:
        """Open a batch in an archive part with all its results and their settings."""
        _refuse()

    def blocks(self, part: PlacedPart) -> list[Block]:
        """Row groups of an archive part, in order of time."""
        _refuse()

    def open(self, block: Block, needs: Collection[str]) -> OpenedBatches:
        """Open the results of a row group.

        `needs` are the lists to read (`stars`, `solution`, `trackers`, `frame`) and the long texts
        (`input`, `answer`); without them the database in memory has none.
        """
        _refuse()

    def current_ids(self, part: PlacedPart, start_ns: int | None, end_ns: int | None) -> list[str]:
        """Ids of an archive part's current results from a time to before another, in order."""
        _refuse()

    def rows(self, part: PlacedPart, ids: Sequence[str], columns: Sequence[str]) -> list[Row]:
        """Columns of results and their batches in an archive part, in order of time."""
        _refuse()

    def together(
        self,
        connection: Connection,
        recorded: Sequence[str],
        archived: Sequence[str],
        needs: Collection[str],
    ) -> OpenedBatches:
        """Open recorded and archived batches in one database, by ids; `needs` as for `open`."""
        _refuse()


def _refuse() -> NoReturn:
    message = f"is archived, and {SETTING} leaves the feature `archive` out, which reads it"
    raise NotAvailable(Fault("batch", message))


def open_archive(folder: Path | None, features_off: str) -> Archive:
    """Open the archive in a folder, with the feature that reads it; see `service.feature`."""
    opened: list[Archive] = [
        module.open_archive(folder) for module in feature_modules("archive", features_off)
    ]
    return opened[0] if opened else Archive()


def parts_between(
    connection: Connection,
    spacecraft: str | None,
    run: str | None,
    first_ns: int | None,
    end_ns: int | None,
) -> list[PlacedPart]:
    """Archive parts that overlap a period; for None, those of every spacecraft or run."""
    c = tables.archived_parts.c
    chosen: list[ColumnElement[bool]] = []
    if spacecraft is not None:
        chosen.append(c.spacecraft == spacecraft)
    if run is not None:
        chosen.append(c.run == run)
    if first_ns is not None:
        chosen.append(c.last_ns >= first_ns)
    if end_ns is not None:
        chosen.append(c.first_ns < end_ns)
    columns = (c.id, c.path, c.sha256, c.first_ns, c.last_ns, c.batches)
    return [PlacedPart(*row) for row in connection.execute(select(*columns).where(*chosen))]


def parts_with(
    connection: Connection, spacecraft: str | None, run: str | None, batch: str
) -> set[int]:
    """Ids of the archive parts that have a batch with this name."""
    c = tables.archived_batches.c
    # The unique index begins with spacecraft and run: give both.
    in_runs = select(tables.runs.c.name) if run is None else [run]
    query = select(c.part_id).where(
        c.spacecraft == spacecraft, c.run.in_(in_runs), c.batch == batch
    )
    return set(connection.scalars(query))


def batch_of(connection: Connection, id: str) -> str:
    """Id of the batch that an archived result belongs to."""
    what_ifs = tables.archived_what_ifs.c
    return connection.scalar(select(what_ifs.batch_id).where(what_ifs.id == id)) or id


def places(connection: Connection, ids: Collection[str]) -> dict[str, list[str]]:
    """Group ids of archived results by the path of their archive part."""
    batches, what_ifs = tables.archived_batches.c, tables.archived_what_ifs.c
    path, has_part = tables.archived_parts.c.path, tables.archived_parts.c.id == batches.part_id
    first = select(batches.id, path).where(has_part, batches.id.in_(ids))
    further = select(what_ifs.id, path).where(has_part, what_ifs.batch_id == batches.id)
    found: dict[str, list[str]] = {}
    for query in (first, further.where(what_ifs.id.in_(ids))):
        for id, file in connection.execute(query):
            found.setdefault(file, []).append(id)
    return found


def holds_any(connection: Connection, spacecraft: str, run: str, start: Utc, end: Utc) -> bool:
    """True if an archive part overlaps a period, so that some of its batches may be archived."""
    c = tables.archived_parts.c
    query = select(c.id).where(
        c.spacecraft == spacecraft,
        c.run == run,
        c.last_ns >= start.tai_ns,
        c.first_ns < end.tai_ns,
    )
    return connection.execute(query.limit(1)).first() is not None


def archived_paths(connection: Connection) -> dict[str, str]:
    """SHA-256 of all archive parts with batches of a database, by path."""
    query = select(tables.archived_parts.c.path, tables.archived_parts.c.sha256)
    return dict(map(tuple, connection.execute(query)))
