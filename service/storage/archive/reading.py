"""Reads archived batches for the service: the one place that knows where a batch is."""

from collections.abc import Collection, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, select

from service.errors import AcquisitionError, Busy
from service.extras import require_extra
from service.storage.archive.tables import archived_batches, archived_parts, archived_what_ifs
from service.storage.recording.identity import stored_answers
from service.times import Utc

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True)
class Archive:
    """The folder with the parts of a database; None: none is set."""

    folder: Path | None

    def stored_answers(self, connection: Connection, ids: Collection[str]) -> dict[str, bytes]:
        """The answers of recorded or archived results, byte for byte; of others there is none."""
        found = stored_answers(connection, ids)
        if len(found) == len(ids):
            return found
        for path, wanted in _places(connection, set(ids) - found.keys()).items():
            read = self.read(path, ["id", "answer"], wanted)
            rows = zip(read["id"].to_pylist(), read["answer"].to_pylist(), strict=True)
            found |= {id: answer.encode() for id, answer in rows}
        return found

    def answers_or_faults(
        self, connection: Connection, ids: Set[str]
    ) -> dict[str, bytes | AcquisitionError]:
        """`stored_answers`, or for archived results what keeps them from being read."""
        found: dict[str, bytes | AcquisitionError] = {**stored_answers(connection, ids)}
        if archived := ids - found.keys():
            try:
                found |= self.stored_answers(connection, archived)
            except AcquisitionError as error:
                found |= dict.fromkeys(archived, error)
        return found

    def read(self, path: str, columns: Sequence[str] | None, ids: Sequence[str]) -> "pa.Table":
        """Some columns, or all, of the results of a part that have these ids.

        Raises `Busy` where the file cannot be read, and `NotAvailable` without the package that
        reads it.
        """
        require_extra("tables", "pyarrow", "archive", path)
        import pyarrow as pa
        from pyarrow import parquet

        if self.folder is None:
            raise Busy("the batch is archived, and this service has no archive folder")
        try:
            return parquet.read_table(
                self.folder / path,
                columns=None if columns is None else list(columns),
                filters=[("id", "in", list(ids))],
                partitioning=None,
                page_checksum_verification=True,
            )
        except (OSError, pa.ArrowException) as error:
            raise Busy("the batch is archived, and the archive cannot be read now") from error


def _places(connection: Connection, ids: Collection[str]) -> dict[str, list[str]]:
    """The ids of archived results by the path of their part."""
    found: dict[str, list[str]] = {}
    wanted = list(ids)
    first = select(archived_batches.c.id, archived_parts.c.path).where(
        archived_batches.c.id.in_(wanted)
    )
    of_batch = archived_batches.join(
        archived_what_ifs, archived_what_ifs.c.batch_id == archived_batches.c.id
    )
    further = (
        select(archived_what_ifs.c.id, archived_parts.c.path)
        .select_from(of_batch)
        .where(archived_what_ifs.c.id.in_(wanted))
    )
    has_part = archived_parts.c.id == archived_batches.c.part_id
    queries: tuple[Any, ...] = (first.where(has_part), further.where(has_part))
    for query in queries:
        for id, path in connection.execute(query):
            found.setdefault(path, []).append(id)
    return found


def holds_any(connection: Connection, spacecraft: str, run: str, start: Utc, end: Utc) -> bool:
    """Whether batches of a period may be archived: whether a part reaches into it."""
    c = archived_parts.c
    query = select(c.id).where(
        c.spacecraft == spacecraft,
        c.run == run,
        c.last_ns >= start.tai_ns,
        c.first_ns < end.tai_ns,
    )
    return connection.scalar(query.limit(1)) is not None


def archived_paths(connection: Connection) -> dict[str, str]:
    """The hashes of the parts that a database has batches in, by path."""
    query = select(archived_parts.c.path, archived_parts.c.sha256)
    return dict(map(tuple, connection.execute(query)))
