"""Spacecraft: state, attitudes, histories, rates, alarms, gyro blocks, calibrations of trackers."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..base import Model, Status
from ..tables import pandas_of, table_of_history
from .answers import Summary

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


class AttitudeRow(Model, frozen=True):
    """An attitude in a history; use it only where `status` is good."""

    id: str
    batch: str
    time: str
    quaternion: Sequence[float]
    frame: str
    covariance_arcsec2: Sequence[Sequence[float]]
    residual_rms_arcsec: float | None
    predicted_rms_arcsec: float | None
    taste: float | None
    method: str
    status: Status


class LiveAttitude(Model, frozen=True, kw_only=True):
    """The filtered attitude at the last epoch of live data; use it only where `status` is good.

    `bias_sigma_deg_per_h` is that of the gyro's bias or, at a constant rate, of the rate.
    """

    spacecraft: str
    time: str
    quaternion: Sequence[float]
    covariance_arcsec2: Sequence[Sequence[float]]
    rate_deg_per_s: Sequence[float]
    bias_deg_per_h: Sequence[float] | None
    bias_sigma_deg_per_h: Sequence[float]
    status: str
    model: str


class Innovation(Model, frozen=True, kw_only=True):
    """How a measured attitude met the filter, and how far it is from the smoothed attitude.

    Vectors are about the body axes.  The innovation is None where nothing was predicted.
    """

    time: str
    outcome: str
    innovation_arcsec: Sequence[float] | None
    innovation_sigma_arcsec: Sequence[float] | None
    chi_square: float | None
    difference_arcsec: Sequence[float]
    difference_sigma_arcsec: Sequence[float]
    model: str
    revision: int


class DefinitiveJob(Model, frozen=True, kw_only=True):
    """The making of a definitive attitude, with the days that are finished.

    `state` is queued, running, done, failed or interrupted; `recorded` counts days with a new
    revision.
    """

    id: str
    spacecraft: str
    run: str
    start: str | None
    end: str | None
    who: str
    created: str
    ended: str | None
    state: str
    done: int
    total: int
    recorded: int
    fault: str | None


class SpacecraftRow(Model, frozen=True, kw_only=True):
    """The state of a spacecraft in a run.

    `attitude` is that of the latest batch, or None; `last_attitude` may be older.  `tracking` is
    acquiring, tracking or lost, None where the latest batch does not ask for the last attitude.
    """

    name: str
    description: str
    retired: bool
    state: str
    latest_batch: Summary | None
    attitude: AttitudeRow | None
    last_attitude: AttitudeRow | None
    tracking: str | None


class MissionNow(Model, frozen=True):
    """The present settings of a mission, with the names of the mission file."""

    digest: str
    settings: dict[str, Any]


class MissionThen(MissionNow, frozen=True):
    """The settings of a mission since some time."""

    since: str


class SpacecraftState(SpacecraftRow, frozen=True, kw_only=True):
    """The state of a spacecraft, and its mission's settings with their history."""

    mission: MissionNow
    history: Sequence[MissionThen]


class Rates(Model, frozen=True):
    """Sums over the batches of an hour or day; `solved` and `suspect` count batches."""

    start: str
    batches: int
    observed: int
    unique: int
    ambiguous: int
    unmatched: int
    solved: int
    suspect: int


class Series(Model, frozen=True, kw_only=True):
    """A quantity over time; a list that the strategy does not give is empty.

    `minmax`: `count`, `mean`, `min` and `max` of each bucket; `latest`: `value` of each batch.
    """

    unit: str
    count: Sequence[int] = ()
    mean: Sequence[float | None] = ()
    min: Sequence[float | None] = ()
    max: Sequence[float | None] = ()
    value: Sequence[float | None] = ()


class History(Model, frozen=True, kw_only=True):
    """Quantities over a period, oldest first; None: unknown.

    `unix_s` is the POSIX time of each bucket's beginning, or of each batch; `thinned` tells
    whether the period has more batches than points.
    """

    spacecraft: str
    run: str
    tracker: str | None = None
    not_split: bool = False
    start: str | None
    end: str | None
    strategy: str
    bucket_s: int | None
    source: str
    thinned: bool
    unix_s: Sequence[float]
    batches: Sequence[int] = ()
    time: Sequence[str] = ()
    id: Sequence[str] = ()
    batch: Sequence[str] = ()
    series: dict[str, Series]

    def to_arrow(self) -> "pa.Table":
        """A table with a row for each point; a column such as `residual_rms_arcsec.mean`.

        Raises `PackageMissing` where pyarrow is not installed.
        """
        return table_of_history(self)

    def to_pandas(self) -> "pd.DataFrame":
        """The same as a data frame.

        Raises `PackageMissing` where pandas and pyarrow are not both installed.
        """
        return pandas_of(self.to_arrow())


class RankedBatch(Summary, frozen=True, kw_only=True):
    """A batch with its value of the quantity that was asked for."""

    value: float


class Ranking(Model, frozen=True, kw_only=True):
    """The worst batches of a period by a quantity, worst first."""

    by: str
    tracker: str | None = None
    not_split: bool = False
    items: Sequence[RankedBatch]


class AlarmValue(Model, frozen=True):
    """An evaluated value with its time and its batch."""

    value: float
    time: str
    batch_id: str | None


class AlarmRaised(AlarmValue, frozen=True):
    """The value that raised an alarm, and the bound that it passed."""

    at: str
    bound: float


class Acted(Model, frozen=True):
    """The author and the time of an action."""

    at: str
    who: str


class Shelved(Acted, frozen=True):
    """Shelved until a time."""

    until: str


class Alarm(Model, frozen=True, kw_only=True):
    """An alarm.  It stays until it is acknowledged and its quantity is back in limits.

    `severity` is the worst so far; `current_severity` is None while the value is in limits.
    `tracker` is None for the spacecraft as a whole.
    """

    id: str
    spacecraft: str
    run: str
    quantity: str
    tracker: str | None = None
    unit: str
    state: str
    severity: str
    current_severity: str | None
    in_limits: bool
    raised: AlarmRaised
    worst: AlarmValue
    latest: AlarmValue
    returned_at: str | None
    acknowledged: Acted | None
    shelved: Shelved | None
    cleared_at: str | None


class AlarmAction(Model, frozen=True):
    """A change of an alarm, by its value or by a person."""

    at: str
    action: str
    who: str | None
    comment: str | None
    severity: str | None
    value: float | None
    time: str | None


class AlarmWithActions(Alarm, frozen=True, kw_only=True):
    """An alarm with its history, oldest first."""

    actions: Sequence[AlarmAction]


class GyroBlock(Model, frozen=True, kw_only=True):
    """A recorded gyro block; `step_s` is None where the block has times of its own."""

    id: str
    spacecraft: str
    run: str
    block: str
    start: str
    end: str
    samples: int
    step_s: float | None
    received: str


class GyroSamples(GyroBlock, frozen=True, kw_only=True):
    """A recorded gyro block with its samples; the times are seconds of TAI after `start`."""

    times_s: Sequence[float]
    rates_rad_per_s: Sequence[Sequence[float]]


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
