"""Queries for the recorded definitive attitude: samples page by page, and innovations."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from msgspec import Struct
from sqlalchemy import ColumnElement, Connection, Select, func, select, tuple_

from service.attitude.definitive import (
    Grade,
    MeasuredInnovations,
    Outcome,
    Status,
    day_bounds,
    unpacked,
    unpacked_innovations,
)
from service.contract.base import Count, Moment, doc
from service.ephemerides.rows import AttitudeRows
from service.gyro.blocks import texts_of
from service.storage.gyro import inside
from service.storage.queries.pages import ResultFilter
from service.storage.queries.time_buckets import buckets_between
from service.storage.sql.definitive_tables import INNOVATIONS, graded_blocks, graded_days
from service.times import DAY_S, Utc, recorded_utc
from service.trends.limits import Sample

METHODS: dict[Grade, str] = {"filtered": "ekf", "smoothed": "filter_smoother"}
"""Words for the method of each grade, as in AD_METHOD of CCSDS ACM."""
STATUS = {Status.GOOD: "good", Status.STARTING: "suspect", Status.DOUBTFUL: "suspect"}
PLACE = (graded_days.c.day, graded_blocks.c.position)
BLOCKS = select(
    *PLACE,
    graded_days.c.id,
    graded_days.c.revision,
    graded_blocks.c.model,
    graded_blocks.c.samples,
    graded_blocks.c.packed,
).join_from(graded_days, graded_blocks, graded_blocks.c.day_id == graded_days.c.id)
MOST_BLOCKS = 48
"""Largest number of blocks read of filtered or smoothed attitudes, or of their innovations.

They are two days at 1 Hz; of a longer period, blocks spread over it are read.
"""


class DefinitiveStretchInfo(Struct, frozen=True, kw_only=True):
    """Unbroken stretch of a day's attitude history with one model of motion."""

    model: str
    """Model of motion: `gyro`, or without one `constant_rate`, whose rate is a random walk."""
    start: Moment
    end: Moment
    samples: Count
    good: Annotated[dict[str, int], doc("Samples of each grade whose status is good.")]


class DaySummary(Struct, frozen=True, kw_only=True):
    """Use of a day's recorded data in the attitude history."""

    stretches: list[DefinitiveStretchInfo]
    measurements: dict[str, int]
    """Measured attitudes by what became of them: accepted, rejected, started (with it the filter
    began), undecided, unused, unusable (its covariance), alone (too few)."""
    gyro: Annotated[
        dict[str, int],
        doc("Samples, gaps, samples beyond the largest rate, zeros while the body turned."),
    ]
    nis_per_degree: float | None
    """Mean of z^T S^-1 z of the accepted measurements per degree of freedom, expected to be 1."""


def definitive_pages(
    reading: Callable[[], AbstractContextManager[Connection]],
    selected: ResultFilter,
    grade: Grade,
    *,
    newest_first: bool = False,
    page: int | None = None,
) -> Iterator[AttitudeRows]:
    """Samples of the latest revisions in a period, page by page: a block of up to an hour each.

    A page has at most the first `page` samples of a block.  Between two blocks no connection is
    held.
    """
    order = [column.desc() if newest_first else column for column in PLACE]
    query = BLOCKS.where(*block_conditions(selected, grade)).order_by(*order).limit(1)
    beyond: Select[Any] = query
    while True:
        with reading() as connection:
            row = connection.execute(beyond).mappings().first()
        if row is None:
            return
        rows = _rows(row, selected, grade)
        if newest_first:
            rows = rows.taken(slice(None, None, -1))
        if len(rows):
            yield rows.taken(slice(0, page))
        place, last = tuple_(*PLACE), tuple_(row["day"], row["position"])
        beyond = query.where(place < last if newest_first else place > last)


def count_samples_of(connection: Connection, selected: ResultFilter, grade: Grade) -> int:
    """Count the samples of the blocks that overlap a period: an upper bound for the period."""
    total = select(func.sum(graded_blocks.c.samples)).join_from(
        graded_days, graded_blocks, graded_blocks.c.day_id == graded_days.c.id
    )
    return int(connection.scalar(total.where(*block_conditions(selected, grade))) or 0)


def made_at(connection: Connection, selected: ResultFilter) -> Utc | None:
    """Time when the newest revision of a period's days was made; None without any."""
    days = graded_days.c
    newest = select(func.max(days.created)).where(
        days.current,
        days.spacecraft == selected.spacecraft,
        days.run == selected.run,
        *buckets_between(days.day, selected.start, selected.end, DAY_S),
    )
    text = connection.scalar(newest)
    return None if text is None else recorded_utc(text)


def block_conditions(selected: ResultFilter, kind: str) -> list[ColumnElement[bool]]:
    """SQL conditions for current blocks of a grade, or of innovations, that overlap a period."""
    days, blocks = graded_days.c, graded_blocks.c
    chosen: list[ColumnElement[bool]] = [
        days.current,
        days.spacecraft == selected.spacecraft,
        days.run == selected.run,
        blocks.grade == kind,
        *buckets_between(days.day, selected.start, selected.end, DAY_S),
    ]
    if selected.start is not None:
        chosen.append(blocks.end_ns >= selected.start.tai_ns)
    if selected.end is not None:
        chosen.append(blocks.start_ns < selected.end.tai_ns)
    return chosen


def _rows(row: Any, selected: ResultFilter, grade: Grade) -> AttitudeRows:
    """Convert the samples of a block that lie in the period to attitude rows."""
    found = unpacked(row["packed"], row["samples"])
    found = found.taken(inside(found.tai_ns, selected.start, selected.end))
    n = len(found)
    start, _ = day_bounds(row["day"])
    status = _repeated(None, n)
    for code, word in STATUS.items():
        status[found.status == code] = word
    known = np.where([each is None for each in status], np.nan, 1.0).reshape(n, 1)
    time = _repeated(None, n)
    time[:] = texts_of(start, np.asarray((found.tai_ns - start.tai_ns) * 1e-9))
    unknown = np.full(n, np.nan)
    return AttitudeRows(
        time_ns=found.tai_ns,
        time=time,
        id=_repeated(row["id"], n),
        batch=_repeated(None, n),
        status=status,
        method=_repeated(METHODS[grade], n),
        quaternion=found.quaternion * known,
        covariance_arcsec2=found.covariance_arcsec2 * known,
        rate_deg_per_s=found.rate_deg_per_s * known,
        residual_rms_arcsec=unknown,
        predicted_rms_arcsec=unknown,
        stars=np.zeros((n, 4), dtype=np.int64),
        model=_repeated(row["model"], n),
        revision=np.full(n, row["revision"], dtype=np.int64),
        bias_deg_per_h=found.bias_deg_per_h,
        bias_sigma_deg_per_h=found.bias_sigma_deg_per_h,
    )


def _repeated(value: str | None, n: int) -> Any:
    column = np.empty(n, dtype=object)
    column[:] = value
    return column


@dataclass(frozen=True)
class Block:
    """Key of a stored block of samples, with its model of motion and times in TAI nanoseconds."""

    day_id: str
    position: int
    model: str
    start_ns: int
    end_ns: int


def latest_innovations(
    connection: Connection, selected: ResultFilter, *, of_gyro: bool = False
) -> list[MeasuredInnovations]:
    """Innovations of a period from its latest blocks, or from those with a gyro, in time order."""
    blocks = blocks_of(connection, selected, INNOVATIONS)
    blocks = [each for each in blocks if each.model == "gyro" or not of_gyro]
    rows = packed_samples(connection, INNOVATIONS, blocks[-MOST_BLOCKS:])
    found = [unpacked_innovations(row.packed, row.samples) for row in rows]
    return [each.taken(inside(each.tai_ns, selected.start, selected.end)) for each in found]


def blocks_of(connection: Connection, selected: ResultFilter, kind: str) -> list[Block]:
    """List the blocks that overlap a period, without their samples, in order of time."""
    c = graded_blocks.c
    query = (
        select(c.day_id, c.position, c.model, c.start_ns, c.end_ns)
        .join_from(graded_days, graded_blocks, c.day_id == graded_days.c.id)
        .where(*block_conditions(selected, kind))
        .order_by(graded_days.c.day, c.position)
    )
    return [Block(*row) for row in connection.execute(query)]


def packed_samples(connection: Connection, kind: str, read: Sequence[Block]) -> list[Any]:
    """Read the packed samples of blocks, in the order of the blocks."""
    c = graded_blocks.c
    place = tuple_(c.day_id, c.position)
    query = select(c.day_id, c.position, c.samples, c.packed).where(
        c.grade == kind, place.in_([(each.day_id, each.position) for each in read])
    )
    rows = {(row.day_id, row.position): row for row in connection.execute(query)}
    return [rows[each.day_id, each.position] for each in read]


_COUNTED = (Outcome.ACCEPTED, Outcome.REJECTED, Outcome.STARTED)


def rejected_samples(connection: Connection, selected: ResultFilter) -> list[Sample]:
    """One sample of 1 or 0 per measured attitude of a period: rejected by the filter or not."""
    found: list[Sample] = []
    for part in latest_innovations(connection, selected):
        counted = np.isin(part.outcome, _COUNTED)
        rejected = part.outcome[counted] == Outcome.REJECTED
        times = part.tai_ns[counted].tolist()
        found += [(at, float(is_one), 1.0) for at, is_one in zip(times, rejected, strict=True)]
    return sorted(found)
