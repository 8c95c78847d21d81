"""Database records of filtered and smoothed days: a new revision if the input has changed.

Also API records of innovations, jobs and the live attitude.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Struct
from pydantic import Field
from sqlalchemy import (
    Connection,
    delete,
    func,
    insert,
    select,
    update,
)

from service.attitude.definitive import (
    GRADES,
    MOST_PACKED,
    DefinitiveSamples,
    MeasuredInnovations,
    Status,
    day_bounds,
    packed,
)
from service.contract.base import (
    Components,
    Count,
    Covariance,
    DescribedAs,
    Digest,
    Id,
    Moment,
    Quaternion,
    Record,
    Stamp,
    doc,
    list_record,
    page_record,
)
from service.contract.base import Status as StatusName
from service.features.definitive.carried import Carried
from service.features.definitive.day import DefinitiveDay, DefinitiveStretch
from service.gyro.blocks import texts_of
from service.storage.queries.definitive import STATUS, DaySummary, DefinitiveStretchInfo
from service.storage.queries.pages import covariance_of
from service.storage.sql.columns import Row
from service.storage.sql.definitive_tables import INNOVATIONS, graded_blocks, graded_days
from service.storage.sql.tables import runs
from service.times import Utc

SHOWN = ("id", "spacecraft", "run", "revision", "created", "samples", "inputs", "digest")


class Innovation(Record, frozen=True, kw_only=True):
    """Difference of a measured attitude from the filter's prediction and the smoothed attitude."""

    time: Moment
    outcome: Annotated[
        str, DescribedAs(Literal["accepted", "rejected", "started", "undecided", "unused"])
    ]
    """`accepted` and `started` measurements were used; `started`: the filter started from it.
    `undecided`: the measurement agrees with two attitudes that contradict each other.
    """
    innovation_arcsec: Components | None
    """Rotation vector from prediction to measurement, about the body axes; null: no prediction."""
    innovation_sigma_arcsec: Components | None
    """One sigma of prediction and measurement together, about each body axis."""
    chi_square: float | None
    """Chi-square of the innovation, with three degrees of freedom: 3 on average."""
    difference_arcsec: Components
    """Rotation vector from the smoothed attitude to the measured one, about the body axes."""
    difference_sigma_arcsec: Components
    """One sigma of the difference; the smoothed attitude depends on the measured one."""
    model: Annotated[str, DescribedAs(Literal["gyro", "constant_rate"])]
    revision: Annotated[int, Field(ge=1), doc("Revision of the day.")]


InnovationPage = page_record("InnovationPage", Innovation, "A page of innovations.")


class DefinitiveJob(Record, frozen=True, kw_only=True):
    """A job that computes the definitive attitude: filtered and smoothed attitudes of days."""

    id: Id
    spacecraft: str
    run: str
    start: Annotated[Moment | None, doc("null: from the first day with batches.")]
    end: Annotated[Moment | None, doc("null: to the last.")]
    who: Annotated[str, doc("`schedule`: the mission asks for it each day.")]
    created: Stamp
    ended: Stamp | None
    state: Annotated[
        str, DescribedAs(Literal["queued", "running", "done", "failed", "interrupted"])
    ]
    done: Annotated[int, doc("Days that are finished.")]
    total: Annotated[int, doc("Days with batches; 0 until they are counted.")]
    recorded: Annotated[int, doc("Days that got a new revision; the others had not changed.")]
    fault: str | None


DefinitiveJobList = list_record(
    "DefinitiveJobList", DefinitiveJob, "Jobs since the start of the service, the newest first."
)


class LiveAttitude(Record, frozen=True, kw_only=True):
    """The filtered attitude at the last epoch of live data; use only with `status` good."""

    spacecraft: str
    time: Annotated[Moment, doc("Time of the last gyro sample or, without a gyro, measurement.")]
    quaternion: Quaternion
    covariance_arcsec2: Covariance
    rate_deg_per_s: Components
    """Rate of the body relative to inertial space, in body axes."""
    bias_deg_per_h: Components | None
    """Bias of the gyro, in body axes; null at a constant rate."""
    bias_sigma_deg_per_h: Components
    """One sigma of the bias or, at a constant rate, of the rate."""
    status: StatusName
    """Status of the filtered attitude; `suspect`: contradicted or not confirmed yet."""
    model: Annotated[str, DescribedAs(Literal["gyro", "constant_rate"])]


@dataclass(frozen=True)
class DayKey:
    """Spacecraft, run and UTC day (as in `Utc.bucket`) that identify a filtered day."""

    spacecraft: str
    run: str
    day: int

    def conditions(self) -> list[Any]:
        """SQL conditions on `graded_days` for one day of a spacecraft and run."""
        c = graded_days.c
        return [c.spacecraft == self.spacecraft, c.run == self.run, c.day == self.day]


class DefinitiveDayRow(Struct, frozen=True, kw_only=True):
    """Database record of a day of filtered and smoothed attitudes."""

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


def current_day(connection: Connection, key: DayKey) -> DefinitiveDayRow | None:
    """Current revision of a filtered day; None without any."""
    query = select(graded_days).where(*key.conditions(), graded_days.c.current)
    row = connection.execute(query).mappings().first()
    return None if row is None else shown(row)


def rows_of(key: DayKey, computed: DefinitiveDay, inputs: str, id: str, created: Utc) -> list[Row]:
    """Database rows of a filtered day: the day without revision, followed by its blocks."""
    blocks = list(_blocks(id, computed))
    digest = hashlib.sha256()
    for block in blocks:
        digest.update(block["packed"])
    start, end = day_bounds(key.day)
    summary = DaySummary(
        stretches=[_stretch(start, each) for each in computed.stretches],
        measurements=computed.measurements,
        gyro=computed.gyro,
        nis_per_degree=computed.nis_per_degree,
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
        "samples": computed.samples,
        "summary": msgspec.json.encode(summary).decode(),
    }
    return [day, *blocks]


def record_day(connection: Connection, key: DayKey, rows: list[Row]) -> DefinitiveDayRow:
    """Record a new revision of a filtered day in place of the current one.

    A day that another process recorded from the same input stays unchanged.
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


def shown(row: Any) -> DefinitiveDayRow:
    """Convert a database row of a filtered day to an API record."""
    start, _ = day_bounds(row["day"])
    return DefinitiveDayRow(
        **{name: row[name] for name in SHOWN},
        day=start.text[:10],
        summary=msgspec.json.decode(row["summary"], type=DaySummary),
    )


def _blocks(day_id: str, computed: DefinitiveDay) -> Iterator[Row]:
    by_kind: dict[str, list[DefinitiveSamples | MeasuredInnovations]] = {
        **{grade: [each.samples[grade] for each in computed.stretches] for grade in GRADES},
        INNOVATIONS: [each.innovations for each in computed.stretches],
    }
    for kind, wholes in by_kind.items():
        position = 0
        for stretch, whole in zip(computed.stretches, wholes, strict=True):
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
    samples: DefinitiveSamples | MeasuredInnovations,
) -> Iterator[DefinitiveSamples | MeasuredInnovations]:
    edges = [*range(0, len(samples), MOST_PACKED), len(samples)]
    for first, end in pairwise(edges):
        yield samples.taken(slice(first, end))


def _stretch(start: Utc, stretch: DefinitiveStretch) -> DefinitiveStretchInfo:
    samples = stretch.samples["smoothed"]
    ends = np.asarray((samples.tai_ns[[0, -1]] - start.tai_ns) * 1e-9)
    first, last = texts_of(start, ends)
    good: dict[str, int] = {
        grade: int((stretch.samples[grade].status == Status.GOOD).sum()) for grade in GRADES
    }
    return DefinitiveStretchInfo(
        model=stretch.model, start=first, end=last, samples=len(samples), good=good
    )


def live_attitude(name: str, day_start: Utc, carried: Carried | None) -> LiveAttitude | None:
    """API record of the live attitude at its last epoch; None if there is none or it is lost."""
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
