"""Recorded batches, ready to run again: one, or a sample of many."""

import json
from dataclasses import dataclass

import numpy as np
from msgspec import structs
from sqlalchemy import Connection, bindparam, func, select

from service.observe.batch import ObservationBatch
from service.observe.wire import OptionsIn, submission_from_json
from service.records.draft import Row
from service.records.pages import PLACE, Stretch
from service.records.tables import batches, results

_SENT = ("input", "time", "time_ns")
# SQLite takes 32,766 values in a statement.
_READ_AT_ONCE = 1_000


@dataclass(frozen=True)
class Sample:
    """Some of the batches of a stretch, in random order; `total` is how many there are.

    `first` and `last` are the times of the earliest and the latest batch of the
    sample, None where there are none.
    """

    total: int
    batches: tuple[ObservationBatch, ...]
    first: str | None
    last: str | None
    rows: tuple[Row, ...] = ()
    """Of each batch, in the same order: result id, input and options as they are stored."""


def batch_again(input: str, own: str, options: OptionsIn | None = None) -> ObservationBatch:
    """A recorded batch with the options of its result; `options` replace what they name of those.

    `input` and `own` are the JSON texts that are stored.
    """
    batch = submission_from_json(input).batch
    merged = merged_options(json.loads(own), options or OptionsIn())
    return structs.replace(batch, options=merged.to_options())


def merged_options(own: Row, options: OptionsIn) -> OptionsIn:
    """A result's own options with others in place of what they name."""
    merged = dict(own)
    for name, value in options.model_dump(exclude_none=True).items():
        merged[name] = merged.get(name, {}) | value if isinstance(value, dict) else value
    return OptionsIn.model_validate(merged)


def sample(connection: Connection, stretch: Stretch, size: int, seed: int = 0) -> Sample:
    """At most `size` batches of a stretch: all, or one drawn from each of as many equal parts.

    Drawn and not every n-th, so that nothing periodic in the telemetry is met
    always or never; the same seed draws the same.
    """
    conditions = stretch.conditions()
    total = int(connection.scalar(select(func.count()).where(*conditions)) or 0)
    rng = np.random.default_rng(seed)
    count = min(size, total)
    ranks = np.arange(1, count + 1)
    if count < total:
        ranks = 1 + np.floor((np.arange(count) + rng.random(count)) * total / count).astype(int)
    rows = [
        row
        for start in range(0, count, _READ_AT_ONCE)
        for row in _at_ranks(connection, stretch, ranks[start : start + _READ_AT_ONCE].tolist())
    ]
    times = [(row["time_ns"], row["time"]) for row in rows]
    drawn = tuple(rows[k] for k in rng.permutation(len(rows)))
    return Sample(
        total,
        tuple(batch_again(row["input"], row["options"]) for row in drawn),
        min(times)[1] if times else None,
        max(times)[1] if times else None,
        drawn,
    )


def _at_ranks(connection: Connection, stretch: Stretch, ranks: list[int]) -> list[Row]:
    """The batches at these places, from 1, in the stretch's order of time."""
    # The index holds all that the ranking needs; inputs are read of the chosen alone.
    rank = func.row_number().over(order_by=PLACE).label("rank")
    ranked = select(results.c.batch_id, rank).where(*stretch.conditions()).subquery()
    chosen = select(ranked.c.batch_id).where(ranked.c.rank.in_(bindparam("ranks", expanding=True)))
    query = (
        select(results.c.id, results.c.options, *(batches.c[name] for name in _SENT))
        .join_from(results, batches, results.c.batch_id == batches.c.id)
        .where(results.c.current, results.c.batch_id.in_(chosen))
        .order_by(*PLACE)
    )
    return [dict(row) for row in connection.execute(query, {"ranks": ranks}).mappings()]
