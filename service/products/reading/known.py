"""Attitudes or orbital states that a file gives in spans of time, and the one at a moment."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, Protocol, TypeVar

import numpy as np

from service.errors import BadFile, Fault
from service.products.attitudes import SAME_MOMENT_NS, Integers
from service.times import Utc
from service.vectors import Vector, rotation_vectors, turned_quaternion

MOST_RECORDS = 5_000_000
"""Attitudes that are held in memory, 40 bytes each."""


CLOCK_NS = 200
"""A time that went through a kernel's clock and ET comes back this near."""


@dataclass(frozen=True)
class Span:
    """Records that are valid from one time to another, `Utc.tai_ns`; some may lie beyond both.

    `place` names the span in messages.  The times of the records ascend.
    """

    place: str
    time_ns: Integers
    first_ns: int
    last_ns: int


@dataclass(frozen=True)
class Segment(Span):
    """Attitudes, quaternions (n, 4) of norm 1, between which it may be interpolated."""

    quaternion: Vector

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
    """The attitudes of one object in a file: segments in order of time that do not overlap."""

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


S = TypeVar("S", bound=Span)


def in_order(file: str, segments: Sequence[S]) -> list[S]:
    """The segments of a file in order of time.

    Raises `BadFile` where one has no useable time, and where two overlap.
    """
    for each in segments:
        if each.first_ns > each.last_ns:
            raise BadFile(Fault(f"{file}, {each.place}", "the segment has no useable time"))
    ordered = sorted(segments, key=lambda each: each.first_ns)
    for one, other in pairwise(ordered):
        if other.first_ns < one.last_ns:
            message = f"overlaps the segment at {one.place}: a time belongs to one segment"
            raise BadFile(Fault(f"{file}, {other.place}", message))
    return ordered


Interpolation = Literal["HERMITE", "LAGRANGE"]


class Ephemeris(Protocol):
    """The motion of one object, as a file describes it."""

    @property
    def object_name(self) -> str:
        """The object."""

    def at(self, moment: Utc) -> Vector | None:
        """The geocentric state (6,) in EME2000, km and km/s; None where the file has none."""


@dataclass(frozen=True)
class StateSegment(Span):
    """States (n, 6), in km and km/s, between which it may be interpolated.

    The polynomial goes through `points` states: HERMITE through their positions and velocities,
    with the velocity as its derivative, LAGRANGE through positions and velocities apart.
    """

    state: Vector
    method: Interpolation
    points: int

    def at(self, time_ns: int) -> Vector | None:
        """The state (6,) at a moment; None outside the segment."""
        if not self.first_ns <= time_ns <= self.last_ns:
            return None
        after = int(np.searchsorted(self.time_ns, time_ns))
        if self.time_ns[after] == time_ns:
            return np.array(self.state[after])
        window = self._window(after, time_ns)
        offset_s = (self.time_ns[window] - time_ns) * 1e-9
        # Steps of about 1: powers of seconds would lose digits.
        unit_s = float(np.ptp(offset_s)) / max(self.points - 1, 1)
        from scipy.interpolate import KroghInterpolator

        place, state = offset_s / unit_s, self.state[window]
        if self.method == "LAGRANGE":
            return np.asarray(KroghInterpolator(place, state)(0.0))
        values = np.stack([state[:, :3], state[:, 3:] * unit_s], axis=1).reshape(-1, 3)
        position, velocity = KroghInterpolator(np.repeat(place, 2), values).derivatives(0.0, 2)
        return np.concatenate([position, velocity / unit_s])

    def _window(self, after: int, time_ns: int) -> slice:
        """The states that the polynomial goes through: as many before the moment as after it.

        Of an odd number the nearest state is in the middle; at the ends of the segment the
        window ends there too.
        """
        first = after - self.points // 2
        nearer_after = 2 * time_ns > self.time_ns[after - 1] + self.time_ns[after]
        if self.points % 2 and not nearer_after:
            first -= 1
        first = min(max(first, 0), len(self.time_ns) - self.points)
        return slice(first, first + self.points)


@dataclass(frozen=True)
class KnownStates:
    """The states of one object in a file: segments in order of time that do not overlap."""

    object_name: str
    segments: Sequence[StateSegment]

    def at(self, moment: Utc) -> Vector | None:
        """The geocentric state (6,) in EME2000, km and km/s; None outside every segment."""
        for each in reversed(self.segments):
            if each.first_ns <= moment.tai_ns:
                return each.at(moment.tai_ns)
        return None


def known_states(file: str, object_name: str, segments: Sequence[StateSegment]) -> KnownStates:
    """The states of a file in order of time; see `in_order`."""
    if not segments:
        raise BadFile(Fault(file, "has no state"))
    return KnownStates(object_name, in_order(file, segments))
