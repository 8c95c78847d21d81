"""Candidates for a pair of points, rejected by bitmap: most of them within nanoseconds.

Star pairs of the right separation are taken from the index both ways round, a
chunk at a time, and a further point's place is worked out for all of them at
once; for those that are left the places of all further points at once.
"""

import numpy as np

from service.compiled.jit import njit
from service.identify.lost_in_space.predictors import BEYOND
from service.identify.lost_in_space.workspace import RANKS
from service.sky.whole_sky.bitmap import cells_of_pairs, cells_of_points
from service.sky.whole_sky.index import BITMAP_RADII_RAD


@njit(nogil=True)
def ranked(prefilter, beyond, prefiltered):  # type: ignore[no-untyped-def]
    """By rank the coefficients in single precision, and the bitmap to ask.

    That is the least that no star within a gate escapes, one of all stars where
    the point may be a star beyond the limit.
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


@njit(nogil=True, error_model="numpy")
def pairs_of(pairs, place, at, count, rows_i, rows_j, chunk):  # type: ignore[no-untyped-def]
    """Make the next `count` pairs ready to be sieved; how many candidates they are.

    A star for point i has its row in `rows_i`, (first, one past the last), and
    one for point j in `rows_j`.  Without a branch, so that many are done at a time.
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


@njit(nogil=True)
def possible_of(bits, count, asked, prefilter, chunk):  # type: ignore[no-untyped-def]
    """How many candidates of a chunk have a star near the place of a point that is asked first.

    Their numbers go to `chunk.possible`: twice the pair's, one more for a pair turned round.
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


@njit(nogil=True)
def stars_near(bits, prefilter, plan, place_a, place_b):  # type: ignore[no-untyped-def]
    """Which points may have a star in their place where i and j are two stars: a bit a rank.

    None where too few of those that are asked first have.
    """
    level, cell = prefilter.level, prefilter.cell
    # All places, also those in vain: of a fixed number several are done at a time.
    cells_of_points(RANKS, prefilter.single, place_a, place_b, cell)
    near = np.int64(0)
    for s in range(plan.prefiltered):
        near |= np.int64((bits[level[s], cell[s] >> 3] >> (cell[s] & 7)) & 1) << s
    possible = 0
    for t in range(plan.firsts):
        possible += (near >> prefilter.turn[t]) & 1
    return near if possible >= plan.needed else 0
