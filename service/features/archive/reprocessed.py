"""Reprocessed runs in an archive: the data that the database keeps of their parts.

The parts are like those of `acquire archive`, but their batches were never in the database.  The
database gets their identities, their share in the trends, and the evaluation of their limits.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import msgspec
import pyarrow as pa
import pyarrow.compute as pc
from sqlalchemy import Connection, select
from sqlalchemy.exc import IntegrityError

from service.errors import BadConfiguration
from service.feature import feature_modules
from service.features.archive.archiving import (
    described,
    hours_of,
    newest_hours,
    note_part,
    put_back,
)
from service.features.archive.folder import Part, manifest_of, parts_of, path_of, write_manifest
from service.features.archive.rows import Rows, read_part
from service.storage.projections import rollups
from service.storage.projections.rollups import WHOLE, RecordedResult, insert_share
from service.storage.recording import events
from service.storage.recording.identity import look_up
from service.storage.recording.result_metrics import rolled_up
from service.storage.recording.unsaved_result import STARS
from service.storage.sql import tables
from service.storage.sql.columns import Row
from service.storage.sql.statements import count, portions
from service.storage.store import Store
from service.times import DAY_S, bucket_start, parse_utc

IDENTITY = ("id", "spacecraft", "run", "batch", "fingerprint")
"""Columns of an archived batch that stay in the database, to recognise it."""
_LONG = ["answer", "options"]


@dataclass(frozen=True)
class RunPart:
    """Archive part of a reprocessed run as written, with the data that the database keeps of it."""

    spacecraft: str
    day: str
    part: Part
    identities: pa.Table
    """Table of the batches' identities, with the columns of `IDENTITY`."""
    shares: Mapping[int, Mapping[str, Row]]
    """Rollup rows by hour, and by tracker or `WHOLE`, that the database keeps of the part."""
    latest: Row
    """Latest batch of the archive part, in the form of an event."""


def run_part(name: str, source: str, rows: Rows, content: bytes) -> RunPart:
    """Describe an archive part of a reprocessed run from its rows and file content."""
    found = rows["batches"]
    first = found.slice(0, 1).to_pylist()[0]
    part = msgspec.structs.replace(described(name, first["run"], rows, content), source=source)
    number = parse_utc(first["time"]).bucket(DAY_S)
    return RunPart(
        first["spacecraft"],
        bucket_start(number, DAY_S).text[:10],
        part,
        found.select(IDENTITY),
        _shares(rows, number),
        _latest(rows),
    )


def _latest(rows: Rows) -> Row:
    """Latest batch of an archive part in the form of an event, as the projector makes it."""
    batch = rows["batches"].slice(len(rows["batches"]) - 1).to_pylist()[0]
    (result,) = (
        rows["results"].filter(pc.equal(rows["results"]["batch_id"], batch["id"])).to_pylist()
    )
    found = {name: batch[name] for name in ("id", "batch", "time")}
    found |= {name: result[name] for name in ("status", "reason")}
    return found | {"counts": {name: result[name] for name in STARS}}


def _shares(rows: Rows, day: int) -> dict[int, dict[str, Row]]:
    made = rows["results"].drop_columns(_LONG)
    hours = hours_of(day, rows["results"]["time_ns"].to_numpy())
    of: dict[tuple[int, str], list[Row]] = {}
    of_batch = {}
    for hour, row in zip(hours, made.to_pylist(), strict=True):
        of.setdefault((hour, WHOLE), []).append(row)
        of_batch[row["batch_id"]] = hour
    for row in rows["tracker_values"].to_pylist():
        of.setdefault((of_batch[row["batch_id"]], row["tracker"]), []).append(row)
    found: dict[int, dict[str, Row]] = {}
    for (hour, tracker), group in of.items():
        found.setdefault(hour, {})[tracker] = rolled_up(group)
    return found


def name_part(folder: Path, made: RunPart) -> str:
    """Enter an archive part in the manifest of its day; returns its path below the folder."""
    manifest = manifest_of(folder, made.spacecraft, made.day).with_part(made.part)
    write_manifest(folder, manifest)
    return path_of(folder, manifest, made.part)


def merge(store: Store, folder: Path, path: str, made: RunPart) -> None:
    """Note an archive part of a reprocessed run in the database, in one transaction.

    Raises `BadConfiguration` where the run has other batches of the same names.
    """
    try:
        off = store.features_off
        store.writer.change(partial(_merge, folder=folder, path=path, made=made, features_off=off))
    except IntegrityError as error:
        raise _taken(made, str(error.orig)) from None


def _merge(
    connection: Connection, folder: Path, path: str, made: RunPart, features_off: str
) -> None:
    spacecraft, run = made.spacecraft, made.part.run
    # Lock the run: a batch that another process records in it holds this row until its commit, and
    # waits for it.  The tables of archived and of recorded batches have no unique key together.
    connection.execute(
        select(tables.runs.c.name).where(tables.runs.c.name == run).with_for_update()
    )
    recorded = select(tables.batches.c.id).where(
        tables.batches.c.spacecraft == spacecraft, tables.batches.c.run == run
    )
    if connection.scalar(recorded.limit(1)) is not None:
        names = made.identities["batch"].to_pylist()
        for some_names in portions(names):
            wanted = {(spacecraft, run, name) for name in some_names}
            if known := look_up(connection, wanted).identities:
                raise _taken(made, next(iter(known))[2])
    number = note_part(connection, spacecraft, made.part, path, made.identities)
    # A recount of an hour locks its rollup and then reads the shares.
    rollups.add_shares(connection, spacecraft, run, made.shares)
    insert_share(connection, number, spacecraft, run, made.shares)
    of_features = feature_modules("projection", features_off)
    projections = [each.apply for each in of_features if each.wants(connection, run)]
    if projections:
        for some_results in _as_recorded(read_part(folder, path, made.part.sha256)):
            for apply in projections:
                apply(connection, some_results)
    fields = {"spacecraft": spacecraft, "run": run, "batches": made.part.batches}
    fields |= {"latest": made.latest}
    events.add_event(connection, "batches", fields, run=run, spacecraft=spacecraft)


def _taken(made: RunPart, what: str) -> BadConfiguration:
    return BadConfiguration(
        f"run {made.part.run}: has other batches of {made.spacecraft} with the names of some that "
        f"were run again ({what}): name another run"
    )


def _as_recorded(rows: Rows) -> Iterator[Sequence[RecordedResult]]:
    """Results of an archive part in the form for projections, in order of time, in portions."""
    made = {row["batch_id"]: row for row in rows["results"].drop_columns(["answer"]).to_pylist()}
    trackers: dict[str, list[Row]] = {}
    for row in rows["tracker_values"].to_pylist():
        trackers.setdefault(row["batch_id"], []).append(row)
    own = rows["batches"].select(["id", "batch", "time", "received"]).to_pylist()
    found = [
        RecordedResult(made[batch["id"]] | batch, trackers.get(batch["id"], ())) for batch in own
    ]
    yield from portions(found)


def unmerged(store: Store, folder: Path, run: str) -> Iterator[tuple[str, RunPart]]:
    """Archive parts of a run that a manifest names but the database lacks, each after its path.

    A process that was killed between the two steps left them.  Raises `BadConfiguration` for a
    damaged part.
    """
    for path, manifest, part in parts_of(folder):
        if part.run != run or part.source is None:
            continue
        with store.reading() as connection:
            if count(connection, tables.archived_parts, tables.archived_parts.c.path == path):
                continue
        rows = read_part(folder, path, part.sha256)
        if not _has_some(store, rows["batches"]["id"].to_pylist()):
            made = run_part(part.file, part.source, rows, b"")
            yield path, replace(made, spacecraft=manifest.spacecraft, day=manifest.day, part=part)


def _has_some(store: Store, ids: Sequence[str]) -> bool:
    """True if any of the batches is recorded or archived."""
    with store.reading() as connection:
        return any(
            connection.scalar(select(table.c.id).where(table.c.id.in_(some_ids)).limit(1))
            for table in (tables.batches, tables.archived_batches)
            for some_ids in portions(ids)
        )


def restore_newest(store: Store, folder: Path, spacecraft: str, run: str) -> None:
    """Record the batches of the archive parts with a run's newest batch and newest attitude.

    As with `acquire archive`, the state of a spacecraft is known without the archive.
    """
    wanted: dict[str, str] = {}
    with store.reading() as connection:
        c = tables.archived_parts.c
        own = c.spacecraft == spacecraft, c.run == run
        for begin_ns, end_ns in newest_hours(connection, spacecraft, run):
            query = select(c.path, c.sha256).where(*own, c.last_ns >= begin_ns, c.first_ns < end_ns)
            wanted |= dict(map(tuple, connection.execute(query)))
    for path, sha256 in sorted(wanted.items()):
        manifest = manifest_of(folder, spacecraft, Path(path).parent.name.removeprefix("day="))
        part = next(each for each in manifest.parts if each.file == Path(path).name)
        rows = read_part(folder, path, sha256)
        store.writer.change(partial(put_back, folder=folder, part=part, rows=rows))
