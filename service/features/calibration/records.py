"""Stored calibrations: the request, the progress, and the result."""

import json
from collections.abc import Collection
from typing import Annotated, ClassVar, Literal

import msgspec
from pydantic import Field
from sqlalchemy import Connection, func, insert, select, update

from service.contract.base import (
    Count,
    Digest,
    Id,
    MissionSettings,
    Moment,
    Page,
    Record,
    Stamp,
    doc,
    page_record,
)
from service.contract.calibration import TrackerGeometry
from service.errors import NotFound, shown_value
from service.storage.sql.columns import Row
from service.storage.sql.statements import rows_of
from service.storage.sql.tables import calibrations

CalibrationStateName = Literal["queued", "running", "done", "failed", "interrupted"]
UnknownKind = Literal["alignment", "scale", "distortion", "temperature", "time_tag", "magnitude"]


class CalibrationBatches(Record, frozen=True, kw_only=True):
    """Numbers of batches that a calibration used, and their period."""

    total: Annotated[Count, doc("Batches in the period.")]
    sampled: Annotated[Count, doc("Batches that were processed again.")]
    used: Annotated[Count, doc("Batches with identified stars.")]
    refused: Annotated[Count, doc("Batches that no longer fit the mission.")]
    first: Moment | None
    last: Moment | None


class CalibrationHeldOut(Record, frozen=True, kw_only=True):
    """Prediction error of a distortion of some degree on blocks of time outside of its fit."""

    degree: Count
    residual_over_sigma: float
    chosen: bool


class CalibrationResiduals(Record, frozen=True, kw_only=True):
    """Root mean square of a tracker's residuals per axis, before and after calibration."""

    tracker: str
    stars: Count
    before_arcsec: float
    after_arcsec: float
    before_over_sigma: float
    after_over_sigma: float


class CalibrationUnknown(Record, frozen=True, kw_only=True):
    """An estimated correction to the settings that the calibration started from."""

    name: str
    tracker: str
    kind: UnknownKind
    value: float
    sigma: Annotated[float, doc("One standard deviation.")]
    unit: str


class CalibrationNotObservable(Record, frozen=True, kw_only=True):
    """A parameter that the stars do not determine, and the reason."""

    name: str
    reason: str


class ResidualCell(Record, frozen=True, kw_only=True):
    """Mean residuals of the stars in a cell of the focal plane, observed minus predicted."""

    h_deg: Annotated[float, doc("Place of the cell's centre.")]
    v_deg: float
    stars: Count
    before_arcsec: Annotated[list[float], Field(min_length=2, max_length=2, description="h, v.")]
    after_arcsec: Annotated[list[float], Field(min_length=2, max_length=2, description="h, v.")]


class ResidualMap(Record, frozen=True, kw_only=True):
    """A tracker's residuals over its focal plane; cells without stars are left out."""

    tracker: str
    radius_deg: float
    step_deg: Annotated[float, doc("The width of a cell.")]
    cells: list[ResidualCell]


class CalibrationResult(Record, frozen=True, kw_only=True):
    """Result of a calibration: parameters, residuals, and the settings to change."""

    batches: CalibrationBatches
    stars: Count
    stars_left_out: Annotated[Count, doc("Stars that were left out as wrong.")]
    degree: Annotated[Count, doc("Degree of the distortion; 0: none.")]
    held_out: Annotated[list[CalibrationHeldOut], doc("Empty where the degree was given.")]
    residual_over_sigma: Annotated[float, doc("Per degree of freedom.")]
    residuals: list[CalibrationResiduals]
    unknowns: list[CalibrationUnknown]
    not_observable: list[CalibrationNotObservable]
    notes: Annotated[list[str], doc("What a mission file cannot hold of it.")]
    maps: list[ResidualMap]
    trackers: Annotated[list[TrackerGeometry], doc("Every tracker of the mission, calibrated.")]
    mission_file: Annotated[str, doc("The lines for the mission file, as TOML.")]


class CalibrationProgress(Record, frozen=True, kw_only=True):
    """Fields of every calibration, present from its start on."""

    component: ClassVar[str] = ""
    id: Id
    spacecraft: str
    version: Annotated[Count, doc("From 1 for each spacecraft.")]
    run: str
    state: CalibrationStateName
    who: str
    created: Stamp
    ended: Stamp | None
    done: Annotated[Count, doc("Batches that have been processed again.")]
    total: Count
    mission: Annotated[Digest, doc("The settings that it started from.")]


class CalibrationSummary(CalibrationProgress, frozen=True, kw_only=True):
    """A calibration without its covariance and maps; `result` fields are null until it is done."""

    fault: str | None
    residual_over_sigma: float | None
    degree: Count | None
    first: Annotated[Moment | None, doc("Time of the earliest batch.")]
    last: Moment | None
    unknowns: list[CalibrationUnknown]
    trackers: list[TrackerGeometry]


class Calibration(CalibrationProgress, frozen=True, kw_only=True):
    """A calibration: its request, its progress and its result."""

    request: MissionSettings
    fault: str | None
    result: CalibrationResult | None
    covariance: Annotated[
        list[list[float]] | None, doc("Covariance of the unknowns, in their order and units.")
    ]


CalibrationPage = page_record(
    "CalibrationPage", CalibrationSummary, "A page of calibrations, newest first."
)


_RESULT = msgspec.json.Decoder(CalibrationResult)
UNFINISHED = ("queued", "running")
_PLAIN = (*(n for n in CalibrationProgress.__struct_fields__ if n != "mission"), "fault")
_SUMMARY = tuple(calibrations.c[name] for name in (*_PLAIN, "mission_digest", "result"))


def add_calibration(connection: Connection, row: Row) -> None:
    """Insert a calibration that begins, as the next version of its spacecraft."""
    latest = select(func.max(calibrations.c.version)).where(
        calibrations.c.spacecraft == row["spacecraft"]
    )
    version = int(connection.scalar(latest) or 0) + 1
    connection.execute(insert(calibrations), row | {"version": version})


def change_calibration(connection: Connection, id: str, changes: Row) -> None:
    """Store the progress or the result of a calibration."""
    connection.execute(update(calibrations).where(calibrations.c.id == id).values(changes))


def unfinished_calibrations(connection: Connection) -> set[str]:
    """Ids of the calibrations that are being computed or are queued."""
    unfinished = calibrations.c.state.in_(UNFINISHED)
    return set(connection.scalars(select(calibrations.c.id).where(unfinished)))


def interrupt_calibrations(
    connection: Connection, now: str, only: Collection[str] | None = None
) -> None:
    """Mark unfinished calibrations as interrupted; with `only`, just the ones with these ids.

    A calibration that another process is still computing gets its result when it ends.
    """
    left = [calibrations.c.state.in_(UNFINISHED)]
    if only is not None:
        left.append(calibrations.c.id.in_(only))
    connection.execute(update(calibrations).where(*left).values(state="interrupted", ended=now))


def read_calibration(connection: Connection, id: str) -> Calibration:
    """Read a calibration with its complete result; raises `NotFound`."""
    row = connection.execute(select(calibrations).where(calibrations.c.id == id)).mappings().first()
    if row is None:
        raise NotFound(f"there is no calibration with the id {shown_value(id)}")
    return Calibration(
        **{name: row[name] for name in _PLAIN},
        mission=row["mission_digest"],
        request=json.loads(row["request"]),
        result=None if row["result"] is None else _RESULT.decode(row["result"]),
        covariance=None if row["covariance"] is None else json.loads(row["covariance"]),
    )


def list_calibrations(
    connection: Connection, spacecraft: str | None, limit: int, cursor: str | None
) -> Page[CalibrationSummary]:
    """One page of calibrations, newest first; the cursor is the id of the last one shown."""
    query = select(*_SUMMARY).order_by(calibrations.c.id.desc()).limit(limit + 1)
    if spacecraft is not None:
        query = query.where(calibrations.c.spacecraft == spacecraft)
    if cursor is not None:
        query = query.where(calibrations.c.id < cursor)
    rows = [_summary(row) for row in rows_of(connection, query)]
    return Page(rows[:limit], rows[limit - 1].id if len(rows) > limit else None)


def _summary(row: Row) -> CalibrationSummary:
    found = None if row["result"] is None else _RESULT.decode(row["result"])
    return CalibrationSummary(
        **{name: row[name] for name in _PLAIN},
        mission=row["mission_digest"],
        residual_over_sigma=None if found is None else found.residual_over_sigma,
        degree=None if found is None else found.degree,
        first=None if found is None else found.batches.first,
        last=None if found is None else found.batches.last,
        unknowns=found.unknowns if found else [],
        trackers=found.trackers if found else [],
    )
