"""Positions and velocities that a file gives, and the state at a moment between them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from service.errors import BadFile, Fault
from service.products.attitudes import Integers
from service.products.reading.spans import in_order
from service.times import Utc
from service.vectors import Vector

Interpolation = Literal["HERMITE", "LAGRANGE"]


class Ephemeris(Protocol):
    """What a file says of the motion of one object."""

    @property
    def object_name(self) -> str:
        """The object."""

    def at(self, moment: Utc) -> Vector | None:
        """The geocentric state (6,) in EME2000, km and km/s; None where the file has none."""


@dataclass(frozen=True)
class StateSegment:
    """States between which it may be interpolated; `place` names it in messages.

    They are valid from `first_ns` to `last_ns`.  The polynomial goes through `points` states:
    HERMITE through their positions and velocities, with the velocity as its derivative, LAGRANGE
    through positions and velocities apart.
    """

    place: str
    time_ns: Integers
    """In ascending order; `Utc.tai_ns`."""
    state: Vector
    """Of shape (n, 6): km and km/s."""
    first_ns: int
    last_ns: int
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
    """What a file says of one object: segments in order of time that do not overlap."""

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
