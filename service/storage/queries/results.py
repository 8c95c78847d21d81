"""Queries for results: lists, single results with all their data, and batches to run again."""

import json
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET
from sqlalchemy import ColumnElement, Connection, Select, bindparam, func, or_, select

from service.contract import answers
from service.contract.answers import Answer
from service.contract.base import Page
from service.errors import BadBatch, Busy, Fault, NotAvailable, NotFound, WrongState, shown_value
from service.missions.mission import Mission
from service.observations.batch import ObservationBatch
from service.observations.schema import OptionsIn, submission_from_json
from service.storage.archived import Archive, PlacedPart, parts_with
from service.storage.queries import pages
from service.storage.queries.pages import (
    PLACE,
    ResultFilter,
    bounds_of,
    count_of_part,
    newest,
    parts_of,
)
from service.storage.recording.unsaved_result import STARS
from service.storage.sql import tables
from service.storage.sql.columns import Row
from service.storage.sql.statements import rows_of
from service.storage.sql.tables import batches, missions, results
from service.times import Utc
from service.trends.quantities import QUANTITIES, value_names

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
    adopted: bool,
    limit: int,
    cursor: str | None,
) -> Page[answers.Summary]:
    """List current results, recorded and archived, newest batch time first.

    `outcome` keeps batches with at least one star of it; `status` those whose attitude is good or
    suspect, or that have none; `batch` the one with this batch id in each selected run; `adopted`
    those whose current result is an adopted what-if.
    """
    chosen = _conditions(selected, batch)
    if outcome is not None:
        chosen.append(results.c[outcome] > 0)
    if status is not None:
        chosen.append(results.c.status == (None if status == "none" else status))
    if adopted:
        chosen.append(results.c.parent_id.is_not(None))
    parts = None
    if batch is not None:
        parts = parts_with(connection, selected.spacecraft, selected.run, batch)
    listing = pages.Listing(
        archive,
        summary_query().where(*chosen),
        selected,
        newest_first=True,
        most_opened=pages.MOST_OPENED,
        parts=parts,
    )
    return listing.page(connection, limit, cursor, summary_of)


def newest_id(connection: Connection, selected: ResultFilter, now: Utc) -> str | None:
    """Id of the newest selected result; see `pages.newest`."""
    row = newest(connection, select(results.c.id), selected, now)
    return None if row is None else str(row["id"])


def _conditions(selected: ResultFilter, batch: str | None) -> list[ColumnElement[bool]]:
    if batch is None:
        return selected.conditions()
    # The unique index begins with spacecraft and run: give both.  Take them from the batch:
    # conditions on its result would make SQLite read all results of the spacecraft.
    in_runs = select(tables.runs.c.name) if selected.run is None else [selected.run]
    ids = select(batches.c.id).where(
        batches.c.spacecraft == selected.spacecraft,
        batches.c.run.in_(in_runs),
        batches.c.batch == batch,
    )
    times = ResultFilter(None, None, selected.start, selected.end)
    return [*times.conditions(), results.c.batch_id.in_(ids)]


def read_result(connection: Connection, id: str) -> Row:
    """Read a result with its batch's input by id; raises `NotFound`."""
    query = select(results, batches.c.input).join_from(results, batches).where(results.c.id == id)
    row = connection.execute(query).mappings().first()
    if row is None:
        raise NotFound(f"there is no batch with the id {shown_value(id)}")
    return dict(row)


def read_parent(connection: Connection, id: str, *, archived: bool, kept: bool) -> Row:
    """Read the result that a what-if starts from, in the form of `read_result`.

    `archived` is True if the connection is to a batch of the archive; `kept`, if the what-if is to
    be recorded.  Raises `WrongState` for both at once.
    """
    row = read_result(connection, id)
    if archived and kept:
        raise WrongState(
            f"the batch with the id {shown_value(id)} is archived: bring its period back with "
            "`acquire archive restore` before you record a what-if of it"
        )
    return row


def _archived(id: str) -> Select[tuple[str]]:
    """SQL query for the spacecraft of an archived result."""
    what_if = select(tables.archived_what_ifs.c.batch_id).where(tables.archived_what_ifs.c.id == id)
    c = tables.archived_batches.c
    return select(c.spacecraft).where(or_(c.id == id, c.id == what_if.scalar_subquery()))


def spacecraft_of(connection: Connection, id: str) -> str | None:
    """Spacecraft of a result, recorded or archived; None for an unknown id."""
    for query in (select(results.c.spacecraft).where(results.c.id == id), _archived(id)):
        found = connection.execute(query).scalar()
        if found is not None:
            return str(found)
    return None


def read_record(connection: Connection, id: str, *, archived: bool = False) -> answers.Result:
    """Read a result with its input and the what-ifs of its batch; raises `NotFound`.

    `archived` is True if the connection is to a batch of the archive.
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


def current_of(connection: Connection, id: str) -> Any:
    """Current result of a result's batch, as a row of `id` and `parent_id`; None if it is gone."""
    batch = select(results.c.batch_id).where(results.c.id == id).scalar_subquery()
    chosen = select(results.c.id, results.c.parent_id).where(
        results.c.batch_id == batch, results.c.current
    )
    return connection.execute(chosen).first()


def adopted_what_ifs(connection: Connection, selected: ResultFilter, limit: int) -> list[Row]:
    """Selected current results that are adopted what-ifs, newest first: id, parent, batch, time."""
    query = (
        select(results.c.id, results.c.parent_id, batches.c.batch, batches.c.time)
        .join_from(results, batches)
        .where(*selected.conditions(), results.c.parent_id.is_not(None))
        .order_by(results.c.id.desc())
        .limit(limit)
    )
    return rows_of(connection, query)


def answer_from_json(text: str | bytes) -> answers.RecordedAnswer:
    """Decode a stored answer, which an earlier version of the service may have written."""
    return _ANSWERS.decode(text)


_ANSWERS = msgspec.json.Decoder(answers.RecordedAnswer)


def _frame_of(row: Any) -> answers.FrameWithStars:
    fields = json.loads(row["summary"]) | json.loads(row["detections"])
    return msgspec.convert(fields, answers.FrameWithStars)


def summary_query() -> Select[Any]:
    """SQL query for the columns that `summary_of` reads."""
    kept = [column for column in results.c if column.name not in ("answer", "spacecraft", "run")]
    named = [batches.c[name] for name in ("spacecraft", "run", "batch", "time", "received")]
    return select(*kept, *named).join_from(results, batches)


def summary_of(row: Any) -> answers.Summary:
    """Convert a database row to an entry of a list of results, without stars and attitude."""
    return answers.Summary(**summary_fields(row))


def summary_fields(row: Any) -> Row:
    """Convert a database row to the fields of a `Summary`."""
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
    """Place of a result among others: spacecraft, run and time, and its batch's current result.

    Without a spacecraft the position is among the results of all spacecraft.
    """

    spacecraft: str | None
    run: str
    time_ns: int
    current: str | None


def place_of(connection: Connection, id: str) -> ResultPlace:
    """Find the spacecraft, run and time of a result."""
    row = connection.execute(select(results).where(results.c.id == id)).one()
    standing = select(results.c.id).where(results.c.batch_id == row.batch_id, results.c.current)
    return ResultPlace(row.spacecraft, row.run, row.time_ns, connection.scalar(standing))


def neighbours(connection: Connection, archive: Archive, place: ResultPlace) -> answers.Neighbours:
    """Results before and after a result in time, of the same spacecraft and run."""
    sides = (_next(connection, archive, place, newest_first=side) for side in (True, False))
    return answers.Neighbours(place.current, *sides)


def _next(
    connection: Connection, archive: Archive, place: ResultPlace, *, newest_first: bool
) -> answers.Summary | None:
    selected = ResultFilter(place.run, place.spacecraft)
    beyond = place.time_ns, pages.FIRST_ID if newest_first else pages.LAST_ID
    query = summary_query().where(*selected.conditions())
    listing = pages.Listing(archive, query, selected, newest_first)
    try:
        found = listing.first_rows(connection, 1, beyond)
    except (Busy, NotAvailable):
        # Without the archive the page of a recorded batch is still shown.
        return None
    return next((summary_of(each.shown) for each in found.rows), None)


_SENT = ("input", "time", "time_ns")
# SQLite takes 32,766 values in a statement.
_READ_AT_ONCE = 1_000


@dataclass(frozen=True)
class BatchSample:
    """Random sample of a period's batches; `total` is the number of batches in the period.

    `first` and `last` are the times of the earliest and the latest batch of the sample, None for an
    empty sample.
    """

    total: int
    first: str | None
    last: str | None
    rows: tuple[Row, ...]
    """Sampled rows, one per batch: the result's id, and input and options as stored."""

    @cached_property
    def batches(self) -> tuple[ObservationBatch, ...]:
        """Sampled batches decoded, with the options of their results, in the order of the rows."""
        return tuple(batch_with_options(row["input"], row["options"]) for row in self.rows)


def recorded_batch(connection: Connection, id: str) -> tuple[ObservationBatch, Answer]:
    """Read the batch of a result, with the result's own options, and its answer."""
    row = read_result(connection, id)
    options = OptionsIn.model_validate_json(row["options"]).to_options()
    batch = submission_from_json(row["input"]).batch
    return msgspec.structs.replace(batch, options=options), answer_from_json(row["answer"])


def recorded_mission(connection: Connection, digest: str) -> Mission:
    """Read a mission's recorded settings by their digest."""
    mission = _MISSIONS.get(digest)
    if mission is None:
        query = select(missions.c.settings).where(missions.c.digest == digest)
        mission = Mission.model_validate_json(connection.execute(query).scalar_one())
        if len(_MISSIONS) >= _MOST_MISSIONS:
            _MISSIONS.clear()
        _MISSIONS[digest] = mission
    return mission


# The content for a digest never changes.
_MISSIONS: dict[str, Mission] = {}
_MOST_MISSIONS = 64


def batch_with_options(input: str, own: str, options: OptionsIn | None = None) -> ObservationBatch:
    """Decode a recorded batch with its result's options, some replaced by `options`.

    `input` and `own` are the stored JSON texts.  Raises `BadBatch` for options of a batch that
    holds a measured attitude.
    """
    batch = submission_from_json(input).batch
    if batch.measurement is not None and options is not None and options.model_fields_set:
        asked = sorted(options.model_fields_set)
        message = "must be left out: a measured attitude is not searched for"
        raise BadBatch(Fault("options", message, shown_value(", ".join(asked))))
    merged = merged_options(json.loads(own), options or OptionsIn())
    return msgspec.structs.replace(batch, options=merged.to_options())


def merged_options(own: Row, options: OptionsIn) -> OptionsIn:
    """Merge a result's own options with others, which take precedence."""
    merged = dict(own)
    for name, value in options.model_dump(exclude_none=True).items():
        merged[name] = merged.get(name, {}) | value if isinstance(value, dict) else value
    return OptionsIn.model_validate(merged)


def sample_batches(
    connection: Connection, archive: Archive, selected: ResultFilter, size: int, seed: int = 0
) -> BatchSample:
    """Sample a period: all batches, or `size` of them, one from each of as many equal parts.

    They are drawn at random, so that a periodic effect is neither always nor never sampled; equal
    seeds draw equal samples.  Archived batches count as earlier than recorded ones.
    """
    conditions = selected.conditions()
    parts = sorted(parts_of(connection, selected), key=lambda each: each.first_ns)
    ends = np.cumsum([0, *(count_of_part(archive, part, selected) for part in parts)])
    recorded = int(connection.scalar(select(func.count()).where(*conditions)) or 0)
    total = int(ends[-1]) + recorded
    rng = np.random.default_rng(seed)
    count = min(size, total)
    ranks = np.arange(1, count + 1)
    if count < total:
        # Integer edges, so that no batch is drawn twice.
        edges = np.arange(count + 1) * total // count
        ranks = 1 + edges[:-1] + np.floor(rng.random(count) * np.diff(edges)).astype(int)
    rows: list[Row] = []
    for part, begin, end in zip(parts, ends, ends[1:], strict=False):
        within = ranks[(ranks > begin) & (ranks <= end)] - begin - 1
        if len(within):
            rows += _of_part(archive, part, selected, within.tolist())
    left = ranks[ranks > ends[-1]] - ends[-1]
    for start in range(0, len(left), _READ_AT_ONCE):
        rows += _at_ranks(connection, selected, left[start : start + _READ_AT_ONCE].tolist())
    times = [(row["time_ns"], row["time"]) for row in rows]
    drawn = tuple(rows[k] for k in rng.permutation(len(rows)))
    return BatchSample(
        total,
        min(times)[1] if times else None,
        max(times)[1] if times else None,
        drawn,
    )


def _of_part(
    archive: Archive, part: PlacedPart, selected: ResultFilter, at: list[int]
) -> list[Row]:
    """Selected batches of an archive part at given positions, counted from 0."""
    ids = archive.current_ids(part, *bounds_of(selected))
    return archive.rows(part, [ids[k] for k in at], ["id", "options", *_SENT])


def _at_ranks(connection: Connection, selected: ResultFilter, ranks: list[int]) -> list[Row]:
    """Selected batches at given positions in the period's order of time, counted from 1."""
    # The index holds all columns for the ranking; inputs are read of the chosen batches only.
    rank = func.row_number().over(order_by=PLACE).label("rank")
    ranked = select(results.c.batch_id, rank).where(*selected.conditions()).subquery()
    chosen = select(ranked.c.batch_id).where(ranked.c.rank.in_(bindparam("ranks", expanding=True)))
    query = (
        select(results.c.id, results.c.options, *(batches.c[name] for name in _SENT))
        .join_from(results, batches, results.c.batch_id == batches.c.id)
        .where(results.c.current, results.c.batch_id.in_(chosen))
        .order_by(*PLACE)
    )
    return [dict(row) for row in connection.execute(query, {"ranks": ranks}).mappings()]
