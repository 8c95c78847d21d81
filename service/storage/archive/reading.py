"""Reading of archived batches for the service; only this module knows where a batch is stored."""

import logging
from collections.abc import Collection, Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import ColumnElement, Connection, select

from service.errors import AcquisitionError, Busy, Fault, NotAvailable
from service.extras import require_extra
from service.sky.cache import LruCache
from service.storage.recording.identity import stored_answers
from service.storage.sql import tables
from service.times import Utc

if TYPE_CHECKING:
    import pyarrow as pa

    from service.storage.archive.rows import Opened

log = logging.getLogger(__name__)


CACHE_BYTES = 64 << 20
"""Size in bytes of the cache of opened row groups."""


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


class Archive:
    """Reader of the archive folder of a database; the folder is None if none is configured.

    Every method raises `Busy` where a file cannot be read, and `NotAvailable` without the folder,
    or without the package that reads it.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self.cache = LruCache(CACHE_BYTES)

    def stored_answers(self, connection: Connection, ids: Collection[str]) -> dict[str, bytes]:
        """Answers of recorded or archived results by id, byte for byte; without unknown ids."""
        found = stored_answers(connection, ids)
        if len(found) == len(ids):
            return found
        for path, wanted in places(connection, set(ids) - found.keys()).items():
            read = self.read(path, ["id", "answer"], [("id", "in", list(wanted))])
            rows = zip(read["id"].to_pylist(), read["answer"].to_pylist(), strict=True)
            found |= {id: answer.encode() for id, answer in rows}
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

    def read(self, path: str, columns: Sequence[str] | None, filters: Any) -> "pa.Table":
        """Read columns, or all, of the results in an archive part that pass pyarrow's `filters`.

        Columns unknown to the version that wrote the part are left out.
        """
        with self._readable(path) as file:
            from pyarrow import parquet

            if columns is not None:
                written = parquet.read_schema(file).names
                columns = [each for each in columns if each in written]
            return parquet.read_table(
                file,
                columns=columns,
                filters=filters,
                partitioning=None,
                page_checksum_verification=True,
            )

    def batch(self, connection: Connection, id: str) -> "Opened | None":
        """Open the batch of an archived result with all its results; None if it is not archived."""
        if (
            connection.scalar(select(tables.results.c.id).where(tables.results.c.id == id))
            is not None
        ):
            return None
        found = places(connection, [id])
        if not found:
            return None
        ((path, _),) = found.items()
        batch_id = batch_of(connection, id)

        def build() -> "Opened":
            from service.storage.archive.folder import read_settings
            from service.storage.archive.rows import WHOLE, Opened, columns_of

            own = [[("id", "=", batch_id)], [("batch_id", "=", batch_id)]]
            read = self.read(path, columns_of(WHOLE), own)
            opened = Opened()
            opened.add_partition(read)
            digests = sorted({*read["mission_digest"].to_pylist()})
            assert self.folder is not None
            opened.add_settings(read_settings(self.folder, digest) for digest in digests)
            return opened

        return self.cache.get((path, batch_id), build)[0]

    def blocks(self, part: PlacedPart) -> list[Block]:
        """Row groups of an archive part, in order of time."""
        with self._readable(part.path) as file:
            from pyarrow import parquet

            about = parquet.read_metadata(file)
            place = about.schema.to_arrow_schema().names.index("time_ns")
            times = [
                about.row_group(k).column(place).statistics for k in range(about.num_row_groups)
            ]
        return [Block(part, k, each.min, each.max) for k, each in enumerate(times)]

    def open(self, block: Block, needs: Collection[str]) -> "Opened":
        """Open the results of a row group with the columns in `needs`; see `rows.columns_of`."""

        def build() -> "Opened":
            from service.storage.archive.rows import Opened, columns_of

            with self._readable(block.part.path) as file:
                from pyarrow import parquet

                whole = parquet.ParquetFile(file, page_checksum_verification=True)
                read = whole.read_row_group(block.group, columns_of(needs))
            opened = Opened()
            opened.add_partition(read)
            return opened

        key = (block.part.path, block.part.sha256, block.group, *sorted(needs))
        return self.cache.get(key, build)[0]

    def current_ids(
        self, part: PlacedPart, start_ns: int | None, end_ns: int | None
    ) -> "pa.ChunkedArray":
        """Ids of an archive part's current results from a time to before another, in order."""
        filters: list[tuple[str, str, object]] = [("current", "=", True)]
        filters += [("time_ns", ">=", start_ns)] if start_ns is not None else []
        filters += [("time_ns", "<", end_ns)] if end_ns is not None else []
        return self.read(part.path, ["id"], filters)["id"]

    @contextmanager
    def _readable(self, path: str) -> Iterator[Path]:
        """Context manager with the path of an archive part's file; read errors get a remedy."""
        require_extra("tables", "pyarrow", "archive", path)
        import pyarrow as pa

        if self.folder is None:
            # A new attempt of the client would not help, only a start of the service with the
            # setting.
            message = (
                "is archived, and no folder of an archive is set: set ACQUIRE_ARCHIVE_FOLDER to "
                "the folder that `acquire archive` wrote; a service must be started again with it"
            )
            raise NotAvailable(Fault("batch", message))
        try:
            yield self.folder / path
        except (OSError, pa.ArrowException) as error:
            log.error("%s: cannot be read: %s", self.folder / path, error)
            raise Busy(
                "the batches are archived, and the archive cannot be read now: have the folder "
                "of ACQUIRE_ARCHIVE_FOLDER mounted, or restored from its backup"
            ) from error


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
    return bool(parts_between(connection, spacecraft, run, start.tai_ns, end.tai_ns))


def archived_paths(connection: Connection) -> dict[str, str]:
    """SHA-256 of all archive parts with batches of a database, by path."""
    query = select(tables.archived_parts.c.path, tables.archived_parts.c.sha256)
    return dict(map(tuple, connection.execute(query)))
