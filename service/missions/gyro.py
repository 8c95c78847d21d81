"""The gyro of a mission: its axes, its noise, and the largest rate that it is believed.

Also how the body moves where there is no gyro.
"""

from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from service.missions.strict import Strict
from service.vectors import Matrix, read_only

LARGEST_RATE_DEG_PER_S = 10.0
"""Where a mission names no other: star trackers do not follow faster motion."""
FIRST_BIAS_RAD_S = 5e-5
"""One sigma of a gyro's bias when nothing is known of it: 10 deg/h."""
RATE_WALK_RAD_S1_5 = 3e-4
"""Where a mission names no other: within minutes a body may begin or end a slew."""
RATE_RAD_S = 2e-3
"""One sigma of the rate of a body when nothing is known of it: 0.1 deg/s."""
UNIT_TOLERANCE, LEAST_VOLUME = 1e-3, 0.1

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
        if np.abs(np.linalg.norm(axes, axis=1) - 1.0).max() > UNIT_TOLERANCE:
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
