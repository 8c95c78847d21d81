"""Attitudes that a file gives, and the attitude at a moment between them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from service.attitude.rotations import rotation_vectors, turned_quaternion
from service.errors import BadFile, Fault
from service.products.attitudes import SAME_MOMENT_NS, Integers
from service.products.reading.spans import in_order
from service.vectors import Vector

MOST_RECORDS = 5_000_000
"""Attitudes that are held in memory, 40 bytes each."""


CLOCK_NS = 200
"""A time that went through a kernel's clock and ET comes back this near."""


@dataclass(frozen=True)
class Segment:
    """Attitudes between which it may be interpolated; `place` names it in messages.

    They are valid from `first_ns` to `last_ns`; records may lie beyond both.
    """

    place: str
    time_ns: Integers
    """In ascending order; `Utc.tai_ns`."""
    quaternion: Vector
    """Of shape (n, 4), of norm 1."""
    first_ns: int
    last_ns: int

    def at(self, time_ns: Integers) -> Vector:
        """The attitudes (n, 4) at moments (n,); NaN outside the segment.

        Between two records the body turns at a constant rate the shorter way.
        """
        # A kernel's clock may put a record some nanoseconds off its moment.
        moment = time_ns.clip(self.first_ns, self.last_ns)
        inside = np.abs(moment - time_ns) <= SAME_MOMENT_NS
        last = len(self.time_ns) - 1
        after = np.searchsorted(self.time_ns, moment).clip(min(1, last), last)
        before = (after - 1).clip(0)
        step_ns = np.maximum(self.time_ns[after] - self.time_ns[before], 1)
        share = (moment - self.time_ns[before]) / step_ns
        q = between(self.quaternion[before], self.quaternion[after], share)
        # Where a record is, it is given as it stands.
        for place in (before, after):
            is_there = np.abs(self.time_ns[place] - moment) <= CLOCK_NS
            q[is_there] = self.quaternion[place[is_there]]
        q[~inside] = np.nan
        return q


@dataclass(frozen=True)
class KnownAttitudes:
    """What a file says of one object: segments in order of time that do not overlap."""

    object_name: str
    segments: Sequence[Segment]

    def __len__(self) -> int:
        return sum(len(each.time_ns) for each in self.segments)

    def at(self, time_ns: Integers) -> Vector:
        """The attitudes (n, 4) at moments (n,); NaN outside every segment."""
        starts = np.array([each.first_ns for each in self.segments], dtype=np.int64)
        place = np.searchsorted(starts, time_ns + SAME_MOMENT_NS, side="right") - 1
        found = np.full((len(time_ns), 4), np.nan)
        for number in np.unique(place[place >= 0]).tolist():
            chosen = place == number
            found[chosen] = self.segments[number].at(time_ns[chosen])
        return found


def between(first: Vector, second: Vector, share: Vector) -> Vector:
    """The attitudes (n, 4) a share (n,) of the way from some (n, 4) to others, the shorter way."""
    return turned_quaternion(first, rotation_vectors(first, second) * share[:, None])


def known_attitudes(file: str, object_name: str, segments: Sequence[Segment]) -> KnownAttitudes:
    """The attitudes of a file in order of time; see `in_order`."""
    if not segments:
        raise BadFile(Fault(file, "has no attitude"))
    return KnownAttitudes(object_name, in_order(file, segments))
