"""Reading results: lists of them, and one with all that belongs to it."""

import json
from dataclasses import dataclass
from typing import Any, Literal

import msgspec
from msgspec import UNSET
from sqlalchemy import ColumnElement, Connection, Select, or_, select

from service.alarms.quantities import QUANTITIES, value_names
from service.errors import Busy, NotFound, WrongState, shown_value
from service.storage.archive.reading import Archive, parts_with
from service.storage.models import answers
from service.storage.models.base import Page
from service.storage.queries import with_archive
from service.storage.queries.pages import ResultFilter, newest
from service.storage.recording.unsaved_result import STARS
from service.storage.sql import tables
from service.storage.sql.columns import Row
from service.storage.sql.tables import batches, results
from service.times import Utc

OutcomeName = Literal["unique", "ambiguous", "unmatched"]
StatusName = Literal["good", "suspect", "none"]


def list_batches(
    connection: Connection,
    archive: Archive,
    selected: ResultFilter,
    *,
    outcome: OutcomeName | None,
    status: StatusName | None,
    batch: str | None,
    limit: int,
    cursor: str | None,
) -> Page[answers.Summary]:
    """Current results, recorded and archived, newest batch time first.

    `outcome` keeps batches with at least one star of it; `status` those whose
    attitude is good or suspect, or that have none; `batch` the one with this batch id in each
    selected run.
    """
    chosen = _conditions(selected, batch)
    if outcome is not None:
        chosen.append(results.c[outcome] > 0)
    if status is not None:
        chosen.append(results.c.status == (None if status == "none" else status))
    parts = None
    if batch is not None:
        parts = parts_with(connection, selected.spacecraft, selected.run, batch)
    listing = with_archive.Listing(
        archive,
        summary_query().where(*chosen),
        selected,
        newest_first=True,
        most_opened=with_archive.MOST_OPENED,
        parts=parts,
    )
    return listing.page(connection, limit, cursor, summary_of)


def newest_id(connection: Connection, selected: ResultFilter, now: Utc) -> str | None:
    """The id of the newest of the selected results; see `pages.newest`."""
    row = newest(connection, select(results.c.id), selected, now)
    return None if row is None else str(row["id"])


def _conditions(selected: ResultFilter, batch: str | None) -> list[ColumnElement[bool]]:
    if batch is None:
        return selected.conditions()
    # The unique index begins with spacecraft and run: neither is left open.  Both are asked of the
    # batch alone: asked of its result, they lead SQLite through all results of the spacecraft.
    in_runs = select(tables.runs.c.name) if selected.run is None else [selected.run]
    ids = select(batches.c.id).where(
        batches.c.spacecraft == selected.spacecraft,
        batches.c.run.in_(in_runs),
        batches.c.batch == batch,
    )
    times = ResultFilter(None, None, selected.start, selected.end)
    return [*times.conditions(), results.c.batch_id.in_(ids)]


def read_result(connection: Connection, id: str) -> Row:
    """A result by its id with its batch's input; raises `NotFound`."""
    query = select(results, batches.c.input).join_from(results, batches).where(results.c.id == id)
    row = connection.execute(query).mappings().first()
    if row is None:
        raise NotFound(f"there is no batch with the id {shown_value(id)}")
    return dict(row)


def read_parent(connection: Connection, id: str, *, archived: bool, kept: bool) -> Row:
    """The result that a what-if starts from, as `read_result`.

    `archived` says that the connection is to a batch of the archive; `kept`, that the what-if is
    to be recorded.  Raises `WrongState` for both at once.
    """
    row = read_result(connection, id)
    if archived and kept:
        raise WrongState(
            f"the batch with the id {shown_value(id)} is archived: bring its period back with "
            "`acquire archive restore` before you record a what-if of it"
        )
    return row


def _archived(id: str) -> Select[tuple[str]]:
    """The query for the spacecraft of an archived result."""
    what_if = select(tables.archived_what_ifs.c.batch_id).where(tables.archived_what_ifs.c.id == id)
    c = tables.archived_batches.c
    return select(c.spacecraft).where(or_(c.id == id, c.id == what_if.scalar_subquery()))


def spacecraft_of(connection: Connection, id: str) -> str | None:
    """The spacecraft of a result, recorded or archived; None where there is none of that id."""
    for query in (select(results.c.spacecraft).where(results.c.id == id), _archived(id)):
        found = connection.execute(query).scalar()
        if found is not None:
            return str(found)
    return None


def read_record(connection: Connection, id: str, *, archived: bool = False) -> answers.Result:
    """A result with its input and the what-ifs of its batch; raises `NotFound`.

    `archived` says that the connection is to a batch of the archive.
    """
    row = read_result(connection, id)
    what_ifs = (
        summary_query()
        .where(results.c.batch_id == row["batch_id"], results.c.parent_id.is_not(None))
        .order_by(results.c.id)
    )
    of_frame = select(tables.frames.c.summary, tables.frames.c.detections).where(
        tables.frames.c.batch_id == row["batch_id"]
    )
    frame = connection.execute(of_frame).mappings().first()
    return answers.Result(
        answer=answer_from_json(row["answer"]),
        input=json.loads(row["input"]),
        options=json.loads(row["options"]),
        measures=measured(row),
        current=row["current"],
        parent=row["parent_id"],
        what_ifs=[
            summary_of({**each, "archived": archived})
            for each in connection.execute(what_ifs).mappings()
        ],
        archived=archived,
        frame=UNSET if frame is None else _frame_of(frame),
    )


def answer_from_json(text: str | bytes) -> answers.Answer:
    """A stored answer, which may be of an earlier version of the service."""
    return _ANSWERS.decode(text)


_ANSWERS = msgspec.json.Decoder(answers.Answer)


def _frame_of(row: Any) -> answers.FrameWithStars:
    fields = json.loads(row["summary"]) | json.loads(row["detections"])
    return msgspec.convert(fields, answers.FrameWithStars)


def frame_of_result(connection: Connection, id: str) -> Row:
    """The data for an overlay of a result; raises `NotFound`, also where there is no frame.

    The `settings` are those of the mission as they were for that result.
    """
    read_result(connection, id)
    query = (
        select(
            results.c.answer,
            results.c.catalog_digest,
            batches.c.input,
            tables.frames.c.detections,
            tables.frames.c.preview,
            tables.frames.c.preview_step,
            tables.missions.c.settings,
        )
        .select_from(
            results.join(batches, results.c.batch_id == batches.c.id)
            .join(tables.frames, tables.frames.c.batch_id == batches.c.id)
            .join(tables.missions, tables.missions.c.digest == results.c.mission_digest)
        )
        .where(results.c.id == id)
    )
    row = connection.execute(query).mappings().first()
    if row is None:
        raise NotFound(f"batch {shown_value(id)} was not made of a frame")
    return dict(row)


def summary_query() -> Select[Any]:
    """The query for what `summary_of` shows."""
    kept = [column for column in results.c if column.name not in ("answer", "spacecraft", "run")]
    named = [batches.c[name] for name in ("spacecraft", "run", "batch", "time", "received")]
    return select(*kept, *named).join_from(results, batches)


def summary_of(row: Any) -> answers.Summary:
    """A result in a list, without its stars and its attitude."""
    return answers.Summary(**summary_fields(row))


def summary_fields(row: Any) -> Row:
    """The fields of a `Summary`."""
    taken = ("id", "spacecraft", "batch", "run", "time", "received", "created", "identifier")
    return {
        **{name: row[name] for name in taken},
        "options": json.loads(row["options"]),
        "counts": answers.StarCounts(**{name: row[name] for name in STARS}),
        "status": row["status"],
        "reason": row["reason"],
        "measures": measured(row),
        "parent": row["parent_id"],
        "current": row["current"],
        "archived": row.get("archived", False),
    }


def measured(row: Any) -> dict[str, float | None]:
    """The values of a result's measured quantities and their ratios, by name."""
    return {name: QUANTITIES[name].value_of(row) for name in value_names()}


@dataclass(frozen=True)
class ResultPlace:
    """A result: its spacecraft, run and time, and the id of the current one of its batch."""

    spacecraft: str
    run: str
    time_ns: int
    current: str | None


def place_of(connection: Connection, id: str) -> ResultPlace:
    """The spacecraft, run and time of a result."""
    row = connection.execute(select(results).where(results.c.id == id)).one()
    standing = select(results.c.id).where(results.c.batch_id == row.batch_id, results.c.current)
    return ResultPlace(row.spacecraft, row.run, row.time_ns, connection.scalar(standing))


def neighbours(connection: Connection, archive: Archive, place: ResultPlace) -> answers.Neighbours:
    """The results before and after one in time, of its spacecraft and run."""
    sides = (_next(connection, archive, place, newest_first=side) for side in (True, False))
    return answers.Neighbours(place.current, *sides)


def _next(
    connection: Connection, archive: Archive, place: ResultPlace, *, newest_first: bool
) -> answers.Summary | None:
    selected = ResultFilter(place.run, place.spacecraft)
    beyond = place.time_ns, with_archive.FIRST_ID if newest_first else with_archive.LAST_ID
    query = summary_query().where(*selected.conditions())
    listing = with_archive.Listing(archive, query, selected, newest_first)
    try:
        found = listing.first_rows(connection, 1, beyond)
    except Busy:
        # Without the archive the page of a recorded batch is shown all the same.
        return None
    return next((summary_of(each.shown) for each in found.rows), None)
