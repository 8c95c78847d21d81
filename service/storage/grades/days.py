"""Days of grades in the records: a new revision where the facts have changed, none otherwise."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Struct
from pydantic import Field
from sqlalchemy import Connection, delete, func, insert, select, update

from service.filtering.state import Status
from service.grades.day import (
    GRADES,
    MOST_PACKED,
    GradedDay,
    GradedSamples,
    GradedStretch,
    MeasuredInnovations,
    day_bounds,
    packed,
)
from service.gyro import texts_of
from service.storage.models.base import Count, Digest, Id, Moment, Stamp, doc
from service.storage.sql.columns import Row
from service.storage.sql.grade_tables import INNOVATIONS, graded_blocks, graded_days
from service.storage.sql.tables import runs
from service.times import Utc

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
    gyro: Annotated[dict[str, int], doc("Samples, gaps, samples beyond the largest rate.")]
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
