"""Output types of the attitude filter and smoother, and the state to continue from."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from service.attitude.definitive import Integers, Outcome, Status
from service.errors import BadInput, Fault
from service.vectors import Vector, read_only

T = TypeVar("T", "AttitudeHistory", "Innovations", "Steps")


@dataclass(frozen=True, eq=False)
class FilterState:
    """State of the filter at an epoch; filtering on from it gives the same bytes.

    `tai_ns` is the time as `Utc.tai_ns`, `quaternion` (4,) inertial to body, `bias_rad_s` (3,) the
    gyro's, `covariance` (6, 6) of attitude error (rad, about the body axes) and bias (rad/s),
    without the part due to a doubt.  `rate_rad_s` (3,) is the last measured rate, `anchor_rad_s`
    (3,) the rate at its last clear change.  `rival` (4,) is the mean of the attitudes that rejected
    measurements indicate during a doubt.

    `redundancy` is the support by measurements since the start (see `FilterSettings`), up to a
    limit; `rejected` counts those rejected in a row, `agreed` those accepted since then,
    `rejected_since_ns` and `doubt_rad` are the time and the largest angle of the rejections.
    `after_gap` is true from a gap of the gyro until the next accepted measurement.
    """

    tai_ns: int
    quaternion: Vector
    bias_rad_s: Vector
    covariance: Vector
    rate_rad_s: Vector
    anchor_rad_s: Vector
    rival: Vector
    status: Status
    redundancy: float = 0.0
    rejected: int = 0
    agreed: int = 0
    rejected_since_ns: int = 0
    doubt_rad: float = 0.0
    after_gap: bool = False

    def as_record(self) -> dict[str, Any]:
        """Filter state as numbers and lists for JSON, without loss of digits."""
        return {
            each.name: value.tolist() if isinstance(value, np.ndarray) else value
            for each in fields(self)
            for value in [getattr(self, each.name)]
        } | {"status": self.status.name}

    @staticmethod
    def from_record(record: dict[str, Any]) -> "FilterState":
        """Filter state from the record made by `as_record`."""
        values: dict[str, Any] = {
            name: read_only(np.array(value, dtype=np.float64)) if isinstance(value, list) else value
            for name, value in record.items()
        }
        return FilterState(**{**values, "status": Status[record["status"]]})


@dataclass(frozen=True, eq=False)
class Innovations:
    """Innovations of m measurements in the filter, in order of time.

    `kind` (m,) is `updates.ATTITUDE` or `DIRECTION`, `row` (m,) the row in the input of that kind,
    `outcome` (m,) an `Outcome`.  `innovation_rad` (m, 3) with `covariance_rad2` (m, 3, 3) is the
    rotation about the body axes from prediction to measurement; a direction has two components
    across it.  `nis` (m,) is z^T S^-1 z.  Missing values are NaN: the third component of a
    direction, and measurements without a prediction.
    """

    tai_ns: Integers
    kind: Integers
    row: Integers
    innovation_rad: Vector
    covariance_rad2: Vector
    nis: Vector
    outcome: Integers

    @property
    def degrees(self) -> Integers:
        """Degrees of freedom (m,) of the chi-square of each innovation."""
        return np.where(self.kind == 0, 3, 2)

    @property
    def accepted(self) -> npt.NDArray[np.bool_]:
        """Mask (m,) of accepted measurements."""
        return np.asarray(self.outcome == Outcome.ACCEPTED)

    def counts(self) -> dict[str, int]:
        """Number of measurements with each outcome, by its lower-case name."""
        return {each.name.lower(): int(np.sum(self.outcome == each)) for each in Outcome}


@dataclass(frozen=True, eq=False)
class AttitudeHistory:
    """Filtered or smoothed attitudes at n epochs.

    `tai_ns` (n,), `quaternion` (n, 4) inertial to body, `rate_rad_s` (n, 3) of the body in the step
    that ends at the epoch, `bias_rad_s` (n, 3) of the gyro, `status` (n,) a `Status`.
    `model_covariance` (n, 6, 6) of attitude error (rad, body axes) and bias (rad/s) follows from
    the model; `doubt_rad` (n,) is a further error of the attitude that contradicting measurements
    indicate.  With status NONE all values are NaN.
    """

    tai_ns: Integers
    quaternion: Vector
    rate_rad_s: Vector
    bias_rad_s: Vector
    model_covariance: Vector
    doubt_rad: Vector
    status: Integers

    @property
    def covariance(self) -> Vector:
        """Covariance (n, 6, 6) including doubts, each as one more sigma about every axis."""
        full = self.model_covariance.copy()
        axes = np.arange(3)
        full[:, axes, axes] += self.doubt_rad[:, None] ** 2
        return full

    @property
    def good(self) -> npt.NDArray[np.bool_]:
        """Mask (n,) of epochs with status GOOD."""
        return np.asarray(self.status == Status.GOOD)


@dataclass(frozen=True, eq=False)
class Steps:
    """Data of the steps to n epochs that the smoother needs; see `propagation.Timeline`.

    `started` (n,) is true where the state was replaced, `updated` (n,) nonzero there and where a
    measurement was accepted (see `forward.Epochs`); `shift` (n, 3) was added to the variance of the
    bias before the step.
    """

    step_s: Vector
    measured_rate_rad_s: Vector
    gap_s: Vector
    started: npt.NDArray[np.bool_]
    updated: Integers
    shift: Vector


@dataclass(frozen=True, eq=False)
class FilterResult:
    """Result of the filter: attitudes, outcomes of measurements, and the final state.

    `outside` counts unprocessed measurements before the first gyro sample or after the last: the
    latter belong to the next interval.
    """

    history: AttitudeHistory
    innovations: Innovations
    steps: Steps
    state: FilterState
    outside: int

    @property
    def starts(self) -> int:
        """Number of starts of the filter from a measured attitude, the first included."""
        return int(np.sum(self.innovations.outcome == Outcome.STARTED))


def joined(results: Sequence[FilterResult]) -> FilterResult:
    """Join consecutive filter results, each filtered from the final state of the one before.

    The row numbers of innovations stay relative to each part.  Raises `BadInput` without any
    result, and for epochs out of order.
    """
    if not results:
        raise BadInput(Fault("results", "must be at least one"))
    history = _joined([each.history for each in results])
    if np.any(np.diff(history.tai_ns) < 0):
        raise BadInput(Fault("results", "must be in order of time"))
    return replace(
        results[-1],
        history=history,
        innovations=_joined([each.innovations for each in results]),
        steps=_joined([each.steps for each in results]),
        outside=sum(each.outside for each in results),
    )


def _joined(parts: Sequence[T]) -> T:
    """Concatenate records of arrays field by field."""
    names = [each.name for each in fields(parts[0])]
    # Read-only as in each part: the smoother would be compiled once more for other arrays.
    joined = {
        name: read_only(np.concatenate([getattr(part, name) for part in parts])) for name in names
    }
    return type(parts[0])(**joined)
