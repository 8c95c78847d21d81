"""Attitudes or orbital states from a file, interpolated at a given time."""

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, Protocol, Self, TypeVar

import numpy as np
import numpy.typing as npt

from service.ephemerides.rows import SAME_MOMENT_NS, Integers
from service.errors import BadFile, Fault
from service.interpolation import QUARTER_TURN_RAD, steps_between
from service.times import Utc
from service.vectors import Vector, rotation_vectors, turned_quaternion

MOST_RECORDS = 5_000_000
"""Greatest number of attitudes held in memory, 40 bytes each, or 64 with rates."""

CLOCK_NS = 200
"""Largest rounding error in nanoseconds of a time converted through a kernel's clock."""
DISCRETE_NS = 1_000_000
"""Nanoseconds about a record of a discrete segment for which its attitude holds."""

Flags = npt.NDArray[np.bool_]
FILL_RAD = 0.05
"""Least jump in radians to the identity that marks it as a fill value."""
STILL_RAD = 1e-5
"""Rotation in radians between records above which rates of zero count as missing."""
MISSED_RAD, MISSED_SHARE = math.radians(0.05), 0.5
"""Least difference, in radians and as a share, of a step from its rates that contradicts them."""
HELD_RAD, HELD_RAD_S, HELD_SHARE = math.radians(0.25), math.radians(0.01), 0.7
"""Least turn and rate of a body whose repeated attitude was not measured anew, and the least share
of the rates' turns that they make together: more than the rounding of three decimals, than the
bias of a gyro, and than noise."""
MEANT_SHARE = 0.1
"""Largest share of that difference that is left where rates are meant in another sign or unit."""
FEWEST_STEPS = 3
"""Least number of steps between records that tell whether rates and attitudes agree."""


@dataclass(frozen=True)
class Span:
    """Records valid in a span of time, `Utc.tai_ns`; some records may lie outside.

    `place` names the span in messages.  The times of the records ascend.
    """

    place: str
    time_ns: Integers
    first_ns: int
    last_ns: int


@dataclass(frozen=True)
class Segment(Span):
    """Attitudes of a span, quaternions (n, 4) of norm 1, to interpolate between.

    `rate_rad_s` (n, 3) are the rates of the body relative to inertial, in body axes; None if the
    file gives none.  A `discrete` segment is known at its records only.  `basis` is the origin of
    the attitudes as the file names it, such as PREDICTED.
    """

    quaternion: Vector
    rate_rad_s: Vector | None = None
    discrete: bool = False
    basis: str = ""

    def at(self, time_ns: Integers, rate_rad_s: Vector | None = None) -> Vector:
        """Attitudes (n, 4) at times (n,); NaN outside of the segment and where unknown.

        Interpolation between records is described in `interpolation`.  Rates (n, 3) about the body
        axes from another source are used between records without rates, if the body makes more than
        a quarter turn at them.
        """
        # A kernel's clock may put a record some nanoseconds off its moment.
        moment = time_ns.clip(self.first_ns, self.last_ns)
        inside = np.abs(moment - time_ns) <= SAME_MOMENT_NS
        last = len(self.time_ns) - 1
        after = np.searchsorted(self.time_ns, moment).clip(min(1, last), last)
        before = (after - 1).clip(0)
        step_ns = np.maximum(self.time_ns[after] - self.time_ns[before], 1)
        rates: tuple[Vector | None, Vector | None] = (None, None)
        if self.rate_rad_s is not None:
            rates = (self.rate_rad_s[before], self.rate_rad_s[after])
        elif rate_rad_s is not None:
            turn = np.linalg.norm(rate_rad_s, axis=1) * step_ns * 1e-9
            far = np.where((turn > QUARTER_TURN_RAD)[:, None], rate_rad_s, np.nan)
            rates = (far, far)
        steps = steps_between(
            self.quaternion[before], self.quaternion[after], step_ns * 1e-9, *rates
        )
        q = steps.at((moment - self.time_ns[before]) / step_ns)
        q[~steps.is_known] = np.nan
        if self.discrete:
            q[:] = np.nan
        # At the time of a record, return that record unchanged.
        for place in (before, after):
            apart_ns = np.abs(self.time_ns[place] - moment)
            is_there = apart_ns <= (DISCRETE_NS if self.discrete else CLOCK_NS)
            q[is_there] = self.quaternion[place[is_there]]
        q[~inside] = np.nan
        return q


@dataclass(frozen=True)
class KnownAttitudes:
    """Attitudes of one object in a file: segments in order of time that do not overlap."""

    object_name: str
    segments: Sequence[Segment]

    def __len__(self) -> int:
        return sum(len(each.time_ns) for each in self.segments)

    def of_basis(self, bases: Sequence[str]) -> Self:
        """The same attitudes, restricted to segments whose basis is one of `bases`."""
        return replace(self, segments=[each for each in self.segments if each.basis in bases])

    def at(self, time_ns: Integers, rate_rad_s: Vector | None = None) -> Vector:
        """Attitudes (n, 4) at times (n,); NaN where unknown; see `Segment.at`."""
        starts = np.array([each.first_ns for each in self.segments], dtype=np.int64)
        place = np.searchsorted(starts, time_ns + SAME_MOMENT_NS, side="right") - 1
        found = np.full((len(time_ns), 4), np.nan)
        for number in np.unique(place[place >= 0]).tolist():
            chosen = place == number
            rates = None if rate_rad_s is None else rate_rad_s[chosen]
            found[chosen] = self.segments[number].at(time_ns[chosen], rates)
        return found


def told_rates(quaternion: Vector, rate_rad_s: Vector | None) -> Vector | None:
    """Given rates (n, 3) of attitudes (n, 4); None if missing, or zero although the body turns."""
    if rate_rad_s is None or rate_rad_s.any() or len(quaternion) < 2:
        return rate_rad_s
    turned = np.linalg.norm(rotation_vectors(quaternion[:-1], quaternion[1:]), axis=1)
    return None if turned.max() > STILL_RAD else rate_rad_s


def known_attitudes(file: str, object_name: str, segments: Sequence[Segment]) -> KnownAttitudes:
    """The attitudes of a file, with its segments in order of time; raises `BadFile` for none."""
    if not segments:
        raise BadFile(Fault(file, "has no attitude"))
    for each in segments:
        _require_no_fill(file, each)
        _require_own_rates(file, each)
    return KnownAttitudes(object_name, in_order(file, segments))


def _require_no_fill(file: str, segment: Segment) -> None:
    """Raise `BadFile` for records of the identity that stand for no attitude.

    The body would have to jump there, or away, much faster than it turns beside these records, and
    no rates lead there.
    """
    q, times, rate = segment.quaternion, segment.time_ns, segment.rate_rad_s
    is_identity = ~q[:, :3].any(axis=1)
    others = np.flatnonzero(~is_identity)
    if len(others) < 2:
        return
    for row in np.flatnonzero(is_identity).tolist():
        after = int(np.searchsorted(others, row))
        sides = []
        if after >= 2:
            sides.append((others[after - 1], others[after - 2]))
        if after <= len(others) - 2:
            sides.append((others[after], others[after + 1]))
        jumps = [_angle_rad(q[row], q[near]) for near, _ in sides]
        own = [
            _angle_rad(q[near], q[far])
            * abs((times[row] - times[near]) / (times[near] - times[far]))
            for near, far in sides
        ]
        if rate is not None and any(
            _angle_rad(q[row], _carried(q[near], rate[[near, row]], times[row] - times[near]))
            < FILL_RAD
            for near, _ in sides
        ):
            continue
        if sides and all(j > max(FILL_RAD, 2.0 * o) for j, o in zip(jumps, own, strict=True)):
            jump_deg = np.degrees(min(jumps))
            message = f"is the identity, {jump_deg:.3g} degrees from its neighbours: no attitude?"
            raise BadFile(Fault(f"{file}, {segment.place}, record {row + 1}", message))


def _carried(q: Vector, rates_rad_s: Vector, passed_ns: int) -> Vector:
    """An attitude (4,) carried on by the mean of rates (2, 3)."""
    turn = rates_rad_s.mean(axis=0) * (passed_ns * 1e-9)
    return np.asarray(turned_quaternion(q[None], turn[None])[0])


def _is_held(repeats: Flags, expected: Vector, step_s: Vector) -> Flags:
    """Steps of one repeated attitude from whose first to last the rates turn the body far.

    At ten records a second each step is a small one.
    """
    runs = np.cumsum(~repeats)
    turns = [np.bincount(runs, np.where(repeats, axis, 0.0)) for axis in expected.T]
    turn_rad = np.linalg.norm(turns, axis=0)
    path_rad = np.bincount(runs, np.where(repeats, np.linalg.norm(expected, axis=1), 0.0))
    passed_s = np.bincount(runs, np.where(repeats, step_s[:, 0], 0.0))
    least_rad = np.maximum(HELD_RAD, np.maximum(HELD_SHARE * path_rad, HELD_RAD_S * passed_s))
    return np.asarray((turn_rad > least_rad)[runs])


def _require_own_rates(file: str, segment: Segment) -> None:
    """Raise `BadFile` for rates that fit the attitudes in another sign or unit only.

    So it does for attitudes that are repeated while the rates turn the body, as where telemetry
    stands still. Steps of more than a quarter turn, which a body may make either way, are left to
    the interpolation, as are rates that fit in no way.
    """
    q, rate = segment.quaternion, segment.rate_rad_s
    if rate is None or segment.discrete:
        return
    step_s = np.diff(segment.time_ns)[:, None] * 1e-9
    turned, expected = rotation_vectors(q[:-1], q[1:]), 0.5 * (rate[1:] + rate[:-1]) * step_s
    by_steps, by_rates, missed = (
        np.linalg.norm(v, axis=1) for v in (turned, expected, turned - expected)
    )
    larger = np.maximum(by_steps, by_rates)
    near = larger <= QUARTER_TURN_RAD
    repeats = near & (q[1:] == q[:-1]).all(axis=1)
    stands = repeats & _is_held(repeats, expected, step_s)
    if stands.any():
        record = int(np.flatnonzero(stands)[0]) + 2
        message = "repeats the attitude before it, from which its rates turn the body"
        raise BadFile(Fault(f"{file}, {segment.place}, record {record}", message))
    wrong = near & (missed > np.maximum(MISSED_RAD, MISSED_SHARE * larger))
    count, steps = int(wrong.sum()), int(near.sum())
    if steps < FEWEST_STEPS or 2 * count <= steps:
        return
    for factor, words in ((-1.0, "of the opposite sign"), (math.degrees(1.0), "in rad/s")):
        other = np.linalg.norm(turned - factor * expected, axis=1)
        if np.median(other[wrong]) < MEANT_SHARE * np.median(missed[wrong]):
            message = (
                f"do not lead from one attitude to the next in {count} of {steps} steps, and do "
                f"if they are {words}"
            )
            raise BadFile(Fault(f"{file}, {segment.place}, rates", message))


def _angle_rad(one: Vector, other: Vector) -> float:
    return float(np.linalg.norm(rotation_vectors(one[None], other[None])))


S = TypeVar("S", bound=Span)


def in_order(file: str, segments: Sequence[S]) -> list[S]:
    """The segments of a file in order of time; raises `BadFile` if two overlap.

    Raises `BadFile` for a segment without useable time, and if two overlap.
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


def by_priority(segments: Sequence[Segment]) -> list[Segment]:
    """Segments without overlap: at any time the last one in the file has priority.

    A discrete segment is unknown between its records, where earlier segments stay valid.
    """
    firsts: list[int] = []
    lasts: list[int] = []
    found = []
    for segment in reversed(segments):
        spans = [(segment.first_ns, segment.last_ns)]
        if segment.discrete:
            spans = [(int(t) - DISCRETE_NS, int(t) + DISCRETE_NS) for t in segment.time_ns]
        for first_ns, last_ns in spans:
            place = end = bisect_left(lasts, first_ns)
            begin = first_ns
            while end < len(firsts) and firsts[end] <= last_ns:
                if begin < firsts[end]:
                    found.append(replace(segment, first_ns=begin, last_ns=firsts[end] - 1))
                # A moment just after an interval is that of its end, see `KnownAttitudes.at`.
                begin = lasts[end] + SAME_MOMENT_NS + 1
                end += 1
            if begin <= last_ns:
                found.append(replace(segment, first_ns=begin, last_ns=last_ns))
            low = min([first_ns, *firsts[place:end]])
            high = max([last_ns, *lasts[place:end]])
            firsts[place:end], lasts[place:end] = [low], [high]
    return found


Interpolation = Literal["HERMITE", "LAGRANGE"]


class Ephemeris(Protocol):
    """Interface of an orbit ephemeris read from a file."""

    @property
    def object_name(self) -> str:
        """Name of the object whose orbit is described."""

    def at(self, moment: Utc) -> Vector | None:
        """Geocentric state (6,) in EME2000, km and km/s, at a time; None outside of the file."""


@dataclass(frozen=True)
class StateSegment(Span):
    """Orbital states (n, 6) of a span, in km and km/s, to interpolate between.

    The polynomial passes through `points` states: HERMITE through positions with velocities as
    derivatives, LAGRANGE through positions and velocities separately.
    """

    state: Vector
    method: Interpolation
    points: int

    def at(self, time_ns: int) -> Vector | None:
        """State (6,) interpolated at a time; None outside of the segment."""
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
        """Slice of the states through which the interpolating polynomial passes, about a time.

        With an odd number the nearest state is in the middle; at the ends of the segment the window
        ends there too.
        """
        first = after - self.points // 2
        nearer_after = 2 * time_ns > self.time_ns[after - 1] + self.time_ns[after]
        if self.points % 2 and not nearer_after:
            first -= 1
        first = min(max(first, 0), len(self.time_ns) - self.points)
        return slice(first, first + self.points)


@dataclass(frozen=True)
class KnownStates:
    """Orbital states of one object in a file: segments in order of time that do not overlap."""

    object_name: str
    segments: Sequence[StateSegment]

    def at(self, moment: Utc) -> Vector | None:
        """Geocentric state (6,) in EME2000, km and km/s; None outside of all segments."""
        for each in reversed(self.segments):
            if each.first_ns <= moment.tai_ns:
                return each.at(moment.tai_ns)
        return None


def known_states(file: str, object_name: str, segments: Sequence[StateSegment]) -> KnownStates:
    """The orbital states of a file, with segments in order of time; raises `BadFile` for none."""
    if not segments:
        raise BadFile(Fault(file, "has no state"))
    return KnownStates(object_name, in_order(file, segments))
