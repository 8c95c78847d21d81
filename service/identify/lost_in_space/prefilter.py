"""Candidates for a pair of points, rejected by bitmap: most of them within nanoseconds.

Star pairs of the right separation are taken from the index both ways round, a
chunk at a time, and a further point's place is worked out for all of them at
once; for those that are left the places of all further points at once.
"""

import numpy as np

from service.compiled.jit import njit
from service.identify.lost_in_space.predictors import BEYOND
from service.identify.lost_in_space.workspace import CHUNK
from service.sky.whole_sky.bitmap import cells_of_candidates, cells_of_points
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


@njit(nogil=True)
def candidates_of(pairs, place, at, end, rows_i, rows_j, chunk):  # type: ignore[no-untyped-def]
    """The next candidates of a run of pairs: how many, and the pair to go on with.

    A star for point i has its row in `rows_i`, (first, one past the last), and
    one for point j in `rows_j`.
    """
    first_i, last_i = rows_i
    first_j, last_j = rows_j
    rows, places = chunk.rows, chunk.places
    count = 0
    while at < end and count < CHUNK - 1:
        r, s = np.int64(pairs[at, 0]), np.int64(pairs[at, 1])
        at += 1
        straight = first_i <= r and r < last_i and first_j <= s and s < last_j
        turned = first_i <= s and s < last_i and first_j <= r and r < last_j
        if straight:
            rows[0, count], rows[1, count] = r, s
            for c in range(3):
                places[c, count], places[3 + c, count] = place[r, c], place[s, c]
            count += 1
        if turned:
            rows[0, count], rows[1, count] = s, r
            for c in range(3):
                places[c, count], places[3 + c, count] = place[s, c], place[r, c]
            count += 1
    return count, at


@njit(nogil=True)
def possible_of(bits, count, asked, prefilter, chunk):  # type: ignore[no-untyped-def]
    """How many of a chunk have a star near the place of one of the points asked first.

    Their numbers go to `chunk.possible`.
    """
    possible, cell = chunk.possible, chunk.cell
    for q in range(count):
        possible[q] = 0
    for t in range(asked):
        s = prefilter.turn[t]
        cells_of_candidates(
            *(count, prefilter.single[0, s], prefilter.single[1, s], prefilter.single[2, s]),
            *(chunk.places, cell),
        )
        some = bits[prefilter.level[s]]
        for q in range(count):
            possible[q] |= (some[cell[q] >> 3] >> (cell[q] & 7)) & 1
    left = 0
    for q in range(count):
        is_possible = possible[q]
        possible[left] = q
        left += is_possible
    return left


@njit(nogil=True)
def stars_near(bits, prefilter, plan, places, q):  # type: ignore[no-untyped-def]
    """Which points may have a star in their place in candidate q of a chunk: a bit a rank.

    None where too few of those that are asked first have.
    """
    level, cell = prefilter.level, prefilter.cell
    cells_of_points(plan.prefiltered, prefilter.single, places, q, cell)
    near = np.int64(0)
    for s in range(plan.prefiltered):
        near |= np.int64((bits[level[s], cell[s] >> 3] >> (cell[s] & 7)) & 1) << s
    possible = 0
    for t in range(plan.firsts):
        possible += (near >> prefilter.turn[t]) & 1
    return near if possible >= plan.needed else 0
