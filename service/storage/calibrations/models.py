"""Calibrations of trackers, and what an operator adopted of them."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from service.storage.models.base import (
    Components,
    Count,
    Digest,
    Id,
    MissionSettings,
    Moment,
    Record,
    Stamp,
    doc,
)

CalibrationStateName = Literal["queued", "running", "done", "failed", "interrupted"]
UnknownKind = Literal["alignment", "scale", "distortion", "temperature", "time_tag", "magnitude"]
Terms = Annotated[
    list[Components],
    doc("Powers of the measured h and v in degrees, and the coefficient, as in mission files."),
]


class FocalPlane(Record, frozen=True, kw_only=True):
    """A tracker's focal-plane calibration, as in mission files."""

    component: ClassVar[str] = "FocalPlane"
    scale: float
    h_terms: Terms
    v_terms: Terms


class TrackerMagnitudes(Record, frozen=True, kw_only=True):
    """A tracker's magnitude calibration, as in mission files."""

    component: ClassVar[str] = "TrackerMagnitudes"
    zero_mag: float
    scale: float
    color_mag: float


class TrackerGeometry(Record, frozen=True, kw_only=True):
    """Alignment, focal plane and magnitudes of a tracker, as in mission files."""

    component: ClassVar[str] = "TrackerGeometry"
    name: str
    x_axis_body: Components
    y_axis_body: Components
    z_axis_body: Components
    calibration: FocalPlane
    magnitudes: Annotated[
        TrackerMagnitudes | None, doc("Null: as the mission file has them (earlier versions).")
    ] = None


class CalibrationBatches(Record, frozen=True, kw_only=True):
    """The batches that a calibration came from."""

    component: ClassVar[str] = "CalibrationBatches"
    total: Annotated[Count, doc("Batches in the period.")]
    sampled: Annotated[Count, doc("Batches that were processed again.")]
    used: Annotated[Count, doc("Batches with identified stars.")]
    refused: Annotated[Count, doc("Batches that no longer fit the mission.")]
    first: Moment | None
    last: Moment | None


class CalibrationHeldOut(Record, frozen=True, kw_only=True):
    """How well a distortion of a degree predicts blocks of time that it was not fitted to."""

    component: ClassVar[str] = "CalibrationHeldOut"
    degree: Count
    residual_over_sigma: float
    chosen: bool


class CalibrationResiduals(Record, frozen=True, kw_only=True):
    """Root mean square of a tracker's residuals per axis, before and after."""

    component: ClassVar[str] = "CalibrationResiduals"
    tracker: str
    stars: Count
    before_arcsec: float
    after_arcsec: float
    before_over_sigma: float
    after_over_sigma: float


class CalibrationUnknown(Record, frozen=True, kw_only=True):
    """An estimated correction to the settings that the calibration started from."""

    component: ClassVar[str] = "CalibrationUnknown"
    name: str
    tracker: str
    kind: UnknownKind
    value: float
    sigma: Annotated[float, doc("One standard deviation.")]
    unit: str


class CalibrationNotObservable(Record, frozen=True, kw_only=True):
    """Something that the stars cannot show, and why."""

    component: ClassVar[str] = "CalibrationNotObservable"
    name: str
    reason: str


class ResidualCell(Record, frozen=True, kw_only=True):
    """Mean residuals of the stars in a cell of the focal plane, observed minus predicted."""

    component: ClassVar[str] = "ResidualCell"
    h_deg: Annotated[float, doc("Of the cell's centre.")]
    v_deg: float
    stars: Count
    before_arcsec: Annotated[list[float], Field(min_length=2, max_length=2, description="h, v.")]
    after_arcsec: Annotated[list[float], Field(min_length=2, max_length=2, description="h, v.")]


class ResidualMap(Record, frozen=True, kw_only=True):
    """A tracker's residuals over its focal plane; cells without stars are left out."""

    component: ClassVar[str] = "ResidualMap"
    tracker: str
    radius_deg: float
    step_deg: Annotated[float, doc("The width of a cell.")]
    cells: list[ResidualCell]


class CalibrationResult(Record, frozen=True, kw_only=True):
    """What the stars say of the trackers."""

    component: ClassVar[str] = "CalibrationResult"
    batches: CalibrationBatches
    stars: Count
    stars_left_out: Annotated[Count, doc("Stars that were left out as wrong.")]
    degree: Annotated[Count, doc("Of the distortion; 0: none.")]
    held_out: Annotated[list[CalibrationHeldOut], doc("Empty where the degree was given.")]
    residual_over_sigma: Annotated[float, doc("Per degree of freedom.")]
    residuals: list[CalibrationResiduals]
    unknowns: list[CalibrationUnknown]
    not_observable: list[CalibrationNotObservable]
    notes: Annotated[list[str], doc("What a mission file cannot hold of it.")]
    maps: list[ResidualMap]
    trackers: Annotated[list[TrackerGeometry], doc("Every tracker of the mission, calibrated.")]
    mission_file: Annotated[str, doc("The lines for the mission file, as TOML.")]


class CalibrationSummary(Record, frozen=True, kw_only=True):
    """A calibration without its covariance and maps; `result` fields are null until it is done."""

    component: ClassVar[str] = "CalibrationSummary"
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
    fault: str | None
    residual_over_sigma: float | None
    degree: Count | None
    first: Annotated[Moment | None, doc("Time of the earliest batch.")]
    last: Moment | None
    unknowns: list[CalibrationUnknown]
    trackers: list[TrackerGeometry]


class Calibration(Record, frozen=True, kw_only=True):
    """A calibration: what was asked, how far it is, and what was found."""

    component: ClassVar[str] = "Calibration"
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
    request: MissionSettings
    fault: str | None
    result: CalibrationResult | None
    covariance: Annotated[
        list[list[float]] | None, doc("Of the unknowns, in their order and units.")
    ]


class CalibrationPage(Record, frozen=True, kw_only=True):
    """A page of calibrations, newest first."""

    component: ClassVar[str] = "CalibrationPage"
    items: list[CalibrationSummary]
    next_cursor: str | None


class CalibrationAdoption(Record, frozen=True, kw_only=True):
    """A change of the calibration in force, by whom and when."""

    component: ClassVar[str] = "CalibrationAdoption"
    id: Id
    spacecraft: str
    adopted: Stamp
    who: str
    note: str
    calibration: Annotated[Id | None, doc("Null: back to the mission file.")]
    version: Annotated[Count | None, doc("The version of the calibration.")]
    file: Annotated[Digest, doc("The mission file's own settings at that time.")]
    mission: Annotated[Digest, doc("The settings in force since then.")]
    trackers: list[TrackerGeometry] | None


class CalibrationInForce(Record, frozen=True, kw_only=True):
    """The calibration that new batches of a spacecraft use, and what held before."""

    component: ClassVar[str] = "CalibrationInForce"
    spacecraft: str
    mission: Annotated[Digest, doc("The settings in force.")]
    calibration: Annotated[Id | None, doc("Null: the mission file holds.")]
    overridden: Annotated[
        bool, doc("Whether the mission file was changed after the adoption, so that it holds.")
    ]
    history: Annotated[list[CalibrationAdoption], doc("Newest first.")]
