"""Recorded batches, ready to run again: one, or a sample of many."""

import json
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np
from sqlalchemy import Connection, bindparam, func, select

from service.errors import BadBatch, Fault, shown_value
from service.missions.mission import Mission
from service.observations.batch import ObservationBatch
from service.observations.schema import OptionsIn, submission_from_json
from service.storage.archive.reading import Archive, PlacedPart
from service.storage.models.answers import Answer
from service.storage.queries.pages import PLACE, ResultFilter
from service.storage.queries.results import answer_from_json, read_result
from service.storage.queries.with_archive import bounds_of, count_of_part, parts_of
from service.storage.sql.columns import Row
from service.storage.sql.tables import batches, missions, results

_SENT = ("input", "time", "time_ns")
# SQLite takes 32,766 values in a statement.
_READ_AT_ONCE = 1_000


@dataclass(frozen=True)
class BatchSample:
    """Some of the batches of a period, in random order; `total` is how many there are.

    `first` and `last` are the times of the earliest and the latest batch of the
    sample, None where there are none.
    """

    total: int
    first: str | None
    last: str | None
    rows: tuple[Row, ...]
    """Rows of the batches: result id, input and options as they are stored."""

    @cached_property
    def batches(self) -> tuple[ObservationBatch, ...]:
        """The batches with the options of their results, in the order of the rows."""
        return tuple(batch_with_options(row["input"], row["options"]) for row in self.rows)


def recorded_batch(connection: Connection, id: str) -> tuple[ObservationBatch, Answer]:
    """The batch that a result was made of, with the result's own options, and the answer."""
    row = read_result(connection, id)
    options = OptionsIn.model_validate_json(row["options"]).to_options()
    batch = submission_from_json(row["input"]).batch
    return msgspec.structs.replace(batch, options=options), answer_from_json(row["answer"])


def recorded_mission(connection: Connection, digest: str) -> Mission:
    """A mission as its settings were when their digest was recorded."""
    mission = _MISSIONS.get(digest)
    if mission is None:
        query = select(missions.c.settings).where(missions.c.digest == digest)
        mission = Mission.model_validate_json(connection.execute(query).scalar_one())
        if len(_MISSIONS) >= _MOST_MISSIONS:
            _MISSIONS.clear()
        _MISSIONS[digest] = mission
    return mission


# What a digest stands for never changes.
_MISSIONS: dict[str, Mission] = {}
_MOST_MISSIONS = 64


def batch_with_options(input: str, own: str, options: OptionsIn | None = None) -> ObservationBatch:
    """A recorded batch with the options of its result; `options` replace what they name of those.

    `input` and `own` are the JSON texts that are stored.  Raises `BadBatch` for options of a
    batch that holds a measured attitude.
    """
    batch = submission_from_json(input).batch
    if batch.measurement is not None and options is not None and options.model_fields_set:
        asked = sorted(options.model_fields_set)
        message = "must be left out: a measured attitude is not searched for"
        raise BadBatch(Fault("options", message, shown_value(", ".join(asked))))
    merged = merged_options(json.loads(own), options or OptionsIn())
    return msgspec.structs.replace(batch, options=merged.to_options())


def merged_options(own: Row, options: OptionsIn) -> OptionsIn:
    """A result's own options with others in place of what they name."""
    merged = dict(own)
    for name, value in options.model_dump(exclude_none=True).items():
        merged[name] = merged.get(name, {}) | value if isinstance(value, dict) else value
    return OptionsIn.model_validate(merged)


def sample_batches(
    connection: Connection, archive: Archive, selected: ResultFilter, size: int, seed: int = 0
) -> BatchSample:
    """All batches of a period, or `size` of them: one drawn from each of as many parts.

    Drawn and not every n-th, so that nothing periodic in the telemetry is met
    always or never; the same seed draws the same.  The archived ones count as the earlier.
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
        # Whole parts, so that none is drawn twice.
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
    """The batches of a part at these places, from 0, among those that are selected."""
    ids = archive.current_ids(part, *bounds_of(selected)).take(at).to_pylist()
    read = archive.read(part.path, ["id", "options", *_SENT], [("id", "in", ids)])
    return [dict(row) for row in read.to_pylist()]


def _at_ranks(connection: Connection, selected: ResultFilter, ranks: list[int]) -> list[Row]:
    """The batches at these places, from 1, in the period's order of time."""
    # The index holds all that the ranking needs; inputs are read of the chosen alone.
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
