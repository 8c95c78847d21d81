"""The arrays that a search works in: views of one block of memory, kept from call to call.

A search takes microseconds, and asking the system for memory may take longer
than the search.  A block is used by one call at a time.
"""

from collections import namedtuple
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from service.compiled.arrays import view_into
from service.compiled.jit import njit

LEDGER = 12
"""Attitudes that are remembered, the heaviest."""
MOST_POINTS = 24
"""Brightest points of which pairs are made."""
CHUNK = 64
"""Pairs of stars that are prefiltered at a time."""
MAX_DEFERRED = 4096
"""Candidates of few further points wait until all pairs were tried for one that has more."""
USUAL_POINTS = 64
"""A block that is kept is large enough for so many."""
RANKS = 16
"""Places for the most telling points, `MAX_PREFILTERED` of them."""

_SHARED = np.dtype(
    [
        ("counters", np.int64, 5),
        ("velocity", np.float64, 3),
        ("turn", np.int64, 4),
        ("single", np.float32, (3, RANKS)),
        ("level", np.int32, RANKS),
        ("rank_cell", np.int32, RANKS),
        ("places", np.float32, (6, CHUNK)),
        ("allowed", np.int32, CHUNK),
        ("chunk_cell", np.int32, (2, CHUNK)),
        ("seen", np.int32, CHUNK),
        ("possible", np.int32, 2 * CHUNK),
        ("t", np.float64, (3, 3)),
        ("t_covariance", np.float64, (3, 3)),
        ("matrix", np.float64, (3, 3)),
        ("inside", np.int32, CHUNK),
        ("weight", np.float64, LEDGER),
        ("attitude", np.float64, (LEDGER, 3, 3)),
        ("covariance", np.float64, (LEDGER, 3, 3)),
        ("pair_cost", np.float64, (MOST_POINTS, MOST_POINTS)),
        ("used", np.float64, MOST_POINTS),
        ("covered", np.int64, MOST_POINTS),
        ("deferred", np.int32, (MAX_DEFERRED, 4)),
    ],
    align=True,
)
"""What stands in a block once, whatever the number of points."""
_OF_A_POINT = np.dtype(
    [
        ("observed", np.float64, 3),
        ("magnitude", np.float64),
        ("sigma", np.float64),
        ("order", np.int64),
        ("match", np.int64),
        ("near", np.float64),
        ("first", np.int64),
        ("last", np.int64),
        ("share", np.float64),
        ("beyond", np.float64),
        ("coefficients", np.float64, 3),
        ("gate", np.float64),
        ("telling", np.int64),
        ("telling_cost", np.float64),
        ("ledger", np.int64, LEDGER),
    ]
)
"""Its size for every point; after what stands there once, field by field for all points."""


def _offsets(layout: np.dtype[Any]) -> Any:
    fields: Mapping[str, Any] = layout.fields or {}
    return namedtuple("Offsets", fields)(*(offset for _, offset, *_ in fields.values()))


AT, POINT_AT = _offsets(_SHARED), _offsets(_OF_A_POINT)
SHARED_BYTES, POINT_BYTES = _SHARED.itemsize, _OF_A_POINT.itemsize


class Points(NamedTuple):
    """The observed points (n), brightest first, in the tracker's axes, +Z the boresight.

    Magnitudes may be NaN.  Sigmas are one standard deviation per tangent axis,
    radians.  `velocity` of the observer in inertial axes, in units of c, is
    zero where aberration is not to be corrected.
    """

    observed: Any
    magnitude: Any
    sigma: Any
    velocity: Any


class FieldBounds(NamedTuple):
    """The field of view: within a cosine of the boresight, and within two tangents.

    `area` is its solid angle, `limit_mag` the faintest star that the tracker
    shows, NaN where that is not known, `magnitude_sigma` what a magnitude is
    off by at random.
    """

    cos_radius: Any
    tan_x: Any
    tan_y: Any
    area: Any
    limit_mag: Any
    magnitude_sigma: Any


class Ledger(NamedTuple):
    """Weighed attitudes.

    `match` (LEDGER, n) rows of stars, log `weight` (LEDGER,), `attitude` and
    `covariance` (LEDGER, 3, 3).
    """

    match: Any
    weight: Any
    attitude: Any
    covariance: Any


class Candidate(NamedTuple):
    """The present candidate.

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


class PointPairs(NamedTuple):
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


class Prefilter(NamedTuple):
    """Arrays with which one pair of points predicts the places of the other points.

    For every point the `coefficients` (n, 3) of its place and its `gate` (n,); `order`
    (n,): the most telling first, by `cost` (n,).  By rank in that order: the
    coefficients once more in `single` precision (3, RANKS), the bitmap `level` that answers
    for it and the present `cell` (RANKS,).  `turn` (4,): the ranks that are asked first.
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
    """Pairs of stars to be prefiltered together, each both ways round: two candidates.

    The `places` (6, CHUNK) of their stars.  Which of the two are `allowed` (CHUNK,) by their
    magnitudes and which have been `seen` (CHUNK,) to have a star near: a bit for the pair as
    it is, a second for the pair turned round.  The `cell` (2, CHUNK) where a further
    point is looked for, and the candidates that are `possible` (2 CHUNK,).
    """

    places: Any
    allowed: Any
    cell: Any
    seen: Any
    possible: Any


class Workspace(NamedTuple):
    """What a search for n points writes to: a block of `words_for(n)` words.

    Passed on as it is, and cut where it is needed: code that passes on dozens of
    arrays takes minutes to compile.
    """

    block: Any
    n: Any


@njit(nogil=True)
def words_for(n):  # type: ignore[no-untyped-def]
    """How many words of 64 bits a search for n points needs."""
    return (SHARED_BYTES + n * POINT_BYTES) // 8


@njit(nogil=True)
def _by_point(workspace, offset, shape, dtype):  # type: ignore[no-untyped-def]
    """A field of every point."""
    block, n = workspace
    return view_into(block, SHARED_BYTES + n * offset, shape, dtype)


@njit(nogil=True)
def points_in(workspace):  # type: ignore[no-untyped-def]
    """The points, brightest first."""
    n = workspace.n
    return Points(
        _by_point(workspace, POINT_AT.observed, (n, 3), np.float64),
        _by_point(workspace, POINT_AT.magnitude, (n,), np.float64),
        _by_point(workspace, POINT_AT.sigma, (n,), np.float64),
        view_into(workspace.block, AT.velocity, (3,), np.float64),
    )


@njit(nogil=True)
def order_in(workspace):  # type: ignore[no-untyped-def]
    """The rows (n,) of the points as they were given."""
    return _by_point(workspace, POINT_AT.order, (workspace.n,), np.int64)


@njit(nogil=True)
def candidate_in(workspace):  # type: ignore[no-untyped-def]
    """See `Candidate`."""
    block, n = workspace
    return Candidate(
        _by_point(workspace, POINT_AT.match, (n,), np.int64),
        _by_point(workspace, POINT_AT.near, (n,), np.float64),
        view_into(block, AT.t, (3, 3), np.float64),
        view_into(block, AT.t_covariance, (3, 3), np.float64),
        view_into(block, AT.matrix, (3, 3), np.float64),
        view_into(block, AT.inside, (CHUNK,), np.int32),
    )


@njit(nogil=True)
def point_pairs_in(workspace):  # type: ignore[no-untyped-def]
    """See `PointPairs`."""
    block, n = workspace
    return PointPairs(
        view_into(block, AT.pair_cost, (MOST_POINTS, MOST_POINTS), np.float64),
        view_into(block, AT.used, (MOST_POINTS,), np.float64),
        view_into(block, AT.covered, (MOST_POINTS,), np.int64),
        _by_point(workspace, POINT_AT.first, (n,), np.int64),
        _by_point(workspace, POINT_AT.last, (n,), np.int64),
        _by_point(workspace, POINT_AT.share, (n,), np.float64),
        _by_point(workspace, POINT_AT.beyond, (n,), np.float64),
    )


@njit(nogil=True)
def prefilter_in(workspace):  # type: ignore[no-untyped-def]
    """See `Prefilter`."""
    block, n = workspace
    return Prefilter(
        _by_point(workspace, POINT_AT.coefficients, (n, 3), np.float64),
        _by_point(workspace, POINT_AT.gate, (n,), np.float64),
        _by_point(workspace, POINT_AT.telling, (n,), np.int64),
        _by_point(workspace, POINT_AT.telling_cost, (n,), np.float64),
        view_into(block, AT.turn, (4,), np.int64),
        view_into(block, AT.single, (3, RANKS), np.float32),
        view_into(block, AT.level, (RANKS,), np.int32),
        view_into(block, AT.rank_cell, (RANKS,), np.int32),
    )


@njit(nogil=True)
def chunk_in(workspace):  # type: ignore[no-untyped-def]
    """See `Chunk`."""
    block = workspace.block
    return Chunk(
        view_into(block, AT.places, (6, CHUNK), np.float32),
        view_into(block, AT.allowed, (CHUNK,), np.int32),
        view_into(block, AT.chunk_cell, (2, CHUNK), np.int32),
        view_into(block, AT.seen, (CHUNK,), np.int32),
        view_into(block, AT.possible, (2 * CHUNK,), np.int32),
    )


@njit(nogil=True)
def ledger_in(workspace):  # type: ignore[no-untyped-def]
    """See `Ledger`."""
    block, n = workspace
    return Ledger(
        _by_point(workspace, POINT_AT.ledger, (LEDGER, n), np.int64),
        view_into(block, AT.weight, (LEDGER,), np.float64),
        view_into(block, AT.attitude, (LEDGER, 3, 3), np.float64),
        view_into(block, AT.covariance, (LEDGER, 3, 3), np.float64),
    )


@njit(nogil=True)
def counters_in(workspace):  # type: ignore[no-untyped-def]
    """What the search counts (5,)."""
    return view_into(workspace.block, AT.counters, (5,), np.int64)


@njit(nogil=True)
def deferred_in(workspace):  # type: ignore[no-untyped-def]
    """Deferred candidates (MAX_DEFERRED, 4).

    The pair of points, its two stars, and which further points may have one.
    """
    return view_into(workspace.block, AT.deferred, (MAX_DEFERRED, 4), np.int32)
