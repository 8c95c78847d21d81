"""What the record asks of the archive: to read archived batches, and to remove some."""

import logging
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import ColumnElement, Connection

from service.errors import Busy, Fault, NotAvailable
from service.extras import require_extra
from service.sky.cache import LruCache
from service.storage.archived import Archive, Block, PlacedPart, places
from service.storage.sql.columns import Row
from service.storage.store import Store

if TYPE_CHECKING:
    import pyarrow as pa

    from service.features.archive.rows import Opened

log = logging.getLogger(__name__)


CACHE_BYTES = 64 << 20
"""Size in bytes of the cache of opened row groups."""
_LOOKED_UP_AT_ONCE = 1_000


class ParquetArchive(Archive):
    """Reader of the archive folder of a database; the folder is None if none is configured.

    Every method raises `Busy` where a file cannot be read, and `NotAvailable` without the folder,
    or without the package that reads it.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self.cache = LruCache(CACHE_BYTES)

    def answers_in(self, path: str, ids: Sequence[str]) -> dict[str, bytes]:
        """Answers of results in an archive part by id, byte for byte."""
        read = self.read(path, ["id", "answer"], [("id", "in", list(ids))])
        rows = zip(read["id"].to_pylist(), read["answer"].to_pylist(), strict=True)
        return {id: answer.encode() for id, answer in rows}

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

    def batch_in(self, path: str, batch_id: str) -> "Opened":
        """Open a batch in an archive part with all its results and their settings."""

        def build() -> "Opened":
            from service.features.archive.folder import read_settings
            from service.features.archive.rows import WHOLE, Opened, columns_of

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
            from service.features.archive.rows import Opened, columns_of

            with self._readable(block.part.path) as file:
                from pyarrow import parquet

                whole = parquet.ParquetFile(file, page_checksum_verification=True)
                read = whole.read_row_group(block.group, columns_of(needs))
            opened = Opened()
            opened.add_partition(read)
            return opened

        key = (block.part.path, block.part.sha256, block.group, *sorted(needs))
        return self.cache.get(key, build)[0]

    def current_ids(self, part: PlacedPart, start_ns: int | None, end_ns: int | None) -> list[str]:
        """Ids of an archive part's current results from a time to before another, in order."""
        filters: list[tuple[str, str, object]] = [("current", "=", True)]
        filters += [("time_ns", ">=", start_ns)] if start_ns is not None else []
        filters += [("time_ns", "<", end_ns)] if end_ns is not None else []
        found: list[str] = self.read(part.path, ["id"], filters)["id"].to_pylist()
        return found

    def rows(self, part: PlacedPart, ids: Sequence[str], columns: Sequence[str]) -> list[Row]:
        """Columns of results and their batches in an archive part, in order of time."""
        found: list[Row] = self.read(part.path, columns, [("id", "in", list(ids))]).to_pylist()
        return found

    def together(
        self,
        connection: Connection,
        recorded: Sequence[str],
        archived: Sequence[str],
        needs: Collection[str],
    ) -> "Opened":
        """Open recorded and archived batches in one database, by ids; `needs` as for `open`."""
        require_extra("tables", "pyarrow", "archive", str(self.folder))
        from service.features.archive.rows import Opened, columns_of, read_rows

        opened = Opened()
        if recorded:
            opened.add_rows(read_rows(connection, recorded))
        of_file: dict[str, list[str]] = {}
        for first in range(0, len(archived), _LOOKED_UP_AT_ONCE):
            some_ids = archived[first : first + _LOOKED_UP_AT_ONCE]
            for path, ids in places(connection, some_ids).items():
                of_file.setdefault(path, []).extend(ids)
        for path, ids in of_file.items():
            own: Any = [[("id", "in", ids)], [("batch_id", "in", ids)]]
            opened.add_partition(self.read(path, columns_of(needs), own))
        opened.add_indexes()
        return opened

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


def open_archive(folder: Path | None) -> ParquetArchive:
    """Open the archive in a folder; without a folder archived batches cannot be read."""
    return ParquetArchive(folder)


def forget_archived(
    store: Store,
    folder: Path,
    chosen: Collection[ColumnElement[bool]],
    forget_recorded: Callable[[Connection], object],
) -> int:
    """Remove archived batches from the database and the folder; see `forgetting`."""
    # Archives need pyarrow, which is an extra.
    from service.features.archive import forgetting

    return forgetting.forget_archived(store, folder, chosen, forget_recorded)
