"""Calibrations of trackers, and what was adopted of them."""

from typing import Any

from ..base import Model


class FocalPlane(Model, frozen=True, kw_only=True):
    """A tracker's focal-plane calibration, as in mission files."""

    scale: float
    h_terms: list[list[float]]
    v_terms: list[list[float]]


class TrackerMagnitudes(Model, frozen=True, kw_only=True):
    """A tracker's magnitude calibration, as in mission files."""

    zero_mag: float
    scale: float
    color_mag: float


class TrackerGeometry(Model, frozen=True, kw_only=True):
    """Alignment, focal plane and magnitudes of a tracker, as in mission files.

    `magnitudes` are None in an adoption of an earlier version: then they are the file's.
    """

    name: str
    x_axis_body: list[float]
    y_axis_body: list[float]
    z_axis_body: list[float]
    calibration: FocalPlane
    magnitudes: TrackerMagnitudes | None = None


class CalibrationBatches(Model, frozen=True, kw_only=True):
    """The batches that a calibration came from."""

    total: int
    sampled: int
    used: int
    refused: int
    first: str | None
    last: str | None


class CalibrationHeldOut(Model, frozen=True, kw_only=True):
    """How well a distortion of a degree predicts blocks of time that it was not fitted to."""

    degree: int
    residual_over_sigma: float
    chosen: bool


class CalibrationResiduals(Model, frozen=True, kw_only=True):
    """Root mean square of a tracker's residuals per axis, before and after."""

    tracker: str
    stars: int
    before_arcsec: float
    after_arcsec: float
    before_over_sigma: float
    after_over_sigma: float


class CalibrationUnknown(Model, frozen=True, kw_only=True):
    """An estimated correction to the settings that the calibration started from."""

    name: str
    tracker: str
    kind: str
    value: float
    sigma: float
    unit: str


class CalibrationNotObservable(Model, frozen=True, kw_only=True):
    """Something that the stars cannot show, and why."""

    name: str
    reason: str


class ResidualCell(Model, frozen=True, kw_only=True):
    """Mean residuals (h, v) of the stars in a cell of the focal plane."""

    h_deg: float
    v_deg: float
    stars: int
    before_arcsec: list[float]
    after_arcsec: list[float]


class ResidualMap(Model, frozen=True, kw_only=True):
    """A tracker's residuals over its focal plane; cells without stars are left out."""

    tracker: str
    radius_deg: float
    step_deg: float
    cells: list[ResidualCell]


class CalibrationResult(Model, frozen=True, kw_only=True):
    """What the stars say of the trackers."""

    batches: CalibrationBatches
    stars: int
    stars_left_out: int
    degree: int
    held_out: list[CalibrationHeldOut]
    residual_over_sigma: float
    residuals: list[CalibrationResiduals]
    unknowns: list[CalibrationUnknown]
    not_observable: list[CalibrationNotObservable]
    notes: list[str]
    maps: list[ResidualMap]
    trackers: list[TrackerGeometry]
    mission_file: str


class _CalibrationFields(Model, frozen=True, kw_only=True):
    id: str
    spacecraft: str
    version: int
    run: str
    state: str
    who: str
    created: str
    ended: str | None
    done: int
    total: int
    mission: str
    fault: str | None


class CalibrationSummary(_CalibrationFields, frozen=True, kw_only=True):
    """A calibration without its covariance and residual maps."""

    residual_over_sigma: float | None
    degree: int | None
    first: str | None
    last: str | None
    unknowns: list[CalibrationUnknown]
    trackers: list[TrackerGeometry]


class Calibration(_CalibrationFields, frozen=True, kw_only=True):
    """A calibration; `result` and `covariance` are None until it is done."""

    request: dict[str, Any]
    result: CalibrationResult | None
    covariance: list[list[float]] | None


class CalibrationChange(Model, frozen=True, kw_only=True):
    """A change of the calibration in force; `calibration` is None where it is the mission file."""

    id: str
    spacecraft: str
    adopted: str
    who: str
    note: str
    calibration: str | None
    version: int | None
    mission: str


class CalibrationAdoption(CalibrationChange, frozen=True, kw_only=True):
    """A change of the calibration in force, with the settings that it brought."""

    file: str
    trackers: list[TrackerGeometry] | None


class CalibrationInForce(Model, frozen=True, kw_only=True):
    """The calibration that new batches use, and what held before, newest first."""

    spacecraft: str
    mission: str
    calibration: str | None
    overridden: bool
    history: list[CalibrationAdoption]
