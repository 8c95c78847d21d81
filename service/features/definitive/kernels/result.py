"""What the filter and the smoother give, and the state carried from one stretch to the next."""

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
    """All that filtering needs of the past: filtering on from here gives the same bytes.

    `tai_ns` is the moment as `Utc.tai_ns`, `quaternion` (4,) inertial to body,
    `bias_rad_s` (3,) that of the gyro, `covariance` (6, 6) of attitude error (rad, about
    the body axes) and bias (rad/s), without what a doubt adds.  `rate_rad_s` (3,) is
    the last measured rate, `anchor_rad_s` (3,) that at its last clear change.  `rival`
    (4,) is the mean attitude that the rejected measurements say, where there is a doubt.

    `redundancy` is how far the measurements since the start support it (see
    `FilterSettings`), up to where more make no difference; `rejected` counts those rejected
    in a row, `agreed` those accepted since then, `rejected_since_ns` and `doubt_rad` say
    when that began and how far off they were.  `after_gap` is true from a gap of the gyro until
    the next accepted measurement.
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
        """The state as numbers and lists, for JSON, which keeps every bit of them."""
        return {
            each.name: value.tolist() if isinstance(value, np.ndarray) else value
            for each in fields(self)
            for value in [getattr(self, each.name)]
        } | {"status": self.status.name}

    @staticmethod
    def from_record(record: dict[str, Any]) -> "FilterState":
        """The state of a record that `as_record` made."""
        values: dict[str, Any] = {
            name: read_only(np.array(value, dtype=np.float64)) if isinstance(value, list) else value
            for name, value in record.items()
        }
        return FilterState(**{**values, "status": Status[record["status"]]})


@dataclass(frozen=True, eq=False)
class Innovations:
    """How m measurements met the prediction, in order of time.

    `kind` (m,) is `updates.ATTITUDE` or `DIRECTION`, `row` (m,) the row among those given
    of that kind, `outcome` (m,) an `Outcome`.  `innovation_rad` (m, 3) with its
    `covariance_rad2` (m, 3, 3) is the rotation about the body axes from prediction to
    measurement; a direction has two components across it.  `nis` (m,) is z^T S^-1 z.
    All three are NaN where there is none: beyond the second component, or where a
    measurement met no prediction.
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
        """Degrees of freedom (m,) of each `nis`."""
        return np.where(self.kind == 0, 3, 2)

    @property
    def accepted(self) -> npt.NDArray[np.bool_]:
        """Which were accepted (m,)."""
        return np.asarray(self.outcome == Outcome.ACCEPTED)

    def counts(self) -> dict[str, int]:
        """How many had each outcome, by its name in small letters."""
        return {each.name.lower(): int(np.sum(self.outcome == each)) for each in Outcome}


@dataclass(frozen=True, eq=False)
class AttitudeHistory:
    """Attitudes at n epochs, filtered or smoothed.

    `tai_ns` (n,), `quaternion` (n, 4) inertial to body, `rate_rad_s` (n, 3) of the body
    in the step that ends at the epoch, `bias_rad_s` (n, 3) of the gyro, `status` (n,) a
    `Status`.  `model_covariance` (n, 6, 6) of attitude error (rad, body axes) and bias
    (rad/s) is what the model says; `doubt_rad` (n,) is how far the attitude may be off
    beyond that, because measurements contradict it.  Where the status is NONE all are NaN.
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
        """The covariance (n, 6, 6) to be relied on: a doubt is one more sigma about each axis."""
        full = self.model_covariance.copy()
        axes = np.arange(3)
        full[:, axes, axes] += self.doubt_rad[:, None] ** 2
        return full

    @property
    def good(self) -> npt.NDArray[np.bool_]:
        """True for each sample (n,) whose attitude is GOOD."""
        return np.asarray(self.status == Status.GOOD)


@dataclass(frozen=True, eq=False)
class Steps:
    """What the smoother needs of the steps to n epochs: see `propagation.Timeline`.

    `started` (n,) says where the state was replaced and `updated` (n,) where it was, or a
    measurement was accepted (see `forward.Epochs`); `shift` (n, 3) was added to the variance of
    the bias before the step.
    """

    step_s: Vector
    measured_rate_rad_s: Vector
    gap_s: Vector
    started: npt.NDArray[np.bool_]
    updated: Integers
    shift: Vector


@dataclass(frozen=True, eq=False)
class FilterResult:
    """The filtered attitudes, what became of the measurements, and the state at the end.

    `outside` counts measurements that were not processed because they are before the
    first gyro sample or after the last: those after it belong to the next stretch.
    """

    history: AttitudeHistory
    innovations: Innovations
    steps: Steps
    state: FilterState
    outside: int

    @property
    def starts(self) -> int:
        """How often the attitude was replaced by a measured one, the first time included."""
        return int(np.sum(self.innovations.outcome == Outcome.STARTED))


def joined(results: Sequence[FilterResult]) -> FilterResult:
    """Consecutive results, each filtered from the state of the one before, as one.

    The rows of the innovations stay those of each part.  Raises `BadInput` where
    there is none, or the epochs are not in order.
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
    """Records of arrays, one after the other."""
    names = [each.name for each in fields(parts[0])]
    # Read-only as in each part: the smoother would be compiled once more for other arrays.
    joined = {
        name: read_only(np.concatenate([getattr(part, name) for part in parts])) for name in names
    }
    return type(parts[0])(**joined)
