"""Records of tracker calibrations: the one in force, and earlier ones."""
# Written by `make client` from service/contract/calibration.py and
# service/features/calibration/records.py.

from collections.abc import Sequence
from typing import Any

from ..base import Model


class FocalPlane(Model, frozen=True, kw_only=True):
    """A tracker's focal-plane calibration, as in mission files."""

    scale: float
    h_terms: Sequence[Sequence[float]]
    """Powers of the measured h and v in degrees, and the coefficient, as in mission files."""
    v_terms: Sequence[Sequence[float]]
    """Powers of the measured h and v in degrees, and the coefficient, as in mission files."""


class TrackerMagnitudes(Model, frozen=True, kw_only=True):
    """A tracker's magnitude calibration, as in mission files."""

    zero_mag: float
    scale: float
    color_mag: float


class TrackerGeometry(Model, frozen=True, kw_only=True):
    """Alignment, focal plane and magnitudes of a tracker, as in mission files."""

    name: str
    x_axis_body: Sequence[float]
    y_axis_body: Sequence[float]
    z_axis_body: Sequence[float]
    calibration: FocalPlane
    magnitudes: TrackerMagnitudes | None = None
    """None: as the mission file has them (earlier versions)."""


class CalibrationAdoption(Model, frozen=True, kw_only=True):
    """Adoption of a calibration, or the return to the mission file: author, time and settings."""

    id: str
    spacecraft: str
    adopted: str
    who: str
    note: str
    calibration: str | None
    """None: back to the mission file."""
    version: int | None
    """The version of the calibration."""
    file: str
    """The mission file's own settings at that time."""
    mission: str
    """The settings in force since then."""
    trackers: Sequence[TrackerGeometry] | None


class CalibrationInForce(Model, frozen=True, kw_only=True):
    """Calibration that new batches of a spacecraft use, with its earlier ones."""

    spacecraft: str
    mission: str
    """The settings in force."""
    calibration: str | None
    """None: the mission file holds."""
    overridden: bool
    """True if the mission file was changed after the adoption, so that it holds."""
    history: Sequence[CalibrationAdoption]
    """Newest first."""


class CalibrationBatches(Model, frozen=True, kw_only=True):
    """Numbers of batches that a calibration used, and their period."""

    total: int
    """Batches in the period."""
    sampled: int
    """Batches that were processed again."""
    used: int
    """Batches with identified stars."""
    refused: int
    """Batches that no longer fit the mission."""
    first: str | None
    last: str | None


class CalibrationHeldOut(Model, frozen=True, kw_only=True):
    """Prediction error of a distortion of some degree on blocks of time outside of its fit."""

    degree: int
    residual_over_sigma: float
    chosen: bool


class CalibrationResiduals(Model, frozen=True, kw_only=True):
    """Root mean square of a tracker's residuals per axis, before and after calibration."""

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
    """One standard deviation."""
    unit: str


class CalibrationNotObservable(Model, frozen=True, kw_only=True):
    """A parameter that the stars do not determine, and the reason."""

    name: str
    reason: str


class ResidualCell(Model, frozen=True, kw_only=True):
    """Mean residuals of the stars in a cell of the focal plane, observed minus predicted."""

    h_deg: float
    """Place of the cell's centre."""
    v_deg: float
    stars: int
    before_arcsec: Sequence[float]
    """h, v."""
    after_arcsec: Sequence[float]
    """h, v."""


class ResidualMap(Model, frozen=True, kw_only=True):
    """A tracker's residuals over its focal plane; cells without stars are left out."""

    tracker: str
    radius_deg: float
    step_deg: float
    """The width of a cell."""
    cells: Sequence[ResidualCell]


class CalibrationResult(Model, frozen=True, kw_only=True):
    """Result of a calibration: parameters, residuals, and the settings to change."""

    batches: CalibrationBatches
    stars: int
    stars_left_out: int
    """Stars that were left out as wrong."""
    degree: int
    """Degree of the distortion; 0: none."""
    held_out: Sequence[CalibrationHeldOut]
    """Empty where the degree was given."""
    residual_over_sigma: float
    """Per degree of freedom."""
    residuals: Sequence[CalibrationResiduals]
    unknowns: Sequence[CalibrationUnknown]
    not_observable: Sequence[CalibrationNotObservable]
    notes: Sequence[str]
    """What a mission file cannot hold of it."""
    maps: Sequence[ResidualMap]
    trackers: Sequence[TrackerGeometry]
    """Every tracker of the mission, calibrated."""
    mission_file: str
    """The lines for the mission file, as TOML."""


class CalibrationProgress(Model, frozen=True, kw_only=True):
    """Fields of every calibration, present from its start on."""

    id: str
    spacecraft: str
    version: int
    """From 1 for each spacecraft."""
    run: str
    state: str
    who: str
    created: str
    ended: str | None
    done: int
    """Batches that have been processed again."""
    total: int
    mission: str
    """The settings that it started from."""


class CalibrationSummary(CalibrationProgress, frozen=True, kw_only=True):
    """A calibration without its covariance and maps; `result` fields are None until it is done."""

    fault: str | None
    residual_over_sigma: float | None
    degree: int | None
    first: str | None
    """Time of the earliest batch."""
    last: str | None
    unknowns: Sequence[CalibrationUnknown]
    trackers: Sequence[TrackerGeometry]


class Calibration(CalibrationProgress, frozen=True, kw_only=True):
    """A calibration: its request, its progress and its result."""

    request: dict[str, Any]
    fault: str | None
    result: CalibrationResult | None
    covariance: Sequence[Sequence[float]] | None
    """Covariance of the unknowns, in their order and units."""
