"""The work arrays of a lost-in-space search, as views of one reusable block of memory.

A search takes microseconds, and a memory allocation may take longer. A block is used by one call at
a time.
"""

from collections import namedtuple
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from service.compiled.arrays import view_into
from service.compiled.jit import njit

LEDGER = 12
"""Number of heaviest attitudes that a search keeps."""
MOST_POINTS = 24
"""Number of brightest points whose pairs are tried."""
CHUNK = 64
"""Number of star pairs that are prefiltered at a time."""
MAX_DEFERRED = 4096
"""Number of weak candidates that may wait until all pairs were tried."""
USUAL_POINTS = 64
"""Number of points for which a reusable block has room."""
RANKS = 16
"""Number of ranks for which the most informative points have slots in the work arrays."""

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
"""Layout of the part of a work block whose size is independent of the number of points."""
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
"""Layout of the part of a work block that has one entry per point, field by field."""


def _offsets(layout: np.dtype[Any]) -> Any:
    fields: Mapping[str, Any] = layout.fields or {}
    return namedtuple("Offsets", fields)(*(offset for _, offset, *_ in fields.values()))


AT, POINT_AT = _offsets(_SHARED), _offsets(_OF_A_POINT)
SHARED_BYTES, POINT_BYTES = _SHARED.itemsize, _OF_A_POINT.itemsize


class Points(NamedTuple):
    """The observed points (n), brightest first, in tracker axes with the boresight along +Z.

    Magnitudes may be NaN. Sigmas are one standard deviation per tangent axis, radians. `velocity`
    of the observer in inertial axes, in units of c, is zero if aberration is not corrected.
    """

    observed: Any
    magnitude: Any
    sigma: Any
    velocity: Any


class FieldBounds(NamedTuple):
    """A field of view for kernels: within a cosine of the boresight, and within two tangents.

    `area` is its solid angle, `limit_mag` the faintest star that the tracker shows, NaN if unknown,
    `magnitude_sigma` the random error of a magnitude.
    """

    cos_radius: Any
    tan_x: Any
    tan_y: Any
    area: Any
    limit_mag: Any
    magnitude_sigma: Any


class Ledger(NamedTuple):
    """The weighed attitudes of a lost-in-space search.

    `match` (LEDGER, n) has rows of stars; further log `weight` (LEDGER,), `attitude` and
    `covariance` (LEDGER, 3, 3).
    """

    match: Any
    weight: Any
    attitude: Any
    covariance: Any


class Candidate(NamedTuple):
    """The candidate attitude that is being refined.

    Its `match` (n,), the distances `near` (n,) of its stars in squared gates, its attitude `t` and
    `covariance` (3, 3), a work `matrix` (3, 3), and a buffer of stars `inside` the field (CHUNK,).
    """

    match: Any
    near: Any
    t: Any
    covariance: Any
    matrix: Any
    inside: Any


class PointPairs(NamedTuple):
    """Data that decide which pair of points a lost-in-space search tries next.

    The `cost` (24, 24) of every pair, the penalty of each point for being `used` (24,), and which
    are `covered` (24,). For every point (n,) the `first` and `last` class of pairs whose fainter
    star it may be, their `share` of all pairs, and the probability of a star `beyond` the limit.
    """

    cost: Any
    used: Any
    covered: Any
    first: Any
    last: Any
    share: Any
    beyond: Any


class Prefilter(NamedTuple):
    """The arrays for predicting other points from one pair of points, and for the bitmaps.

    For every point the `coefficients` (n, 3) of its place and its `gate` (n,); `order` (n,): the
    most informative first, by `cost` (n,). By rank in that order: the coefficients in `single`
    precision (3, RANKS), the bitmap `level` and the present `cell` (RANKS,). `turn` (4,): the ranks
    that are checked first.
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
    """A chunk of star pairs to be prefiltered together, each in both orders: two candidates.

    The `places` (6, CHUNK) of their stars. Two bits for the two orders: those `allowed` (CHUNK,) by
    magnitudes, and those `seen` (CHUNK,) to have a star near. The bitmap `cell` (2, CHUNK) of a
    further point's predicted place, and the candidates that are `possible` (2 CHUNK,).
    """

    places: Any
    allowed: Any
    cell: Any
    seen: Any
    possible: Any


class Workspace(NamedTuple):
    """The memory of a lost-in-space search for n points, as one block of words.

    Kernels pass it on whole and take views where needed: passing dozens of arrays takes minutes to
    compile.
    """

    block: Any
    n: Any


@njit(nogil=True)
def words_for(n):  # type: ignore[no-untyped-def]
    """The number of 64-bit words that a search for n points needs."""
    return (SHARED_BYTES + n * POINT_BYTES) // 8


@njit(nogil=True)
def _by_point(workspace, offset, shape, dtype):  # type: ignore[no-untyped-def]
    """A view of an array with an entry per point in a workspace."""
    block, n = workspace
    return view_into(block, SHARED_BYTES + n * offset, shape, dtype)


@njit(nogil=True)
def points_in(workspace):  # type: ignore[no-untyped-def]
    """The observed points in a workspace, brightest first; see `Points`."""
    n = workspace.n
    return Points(
        _by_point(workspace, POINT_AT.observed, (n, 3), np.float64),
        _by_point(workspace, POINT_AT.magnitude, (n,), np.float64),
        _by_point(workspace, POINT_AT.sigma, (n,), np.float64),
        view_into(workspace.block, AT.velocity, (3,), np.float64),
    )


@njit(nogil=True)
def order_in(workspace):  # type: ignore[no-untyped-def]
    """The rows (n,) that the sorted points of a workspace had in the order given."""
    return _by_point(workspace, POINT_AT.order, (workspace.n,), np.int64)


@njit(nogil=True)
def candidate_in(workspace):  # type: ignore[no-untyped-def]
    """The candidate attitude under refinement in a workspace; see `Candidate`."""
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
    """The costs of point pairs in a workspace; see `PointPairs`."""
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
    """The prediction arrays in a workspace; see `Prefilter`."""
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
    """The chunk of star pairs in a workspace; see `Chunk`."""
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
    """The ledger of attitudes in a workspace; see `Ledger`."""
    block, n = workspace
    return Ledger(
        _by_point(workspace, POINT_AT.ledger, (LEDGER, n), np.int64),
        view_into(block, AT.weight, (LEDGER,), np.float64),
        view_into(block, AT.attitude, (LEDGER, 3, 3), np.float64),
        view_into(block, AT.covariance, (LEDGER, 3, 3), np.float64),
    )


@njit(nogil=True)
def counters_in(workspace):  # type: ignore[no-untyped-def]
    """The counters (5,) of a lost-in-space search in a workspace."""
    return view_into(workspace.block, AT.counters, (5,), np.int64)


@njit(nogil=True)
def deferred_in(workspace):  # type: ignore[no-untyped-def]
    """The deferred candidates (MAX_DEFERRED, 4) in a workspace.

    Each has the pair of points, its two stars, and the mask of further points that may have a star.
    """
    return view_into(workspace.block, AT.deferred, (MAX_DEFERRED, 4), np.int32)
