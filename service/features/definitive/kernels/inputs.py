"""Input types of the attitude filter: settings, constant-rate model, measurements.

Times are nanoseconds of TAI as `Utc.tai_ns`.  Constructors raise `BadInput` naming fields and
values at fault; for samples and measurements the field, row and value of the first fault.
"""

import math
from dataclasses import dataclass

import numpy as np

from service.errors import BadInput, Fault, shown_value
from service.gyro.samples import GyroModel, Times, refuse_rows, set_times, set_values
from service.missions.motion import RATE_RAD_S
from service.vectors import Vector

UNIT_TOLERANCE = 1e-6
LARGEST_SIGMA_RAD = 1.0


@dataclass(frozen=True)
class ConstantRateModel:
    """Model of rotation without a gyro: a body rate that is constant except for a random walk.

    `rate_walk_rad_s1_5` is the density of the random walk in rad/s^1.5, `rate_sigma_rad_s` one
    sigma of the unknown initial rate.

    The filter then runs with a measured rate of zero, so that **the bias is minus the rate**:
    w_true = 0 - b.  A body that turns far between measurements seems to turn slower, or not at all.
    For such a body the rates sent with its measurements can be passed as gyro samples; the bias is
    then their error, `rate_sigma_rad_s` one sigma of it, and `angle_walk_rad_s0_5` the density of
    their other errors in rad/s^.5.
    """

    rate_walk_rad_s1_5: float
    rate_sigma_rad_s: float = RATE_RAD_S
    angle_walk_rad_s0_5: float = 0.0

    def as_gyro(self) -> GyroModel:
        """Equivalent gyro model without gaps: always reads zero, its bias is minus the rate."""
        return GyroModel(
            sigma_v_rad_s0_5=self.angle_walk_rad_s0_5,
            sigma_u_rad_s1_5=self.rate_walk_rad_s1_5,
            bias_sigma_rad_s=self.rate_sigma_rad_s,
            largest_step_s=1e6,
        )


@dataclass(frozen=True)
class FilterSettings:
    """Thresholds of the filter for rejecting measurements, for starts, doubts and resets.

    A measurement is rejected if the chi-square of its innovation has a probability below
    `gate_tail`.  A start is confirmed once the redundancy numbers of the measurements accepted
    since, each a measure of how well the filter predicted one, add up to `start_redundancy`: about
    four measurements with a known bias, six otherwise; at a constant rate each counts one.  Until
    then predicted attitudes are tested with `start_gate_tail`, and a rejected one restarts the
    filter. `confirmations` accepted measurements in a row end a doubt.  After `reset_after_s` with
    every measurement rejected the filter drops its attitude and starts from the measurements: the
    default is longer than the hour for which a tracker may hold on to wrong stars.  A young
    attitude is dropped as soon as more measurements in a row reject it than its redundancy.  The
    first measurement accepted after a gyro gap multiplies the sum by its own redundancy number.  An
    attitude with an axis worse than `lost_rad` is lost: the next measured one replaces it.
    """

    gate_tail: float = 1e-4
    start_gate_tail: float = 1e-3
    start_redundancy: float = 2.0
    confirmations: int = 3
    reset_after_s: float = 7200.0
    lost_rad: float = math.radians(17.0)

    def __post_init__(self) -> None:
        limits = {
            "gate_tail": (self.gate_tail, 1e-12, 0.5),
            "start_gate_tail": (self.start_gate_tail, 1e-12, 0.5),
            "start_redundancy": (self.start_redundancy, 0.0, 1000.0),
            "confirmations": (self.confirmations, 1, 1000),
            "reset_after_s": (self.reset_after_s, 0.0, 1e7),
            "lost_rad": (self.lost_rad, 1e-6, 1.0),
        }
        faults = [
            Fault(f"filter.{name}", f"must be from {least:g} to {most:g}", shown_value(value))
            for name, (value, least, most) in limits.items()
            if not least <= value <= most
        ]
        if faults:
            raise BadInput(faults)


@dataclass(frozen=True, eq=False)
class AttitudeMeasurements:
    """Array of n measured attitudes; `quaternion` (n, 4) is inertial to body.

    `covariance_rad2` (n, 3, 3) is of the small rotation about the body axes.  Equal times are
    allowed, as from several trackers.
    """

    tai_ns: Times
    quaternion: Vector
    covariance_rad2: Vector

    def __post_init__(self) -> None:
        name = "attitudes"
        set_times(self, name)
        set_values(self, name, "quaternion", (4,))
        set_values(self, name, "covariance_rad2", (3, 3))
        _check_units(name, "quaternion", self.quaternion)
        p = self.covariance_rad2
        largest = np.abs(p).max(axis=(1, 2), initial=0.0)
        apart = np.abs(p - p.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
        field = f"{name}.covariance_rad2"
        refuse_rows(field, apart > 1e-9 * largest, "must be symmetric", p)
        eigenvalues = np.linalg.eigvalsh(p)
        refuse_rows(field, eigenvalues[:, 0] <= 1e-12 * largest, "must be positive definite", p)
        most = LARGEST_SIGMA_RAD**2
        refuse_rows(
            field, eigenvalues[:, 2] > most, f"must be at most {most:g} rad2 about each axis", p
        )


@dataclass(frozen=True, eq=False)
class DirectionMeasurements:
    """Array of n measured star directions, used if a batch does not determine an attitude.

    `body` (n, 3) are observed unit vectors in body axes, `inertial` (n, 3) the catalog's,
    `sigma_rad` (n,) one sigma in each of the two axes across.
    """

    tai_ns: Times
    body: Vector
    inertial: Vector
    sigma_rad: Vector

    def __post_init__(self) -> None:
        name = "directions"
        set_times(self, name)
        for field in ("body", "inertial"):
            set_values(self, name, field, (3,))
            _check_units(name, field, getattr(self, field))
        set_values(self, name, "sigma_rad", ())
        wrong = ~((self.sigma_rad > 0.0) & (self.sigma_rad <= LARGEST_SIGMA_RAD))
        expected = f"must be more than 0 and at most {LARGEST_SIGMA_RAD:g} rad"
        refuse_rows(f"{name}.sigma_rad", wrong, expected, self.sigma_rad)


def no_attitudes() -> AttitudeMeasurements:
    """An empty array of measured attitudes."""
    return AttitudeMeasurements(np.zeros(0, dtype=np.int64), np.zeros((0, 4)), np.zeros((0, 3, 3)))


def no_directions() -> DirectionMeasurements:
    """An empty array of measured directions."""
    empty = np.zeros((0, 3))
    return DirectionMeasurements(np.zeros(0, dtype=np.int64), empty, empty, np.zeros(0))


def _check_units(name: str, field: str, vectors: Vector) -> None:
    off = np.abs(np.linalg.norm(vectors, axis=1) - 1.0) > UNIT_TOLERANCE
    refuse_rows(f"{name}.{field}", off, "must have length 1", vectors)
