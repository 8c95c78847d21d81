"""The pair index that the paper calls SIDS (Star Identification Data Structure).

Every pair of zone stars not farther apart than HMAX, the brighter star first,
found by separation.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from service.errors import BadInput, Fault
from service.vectors import Vector, read_only

Indices = npt.NDArray[np.int32]

PAIRS_PER_BIN = 4
MAX_PAIRS = 5_000_000
"""In one index, 80 MB: more than those of the whole sky to V 8 within 8 degrees."""


@dataclass(frozen=True)
class PairIndex:
    """Pairs in order of separation.

    `separation_rad` (NTOT,) ascends; `brighter` and `dimmer` are rows of the
    zone's arrays, of which the brighter is the lower because zones keep the
    brightness order of the run catalog.  `bin_start[k]` is the first pair of
    separation bin k; the last entry is NTOT.
    """

    separation_rad: Vector
    brighter: Indices
    dimmer: Indices
    bin_start: Indices
    bins_per_rad: float

    @property
    def count(self) -> int:
        """The number of pairs, the paper's NTOT."""
        return len(self.separation_rad)

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        arrays = (self.separation_rad, self.brighter, self.dimmer, self.bin_start)
        return sum(array.nbytes for array in arrays)


def build_pairs(direction: Vector, separation_max_deg: float) -> PairIndex:
    """Index the pairs of unit vectors (n, 3), rows in order of brightness, up to HMAX.

    Raises `BadInput` where there would be too many to keep.
    """
    limit = math.radians(separation_max_deg)
    # A sweep along the axis with the widest spread looks at few pairs beyond the limit.
    axis = int(np.argmax(np.ptp(direction, axis=0))) if len(direction) else 0
    sweep = np.argsort(direction[:, axis], kind="stable").astype(np.int32)
    ordered = np.ascontiguousarray(direction[sweep])
    count = _count_pairs(ordered, axis, limit)
    if count > MAX_PAIRS:
        raise BadInput(
            Fault(
                "options.tolerances.pair_separation_max_deg",
                f"makes {count:,} pairs of {len(direction):,} stars; "
                f"at most {MAX_PAIRS:,} are kept",
                str(separation_max_deg),
            )
        )
    separation = np.empty(count)
    brighter, dimmer = np.empty(count, np.int32), np.empty(count, np.int32)
    _fill_pairs(ordered, sweep, axis, limit, separation, brighter, dimmer)
    # Equal separations keep a fixed order whatever the sweep was.
    order = np.lexsort((dimmer, brighter, separation)) if count else np.empty(0, np.int64)
    separation = separation[order]
    bins = max(1, count // PAIRS_PER_BIN)
    bins_per_rad = bins / limit
    edges = np.arange(bins + 1) / bins_per_rad
    bin_start = np.searchsorted(separation, edges).astype(np.int32)
    bin_start[-1] = count
    return PairIndex(
        read_only(separation),
        read_only(brighter[order]),
        read_only(dimmer[order]),
        read_only(bin_start),
        bins_per_rad,
    )


@njit(cache=True, nogil=True)
def separation_rad(a, b):  # type: ignore[no-untyped-def]
    """Angle in radians between two unit vectors, accurate from zero to a half turn."""
    dx, dy, dz = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    half_chord = 0.5 * math.sqrt(dx * dx + dy * dy + dz * dz)
    if half_chord < 0.7:
        return 2.0 * math.asin(half_chord)
    sx, sy, sz = a[0] + b[0], a[1] + b[1], a[2] + b[2]
    return 2.0 * math.atan2(half_chord, 0.5 * math.sqrt(sx * sx + sy * sy + sz * sz))


@njit(cache=True, nogil=True)
def _count_pairs(direction, axis, limit):  # type: ignore[no-untyped-def]
    chord = 2.0 * math.sin(0.5 * min(limit, math.pi))
    count = 0
    for i in range(len(direction)):
        for j in range(i + 1, len(direction)):
            if direction[j, axis] - direction[i, axis] > chord:
                break
            if separation_rad(direction[i], direction[j]) <= limit:
                count += 1
    return count


@njit(cache=True, nogil=True)
def _fill_pairs(direction, sweep, axis, limit, separation, brighter, dimmer):  # type: ignore[no-untyped-def]
    chord = 2.0 * math.sin(0.5 * min(limit, math.pi))
    count = 0
    for i in range(len(direction)):
        for j in range(i + 1, len(direction)):
            if direction[j, axis] - direction[i, axis] > chord:
                break
            angle = separation_rad(direction[i], direction[j])
            if angle <= limit:
                separation[count] = angle
                brighter[count] = min(sweep[i], sweep[j])
                dimmer[count] = max(sweep[i], sweep[j])
                count += 1
