"""Days of grades in the records: a new revision where the facts have changed, none otherwise.

Also their attitudes page by page, over a period, and the filtered one of live data.
"""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Struct
from pydantic import Field
from sqlalchemy import (
    ColumnElement,
    Connection,
    Select,
    delete,
    func,
    insert,
    select,
    tuple_,
    update,
)

from service.contract.base import Count, Digest, Id, Moment, Stamp, doc
from service.contract.products import LiveAttitude
from service.ephemerides.rows import AttitudeRows
from service.filtering.result import Status
from service.grades.carried import Carried
from service.grades.day import (
    GRADES,
    MOST_PACKED,
    Grade,
    GradedDay,
    GradedSamples,
    GradedStretch,
    MeasuredInnovations,
    day_bounds,
    packed,
    unpacked,
)
from service.gyro import texts_of
from service.storage.grades.inputs import inside
from service.storage.queries.pages import ResultFilter, covariance_of
from service.storage.queries.time_buckets import buckets_between
from service.storage.sql.columns import Row
from service.storage.sql.grade_tables import INNOVATIONS, graded_blocks, graded_days
from service.storage.sql.tables import runs
from service.times import DAY_S, Utc

SHOWN = ("id", "spacecraft", "run", "revision", "created", "samples", "inputs", "digest")


@dataclass(frozen=True)
class DayKey:
    """A spacecraft, a run and a UTC day, counted as `Utc.bucket`."""

    spacecraft: str
    run: str
    day: int

    def conditions(self) -> list[Any]:
        """The key as SQL over `graded_days`."""
        c = graded_days.c
        return [c.spacecraft == self.spacecraft, c.run == self.run, c.day == self.day]


class GradedStretchInfo(Struct, frozen=True, kw_only=True):
    """An unbroken stretch of a day."""

    model: str
    """`gyro`, or `constant_rate` where no gyro runs: the rate is a random walk."""
    start: Moment
    end: Moment
    samples: Count
    good: Annotated[dict[str, int], doc("Samples of each grade whose status is good.")]


class DaySummary(Struct, frozen=True, kw_only=True):
    """What became of what was recorded of a day."""

    stretches: list[GradedStretchInfo]
    measurements: dict[str, int]
    """Measured attitudes by what became of them: accepted, rejected, started (with it the filter
    began), undecided, unused, unusable (its covariance), alone (too few)."""
    gyro: Annotated[
        dict[str, int],
        doc("Samples, gaps, samples beyond the largest rate, zeros while the body turned."),
    ]
    nis_per_degree: float | None
    """Mean of z^T S^-1 z of the accepted measurements by degrees of freedom: about 1."""


class GradedDayRow(Struct, frozen=True, kw_only=True):
    """A day of filtered and smoothed attitudes."""

    id: Id
    spacecraft: str
    run: str
    day: Annotated[str, Field(pattern=r"^\d{4}-\d\d-\d\d$"), doc("UTC day.")]
    revision: Annotated[int, Field(ge=1)]
    created: Stamp
    samples: Annotated[Count, doc("Of each grade.")]
    inputs: Annotated[Digest, doc("Of all that the day was computed from.")]
    digest: Annotated[Digest, doc("Of what was computed.")]
    summary: DaySummary


def current_day(connection: Connection, key: DayKey) -> GradedDayRow | None:
    """The current revision of a day, or None."""
    query = select(graded_days).where(*key.conditions(), graded_days.c.current)
    row = connection.execute(query).mappings().first()
    return None if row is None else shown(row)


def rows_of(key: DayKey, graded: GradedDay, inputs: str, id: str, created: Utc) -> list[Row]:
    """The row of a day, and after it those of its blocks; without the revision."""
    blocks = list(_blocks(id, graded))
    digest = hashlib.sha256()
    for block in blocks:
        digest.update(block["packed"])
    start, end = day_bounds(key.day)
    summary = DaySummary(
        stretches=[_stretch(start, each) for each in graded.stretches],
        measurements=graded.measurements,
        gyro=graded.gyro,
        nis_per_degree=graded.nis_per_degree,
    )
    day = {
        "id": id,
        "spacecraft": key.spacecraft,
        "run": key.run,
        "day": key.day,
        "start_ns": start.tai_ns,
        "end_ns": end.tai_ns,
        "current": True,
        "created": created.text,
        "inputs": inputs,
        "digest": f"sha256:{digest.hexdigest()}",
        "samples": graded.samples,
        "summary": msgspec.json.encode(summary).decode(),
    }
    return [day, *blocks]


def record_day(connection: Connection, key: DayKey, rows: list[Row]) -> GradedDayRow:
    """Record a revision of a day in the place of the one before.

    A day that was recorded meanwhile from the same facts stays as it is.
    """
    day, *blocks = rows
    c = graded_days.c
    # Of two processes that smooth a run, one waits.
    lock = select(runs.c.name).where(runs.c.name == key.run)
    connection.execute(lock.with_for_update(key_share=True))
    before = current_day(connection, key)
    if before is not None and before.inputs == day["inputs"]:
        return before
    latest = connection.scalar(select(func.max(c.revision)).where(*key.conditions()))
    new = {**day, "revision": (latest or 0) + 1}
    if before is not None:
        connection.execute(update(graded_days).where(c.id == before.id).values(current=False))
        connection.execute(delete(graded_blocks).where(graded_blocks.c.day_id == before.id))
    connection.execute(insert(graded_days), new)
    if blocks:
        connection.execute(insert(graded_blocks), blocks)
    return shown(new)


def shown(row: Any) -> GradedDayRow:
    """A row as it is answered."""
    start, _ = day_bounds(row["day"])
    return GradedDayRow(
        **{name: row[name] for name in SHOWN},
        day=start.text[:10],
        summary=msgspec.json.decode(row["summary"], type=DaySummary),
    )


def _blocks(day_id: str, graded: GradedDay) -> Iterator[Row]:
    by_kind: dict[str, list[GradedSamples | MeasuredInnovations]] = {
        **{grade: [each.samples[grade] for each in graded.stretches] for grade in GRADES},
        INNOVATIONS: [each.innovations for each in graded.stretches],
    }
    for kind, wholes in by_kind.items():
        position = 0
        for stretch, whole in zip(graded.stretches, wholes, strict=True):
            for part in _parts(whole):
                yield {
                    "day_id": day_id,
                    "grade": kind,
                    "position": position,
                    "model": stretch.model,
                    "start_ns": int(part.tai_ns[0]),
                    "end_ns": int(part.tai_ns[-1]),
                    "samples": len(part),
                    "packed": packed(part),
                }
                position += 1


def _parts(
    samples: GradedSamples | MeasuredInnovations,
) -> Iterator[GradedSamples | MeasuredInnovations]:
    edges = [*range(0, len(samples), MOST_PACKED), len(samples)]
    for first, end in pairwise(edges):
        yield samples.taken(slice(first, end))


def _stretch(start: Utc, stretch: GradedStretch) -> GradedStretchInfo:
    samples = stretch.samples["smoothed"]
    ends = np.asarray((samples.tai_ns[[0, -1]] - start.tai_ns) * 1e-9)
    first, last = texts_of(start, ends)
    good: dict[str, int] = {
        grade: int((stretch.samples[grade].status == Status.GOOD).sum()) for grade in GRADES
    }
    return GradedStretchInfo(
        model=stretch.model, start=first, end=last, samples=len(samples), good=good
    )


METHODS: dict[Grade, str] = {"filtered": "ekf", "smoothed": "filter_smoother"}
"""The words of CCSDS ACM's AD_METHOD."""
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


def graded_pages(
    reading: Callable[[], AbstractContextManager[Connection]],
    selected: ResultFilter,
    grade: Grade,
    *,
    newest_first: bool = False,
    page: int | None = None,
) -> Iterator[AttitudeRows]:
    """The samples of the latest revisions in a period, a block of up to an hour at a time.

    Of each block no more than the first `page`.  Between two blocks no connection is held.
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
    """The samples of the blocks that touch a period: at least those of the period."""
    total = select(func.sum(graded_blocks.c.samples)).join_from(
        graded_days, graded_blocks, graded_blocks.c.day_id == graded_days.c.id
    )
    return int(connection.scalar(total.where(*block_conditions(selected, grade))) or 0)


def block_conditions(selected: ResultFilter, kind: str) -> list[ColumnElement[bool]]:
    """The blocks of a grade, or of innovations, that touch a period, as SQL; latest revisions."""
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
    """The samples of a block that lie in the period."""
    found = unpacked(row["packed"], row["samples"])
    found = found.taken(inside(found.tai_ns, selected))
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


def live_attitude(name: str, day_start: Utc, carried: Carried | None) -> LiveAttitude | None:
    """The answer about the last epoch; None where there is no attitude, or it is lost."""
    if carried is None or (word := STATUS.get(Status(int(carried.sample.status[0])))) is None:
        return None
    sample = carried.sample
    (time,) = texts_of(day_start, np.asarray((sample.tai_ns - day_start.tai_ns) * 1e-9))
    is_gyro = carried.model == "gyro"
    return LiveAttitude(
        spacecraft=name,
        time=time,
        quaternion=sample.quaternion[0].tolist(),
        covariance_arcsec2=covariance_of(sample.covariance_arcsec2[0].tolist()),
        rate_deg_per_s=sample.rate_deg_per_s[0].tolist(),
        bias_deg_per_h=sample.bias_deg_per_h[0].tolist() if is_gyro else None,
        bias_sigma_deg_per_h=sample.bias_sigma_deg_per_h[0].tolist(),
        status=word,
        model=carried.model,
    )
