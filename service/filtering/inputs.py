"""What the filter is given: models of the motion, settings, gyro samples and measurements.

The gyro gives w_measured = (I + M) w_true + b + n_v, db/dt = n_u, in body axes
(Farrenkopf's model).  n_v and n_u are white with densities sigma_v^2 and
sigma_u^2; M holds small constant errors of scale (its diagonal) and of alignment.

Times are nanoseconds of TAI as `Utc.tai_ns`.  Constructors raise `BadInput` naming the
fields and values at fault; of samples and measurements the field, the row and the value of
the first fault.
"""

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault, shown_value
from service.missions.motion import FIRST_BIAS_RAD_S, LARGEST_RATE_DEG_PER_S, RATE_RAD_S
from service.vectors import Vector, read_only

Times = npt.NDArray[np.int64]
UNIT_TOLERANCE = 1e-6
LARGEST_SIGMA_RAD = 1.0


@dataclass(frozen=True)
class GyroModel:
    """One sigma of each error of a gyro, the same for its three axes.

    `sigma_v_rad_s0_5` is the angle random walk in rad/s^.5, `sigma_u_rad_s1_5`
    the walk of the bias in rad/s^1.5, `bias_sigma_rad_s` the bias when nothing is
    known of it.  `scale` and `misalignment_rad` are the errors that calibration
    left: as M is constant, they shift the bias where the rate changes, and the
    filter widens the bias there.

    An interval between samples longer than `largest_step_s` is a gap: the rate is
    taken from the samples on both sides, as a random walk of `coast_rad_s1_5`, and
    the clock may have stepped by `clock_step_s`.  Samples beyond
    `largest_rate_rad_s` are refused.

    Quantisation of the angle is not modelled: it has to be small beside the trackers' noise.
    """

    sigma_v_rad_s0_5: float
    sigma_u_rad_s1_5: float
    bias_sigma_rad_s: float = FIRST_BIAS_RAD_S
    scale: float = 0.0
    misalignment_rad: float = 0.0
    largest_step_s: float = 1.5
    largest_rate_rad_s: float = math.radians(LARGEST_RATE_DEG_PER_S)
    coast_rad_s1_5: float = 1e-4
    clock_step_s: float = 1.0

    def __post_init__(self) -> None:
        faults = [
            Fault(f"gyro.{each.name}", "must be a number from 0 to 1e6", shown_value(value))
            for each in fields(self)
            if not 0.0 <= (value := getattr(self, each.name)) <= 1e6
        ]
        if not faults and self.largest_step_s == 0.0:
            faults.append(Fault("gyro.largest_step_s", "must be more than 0", "0.0"))
        if faults:
            raise BadInput(faults)


@dataclass(frozen=True)
class ConstantRateModel:
    """Motion without a gyro: the rate in body axes is constant but for a random walk.

    `rate_walk_rad_s1_5` is the density of that walk in rad/s^1.5, `rate_sigma_rad_s`
    one sigma of the rate when nothing is known of it.

    The filter then runs with a measured rate of zero, so that **the bias is minus the
    rate**: w_true = 0 - b.  A body that turns far from one measurement to the next looks
    slower than it is, or still.  Of such a body the rates that came with its measurements
    can be given as samples; the bias is then what they are off, `rate_sigma_rad_s` one sigma
    of it, and `angle_walk_rad_s0_5` the density of their other errors in rad/s^.5.
    """

    rate_walk_rad_s1_5: float
    rate_sigma_rad_s: float = RATE_RAD_S
    angle_walk_rad_s0_5: float = 0.0

    def as_gyro(self) -> GyroModel:
        """The gyro that always reads zero and whose bias is minus the rate; it has no gaps."""
        return GyroModel(
            sigma_v_rad_s0_5=self.angle_walk_rad_s0_5,
            sigma_u_rad_s1_5=self.rate_walk_rad_s1_5,
            bias_sigma_rad_s=self.rate_sigma_rad_s,
            largest_step_s=1e6,
        )


@dataclass(frozen=True)
class FilterSettings:
    """When the filter rejects a measurement, and what it does when it rejects all of them.

    A measurement is rejected where chi-square passes its innovation with a
    probability below `gate_tail`.  A start is confirmed once the redundancy numbers of the
    measurements accepted since, each of which says how well the filter predicted one, add
    up to `start_redundancy`: about four measurements where the bias is known, six where
    it is not; at a constant rate each counts one.  Until then the gate of attitudes that
    were predicted is `start_gate_tail`, and one that is rejected starts the filter anew.
    `confirmations` accepted measurements in a row end a doubt.  After `reset_after_s` in
    which everything was rejected the filter gives up its own attitude and starts from the
    measurements: the default is longer than the hour for which a tracker may hold on to
    wrong stars.  A young attitude is given up as soon as more reject it in a row than its
    redundancy.  The first measurement accepted after a gap of the gyro multiplies the sum by
    its own redundancy number.
    An attitude with an axis worse than `lost_rad` is lost: the next one measured replaces it.
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
class GyroSamples:
    """n samples of a gyro: `rate_rad_s` (n, 3) is the mean rate since the sample before.

    Rates are about the body axes, times strictly increasing.
    """

    tai_ns: Times
    rate_rad_s: Vector

    def __post_init__(self) -> None:
        _set_times(self, "gyro", strictly=True)
        _set(self, "gyro", "rate_rad_s", (3,))

    def check(self, model: GyroModel) -> None:
        """Raise `BadInput` where a rate is beyond what the gyro can measure."""
        beyond = np.abs(self.rate_rad_s) > model.largest_rate_rad_s
        _refuse(
            "gyro.rate_rad_s",
            beyond.any(axis=1),
            f"must be at most {model.largest_rate_rad_s:g} rad/s in each axis; is it in deg/s?",
            self.rate_rad_s,
        )


@dataclass(frozen=True, eq=False)
class AttitudeMeasurements:
    """n measured attitudes: `quaternion` (n, 4), inertial to body.

    `covariance_rad2` (n, 3, 3) is of the small rotation about the body axes.  Equal times
    are allowed, as of several trackers.
    """

    tai_ns: Times
    quaternion: Vector
    covariance_rad2: Vector

    def __post_init__(self) -> None:
        name = "attitudes"
        _set_times(self, name)
        _set(self, name, "quaternion", (4,))
        _set(self, name, "covariance_rad2", (3, 3))
        _check_units(name, "quaternion", self.quaternion)
        p = self.covariance_rad2
        largest = np.abs(p).max(axis=(1, 2), initial=0.0)
        apart = np.abs(p - p.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
        field = f"{name}.covariance_rad2"
        _refuse(field, apart > 1e-9 * largest, "must be symmetric", p)
        eigenvalues = np.linalg.eigvalsh(p)
        _refuse(field, eigenvalues[:, 0] <= 1e-12 * largest, "must be positive definite", p)
        most = LARGEST_SIGMA_RAD**2
        _refuse(
            field, eigenvalues[:, 2] > most, f"must be at most {most:g} rad2 about each axis", p
        )


@dataclass(frozen=True, eq=False)
class DirectionMeasurements:
    """n directions, for moments at which no attitude is unique.

    `body` (n, 3) are observed unit vectors in body axes, `inertial` (n, 3) those of
    the catalog, `sigma_rad` (n,) one sigma in each of the two axes across.
    """

    tai_ns: Times
    body: Vector
    inertial: Vector
    sigma_rad: Vector

    def __post_init__(self) -> None:
        name = "directions"
        _set_times(self, name)
        for field in ("body", "inertial"):
            _set(self, name, field, (3,))
            _check_units(name, field, getattr(self, field))
        _set(self, name, "sigma_rad", ())
        wrong = ~((self.sigma_rad > 0.0) & (self.sigma_rad <= LARGEST_SIGMA_RAD))
        expected = f"must be more than 0 and at most {LARGEST_SIGMA_RAD:g} rad"
        _refuse(f"{name}.sigma_rad", wrong, expected, self.sigma_rad)


def no_attitudes() -> AttitudeMeasurements:
    """No measured attitude at all."""
    return AttitudeMeasurements(np.zeros(0, dtype=np.int64), np.zeros((0, 4)), np.zeros((0, 3, 3)))


def no_directions() -> DirectionMeasurements:
    """No measured direction at all."""
    empty = np.zeros((0, 3))
    return DirectionMeasurements(np.zeros(0, dtype=np.int64), empty, empty, np.zeros(0))


def _set_times(record: Any, name: str, strictly: bool = False) -> None:
    times = np.asarray(record.tai_ns)
    field = f"{name}.tai_ns"
    if times.ndim != 1 or times.dtype.kind not in "iu":
        expected = "must be whole nanoseconds in an array of one dimension"
        raise BadInput(Fault(field, expected, f"{times.dtype} of shape {times.shape}"))
    times = times.astype(np.int64)
    steps = np.diff(times)
    wrong = np.append(False, steps <= 0 if strictly else steps < 0)[: len(times)]
    later = "later than" if strictly else "no earlier than"
    _refuse(field, wrong, f"must be {later} the one before", times)
    object.__setattr__(record, "tai_ns", read_only(times))


def _set(record: Any, name: str, field: str, shape: tuple[int, ...]) -> None:
    """Keep a copy of an array, checked for shape and for numbers."""
    shown, expected = f"{name}.{field}", (len(record.tai_ns), *shape)
    try:
        values = np.array(getattr(record, field), dtype=np.float64)
    except (TypeError, ValueError):
        raise BadInput(Fault(shown, "must be an array of numbers")) from None
    if values.shape != expected:
        raise BadInput(Fault(shown, f"must have the shape {expected}", str(values.shape)))
    bad = ~np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    _refuse(shown, bad, "must be finite numbers", values)
    object.__setattr__(record, field, read_only(values))


def _check_units(name: str, field: str, vectors: Vector) -> None:
    off = np.abs(np.linalg.norm(vectors, axis=1) - 1.0) > UNIT_TOLERANCE
    _refuse(f"{name}.{field}", off, "must have length 1", vectors)


def _refuse(field: str, wrong: npt.ArrayLike, expected: str, values: npt.NDArray[Any]) -> None:
    """Raise for the first row that is wrong, and say how many there are."""
    rows = np.flatnonzero(wrong)
    if len(rows):
        more = f"; {len(rows)} rows in all" if len(rows) > 1 else ""
        row = int(rows[0])
        value = shown_value(values[row].tolist())
        raise BadInput(Fault(f"{field}[{row}]", f"{expected}{more}", value))
