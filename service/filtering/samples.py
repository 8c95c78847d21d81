"""What the filter is given: gyro samples, measured attitudes, single directions.

Times are nanoseconds of TAI as `Utc.tai_ns`.  Every constructor raises `BadInput`
with the field, the row and the value of the first fault.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault, shown_value
from service.filtering.gyro import GyroModel
from service.vectors import Vector, read_only

Times = npt.NDArray[np.int64]
UNIT_TOLERANCE = 1e-6
LARGEST_SIGMA_RAD = 1.0


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
