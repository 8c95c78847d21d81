"""A mission's settings for the attitude over time: gyro, motion, prediction, filter, smoothing.

The gyro's axes, its noise, and the largest credible rate; the model of motion without a gyro; and
the prediction of a batch's attitude from the last good one.
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
"""Default of a mission's largest body rate: star trackers do not follow faster motion."""
FIRST_BIAS_RAD_S = 5e-5
"""One sigma of the initial uncertainty of a gyro's bias: 10 deg/h."""
RATE_WALK_RAD_S1_5 = 3e-4
"""Default random walk of the body's rate, large enough for slews that begin within minutes."""
RATE_RAD_S = 2e-3
"""One sigma of the initial uncertainty of a body's rate: 0.1 deg/s."""
FLOOR_DEG, CEILING_DEG = 0.1, 3.0
MAX_AGE_S = 3600.0
BODY_RATE_SIGMA_DEG_PER_S = 0.001
"""Default sigma of the body rates sent with batches, deg/s."""
AXIS_LENGTH_TOLERANCE, LEAST_VOLUME = 1e-3, 0.1

AxisName = Literal["X", "Y", "Z", "-X", "-Y", "-Z"]
Axis = tuple[float, float, float]


class GyroSettings(Strict):
    """The fixed properties of a gyro; the noise is the same for its three axes."""

    axes: tuple[AxisName, AxisName, AxisName] | tuple[Axis, Axis, Axis] = ("X", "Y", "Z")
    """The axes of a sample's three rates: body axes by name, or unit vectors in body components,
    not necessarily at right angles.
    """
    sigma_v_rad_s0_5: float = Field(ge=0, le=1)
    """Angle random walk of a gyro, rad/s^.5 (Farrenkopf's sigma_v)."""
    sigma_u_rad_s1_5: float = Field(ge=0, le=1)
    """Random walk of a gyro's bias, rad/s^1.5 (Farrenkopf's sigma_u)."""
    scale: float = Field(default=0.0, ge=0, le=0.1)
    """One sigma of a gyro's scale factor error after calibration; .001 is 0.1 %."""
    misalignment_arcsec: float = Field(default=0.0, ge=0, le=36_000)
    """One sigma of the misalignment of a gyro's axis after calibration, arcsec."""
    largest_rate_deg_per_s: Annotated[float, Field(gt=0, le=360)] = LARGEST_RATE_DEG_PER_S
    """Largest credible rate about an axis; a block with a larger one is refused."""
    bias_sigma_rad_s: float = Field(default=FIRST_BIAS_RAD_S, gt=0, le=1)
    """One sigma of the initial uncertainty of a gyro's bias, rad/s."""
    samples: Literal["mean", "instant"] = "mean"
    """Meaning of a gyro sample: the mean rate since the previous one, or the rate at its time."""
    largest_step_s: float | None = Field(default=None, gt=0, le=3600)
    """Longest interval between gyro samples that is no gap; None: 1.5 times the median step."""

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
        """Matrix (3, 3) that turns the rates of a gyro sample into rates about the body axes."""
        return read_only(np.linalg.inv(self._axes_body))

    @property
    def _axes_body(self) -> Matrix:
        """The gyro's axes in body components, one per row."""
        return np.array([_vector(axis) for axis in self.axes], np.float64)


class MotionSettings(Strict):
    """The model of the body's motion without a gyro: a constant rate with a random walk."""

    rate_walk_rad_s1_5: float = Field(default=RATE_WALK_RAD_S1_5, gt=0, le=1)
    """Random walk density of the body's rate about each axis, rad/s^1.5."""
    rate_sigma_rad_s: float = Field(default=RATE_RAD_S, gt=0, le=1)
    """One sigma of the initial uncertainty of the body's rate, rad/s."""


def _vector(axis: AxisName | Axis) -> Axis:
    if not isinstance(axis, str):
        return axis
    components = [0.0, 0.0, 0.0]
    components["XYZ".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    return components[0], components[1], components[2]


def largest_rate_deg_per_s(gyro: GyroSettings | None) -> float:
    """The largest credible body rate of a mission, with or without gyro settings."""
    return LARGEST_RATE_DEG_PER_S if gyro is None else gyro.largest_rate_deg_per_s


class Flip(Strict):
    """A manoeuvre, such as SOHO's turns by 180 deg, across which no attitude is predicted."""

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
        """True if the manoeuvre overlaps the period from `first` to `last`."""
        start_ns, end_ns = self._span_ns
        return first.tai_ns < end_ns and start_ns < last.tai_ns

    @cached_property
    def _span_ns(self) -> tuple[int, int]:
        return parse_utc(self.start).tai_ns, parse_utc(self.end).tai_ns


class TrackingSettings(Strict):
    """Settings for the prediction of attitudes: largest age, zone sizes, and affected batches."""

    default: bool = False
    """True if batches with a null `a_priori` are treated as {"from": "last"}."""
    max_age_s: float = Field(default=MAX_AGE_S, gt=0, le=86_400)
    """Largest age in seconds of an attitude from which another is predicted."""
    floor_deg: float = Field(default=FLOOR_DEG, ge=0.001, le=20)
    """Least margin of a predicted zone beyond the field of view, in degrees."""
    ceiling_deg: float = Field(default=CEILING_DEG, ge=0.001, le=60)
    """Largest margin of a predicted zone, in degrees; no prediction is used with a larger sigma."""
    body_rate_sigma_deg_per_s: float = Field(default=BODY_RATE_SIGMA_DEG_PER_S, ge=0, le=10)
    """One sigma of the body rates sent with batches, about each axis."""
    flips: tuple[Flip, ...] = Field(default=(), max_length=1000)
    """Manoeuvres after whose start no earlier attitude predicts a later one."""

    @model_validator(mode="after")
    def _floor_below_ceiling(self) -> Self:
        if self.floor_deg > self.ceiling_deg:
            raise ValueError("floor_deg: must not be above ceiling_deg")
        return self


class LiveFilterSettings(Strict):
    """Settings of the attitude filter of live data; without them the filter is off."""

    every_s: float = Field(default=10.0, ge=0.1, le=3600)
    """Least seconds between two updates of the live filter."""


class SmoothingSettings(Strict):
    """Settings for the automatic smoothing of the definitive attitude."""

    daily: bool = False
    """True if each UTC day of live data is smoothed, two hours and ten minutes after its end."""
