"""Consistency check of a database; reads all of it and changes nothing.

Batches are read a few at a time, each time as of one moment, so that the check can run while the
database is being served.
"""

import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, product
from typing import Any, get_args

import msgspec
import numpy as np
import sqlalchemy as sa
from sqlalchemy.exc import DatabaseError

from service.attitude.definitive import (
    GRADES,
    DefinitiveSamples,
    MeasuredInnovations,
    unpacked,
    unpacked_innovations,
)
from service.errors import BadInput
from service.gyro.blocks import SAME_TIME_NS, Nanoseconds, first_shared_ns
from service.observations.batch import ObservationBatch
from service.observations.schema import fingerprint_of, submission_from_json
from service.storage.gyro import block_of
from service.storage.projections import rollups, seals
from service.storage.queries.definitive import DaySummary
from service.storage.queries.time_buckets import Bucket
from service.storage.recording.identity import SETTINGS, agrees, digest_of, digest_of_row
from service.storage.recording.result_metrics import is_waiting
from service.storage.recording.signing import PublicKey
from service.storage.sql import tables
from service.storage.sql.columns import Row, metadata
from service.storage.sql.definitive_tables import INNOVATIONS, graded_blocks, graded_days
from service.storage.sql.dialects import dialect_of
from service.storage.sql.engines import database_url, reading_engine
from service.storage.sql.migrations import check, disposed, reading, reported
from service.storage.sql.statements import count, owned_rows, rows_of
from service.storage.sql.tables import gyro_blocks
from service.storage.upkeep.verify_chain import Anchor, faults_of_the_chain
from service.times import unix_seconds, utc_of_unix

AT_ONCE, BLOCKS_AT_ONCE = 500, 50
OUTCOMES = ("unique", "ambiguous", "unmatched")
TOLERANCE = 1e-9
"""Relative tolerance for sums of the same numbers in another order."""

Step = Callable[[int, int], object]
"""Callback for the progress of a check: batches examined, batches in total."""


def verify(
    database: str,
    step: Step = lambda done, total: None,
    *,
    public_key: PublicKey | None = None,
    anchors: Sequence[Anchor] = (),
) -> list[str]:
    """Check a database; returns a sentence for each fault.

    Checked are the file itself (SQLite), the schema, every batch with all its results, the trends,
    the gyro blocks, the filtered and smoothed attitudes, the list of archived batches, and the
    chain, with the key that signed its heads and with heads noted elsewhere.  Raises
    `BadConfiguration` where there is no database.
    """
    problems = check(database)
    if problems:
        return problems
    url = database_url(database)
    engine = reading_engine(url)
    if not dialect_of(engine).is_shared:
        sa.event.listen(engine, "connect", _read_any_text)
    with disposed(engine), reported(url):
        return faults_in(engine, step, public_key, anchors)


def faults_in(
    engine: sa.Engine,
    step: Step = lambda done, total: None,
    public_key: PublicKey | None = None,
    anchors: Sequence[Anchor] = (),
) -> list[str]:
    """Check a database that has the schema of this version; a sentence for each fault."""
    found = list(_of_the_file(engine))
    # The content of a damaged file is not evidence of what was written.
    if not found:
        found += _of_the_references(engine)
        found += _of_the_batches(engine, step)
        found += _of_the_missions(engine)
        found += _of_the_seals(engine)
        found += faults_of_the_chain(engine, public_key, anchors)
        found += _of_the_trends(engine)
        found += _of_the_gyro_blocks(engine)
        found += _of_the_archived(engine)
        found += _of_definitive_days(engine)
    return found


def _read_any_text(connection: Any, _: object) -> None:
    """Let SQLite's driver decode damaged UTF-8 with replacements, so that faults name the row."""
    connection.text_factory = partial(str, encoding="utf-8", errors="replace")


def earlier_results(database: str) -> tuple[int, int]:
    """Count results of earlier versions: without a digest, and with one made at an upgrade."""
    digest = tables.results.c.digest
    query = sa.select(sa.func.count().filter(digest.is_(None)), sa.func.count().filter(digest < 0))
    with reading(database) as connection:
        without, later = connection.execute(query.select_from(tables.results)).one()
    return int(without), int(later)


def _of_the_file(engine: sa.Engine) -> Iterator[str]:
    if dialect_of(engine).is_shared:
        return
    try:
        with engine.begin() as connection:
            lines = connection.exec_driver_sql("PRAGMA integrity_check(20)").scalars().all()
    except DatabaseError as error:
        lines = [error.orig]
    for line in lines:
        if line != "ok":
            yield f"the file is damaged: {line}"


def _of_the_references(engine: sa.Engine) -> Iterator[str]:
    if dialect_of(engine).is_shared:
        return
    with engine.begin() as connection:
        for name, row, parent, _ in connection.exec_driver_sql("PRAGMA foreign_key_check").all():
            key = "a row"
            if row is not None:
                query = sa.select(*metadata.tables[name].primary_key).where(sa.text("rowid = :row"))
                key = " ".join(map(str, connection.execute(query, {"row": row}).one()))
            yield f"{name}, {key}: it refers to what is not in {parent}"


def _of_the_batches(engine: sa.Engine, step: Step) -> Iterator[str]:
    with engine.begin() as connection:
        total = count(connection, tables.batches)
    done = 0
    for connection, rows in _pages(engine, tables.batches, ("id",), AT_ONCE):
        yield from _of_a_chunk(connection, {row["id"]: row for row in rows})
        done += len(rows)
        step(done, max(total, done))


def _pages(
    engine: sa.Engine, table: sa.Table, order: Sequence[str], at_once: int
) -> Iterator[tuple[sa.Connection, list[Row]]]:
    """Pages of a table's rows in the order of unique columns, each with its own connection."""
    columns = [table.c[name] for name in order]
    query = sa.select(table).order_by(*columns).limit(at_once)
    beyond = query
    while True:
        with engine.begin() as connection:
            if rows := rows_of(connection, beyond):
                yield connection, rows
        if len(rows) < at_once:
            return
        last = [rows[-1][name] for name in order]
        beyond = query.where(sa.tuple_(*columns) > sa.tuple_(*last))


def _of_a_chunk(connection: sa.Connection, chunk: Mapping[str, Row]) -> Iterator[str]:
    of_batch = owned_rows(connection, tables.results, "batch_id", chunk)
    made = [row for rows in of_batch.values() for row in rows]
    ids = [row["id"] for row in made]
    stars = owned_rows(connection, tables.star_results, "result_id", ids)
    solutions = owned_rows(connection, tables.solutions, "result_id", ids)
    frames = owned_rows(connection, tables.frames, "batch_id", chunk)
    yield from _of_the_trackers(connection, chunk, made)
    for id, batch in chunk.items():
        frame = next(iter(frames[id]), None)
        yield from _of_a_batch(batch, of_batch[id], frame)
        for row in of_batch[id]:
            own_stars, solution = stars[row["id"]], next(iter(solutions[row["id"]]), None)
            outcomes = Counter(star["outcome"] for star in own_stars)
            yield from _of_a_result(row, batch, outcomes, solution is not None)
            own = (batch, frame) if row["id"] == id else ()
            if row["digest"] is None and row["seq"]:
                yield f"result {row['id']} of batch {id}: it has no digest"
            if not agrees(row["digest"], digest_of(row, own_stars, solution, *own)):
                yield f"result {row['id']} of batch {id}: it is not what was recorded"


def _of_the_trackers(
    connection: sa.Connection, chunk: Mapping[str, Row], made: Sequence[Row]
) -> Iterator[str]:
    """Faults in the stored values of trackers, which must agree with the trackers' stars.

    A batch of several trackers without such values must be waiting to be split.
    """
    current = {row["id"]: row["batch_id"] for row in made if row["current"]}
    # Digests of results of an earlier version were made at an upgrade, and are negative.
    own = [row for row in made if row["current"] and row["digest"] is not None]
    digested = {row["batch_id"] for row in own if row["digest"] >= 0}
    stars = tables.star_results.c
    groups = stars.result_id, stars.tracker, stars.outcome
    counted = sa.select(*groups, sa.func.count()).where(stars.result_id.in_(current))
    seen: dict[str, dict[str, Counter[str]]] = {}
    for id, tracker, outcome, number in connection.execute(counted.group_by(*groups)):
        of_batch = seen.setdefault(current[id], {})
        of_batch.setdefault(tracker, Counter())[outcome] = number
    stored: dict[str, dict[str, Counter[str]]] = {}
    query = sa.select(tables.tracker_values).where(tables.tracker_values.c.batch_id.in_(chunk))
    for row in rows_of(connection, query):
        of_batch = stored.setdefault(row["batch_id"], {})
        of_batch[row["tracker"]] = Counter({name: row[name] for name in OUTCOMES})
        if not agrees(row["row_digest"], digest_of_row(tables.tracker_values, row)):
            yield f"batch {row['batch_id']}: {row['tracker']}'s values are not what was recorded"
        elif row["row_digest"] is None and row["batch_id"] in digested:
            yield f"batch {row['batch_id']}: {row['tracker']}'s values have no digest"
    for id, batch in chunk.items():
        of_stars, of_rows = seen.get(id, {}), stored.get(id, {})
        if of_rows:
            # A tracker may have seen no star.
            if {name: each for name, each in of_rows.items() if each.total()} != of_stars:
                yield f"batch {id}: its trackers' counts are not those of their stars"
        elif len(of_stars) > 1 and not is_waiting(connection, batch["spacecraft"], batch["run"]):
            yield f"batch {id}: it has several trackers and is not split by them"


def _of_a_batch(batch: Row, made: Sequence[Row], frame: Row | None) -> Iterator[str]:
    """Faults of a batch; `frame` is the row of the frame that it was made from, if any."""
    name = f"batch {batch['id']}"
    current = sum(bool(row["current"]) for row in made)
    if current != 1:
        yield f"{name}: {current} of its results are current, not one"
    # The fingerprint of a batch made from a frame covers the frame and the data sent with it.
    try:
        if frame is None and fingerprint_of(batch["input"]) != batch["fingerprint"]:
            yield f"{name}: its input is not the one that was fingerprinted"
        read = submission_from_json(batch["input"]).batch
    except BadInput as error:
        yield f"{name}: its input cannot be read: {error}"
        return
    identity = (read.spacecraft, read.run, read.batch, read.time.tai_ns)
    if identity != tuple(batch[key] for key in ("spacecraft", "run", "batch", "time_ns")):
        yield f"{name}: its input is of {read.spacecraft}, run {read.run}, batch {read.batch}"
    if frame is not None:
        yield from _of_a_frame(name, frame, read, made)


def _of_a_frame(
    name: str, frame: Row, read: ObservationBatch, made: Sequence[Row]
) -> Iterator[str]:
    """Faults of a batch that was made from a frame.

    The data sent with the frame are not kept, so its fingerprint cannot be computed again.
    """
    sent = [mag for each in read.observations for mag in each.magnitude_mag.tolist()]
    try:
        stars = msgspec.json.decode(frame["detections"])["stars"]
        found = [star["magnitude"] for star in stars if star["used"]]
    except (msgspec.DecodeError, KeyError, TypeError):
        yield f"{name}: what was found on its frame cannot be read"
        return
    if sent != found:
        yield f"{name}: the stars of its input are not those of its frame"
    for row in made:
        if row["id"] == row["batch_id"] and _frame_digest(row["answer"]) != frame["digest"]:
            yield f"{name}: its answer is about another frame than the one that is kept"


def _frame_digest(answer: str) -> object:
    try:
        return msgspec.json.decode(answer)["frame"]["digest"]
    except (msgspec.DecodeError, KeyError, TypeError):
        return None


def _of_a_result(row: Row, batch: Row, stars: "Counter[str]", is_solved: bool) -> Iterator[str]:
    name = f"result {row['id']}"
    copied = ("spacecraft", "run", "time_ns")
    if any(row[key] != batch[key] for key in copied):
        yield f"{name}: its spacecraft, run or time is not that of its batch"
    counts = {outcome: row[outcome] for outcome in OUTCOMES}
    if counts != {outcome: stars[outcome] for outcome in OUTCOMES}:
        yield f"{name}: its counts are not those of its stars"
    if row["observed"] != sum(counts.values()):
        yield f"{name}: the outcomes of its stars do not add up"
    if is_solved != (row["status"] is not None):
        yield f"{name}: its attitude is missing, or there is one that its status denies"
    try:
        answer = msgspec.json.decode(row["answer"])
        stated = answer["id"], answer["counts"], (answer["attitude"] or {}).get("status")
    except (msgspec.DecodeError, KeyError, TypeError, AttributeError):
        yield f"{name}: its answer cannot be read"
        return
    if stated != (row["id"], {"observed": row["observed"], **counts}, row["status"]):
        yield f"{name}: its answer says otherwise than its row"


def _of_the_trends(engine: sa.Engine) -> Iterator[str]:
    try:
        for bucket, of_trackers in product(get_args(Bucket), (False, True)):
            yield from _of_trends_by(engine, bucket, of_trackers=of_trackers)
    except BadInput as error:
        yield f"the trends cannot be counted again: {error}"


def _of_trends_by(engine: sa.Engine, bucket: Bucket, *, of_trackers: bool) -> Iterator[str]:
    with engine.begin() as connection:
        stored, counted = (
            {key: row for key, row in found.items() if row["batches"]}
            for found in (
                rollups.stored(connection, bucket, of_trackers=of_trackers),
                rollups.recount(connection, bucket, of_trackers=of_trackers),
            )
        )
        # Results that are not projected yet will be added.
        waiting = rollups.waiting(connection, bucket)
    for key in sorted(stored.keys() | counted.keys()):
        spacecraft, run, *tracker, number = key
        is_waiting = (spacecraft, run, number) in waiting
        if not is_waiting and not _alike(stored.get(key), counted.get(key)):
            of = ", ".join([f"trends of {spacecraft}, run {run}", *tracker])
            yield f"{of}, {bucket} {number}: not those of the results"


def _of_the_missions(engine: sa.Engine) -> Iterator[str]:
    """Faults of settings and catalogs whose content does not match their digest."""
    with engine.begin() as connection:
        rows = {table: rows_of(connection, sa.select(table)) for table in SETTINGS}
    for table, table_rows in rows.items():
        for row in table_rows:
            if not agrees(row["row_digest"], digest_of_row(table, row)):
                yield f"{table.name}, {row['digest']}: the row is not what was recorded"
    # Hash the settings as `Mission.digest` does.
    for digest, settings in ((row["digest"], row["settings"]) for row in rows[tables.missions]):
        try:
            canonical = json.dumps(json.loads(settings), sort_keys=True, separators=(",", ":"))
        except ValueError:
            canonical = settings
        if digest != f"sha256:{hashlib.sha256(canonical.encode()).hexdigest()}":
            yield f"mission settings {digest}: they are not what was recorded"


def _of_the_seals(engine: sa.Engine) -> Iterator[str]:
    with engine.begin() as connection:
        stored, counted = seals.stored(connection), seals.counted(connection)
    for key in sorted(stored.keys() | counted.keys()):
        if (sealed := stored.get(key, (0, 0))) != (found := counted.get(key, (0, 0))):
            spacecraft, run, hour = key
            start = utc_of_unix(float(unix_seconds(hour * seals.HOUR_NS))).text
            yield (
                f"{spacecraft}, run {run}, the hour from {start}: results were removed, added or "
                f"exchanged; {sealed[0]} were recorded, {found[0]} are there"
            )


def _alike(one: Row | None, other: Row | None) -> bool:
    if one is None or other is None or one.keys() != other.keys():
        return False
    return all(_same(one[name], other[name]) for name in one)


def _same(one: float | None, other: float | None) -> bool:
    if one is None or other is None:
        return one is other
    return math.isclose(one, other, rel_tol=TOLERANCE, abs_tol=TOLERANCE)


def _of_the_archived(engine: sa.Engine) -> Iterator[str]:
    """Faults of archived batches: without a part, too few for their part, or recorded as well."""
    archived, recorded_ones = tables.archived_batches.c, tables.batches.c
    counted = sa.select(archived.part_id, sa.func.count()).group_by(archived.part_id)
    same = (archived[name] == recorded_ones[name] for name in ("spacecraft", "run", "batch"))
    both = sa.select(recorded_ones.id).where(*same)
    with engine.begin() as connection:
        found = dict(map(tuple, connection.execute(counted)))
        parts = rows_of(connection, sa.select(tables.archived_parts))
        recorded = list(connection.scalars(both)) if found else []
    for part in parts:
        if found.pop(part["id"], 0) != part["batches"]:
            yield f"archived part {part['path']}: its batches are not all noted as archived"
    for part_id in found:
        yield f"archived batches are noted of a part that is not there: {part_id}"
    for id in recorded:
        yield f"batch {id}: it is recorded and archived"


_UNPACKED: dict[str, Callable[[bytes, int], DefinitiveSamples | MeasuredInnovations]] = {
    INNOVATIONS: unpacked_innovations
}


def _of_definitive_days(engine: sa.Engine) -> Iterator[str]:
    """Faults of the days of filtered and smoothed attitudes, a sentence each.

    The samples of a current day must be those that were digested, in order of time, within the day
    and as many as it says; an earlier revision has none.
    """
    pages = _pages(engine, graded_days, ("id",), AT_ONCE)
    for id in [day["id"] for _, days in pages for day in days]:
        # Read as of one moment: a new revision takes the samples from the one before.
        with engine.begin() as connection:
            yield from _of_a_day(connection, id)


def _of_a_day(connection: sa.Connection, id: str) -> Iterator[str]:
    rows = rows_of(connection, sa.select(graded_days).where(graded_days.c.id == id))
    if not rows:
        return
    (row,) = rows
    name = f"definitive day {id}"
    c = graded_blocks.c
    if not row["current"]:
        if count(connection, graded_blocks, c.day_id == id):
            yield f"{name}: it has samples, though it is not the current revision"
        return
    digest, samples = hashlib.sha256(), Counter[str]()
    try:
        stretches = msgspec.json.decode(row["summary"], type=DaySummary).stretches
    except msgspec.MsgspecError:
        yield f"{name}: its summary cannot be read"
        return
    # The model of each sample of a grade; the model of measurements is not used.
    models = [each.model for each in stretches for _ in range(each.samples)]
    for grade in (*GRADES, INNOVATIONS):
        end_ns = row["start_ns"]
        chosen = sa.select(graded_blocks).where(c.day_id == row["id"], c.grade == grade)
        for block in connection.execute(chosen.order_by(c.position)).mappings():
            where = f"{name}: block {block['position']} of {grade}"
            try:
                found = _UNPACKED.get(grade, unpacked)(block["packed"], block["samples"])
            except ValueError as error:
                yield f"{where}: its samples cannot be read: {error}"
                continue
            digest.update(block["packed"])
            of_samples = models[samples[grade] :][: block["samples"]]
            if grade != INNOVATIONS and set(of_samples) != {block["model"]}:
                yield f"{where}: its model is not the one that its day has"
            samples[grade] += block["samples"]
            times = found.tai_ns
            bounds = block["start_ns"], block["end_ns"]
            # Measurements of two trackers may have the same time.
            least = 0 if grade == INNOVATIONS else 1
            if np.any(np.diff(times) < least) or bounds != (int(times[0]), int(times[-1])):
                yield f"{where}: its times are not those of its samples"
            if block["start_ns"] < end_ns or block["end_ns"] >= row["end_ns"]:
                yield f"{where}: it does not lie within its day, after the block before it"
            end_ns = block["end_ns"]
    if any(samples[grade] != row["samples"] for grade in GRADES):
        yield f"{name}: it has not as many samples as it says"
    elif f"sha256:{digest.hexdigest()}" != row["digest"]:
        yield f"{name}: its samples are not those that were digested"


def _of_the_gyro_blocks(engine: sa.Engine) -> Iterator[str]:
    """Faults of the gyro blocks, a sentence each.

    A block must be the one that was sent, and no two of a spacecraft and a run may share a time.
    """
    before: list[tuple[Any, Nanoseconds]] = []
    order = ("spacecraft", "run", "start_ns", "id")
    pages = _pages(engine, gyro_blocks, order, BLOCKS_AT_ONCE)
    for row in chain.from_iterable(rows for _, rows in pages):
        name = f"gyro block {row['id']}"
        try:
            block = block_of(row)
            times_ns = block.tai_ns
            rising = bool(np.all(np.diff(times_ns) >= SAME_TIME_NS))
        except ValueError as error:
            yield f"{name}: its samples cannot be read: {error}"
            continue
        if block.fingerprint != row["fingerprint"]:
            yield f"{name}: its samples are not those that were fingerprinted"
        stated = row["start_ns"], row["end_ns"], row["end"]
        if not rising or stated != (int(times_ns[0]), int(times_ns[-1]), block.end.text):
            yield f"{name}: its times are not those of its samples"
        near = row["start_ns"] - SAME_TIME_NS
        place = row["spacecraft"], row["run"]
        before = [
            (other, others_ns)
            for other, others_ns in before
            if other["end_ns"] > near and (other["spacecraft"], other["run"]) == place
        ]
        for other, others_ns in before:
            if first_shared_ns(times_ns, others_ns) is not None:
                yield f"{name}: it shares a time with gyro block {other['id']}"
        before.append((row, times_ns))
