"""The lost-in-space solver: the attitude of a star field without prior knowledge.

Use it as `LostInSpace(index, field).solve(direction, magnitude_mag, sigma_rad)`.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from service.attitude.solution import NoAttitude
from service.compiled.arrays import borrowed_view
from service.compiled.jit import njit
from service.identify.lost_in_space import decision, posterior
from service.identify.lost_in_space.pair_order import magnitude_gate
from service.identify.lost_in_space.search import MAX_WORK, search
from service.identify.lost_in_space.workspace import (
    USUAL_POINTS,
    FieldBounds,
    Points,
    Workspace,
    ledger_in,
    order_in,
    points_in,
    words_for,
)
from service.sky.whole_sky.index import SkyIndex, index_in
from service.vectors import Matrix, Vector, locked

Rows = npt.NDArray[np.int64]
_AT_REST = np.zeros(3)
_BLOCKS: list[Vector] = []
"""Work blocks kept for reuse, as many as searches ever ran at once."""
FEWEST_POINTS = 3
"""Least number of points for a search: two stars are ambiguous."""


NO_MIRROR_ABOVE = 25.0
"""Log odds above which a field is not tested against its mirror image."""

_REFUSALS = {
    decision.FOUND: None,
    decision.TOO_FEW: NoAttitude.FEWER_THAN_THREE_STARS,
    decision.NOTHING: NoAttitude.NO_MATCH,
    decision.DOUBTFUL: NoAttitude.DOUBTFUL_MATCH,
    decision.DEGENERATE: NoAttitude.DEGENERATE_GEOMETRY,
}


@dataclass(frozen=True)
class FieldOfView:
    """Tracker's field of view: a circle or square about +Z, its limiting magnitude, its photometry.

    `limit_mag` is NaN if the faintest visible star is not known.
    """

    radius_deg: float
    half_width_deg: float | None = None
    """Half the side of a square field with corners at `radius_deg`; None for a circular one."""
    limit_mag: float = math.nan
    magnitude_sigma_mag: float = 0.5

    @classmethod
    def square(cls, side_deg: float) -> "FieldOfView":
        """A square field of view with edges `side_deg` apart."""
        tangent = math.tan(math.radians(0.5 * side_deg))
        corner_deg = math.degrees(math.atan(tangent * math.sqrt(2.0)))
        return cls(corner_deg, 0.5 * side_deg)

    def as_field(self) -> FieldBounds:
        """The field of view in the form that kernels take."""
        cosine = math.cos(math.radians(self.radius_deg))
        if self.half_width_deg is None:
            return FieldBounds(
                *(cosine, math.inf, math.inf, 2.0 * math.pi * (1.0 - cosine)),
                *(self.limit_mag, self.magnitude_sigma_mag),
            )
        tangent = math.tan(math.radians(self.half_width_deg))
        # The solid angle of a pyramid over a square.
        area = 4.0 * math.asin(tangent * tangent / (1.0 + tangent * tangent))
        return FieldBounds(cosine, tangent, tangent, area, self.limit_mag, self.magnitude_sigma_mag)


class LostInSpaceResult(NamedTuple):
    """The result of a lost-in-space search; its rows are in the order of the given points.

    It is a tuple because its construction must be cheap beside a solution of ten microseconds. If
    `refusal` gives a reason for no attitude, the arrays describe the best candidate, if any.
    """

    refusal: NoAttitude | None
    matrices: npt.NDArray[np.float64]
    """The attitude matrix and the covariance matrix, stacked (2, 3, 3)."""
    star: Rows
    """The index row of each point's star (n,), -1 for an unexplained point."""
    log_odds: float
    """Natural logarithm of the odds of the attitude against all other explanations."""
    matched: int
    work: int
    """The number of candidates examined."""
    bounded: bool
    """True if the search ended at the work limit."""

    @property
    def attitude(self) -> Matrix | None:
        """The attitude matrix (3, 3) from inertial to tracker components; None if refused."""
        return None if self.refusal is not None else np.asarray(self.matrices[0])

    @property
    def covariance_rad2(self) -> Matrix:
        """The covariance (3, 3) of the attitude, for small rotations about the tracker's axes."""
        return np.asarray(self.matrices[1])


class StarChances(NamedTuple):
    """Likeliest star of each point (-1: none), its probability, that of no star, second star."""

    star: Rows
    probability: Vector
    none: Vector
    rival: Rows


class LostInSpace:
    """A lost-in-space solver for one field of view and one sky index; stateless between calls."""

    def __init__(self, index: SkyIndex, field: FieldOfView) -> None:
        self.index = index
        self.field = field
        self._field = np.array(field.as_field())

    def solve(
        self,
        direction: Vector,
        magnitude_mag: Vector,
        sigma_rad: Vector,
        velocity_c: Vector = _AT_REST,
        max_work: int = MAX_WORK,
    ) -> LostInSpaceResult:
        """Solve the attitude of points (n, 3) in tracker axes; magnitudes may be NaN.

        `sigma_rad` (n,) is one standard deviation per tangent axis. `velocity_c` of the observer,
        inertial, in units of c, is used for aberration; zero if uncorrected. At most `max_work`
        candidates are examined.
        """
        block = _BLOCKS.pop() if _BLOCKS else np.empty(words_for(USUAL_POINTS))
        code, *rest = _solve(
            *map(locked, (direction, magnitude_mag, sigma_rad, velocity_c)),
            *(self.index.store, self._field, max_work, block),
        )
        _BLOCKS.append(block)
        return LostInSpaceResult(_REFUSALS[code], *rest)

    def chances(
        self,
        result: LostInSpaceResult,
        direction: Vector,
        magnitude_mag: Vector,
        sigma_rad: Vector,
        velocity_c: Vector = _AT_REST,
    ) -> StarChances:
        """The probabilities of each point's star, and of its rival, at the attitude of a result."""
        points = Points(*map(locked, (direction, magnitude_mag, sigma_rad, velocity_c)))
        doubt = 1.0 / (1.0 + math.exp(min(result.log_odds, 700.0)))
        gate = magnitude_gate(self.field.magnitude_sigma_mag)
        return StarChances(
            *decision.star_probabilities(
                *(points, self.index.arrays, self.field.as_field(), gate),
                *(*result.matrices, result.star, doubt),
            )
        )


@njit(nogil=True)
def _sort_points(direction, magnitude, sigma, velocity, workspace):  # type: ignore[no-untyped-def]
    """Sort the points brightest first, unknown magnitudes last, ties in the given order."""
    n = len(direction)
    order, points = order_in(workspace), points_in(workspace)
    for k in range(n):
        m = magnitude[k]
        at = k
        while at > 0 and (
            magnitude[order[at - 1]] > m or (np.isnan(magnitude[order[at - 1]]) and not np.isnan(m))
        ):
            order[at] = order[at - 1]
            at -= 1
        order[at] = k
    for k in range(n):
        for i in range(3):
            points.observed[k, i] = direction[order[k], i]
        points.magnitude[k], points.sigma[k] = magnitude[order[k]], sigma[order[k]]
    for i in range(3):
        points.velocity[i] = velocity[i]


@njit(nogil=True)
def _decided(n, count, work, bounded, workspace, matrices, star):  # type: ignore[no-untyped-def]
    """Fill attitude, covariance and stars in the given order of points; returns the decision."""
    ledger, order = ledger_in(workspace), order_in(workspace)
    best, log_odds, code = decision.decide(ledger, count)
    matched = 0
    if best >= 0:
        for i in range(3):
            for j in range(3):
                matrices[0, i, j] = ledger.attitude[best, i, j]
                matrices[1, i, j] = ledger.covariance[best, i, j]
        for k in range(n):
            star[order[k]] = ledger.match[best, k]
            matched += ledger.match[best, k] >= 0
    if n < FEWEST_POINTS:
        code = decision.TOO_FEW
    elif work == 0:
        # Not searched: chance would match so few or such inaccurate points somewhere.
        code = decision.DOUBTFUL
    return code, log_odds, matched, work, bounded


@njit(nogil=True)
def _field_in(values):  # type: ignore[no-untyped-def]
    return FieldBounds(values[0], values[1], values[2], values[3], values[4], values[5])


@njit(nogil=True)
def _solve(direction, magnitude, sigma, velocity, store, field, max_work, block):  # type: ignore[no-untyped-def]
    n = len(direction)
    matrices, star = np.zeros((2, 3, 3)), np.full(n, -1, np.int64)
    if len(block) < words_for(n):
        block = np.empty(words_for(n))
    _sort_points(direction, magnitude, sigma, velocity, Workspace(block, n))
    # Arrays are allocated in this function and kept alive, so that callees may borrow them.
    code, log_odds, matched, work, bounded = _searched(
        *(n, store, field, max_work, block, matrices, star)
    )
    return code, matrices, star, log_odds, matched, work, bounded


@njit(nogil=True)
def _searched(n, store, field, max_work, block, matrices, star):  # type: ignore[no-untyped-def]
    matrices, star = borrowed_view(matrices), borrowed_view(star)
    index, field = index_in(store), _field_in(field)
    workspace = Workspace(block, n)
    points, ledger = points_in(workspace), ledger_in(workspace)
    count, work, bounded = search(points, index, field, max_work, workspace)
    decided = _decided(n, count, work, bounded, workspace, matrices, star)
    code, log_odds, matched, _, _ = decided
    if code != decision.FOUND or log_odds > NO_MIRROR_ABOVE or n - matched < 2:
        return decided
    # Stars symmetric about a line match a mirrored sky too, but the others do not.
    weight = ledger.weight[:count].max()
    for k in range(n):
        points.observed[k, 0] = -points.observed[k, 0]
    count, more, bounded = search(points, index, field, max_work, workspace)
    if count > 0 and ledger.weight[:count].max() > weight + math.log(posterior.DOUBT):
        code = decision.DOUBTFUL
    return code, log_odds, matched, work + more, bounded
