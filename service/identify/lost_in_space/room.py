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
POINT_WORDS = 18
"""Of every point, beside those of the ledger."""
TALLY_AT = 0
VELOCITY_AT = TALLY_AT + 8 * 4
SIEVE_AT = VELOCITY_AT + 8 * 4
CHUNK_AT = SIEVE_AT + 32 + 20 * RANKS
HAND_AT = CHUNK_AT + 40 * CHUNK
LEDGER_AT = HAND_AT + 216 + 4 * CHUNK
PAIRS_AT = LEDGER_AT + 8 * 19 * LEDGER
LATER_AT = PAIRS_AT + 8 * MOST_POINTS * (MOST_POINTS + 2)
POINTS_AT = LATER_AT + 16 * MOST_PUT_OFF
"""Where in a block what begins, in bytes; at the end what depends on the number of points."""


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
    """What a search for n points writes to: a block of `words_for(n)` words.

    Handed on as it is, and cut where it is needed: code that hands on dozens of
    arrays takes minutes to compile.
    """

    block: Any
    n: Any


@njit(cache=True, nogil=True)
def words_for(n):  # type: ignore[no-untyped-def]
    """How many words of 64 bits a search for n points needs."""
    return POINTS_AT // 8 + n * (POINT_WORDS + LEDGER)


@njit(cache=True, nogil=True)
def points_in(room):  # type: ignore[no-untyped-def]
    """The points, brightest first."""
    block, n = room
    return Points(
        lent(block, POINTS_AT, (n, 3), np.float64),
        lent(block, POINTS_AT + 24 * n, (n,), np.float64),
        lent(block, POINTS_AT + 32 * n, (n,), np.float64),
        lent(block, VELOCITY_AT, (3,), np.float64),
    )


@njit(cache=True, nogil=True)
def order_in(room):  # type: ignore[no-untyped-def]
    """The rows (n,) of the points as they were given."""
    block, n = room
    return lent(block, POINTS_AT + 40 * n, (n,), np.int64)


@njit(cache=True, nogil=True)
def hand_in(room):  # type: ignore[no-untyped-def]
    """See `Hand`."""
    block, n = room
    return Hand(
        lent(block, POINTS_AT + 48 * n, (n,), np.int64),
        lent(block, POINTS_AT + 56 * n, (n,), np.float64),
        lent(block, HAND_AT, (3, 3), np.float64),
        lent(block, HAND_AT + 72, (3, 3), np.float64),
        lent(block, HAND_AT + 144, (3, 3), np.float64),
        lent(block, HAND_AT + 216, (CHUNK,), np.int32),
    )


@njit(cache=True, nogil=True)
def pairs_in(room):  # type: ignore[no-untyped-def]
    """See `Pairs`."""
    block, n = room
    every = MOST_POINTS * MOST_POINTS
    return Pairs(
        lent(block, PAIRS_AT, (MOST_POINTS, MOST_POINTS), np.float64),
        lent(block, PAIRS_AT + 8 * every, (MOST_POINTS,), np.float64),
        lent(block, PAIRS_AT + 8 * (every + MOST_POINTS), (MOST_POINTS,), np.int64),
        lent(block, POINTS_AT + 64 * n, (n,), np.int64),
        lent(block, POINTS_AT + 72 * n, (n,), np.int64),
        lent(block, POINTS_AT + 80 * n, (n,), np.float64),
        lent(block, POINTS_AT + 88 * n, (n,), np.float64),
    )


@njit(cache=True, nogil=True)
def sieve_in(room):  # type: ignore[no-untyped-def]
    """See `Sieve`."""
    block, n = room
    return Sieve(
        lent(block, POINTS_AT + 96 * n, (n, 3), np.float64),
        lent(block, POINTS_AT + 120 * n, (n,), np.float64),
        lent(block, POINTS_AT + 128 * n, (n,), np.int64),
        lent(block, POINTS_AT + 136 * n, (n,), np.float64),
        lent(block, SIEVE_AT, (4,), np.int64),
        lent(block, SIEVE_AT + 32, (3, RANKS), np.float32),
        lent(block, SIEVE_AT + 32 + 12 * RANKS, (RANKS,), np.int32),
        lent(block, SIEVE_AT + 32 + 16 * RANKS, (RANKS,), np.int32),
    )


@njit(cache=True, nogil=True)
def chunk_in(room):  # type: ignore[no-untyped-def]
    """See `Chunk`."""
    block = room.block
    return Chunk(
        lent(block, CHUNK_AT, (2, CHUNK), np.int32),
        lent(block, CHUNK_AT + 8 * CHUNK, (6, CHUNK), np.float32),
        lent(block, CHUNK_AT + 32 * CHUNK, (CHUNK,), np.int32),
        lent(block, CHUNK_AT + 36 * CHUNK, (CHUNK,), np.int32),
    )


@njit(cache=True, nogil=True)
def ledger_in(room):  # type: ignore[no-untyped-def]
    """See `Ledger`."""
    block, n = room
    return Ledger(
        lent(block, POINTS_AT + 144 * n, (LEDGER, n), np.int64),
        lent(block, LEDGER_AT, (LEDGER,), np.float64),
        lent(block, LEDGER_AT + 8 * LEDGER, (LEDGER, 3, 3), np.float64),
        lent(block, LEDGER_AT + 80 * LEDGER, (LEDGER, 3, 3), np.float64),
    )


@njit(cache=True, nogil=True)
def tally_in(room):  # type: ignore[no-untyped-def]
    """What the search counts (4,)."""
    return lent(room.block, TALLY_AT, (4,), np.int64)


@njit(cache=True, nogil=True)
def later_in(room):  # type: ignore[no-untyped-def]
    """Candidates put off (MOST_PUT_OFF, 4).

    The pair of points, its two stars, and which further points may have one.
    """
    return lent(room.block, LATER_AT, (MOST_PUT_OFF, 4), np.int32)
