"""Index of star pairs by separation, called SIDS in the paper (Star Identification Data Structure).

It has every pair of zone stars within HMAX of each other, the brighter star first.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.compiled.jit import njit
from service.errors import BadInput, Fault
from service.sky.geometry.directions import separation_of, separation_rad
from service.vectors import Vector, locked, read_only

Indices = npt.NDArray[np.int32]

PAIRS_PER_BIN = 4
PARTS = 4
"""Number of sub-bins per bin into which pairs are counted for sorting."""
MAX_IN_PART = 64
MAX_CUBES = 64
"""Largest number of cubes along an edge of the cube about the sphere."""
MAX_PAIRS = 5_000_000
"""Largest number of pairs in one index (80 MB), more than the whole sky to V 8 within 8 degrees."""


@dataclass(frozen=True)
class PairIndex:
    """Star pairs in order of separation.

    `separation_rad` (NTOT,) ascends; `rows` (2, NTOT) are the rows of the brighter and the dimmer
    star in the zone's arrays, the brighter being the lower because zones keep the brightness order
    of the run catalog. `bin_start[k]` is the first pair of separation bin k; the last entry is
    NTOT.
    """

    separation_rad: Vector
    rows: Indices
    bin_start: Indices
    bins_per_rad: float

    @property
    def brighter(self) -> Indices:
        """The rows (NTOT,) of the pairs' brighter stars."""
        return np.asarray(self.rows[0])

    @property
    def dimmer(self) -> Indices:
        """The rows (NTOT,) of the pairs' dimmer stars."""
        return np.asarray(self.rows[1])

    @property
    def count(self) -> int:
        """The number of pairs, NTOT in the paper."""
        return len(self.separation_rad)

    @property
    def nbytes(self) -> int:
        """The size of the pair index in memory, in bytes."""
        arrays = (self.separation_rad, self.rows, self.bin_start)
        return sum(array.nbytes for array in arrays)


def build_pairs(direction: Vector, separation_max_deg: float) -> PairIndex:
    """Index the pairs of unit vectors (n, 3), sorted by brightness, with separations up to a limit.

    The limit is the paper's HMAX. Raises `BadInput` for too many pairs.
    """
    limit = math.radians(separation_max_deg)
    n, direction = len(direction), locked(direction)
    # An estimate of the number for stars spread evenly over a tenth of the sky.
    share = min(1.0, 10.0 * math.sin(0.5 * min(limit, math.pi)) ** 2)
    capacity = min(MAX_PAIRS, int(0.5 * n * n * share) + 1024) + n
    found = (np.empty(capacity), np.empty(capacity, np.int32), np.empty(capacity, np.int32))
    count, complete = _find_pairs(direction, limit, *found)
    if count > MAX_PAIRS:
        raise BadInput(
            Fault(
                "options.tolerances.pair_separation_max_deg",
                f"makes {count:,} pairs of {n:,} stars; at most {MAX_PAIRS:,} are kept",
                str(separation_max_deg),
            )
        )
    if not complete:
        capacity = count + n
        found = (np.empty(capacity), np.empty(capacity, np.int32), np.empty(capacity, np.int32))
        count, _ = _find_pairs(direction, limit, *found)
    bins = max(1, count // PAIRS_PER_BIN)
    bins_per_rad = bins / limit
    separation, rows = np.empty(count), np.empty((2, count), np.int32)
    bin_start = np.empty(bins + 1, np.int32)
    if not _sort_pairs(*found, bins_per_rad, separation, rows[0], rows[1], bin_start):
        order = np.lexsort((rows[1], rows[0], separation))
        separation, rows = separation[order], rows[:, order]
    return PairIndex(read_only(separation), read_only(rows), read_only(bin_start), bins_per_rad)


@njit(nogil=True)
def _find_pairs(direction, limit, separation, brighter, dimmer):  # type: ignore[no-untyped-def]
    """Find the pairs up to a separation; returns their number, and true if all fit in the arrays.

    Stars are sorted into cubes as wide as the longest chord, so that partners are in the same or in
    adjacent cubes. About a third of the candidates are partners, unpredictably: each is written to
    the next slot and counted only if it is one, which is cheaper than a branch.
    """
    n, capacity = len(direction), len(separation)
    chord = 2.0 * math.sin(0.5 * min(limit, math.pi))
    side = max(1, min(MAX_CUBES, int(2.0 / chord))) if chord > 0.0 else MAX_CUBES
    scale = 0.5 * side
    cube = np.empty(n, np.int32)
    start = np.zeros(side * side * side + 1, np.int32)
    for row in range(n):
        x = min(side - 1, max(0, int((direction[row, 0] + 1.0) * scale)))
        y = min(side - 1, max(0, int((direction[row, 1] + 1.0) * scale)))
        z = min(side - 1, max(0, int((direction[row, 2] + 1.0) * scale)))
        cube[row] = (x * side + y) * side + z
        start[cube[row] + 1] += 1
    for k in range(len(start) - 1):
        start[k + 1] += start[k]
    place = start[:-1].copy()
    rows = np.empty(n, np.int32)
    ordered = np.empty((n, 3))
    for row in range(n):
        at = place[cube[row]]
        rows[at] = row
        for i in range(3):
            ordered[at, i] = direction[row, i]
        place[cube[row]] += 1
    # A little more than the chord; the separation decides.
    most = chord * chord * (1.0 + 1e-12)
    count = 0
    complete = True
    for at in range(n):
        row = rows[at]
        own = cube[row]
        x, y, z = own // (side * side), own // side % side, own % side
        a0, a1, a2 = ordered[at, 0], ordered[at, 1], ordered[at, 2]
        low, high = max(z - 1, 0), min(z + 1, side - 1)
        # Cubes along z are contiguous; each pair of touching cubes is visited once.
        for part in range(5):
            if part == 0:
                first, last = at + 1, start[own - z + high + 1]
            else:
                u = x if part == 1 else x + 1
                v = y + 1 if part == 1 else y + part - 3
                if u >= side or v < 0 or v >= side:
                    continue
                base = (u * side + v) * side
                first, last = start[base + low], start[base + high + 1]
            complete = complete and count + last - first <= capacity
            for other in range(first, last):
                d0, d1, d2 = a0 - ordered[other, 0], a1 - ordered[other, 1], a2 - ordered[other, 2]
                square = d0 * d0 + d1 * d1 + d2 * d2
                if complete:
                    separation[count] = square
                    brighter[count] = row
                    dimmer[count] = rows[other]
                count += square <= most
    if not complete:
        return count, False
    kept = 0
    for k in range(count):
        square, one, other = separation[k], brighter[k], dimmer[k]
        angle = (
            separation_of(square)
            if square < 1.96
            else separation_rad(direction[one], direction[other])
        )
        separation[kept] = angle
        brighter[kept], dimmer[kept] = min(one, other), max(one, other)
        kept += angle <= limit
    return kept, True


@njit(nogil=True)
def _sort_pairs(found, one, other, bins_per_rad, separation, brighter, dimmer, bin_start):  # type: ignore[no-untyped-def]
    """Sort pairs by separation and then by stars, and fill in the start of each bin.

    Pairs are counted into sub-bins that hold few each. Unnaturally regular stars may overfill
    sub-bins: then pairs are sorted by sub-bin only, and False is returned.
    """
    count, bins = len(separation), len(bin_start) - 1
    parts, parts_per_rad = bins * PARTS, bins_per_rad * PARTS
    start = np.zeros(parts + 1, np.int32)
    for k in range(count):
        start[min(parts - 1, int(found[k] * parts_per_rad)) + 1] += 1
    crowded = False
    for k in range(parts):
        crowded = crowded or start[k + 1] > MAX_IN_PART
        start[k + 1] += start[k]
    for k in range(bins + 1):
        bin_start[k] = start[k * PARTS]
    for k in range(count):
        own = min(parts - 1, int(found[k] * parts_per_rad))
        at = start[own]
        separation[at], brighter[at], dimmer[at] = found[k], one[k], other[k]
        start[own] = at + 1
    if crowded:
        return False
    for at in range(1, count):
        angle = separation[at]
        if separation[at - 1] < angle:
            continue
        a, b = brighter[at], dimmer[at]
        to = at
        while to > 0 and (
            separation[to - 1] > angle
            or (
                separation[to - 1] == angle
                and (brighter[to - 1] > a or (brighter[to - 1] == a and dimmer[to - 1] > b))
            )
        ):
            separation[to] = separation[to - 1]
            brighter[to], dimmer[to] = brighter[to - 1], dimmer[to - 1]
            to -= 1
        separation[to], brighter[to], dimmer[to] = angle, a, b
    return True
