"""What the filter carries from one stretch to the next."""

from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any

import numpy as np

from service.vectors import Vector, read_only


class Status(IntEnum):
    """What an attitude is worth.

    NONE: no attitude was measured yet.  STARTING: started, and not yet confirmed by
    further measurements.  GOOD.  DOUBTFUL: the last measurements contradict the
    attitude, and one of both is wrong.  LOST: too long without measurements.
    """

    NONE = 0
    STARTING = 1
    GOOD = 2
    DOUBTFUL = 3
    LOST = 4


class Outcome(IntEnum):
    """What became of a measurement.

    UNUSED: a direction where there was no attitude.  UNDECIDED: it agrees with the attitude
    and with the one that contradicted it, and was not used either.
    """

    UNUSED = 0
    ACCEPTED = 1
    REJECTED = 2
    STARTED = 3
    UNDECIDED = 4


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
