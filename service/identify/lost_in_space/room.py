"""The arrays that a search works in: one block, kept from call to call.

A search takes microseconds, and asking the system for memory may take longer
than the search.  A block is used by one call at a time.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from service.identify.lost_in_space.seen import Points
from service.sky.sky_store import lent

LEDGER = 12
"""Attitudes that are remembered, the heaviest."""
MOST_POINTS = 24
"""Brightest points of which pairs are made."""
CHUNK = 64
"""Candidates that are sieved at a time."""
MOST_PUT_OFF = 4096
"""Candidates of few further points wait until all pairs were tried for one that has more."""
USUAL_POINTS = 64
"""A block that is kept is large enough for so many."""
RANKS = 16
"""Places for the most telling points, `MOST_SIEVES` of them."""
POINT_WORDS = 3 + 3 + 7 + 5
FIXED_WORDS = (
    (20 * RANKS + 88 + 44 * CHUNK) // 8
    + 27
    + 19 * LEDGER
    + MOST_POINTS * (MOST_POINTS + 2)
    + 2 * MOST_PUT_OFF
)
"""What `room_in` takes of every point, and whatever their number."""


class Ledger(NamedTuple):
    """Weighed attitudes.

    `match` (LEDGER, n) rows of stars, log `weight` (LEDGER,), `attitude` and
    `covariance` (LEDGER, 3, 3).
    """

    match: Any
    weight: Any
    attitude: Any
    covariance: Any


class Hand(NamedTuple):
    """The candidate in hand.

    Its `match` (n,), how `near` (n,) its stars are by gates squared, its attitude `t`
    and `covariance` (3, 3), a `matrix` (3, 3) to work in, and stars `inside` the field
    (CHUNK,).
    """

    match: Any
    near: Any
    t: Any
    covariance: Any
    matrix: Any
    inside: Any


class Pairs(NamedTuple):
    """What decides which pair of points is tried next.

    The `cost` (24, 24) of every pair, how much each point is set back for being `used`
    (24,), which are `covered` (24,).  Of every point (n,) the `first` and `last` class of a
    pair whose fainter star it is, the `share` of all pairs that these hold, and the
    chance that it is a star `beyond` the limit.
    """

    cost: Any
    used: Any
    covered: Any
    first: Any
    last: Any
    share: Any
    beyond: Any


class Sieve(NamedTuple):
    """Of one pair of points what the others are looked for with.

    For every point the `coefficients` (n, 3) of its place and its `gate` (n,); `order`
    (n,): the most telling first, by `cost` (n,).  By rank in that order: the
    coefficients once more in `single` precision (3, RANKS), the bitmap `level` that answers
    for it and the `cell` in hand (RANKS,).  `turn` (4,): the ranks that are asked first.
    """

    coefficients: Any
    gate: Any
    order: Any
    cost: Any
    turn: Any
    single: Any
    level: Any
    cell: Any


class Chunk(NamedTuple):
    """Candidates to be sieved together.

    Their star `rows` (2, CHUNK) and `places` (6, CHUNK), the `cell` (CHUNK,) where a
    further point is looked for, and which are `possible` (CHUNK,).
    """

    rows: Any
    places: Any
    cell: Any
    possible: Any


class Room(NamedTuple):
    """What a search writes to.

    `order` (n,) are the rows, as they were given, of the `points`, which are brightest
    first; `tally` is what the search counts; `later` (MOST_PUT_OFF, 4) keeps of
    candidates that are put off the pair of points, the two stars, and which further
    points may have one.
    """

    order: Any
    points: Points
    tally: Any
    later: Any
    hand: Hand
    ledger: Ledger
    pairs: Pairs
    sieve: Sieve
    chunk: Chunk


@njit(cache=True, nogil=True)
def words_for(n):  # type: ignore[no-untyped-def]
    """How many words of 64 bits a search for n points needs."""
    return FIXED_WORDS + n * (POINT_WORDS + LEDGER)


@njit(cache=True, nogil=True)
def room_in(block, n):  # type: ignore[no-untyped-def]
    """The arrays of a search for n points, cut from a block of `words_for(n)` words."""
    f8, f4, i8, i4 = np.float64, np.float32, np.int64, np.int32
    at = 0
    # What is most used comes first, so that it lies together.
    single = lent(block, at, (3, RANKS), f4)
    at += 12 * RANKS
    level, cell = lent(block, at, (RANKS,), i4), lent(block, at + 4 * RANKS, (RANKS,), i4)
    at += 8 * RANKS
    turn, tally = lent(block, at, (4,), i8), lent(block, at + 32, (4,), i8)
    velocity = lent(block, at + 64, (3,), f8)
    at += 88
    places = lent(block, at, (6, CHUNK), f4)
    at += 24 * CHUNK
    rows, cells = lent(block, at, (2, CHUNK), i4), lent(block, at + 8 * CHUNK, (CHUNK,), i4)
    possible = lent(block, at + 12 * CHUNK, (CHUNK,), i4)
    inside = lent(block, at + 16 * CHUNK, (CHUNK,), i4)
    at += 20 * CHUNK
    matrices = lent(block, at, (3, 3, 3), f8)
    at += 8 * 27
    weight = lent(block, at, (LEDGER,), f8)
    at += 8 * LEDGER
    attitudes = lent(block, at, (2, LEDGER, 3, 3), f8)
    at += 8 * 18 * LEDGER
    cost = lent(block, at, (MOST_POINTS, MOST_POINTS), f8)
    at += 8 * MOST_POINTS * MOST_POINTS
    used = lent(block, at, (MOST_POINTS,), f8)
    covered = lent(block, at + 8 * MOST_POINTS, (MOST_POINTS,), i8)
    at += 16 * MOST_POINTS
    later = lent(block, at, (MOST_PUT_OFF, 4), i4)
    at += 16 * MOST_PUT_OFF
    observed, coefficients = lent(block, at, (n, 3), f8), lent(block, at + 24 * n, (n, 3), f8)
    at += 48 * n
    real, whole = lent(block, at, (7, n), f8), lent(block, at + 56 * n, (5, n), i8)
    at += 96 * n
    match = lent(block, at, (LEDGER, n), i8)
    return Room(
        whole[0],
        Points(observed, real[0], real[1], velocity),
        tally,
        later,
        Hand(whole[1], real[2], matrices[0], matrices[1], matrices[2], inside),
        Ledger(match, weight, attitudes[0], attitudes[1]),
        Pairs(cost, used, covered, whole[2], whole[3], real[3], real[4]),
        Sieve(coefficients, real[5], whole[4], real[6], turn, single, level, cell),
        Chunk(rows, places, cells, possible),
    )
