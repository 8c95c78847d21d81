"""Rejection of candidate star pairs by bitmaps of the sky, within nanoseconds for most.

Star pairs of the right separation are read from the index in both orders, a chunk at a time. First
one further point's place is predicted for all of them at once; then, for the remaining pairs, the
places of all further points at once.
"""

import numpy as np

from service.compiled.jit import njit
from service.identify.lost_in_space.predictors import BEYOND
from service.identify.lost_in_space.workspace import RANKS
from service.sky.whole_sky.bitmap import cells_of_pairs, cells_of_points
from service.sky.whole_sky.index import BITMAP_RADII_RAD


@njit(nogil=True)
def ranked(prefilter, beyond, prefiltered):  # type: ignore[no-untyped-def]
    """Sort prediction coefficients by rank, in single precision, with the bitmap for each point.

    The bitmap is the finest that covers the point's gate; a point that may be a star beyond the
    limit uses the bitmap of all stars.
    """
    for s in range(prefiltered):
        k = prefilter.order[s]
        level = 0
        while BITMAP_RADII_RAD[level] < prefilter.gate[k]:
            level += 1
        if beyond[k] > BEYOND:
            level += len(BITMAP_RADII_RAD)
        prefilter.level[s] = level
        for c in range(3):
            prefilter.single[c, s] = prefilter.coefficients[k, c]


@njit(nogil=True, error_model="numpy", forceinline=True)
def pairs_of(pairs, place, at, count, rows_i, rows_j, chunk):  # type: ignore[no-untyped-def]
    """Load the next `count` star pairs into the prefilter; returns their number of candidates.

    Stars for point i are in the row range `rows_i` (first, one past the last), those for point j in
    `rows_j`. Written without branches, so that it is vectorised.
    """
    first_i, last_i = np.int32(rows_i[0]), np.int32(rows_i[1])
    first_j, last_j = np.int32(rows_j[0]), np.int32(rows_j[1])
    places, allowed = chunk.places, chunk.allowed
    candidates = np.int32(0)
    for q in range(count):
        r, s = np.int32(pairs[at + q, 0]), np.int32(pairs[at + q, 1])
        places[0, q], places[1, q], places[2, q] = place[r, 0], place[r, 1], place[r, 2]
        places[3, q], places[4, q], places[5, q] = place[s, 0], place[s, 1], place[s, 2]
        straight = (first_i <= r) & (r < last_i) & (first_j <= s) & (s < last_j)
        turned = (first_i <= s) & (s < last_i) & (first_j <= r) & (r < last_j)
        allowed[q] = np.int32(straight) | (np.int32(turned) << np.int32(1))
        candidates += np.int32(straight) + np.int32(turned)
    return candidates


@njit(nogil=True, forceinline=True)
def possible_of(bits, count, asked, prefilter, chunk):  # type: ignore[no-untyped-def]
    """The number of a chunk's candidates whose first predicted points may have a star.

    Their numbers go to `chunk.possible`: twice the pair's index, plus one for the reversed order.
    """
    possible, cell, seen, allowed = chunk.possible, chunk.cell, chunk.seen, chunk.allowed
    for q in range(count):
        seen[q] = 0
    for t in range(asked):
        s = prefilter.turn[t]
        cells_of_pairs(
            *(count, prefilter.single[0, s], prefilter.single[1, s], prefilter.single[2, s]),
            *(chunk.places, cell),
        )
        marked = bits[prefilter.level[s]]
        for q in range(count):
            c, d = np.uint32(cell[0, q]), np.uint32(cell[1, q])
            straight = (marked[c >> np.uint32(3)] >> (c & np.uint32(7))) & 1
            turned = (marked[d >> np.uint32(3)] >> (d & np.uint32(7))) & 1
            seen[q] |= np.int32(straight) | (np.int32(turned) << np.int32(1))
    left = 0
    for q in range(count):
        is_possible = seen[q] & allowed[q]
        possible[left] = 2 * q
        left += is_possible & 1
        possible[left] = 2 * q + 1
        left += is_possible >> 1
    return left


@njit(nogil=True, forceinline=True)
def stars_near(bits, prefilter, plan, place_a, place_b):  # type: ignore[no-untyped-def]
    """Mask, by rank, of points that may have a star if i and j are two given stars; 0 if too few.

    Zero if too few of the points that are checked first may have a star.
    """
    level, cell = prefilter.level, prefilter.cell
    # Unused slots are computed too: a fixed count is vectorised.
    cells_of_points(RANKS, prefilter.single, place_a, place_b, cell)
    near = np.int64(0)
    for s in range(plan.prefiltered):
        near |= np.int64((bits[level[s], cell[s] >> 3] >> (cell[s] & 7)) & 1) << s
    possible = 0
    for t in range(plan.firsts):
        possible += (near >> prefilter.turn[t]) & 1
    return near if possible >= plan.needed else 0
