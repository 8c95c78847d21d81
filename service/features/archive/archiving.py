"""Archiving: moves old batches from the database to an archive without losing any.

A part is written, read back from its file and named in the manifest.  Then one transaction compares
the file with the record bit by bit, notes the batches as archived and deletes them.  If the command
is interrupted before that, the batches stay in the record, and the next call discards the part.

The module also takes archived batches back into the database, and verifies an archive.
"""

import hashlib
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
from sqlalchemy import ColumnElement, Connection, delete, func, insert, select
from sqlalchemy.exc import IntegrityError

from service.errors import BadConfiguration, BadInput
from service.features.archive.folder import (
    UNFINISHED,
    Manifest,
    Part,
    Settings,
    claim,
    day_folder,
    day_folders,
    is_locked,
    locked,
    manifest_of,
    parts_of,
    path_of,
    read_partition,
    read_settings,
    remove_part,
    write_manifest,
    write_partition,
    write_settings,
)
from service.features.archive.rows import (
    Rows,
    differing,
    from_partition,
    insert_rows,
    lock_rows,
    read_part,
    read_rows,
    to_partition,
)
from service.observations.schema import fingerprint_of
from service.storage.projections import rollups, seals
from service.storage.projections.heads import newest_head
from service.storage.projections.rollups import keep_share
from service.storage.recording.identity import digest_of_row, made_later
from service.storage.recording.result_metrics import is_waiting
from service.storage.sql import tables
from service.storage.sql.statements import count, insert_all, insert_missing, insert_runs, portions
from service.storage.store import Store
from service.storage.upkeep.prune import delete_batches
from service.times import DAY_S, HOUR_S, Utc, bucket_start, parse_utc, utc_now

Integers = npt.NDArray[np.int64]

MOST_BATCHES = 10_000
"""Largest number of batches in a part, which is held in memory and deleted in one transaction."""

MAX_ATTEMPTS = 5


@dataclass
class Archived:
    """Progress of archiving: batches in total, batches archived, parts and bytes written."""

    total: int
    batches: int = 0
    parts: int = 0
    bytes: int = 0


@dataclass(frozen=True, order=True)
class _Day:
    spacecraft: str
    run: str
    number: int

    @property
    def text(self) -> str:
        return bucket_start(self.number, DAY_S).text[:10]


def archive(
    store: Store,
    folder: Path,
    before: Utc,
    *,
    step: Callable[[Archived], object] = lambda archived: None,
) -> Archived:
    """Move the batches whose time is before `before` to the archive in `folder`.

    The hours of the newest batch and of the newest attitude of each spacecraft and run stay, so
    that its state is known without the archive.  Gyro blocks stay.  After an interruption another
    call continues.  Raises `BadConfiguration` where the folder is missing, in use or of another
    database, where batches are not split by tracker yet, and where a part of the archive
    contradicts the record.
    """
    with locked(folder):
        with store.reading() as connection:
            claim(connection, folder)
            days = _days(connection, before)
            chosen = {day: _chosen(connection, day, before) for day in days}
            total = sum(count(connection, tables.results, *each) for each in chosen.values())
        archived = Archived(total)
        step(archived)
        for day in days:
            _discard_unfinished(store, folder, day)
            for ids in _portions(store, chosen[day]):
                part = _archive(store, folder, day, ids)
                archived.batches += part.batches
                archived.parts += 1
                archived.bytes += part.bytes
                step(archived)
    return archived


def _days(connection: Connection, before: Utc) -> list[_Day]:
    daily = tables.rollups_daily.c
    query = select(daily.spacecraft, daily.run, daily.bucket).where(
        daily.bucket <= before.bucket(DAY_S)
    )
    found = sorted(_Day(*row) for row in connection.execute(query))
    for spacecraft, run in sorted({(day.spacecraft, day.run) for day in found}):
        if is_waiting(connection, spacecraft, run):
            raise BadConfiguration(
                f"{spacecraft}, run {run}: batches from before it had several trackers are not "
                "split by tracker yet: run `acquire database split-trackers` first"
            )
    return found


def _chosen(connection: Connection, day: _Day, before: Utc) -> list[ColumnElement[bool]]:
    """SQL conditions for the current results of a day that are to be archived."""
    end_ns = min(bucket_start(day.number + 1, DAY_S).tai_ns, before.tai_ns)
    chosen: list[ColumnElement[bool]] = [
        tables.results.c.current,
        tables.results.c.spacecraft == day.spacecraft,
        tables.results.c.run == day.run,
        tables.results.c.time_ns >= bucket_start(day.number, DAY_S).tai_ns,
        tables.results.c.time_ns < end_ns,
    ]
    # A batch dated in the future does not count as the newest one.
    until = utc_now().bucket(HOUR_S)
    for begin_ns, end_ns in newest_hours(connection, day.spacecraft, day.run, until):
        chosen.append(~tables.results.c.time_ns.between(begin_ns, end_ns - 1))
    return chosen


def newest_hours(
    connection: Connection, spacecraft: str, run: str, until: int | None = None
) -> Iterator[tuple[int, int]]:
    """Bounds in ns of TAI of the hours with a run's newest batch and with its newest attitude.

    Hours after `until` are left out.
    """
    hourly = tables.rollups_hourly.c
    own = [hourly.spacecraft == spacecraft, hourly.run == run]
    if until is not None:
        own.append(hourly.bucket <= until)
    for has in (hourly.batches, hourly.solved):
        hour = connection.scalar(select(func.max(hourly.bucket)).where(*own, has > 0))
        if hour is not None:
            yield bucket_start(hour, HOUR_S).tai_ns, bucket_start(hour + 1, HOUR_S).tai_ns


def _portions(store: Store, chosen: Sequence[ColumnElement[bool]]) -> Iterator[list[str]]:
    """Batch ids for one archive part after another, in order of time."""
    query = select(tables.results.c.batch_id).where(*chosen)
    query = query.order_by(tables.results.c.time_ns, tables.results.c.batch_id).limit(MOST_BATCHES)
    while True:
        with store.reading() as connection:
            ids = list(connection.scalars(query))
        if not ids:
            return
        yield ids


def _archive(store: Store, folder: Path, day: _Day, batch_ids: Sequence[str]) -> Part:
    """Write an archive part, name it in the manifest, and delete its batches from the database."""
    for _ in range(MAX_ATTEMPTS):
        with store.reading() as connection:
            rows = read_rows(connection, batch_ids)
            made = rows["results"]
            used = (
                pc.unique(made[f"{kind}_digest"]).to_pylist() for kind in ("mission", "catalog")
            )
            keep_settings(connection, folder, *used)
            tracked = connection.scalar(
                select(tables.runs.c.tracked).where(tables.runs.c.name == day.run)
            )
            head = newest_head(connection)
        file = _new_file(day_folder(folder, day.spacecraft, day.text))
        content = write_partition(file, to_partition(rows))
        part = described(file.name, day.run, rows, content)
        part = msgspec.structs.replace(
            part, tracked=bool(tracked), record_head=None if head is None else head.text
        )
        manifest = manifest_of(folder, day.spacecraft, day.text).with_part(part)
        write_manifest(folder, manifest)
        path = path_of(folder, manifest, part)
        written = from_partition(read_partition(content))
        take_out = partial(_take_out, day=day, part=part, path=path, written=written)
        if store.writer.change(take_out):
            return part
        # The record changed after it was read, for example by a what-if: write the part again.
        remove_part(folder, manifest, part)
    raise BadConfiguration(f"{path}: the record of these batches changes too often, or is damaged")


def _new_file(folder: Path) -> Path:
    """Choose a name for an archive file that no existing file has, named in a manifest or not."""
    names = [each.name for each in folder.glob("part-*.parquet")]
    numbers = [int(each.removeprefix("part-").partition(".")[0]) for each in names]
    return folder / f"part-{1 + max(numbers, default=0)}.parquet"


def described(name: str, run: str, rows: Rows, content: bytes) -> Part:
    """Build the manifest entry of an archive part from its rows and file content."""
    found = rows["batches"]
    first, last = found.slice(0, 1).to_pylist()[0], found.slice(len(found) - 1).to_pylist()[0]
    made = rows["results"]
    return Part(
        file=name,
        run=run,
        batches=len(found),
        results=len(made),
        first=first["time"],
        last=last["time"],
        first_ns=first["time_ns"],
        last_ns=last["time_ns"],
        bytes=len(content),
        sha256=hashlib.sha256(content).hexdigest(),
        missions=sorted(pc.unique(made["mission_digest"]).to_pylist()),
        catalogs=sorted(pc.unique(made["catalog_digest"]).to_pylist()),
    )


def keep_settings(
    connection: Connection, folder: Path, of_missions: Sequence[str], of_catalogs: Sequence[str]
) -> None:
    """Copy the settings and catalogs with these digests to the archive."""
    for digests, table in ((of_missions, tables.missions), (of_catalogs, tables.catalogs)):
        query = select(table).where(table.c.digest.in_(digests))
        for row in connection.execute(query).mappings():
            write_settings(folder, Settings(digest=row["digest"], row=dict(row)))


def note_part(
    connection: Connection, spacecraft: str, part: Part, path: str, found: pa.Table
) -> int:
    """Note the batches of an archive part in the database; returns the id of the part."""
    names = ("run", "first_ns", "last_ns", "batches", "sha256")
    row = {name: getattr(part, name) for name in names} | {"path": path, "spacecraft": spacecraft}
    part_id = connection.execute(
        insert(tables.archived_parts).returning(tables.archived_parts.c.id), row
    )
    number = int(part_id.scalar_one())
    columns = [each.name for each in tables.archived_batches.columns if each.name != "part_id"]
    numbers = pa.array([number] * len(found), pa.int32())
    noted = found.select(columns).append_column("part_id", numbers)
    insert_all(connection, tables.archived_batches, noted.to_pylist())
    return number


def _take_out(connection: Connection, day: _Day, part: Part, path: str, written: Rows) -> bool:
    """Note an archive part's batches and delete them; False if the record has changed meanwhile."""
    ids = written["batches"]["id"].to_pylist()
    lock_rows(connection, ids)
    if differing(read_rows(connection, ids), written) is not None:
        return False
    number = note_part(connection, day.spacecraft, part, path, written["batches"])
    made = written["results"]
    further = made.filter(pc.not_equal(made["id"], made["batch_id"])).select(["id", "batch_id"])
    insert_all(connection, tables.archived_what_ifs, further.to_pylist())
    of_hour = _by_hour(day, written)
    # A recount of an hour reads its results, then its shares: it must see all of this, or nothing.
    position = rollups.lock_position(connection)
    keep_share(connection, number, day.spacecraft, day.run, of_hour)
    delete_batches(connection, ids)
    if pc.max(made["seq"]).as_py() > position:
        # The projector will not find these results any more.
        rollups.renew(connection, ((day.spacecraft, day.run, hour) for hour in of_hour))
    return True


def _by_hour(day: _Day, rows: Rows) -> dict[int, list[str]]:
    """Ids of a day's batches by the number of their hour."""
    hours = hours_of(day.number, rows["batches"]["time_ns"].to_numpy())
    found: dict[int, list[str]] = {}
    for hour, id in zip(hours, rows["batches"]["id"].to_pylist(), strict=True):
        found.setdefault(hour, []).append(id)
    return found


def hours_of(day: int, times_ns: Integers) -> list[int]:
    """Hour numbers (n,) of one day's batches, as `Utc.bucket` gives, from times in ns of TAI."""
    hours = range(24 * day, 24 * day + 24)
    starts_ns = np.array([bucket_start(hour, HOUR_S).tai_ns for hour in hours])
    # A leap second belongs to the hour that it ends.
    place = np.searchsorted(starts_ns, times_ns, side="right") - 1
    return [hours[k] for k in place.tolist()]


def _discard_unfinished(store: Store, folder: Path, day: _Day) -> None:
    """Delete a day's archive files whose batches are all still in the record.

    Files of other databases, which have none of these batches, stay.
    """
    manifest = manifest_of(folder, day.spacecraft, day.text)
    paths = {path_of(folder, manifest, part): part for part in manifest.parts}
    with store.reading() as connection:
        query = select(tables.archived_parts.c.path).where(tables.archived_parts.c.path.in_(paths))
        known = set(connection.scalars(query))
    for path, part in paths.items():
        if path in known or part.run != day.run:
            continue
        rows = read_part(folder, path, part.sha256)
        with store.reading() as connection:
            present = read_rows(connection, rows["batches"]["id"].to_pylist())
        if not len(present["results"]):
            continue
        own, recorded = (set(each["results"]["id"].to_pylist()) for each in (rows, present))
        if not own <= recorded:
            raise BadConfiguration(
                f"{folder / path}: the database has some of its batches and lacks others: restore "
                "it with `acquire archive restore`, or move it away"
            )
        manifest = remove_part(folder, manifest, part)


@dataclass(frozen=True)
class PartFilter:
    """Filter for archive parts by spacecraft, run and period; None selects all."""

    spacecraft: str | None = None
    run: str | None = None
    start: Utc | None = None
    end: Utc | None = None

    def takes(self, manifest: Manifest, part: Part) -> bool:
        """True if the filter selects an archive part."""
        return (
            self.spacecraft in (None, manifest.spacecraft)
            and self.run in (None, part.run)
            and (self.start is None or part.last_ns >= self.start.tai_ns)
            and (self.end is None or part.first_ns < self.end.tai_ns)
        )


@dataclass
class Restored:
    """Progress of a restore: batches in the selected parts, batches checked, batches restored."""

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
    """Record the batches of all selected archive parts again, each part in one transaction.

    The files stay.  A part whose batches are recorded is skipped, so that an interrupted call can
    be repeated.  Raises `BadConfiguration` for a damaged part, and for one whose batches the
    database has from another source.
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
                is_new = store.writer.change(record_again)
            except IntegrityError as error:
                raise BadConfiguration(
                    f"{folder / path}: the database has other batches of these names: {error.orig}"
                ) from None
            restored.batches += part.batches
            restored.restored += part.batches if is_new else 0
            step(restored)
    return restored


def put_back(connection: Connection, folder: Path, part: Part, rows: Rows) -> bool:
    """Insert the rows of an archive part into the database; False if they are there already."""
    ids = rows["batches"]["id"].to_pylist()
    query = select(tables.batches.c.id).where(tables.batches.c.id.in_(ids[:1]))
    if connection.scalar(query) is not None:
        return False
    part_id = connection.scalar(
        select(tables.archived_batches.c.part_id).where(tables.archived_batches.c.id.in_(ids[:1]))
    )
    for digests, table in ((part.missions, tables.missions), (part.catalogs, tables.catalogs)):
        rows_of_settings = [read_settings(folder, each).row for each in digests]
        for row in rows_of_settings:
            # Settings in an archive of an earlier version have no digest.
            digest = row.get("row_digest")
            row["row_digest"] = made_later(digest_of_row(table, row)) if digest is None else digest
        insert_missing(connection, table, rows_of_settings)
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
        # The trends already have the share of a part that the database knows.
        _add_to_trends(connection, rows)
    return True


def forget_part(
    connection: Connection, part_id: int, spacecraft: str, run: str, batch_ids: Sequence[str]
) -> None:
    """Delete an archive part from the database: its entry, batch ids, and share in the trends."""
    rollups.forget_share(connection, part_id, spacecraft, run)
    for ids in portions(batch_ids):
        for column in (tables.archived_batches.c.id, tables.archived_what_ifs.c.batch_id):
            connection.execute(delete(column.table).where(column.in_(ids)))
    own = tables.archived_parts.c.id == part_id
    connection.execute(delete(tables.archived_parts).where(own))


def _placed(rows: Rows, position: int) -> Rows:
    """Rows of results without their places in the record after `position`.

    The projector passes over the kept places: their part in the trends is there, or added here.
    """
    made = rows["results"]
    places = pc.fill_null(made["seq"], 0)
    is_kept = pc.and_(pc.less_equal(places, position), bool(position))
    places = pc.if_else(is_kept, places, pa.scalar(0, pa.int64()))
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
    """Check an archive; yields a sentence for each fault, none if every part is whole.

    Every file is read, its hash compared, and its rows compared with the manifest and the
    fingerprints.  `needed` has the hashes of the parts that a database needs, by path.
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
    # Another command may be writing parts: a file without an entry is no fault.
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
    """True if an input has the given fingerprint; False for an unreadable input."""
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
        # The fingerprint of a frame covers more than the archive keeps.
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
