"""A mission's tables about attitude over time: gyro, motion, prediction, filter and smoothing.

The gyro: its axes, its noise, and the largest rate that it is believed; how the body moves
where there is none; and how the attitude of a batch is predicted from the last good one.
"""

from functools import cached_property
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from service.errors import BadInput
from service.missions.strict import Strict
from service.times import Utc, parse_utc
from service.vectors import Matrix, read_only

LARGEST_RATE_DEG_PER_S = 10.0
"""Default of a mission: star trackers do not follow faster motion."""
FIRST_BIAS_RAD_S = 5e-5
"""One sigma of a gyro's bias when nothing is known of it: 10 deg/h."""
RATE_WALK_RAD_S1_5 = 3e-4
"""Default of a mission: within minutes a body may begin or end a slew."""
RATE_RAD_S = 2e-3
"""One sigma of the rate of a body when nothing is known of it: 0.1 deg/s."""
FLOOR_DEG, CEILING_DEG = 0.1, 3.0
MAX_AGE_S = 3600.0
BODY_RATE_SIGMA_DEG_PER_S = 0.001
"""Default sigma of the rates that batches carry."""
AXIS_LENGTH_TOLERANCE, LEAST_VOLUME = 1e-3, 0.1

AxisName = Literal["X", "Y", "Z", "-X", "-Y", "-Z"]
Axis = tuple[float, float, float]


class GyroSettings(Strict):
    """What is fixed of a gyro; the noise is the same for its three axes."""

    axes: tuple[AxisName, AxisName, AxisName] | tuple[Axis, Axis, Axis] = ("X", "Y", "Z")
    """The axes about which the three rates of a sample are measured: body axes by name, or unit
    vectors in body components, which need not be at right angles."""
    sigma_v_rad_s0_5: float = Field(ge=0, le=1)
    """Angle random walk, rad/s^.5 (Farrenkopf's sigma_v)."""
    sigma_u_rad_s1_5: float = Field(ge=0, le=1)
    """Walk of the bias, rad/s^1.5 (Farrenkopf's sigma_u)."""
    scale: float = Field(default=0.0, ge=0, le=0.1)
    """One sigma of the error of scale that calibration left; .001 is 0.1 %."""
    misalignment_arcsec: float = Field(default=0.0, ge=0, le=36_000)
    """One sigma of the error of an axis' direction that calibration left."""
    largest_rate_deg_per_s: Annotated[float, Field(gt=0, le=360)] = LARGEST_RATE_DEG_PER_S
    """A block with a larger rate about an axis is refused."""
    bias_sigma_rad_s: float = Field(default=FIRST_BIAS_RAD_S, gt=0, le=1)
    """One sigma of the bias when nothing is known of it."""
    samples: Literal["mean", "instant"] = "mean"
    """A sample is the mean rate since the sample before it, or the rate at its own time."""
    largest_step_s: float | None = Field(default=None, gt=0, le=3600)
    """A longer interval between samples is a gap; None: one and a half times the median step."""

    @model_validator(mode="after")
    def _axes_span_space(self) -> "GyroSettings":
        axes = self._axes_body
        if np.abs(np.linalg.norm(axes, axis=1) - 1.0).max() > AXIS_LENGTH_TOLERANCE:
            raise ValueError("axes: each must be a unit vector")
        if abs(np.linalg.det(axes)) < LEAST_VOLUME:
            raise ValueError("axes: the three must not lie near one plane")
        return self

    @cached_property
    def body_from_gyro(self) -> Matrix:
        """The rates about the body axes are this (3, 3) @ the rates of a sample."""
        return read_only(np.linalg.inv(self._axes_body))

    @property
    def _axes_body(self) -> Matrix:
        """The axes in body components, a row each."""
        return np.array([_vector(axis) for axis in self.axes], np.float64)


class MotionSettings(Strict):
    """How the body moves where there is no gyro: at a constant rate but for a random walk."""

    rate_walk_rad_s1_5: float = Field(default=RATE_WALK_RAD_S1_5, gt=0, le=1)
    """Density of the walk of the rate, rad/s^1.5, about each axis."""
    rate_sigma_rad_s: float = Field(default=RATE_RAD_S, gt=0, le=1)
    """One sigma of the rate when nothing is known of it."""


def _vector(axis: AxisName | Axis) -> Axis:
    if not isinstance(axis, str):
        return axis
    components = [0.0, 0.0, 0.0]
    components["XYZ".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    return components[0], components[1], components[2]


def largest_rate_deg_per_s(gyro: GyroSettings | None) -> float:
    """The largest rate of a mission, which may have no table of its gyro."""
    return LARGEST_RATE_DEG_PER_S if gyro is None else gyro.largest_rate_deg_per_s


class Flip(Strict):
    """A manoeuvre through which no attitude is carried, such as SOHO's turns by 180 deg."""

    start: str
    end: str

    @field_validator("start", "end")
    @classmethod
    def _is_time(cls, text: str) -> str:
        try:
            parse_utc(text)
        except BadInput as error:
            raise ValueError(error.faults[0].message) from None
        return text

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        start_ns, end_ns = self._span_ns
        if end_ns <= start_ns:
            raise ValueError("end: must come after start")
        return self

    def lies_between(self, first: Utc, last: Utc) -> bool:
        """True if the period overlaps that from `first` to `last`."""
        start_ns, end_ns = self._span_ns
        return first.tai_ns < end_ns and start_ns < last.tai_ns

    @cached_property
    def _span_ns(self) -> tuple[int, int]:
        return parse_utc(self.start).tai_ns, parse_utc(self.end).tai_ns


class TrackingSettings(Strict):
    """The prediction of an attitude: how old, how sure, and for which batches."""

    default: bool = False
    """Batches whose `a_priori` is null are tracked as if it were {"from": "last"}."""
    max_age_s: float = Field(default=MAX_AGE_S, gt=0, le=86_400)
    """An older attitude predicts nothing."""
    floor_deg: float = Field(default=FLOOR_DEG, ge=0.001, le=20)
    """A zone reaches beyond the field of view by this at least."""
    ceiling_deg: float = Field(default=CEILING_DEG, ge=0.001, le=60)
    """And by this at most; a prediction of which one sigma is more predicts nothing."""
    body_rate_sigma_deg_per_s: float = Field(default=BODY_RATE_SIGMA_DEG_PER_S, ge=0, le=10)
    """One sigma of the rates that batches carry, about each axis."""
    flips: tuple[Flip, ...] = Field(default=(), max_length=1000)
    """An attitude from before the end of one predicts nothing after its start."""

    @model_validator(mode="after")
    def _floor_below_ceiling(self) -> Self:
        if self.floor_deg > self.ceiling_deg:
            raise ValueError("floor_deg: must not be above ceiling_deg")
        return self


class LiveFilterSettings(Strict):
    """The filter of live data; off where the mission has no such table."""

    every_s: float = Field(default=10.0, ge=0.1, le=3600)
    """Seconds from one look at what was recorded to the next, at least."""


class SmoothingSettings(Strict):
    """When the service makes the definitive attitude by itself."""

    daily: bool = False
    """Each UTC day of live data, two hours and ten minutes after its end."""
