"""Takes archived batches back into the database, and verifies an archive."""

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
from sqlalchemy import Connection, delete, select
from sqlalchemy.exc import IntegrityError

from service.errors import BadConfiguration, BadInput
from service.observations.schema import fingerprint_of
from service.storage.archive.folder import (
    UNFINISHED,
    Manifest,
    Part,
    day_folders,
    is_locked,
    locked,
    parts_of,
    read_settings,
)
from service.storage.archive.rows import Rows, insert_rows, read_part
from service.storage.projections import rollups, seals
from service.storage.sql import tables
from service.storage.sql.statements import insert_missing, insert_runs, portions
from service.storage.store import Store
from service.times import HOUR_S, Utc, parse_utc


@dataclass(frozen=True)
class PartFilter:
    """Selects the parts of a spacecraft and a run with a time from `start` to before `end`."""

    spacecraft: str | None = None
    run: str | None = None
    start: Utc | None = None
    end: Utc | None = None

    def takes(self, manifest: Manifest, part: Part) -> bool:
        """True if a part is selected."""
        return (
            self.spacecraft in (None, manifest.spacecraft)
            and self.run in (None, part.run)
            and (self.start is None or part.last_ns >= self.start.tai_ns)
            and (self.end is None or part.first_ns < self.end.tai_ns)
        )


@dataclass
class Restored:
    """How many batches the selected parts have, how many were looked at, how many restored."""

    total: int
    batches: int = 0
    restored: int = 0


def restore(
    store: Store,
    folder: Path,
    selected: PartFilter,
    *,
    step: Callable[[Restored], object] = lambda restored: None,
) -> Restored:
    """Record the batches of all selected parts again, each part whole and in one transaction.

    The files stay.  A part whose batches are recorded is passed over, so that an interrupted
    call is made again.  Raises `BadConfiguration` for a damaged part, and for one whose batches
    the database has from somebody else.
    """
    with locked(folder):
        parts = [
            (path, part)
            for path, manifest, part in parts_of(folder)
            if selected.takes(manifest, part)
        ]
        restored = Restored(sum(part.batches for _, part in parts))
        step(restored)
        for path, part in parts:
            rows = read_part(folder, path, part.sha256)
            record_again = partial(put_back, folder=folder, part=part, rows=rows)
            try:
                is_new = store.writer.change(record_again).result()
            except IntegrityError as error:
                raise BadConfiguration(
                    f"{folder / path}: the database has other batches of these names: {error.orig}"
                ) from None
            restored.batches += part.batches
            restored.restored += part.batches if is_new else 0
            step(restored)
    return restored


def put_back(connection: Connection, folder: Path, part: Part, rows: Rows) -> bool:
    """Insert the rows of a part; False: they are there."""
    ids = rows["batches"]["id"].to_pylist()
    query = select(tables.batches.c.id).where(tables.batches.c.id.in_(ids[:1]))
    if connection.scalar(query) is not None:
        return False
    part_id = connection.scalar(
        select(tables.archived_batches.c.part_id).where(tables.archived_batches.c.id.in_(ids[:1]))
    )
    for digests, table in ((part.missions, tables.missions), (part.catalogs, tables.catalogs)):
        rows_of_settings = [read_settings(folder, each).row for each in digests]
        # An archive of an earlier version has none.
        insert_missing(connection, table, [{"row_digest": None} | row for row in rows_of_settings])
    created = pc.min(rows["batches"]["received"]).as_py()
    insert_runs(connection, {part.run: created}, tracked=part.tracked)
    if part_id is not None:
        spacecraft = rows["batches"]["spacecraft"][0].as_py()
        forget_part(connection, part_id, spacecraft, part.run, ids)
    position = rollups.lock_position(connection)
    insert_rows(connection, _placed(rows, 0 if part_id is None else position))
    for some_ids in portions(ids):
        seals.add(connection, tables.results.c.batch_id.in_(some_ids))
    if part_id is None:
        # The trends have the share of a part that the database knows.
        _add_to_trends(connection, rows)
    return True


def forget_part(
    connection: Connection, part_id: int, spacecraft: str, run: str, batch_ids: Sequence[str]
) -> None:
    """Delete what the database knows of a part with these batches, and its share in the trends."""
    rollups.forget_share(connection, part_id, spacecraft, run)
    for ids in portions(batch_ids):
        for column in (tables.archived_batches.c.id, tables.archived_what_ifs.c.batch_id):
            connection.execute(delete(column.table).where(column.in_(ids)))
    own = tables.archived_parts.c.id == part_id
    connection.execute(delete(tables.archived_parts).where(own))


def _placed(rows: Rows, position: int) -> Rows:
    """The rows with their places in the record where these are not after `position`, else none.

    The projector passes over them: what they add to the trends is there, or is added here.
    """
    made = rows["results"]
    places = pc.fill_null(made["seq"], 0)
    places = pc.if_else(pc.less_equal(places, position), places, pa.scalar(0, pa.int64()))
    return rows | {"results": made.set_column(made.column_names.index("seq"), "seq", places)}


def _add_to_trends(connection: Connection, rows: Rows) -> None:
    times = zip(*(rows["batches"][name].to_pylist() for name in ("id", "time")), strict=True)
    hours = {id: parse_utc(time).bucket(HOUR_S) for id, time in times}
    current = {row["batch_id"]: row for row in rows["results"].to_pylist() if row["current"]}
    keys = {id: (row["spacecraft"], row["run"], hours[id]) for id, row in current.items()}
    rollups.add(connection, ((keys[id], row) for id, row in current.items()))
    of_trackers = rows["tracker_values"].to_pylist()
    rollups.add(connection, ((keys[row["batch_id"]], row) for row in of_trackers))


def verify_archive(
    folder: Path,
    needed: Mapping[str, str],
    step: Callable[[int], object] = lambda batches: None,
) -> Iterator[str]:
    """The faults of an archive, a sentence each, as they are found; none: every part is whole.

    Every file is read, its hash compared, and its rows with what the manifest and the
    fingerprints say.  `needed` has the hashes of the parts that a database needs, by path.
    """
    done, whole = 0, {}
    named: dict[Path, set[str]] = {day: set() for day in day_folders(folder)}
    for path, manifest, part in parts_of(folder):
        named.setdefault((folder / path).parent, set()).add(part.file)
        whole[path] = part.sha256
        try:
            yield from _of_a_part(folder, path, manifest, part)
        except BadConfiguration as error:
            yield str(error)
        done += part.batches
        step(done)
    # Another command may be writing parts: what it has not named yet is not left over.
    if not is_locked(folder):
        for day, files in named.items():
            yield from _unnamed(day, files)
    for path, sha256 in needed.items():
        if whole.get(path) != sha256:
            yield f"{folder / path}: the database has batches in it, and no manifest names it so"


def _unnamed(day: Path, named: Container[str]) -> Iterator[str]:
    for file in sorted(day.iterdir()):
        if file.suffix == UNFINISHED:
            yield f"{file}: was not written to its end"
        elif file.suffix == ".parquet" and file.name not in named:
            yield f"{file}: the manifest does not name it"


def _is_own(input: str, fingerprint: str) -> bool:
    """True if a fingerprint is that of an input; of one that cannot be read it is not."""
    try:
        return fingerprint_of(input) == fingerprint
    except BadInput:
        return False


def _of_a_part(folder: Path, path: str, manifest: Manifest, part: Part) -> Iterator[str]:
    name = str(folder / path)
    rows = read_part(folder, path, part.sha256)
    found, made = rows["batches"].to_pylist(), rows["results"].to_pylist()
    if (len(found), len(made)) != (part.batches, part.results):
        yield f"{name}: has other numbers of batches and results than the manifest says"
    if {(each["spacecraft"], each["run"]) for each in found} != {(manifest.spacecraft, part.run)}:
        yield f"{name}: has batches of another spacecraft or run"
    framed = set(rows["frames"]["batch_id"].to_pylist())
    for each in found:
        # That of a frame is of more than what is kept.
        if each["id"] not in framed and not _is_own(each["input"], each["fingerprint"]):
            yield f"{name}: batch {each['id']}: its input is not the one that was fingerprinted"
    current = [each["batch_id"] for each in made if each["current"]]
    if sorted(current) != sorted(each["id"] for each in found):
        yield f"{name}: not every batch has one current result"
    for digest in chain(part.missions, part.catalogs):
        try:
            read_settings(folder, digest)
        except BadConfiguration as error:
            yield str(error)
