"""The blind solver: attitude, focal length and lens from the places of stars on a picture.

Patterns of four points are looked up by their shape, which neither rotation nor scale changes; each
hit gives an attitude and a focal length, which are then verified with the other stars that the
picture should show.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from service.features.pictures.blind.lens import Lens, distance_of
from service.features.pictures.blind.quads import (
    LEAST_WIDTH,
    LEVELS_DEG,
    QuadLevel,
    build_quad_level,
    quad_codes,
)
from service.features.pictures.blind.verify import Points, Stars, Verified, matched, refine, verify
from service.vectors import Matrix, Projection, Vector

Sets = npt.NDArray[np.int64]

ACCEPT_LOG_ODDS = 14.0
SURE_LOG_ODDS = 30.0
"""Log odds of an attitude and lens at which a blind search ends at once."""
STAGES = ((8, 0.02), (12, 0.02), (16, 0.025), (10, 0.05), (22, 0.025))
"""Stages of a blind search: number of likely points for patterns, and tolerance of their codes."""
NARROW_TAN = 0.25
"""Largest ratio of half diagonal to focal length for which one trial focal length suffices."""
WIDE_STEP = 1.3
"""Ratio of successive trial focal lengths for wider fields."""
VERIFIED_POINTS = 40
COARSE_POINTS = 24
COARSE_GATE = 0.02
"""Tolerance of a match before the lens is fitted, as a share of the half diagonal."""
LIKELY_CHANCE = 0.1
"""Largest probability that chance explains the additional matches of a hit worth verifying."""
MOST_HITS = 20_000
"""Largest number of pattern hits: about half a second of work; random points give a tenth."""
WIDEST_FIELD_DEG = (3.0, 70.0)


@dataclass(frozen=True)
class FocalRange:
    """A range of focal lengths to search, in pixels."""

    least_px: float
    most_px: float

    @property
    def log_width(self) -> float:
        """The width of a range of focal lengths in logarithms, at least 0.01."""
        return max(math.log(self.most_px / self.least_px), 0.01)

    @classmethod
    def about(cls, focal_px: float, share: float) -> "FocalRange":
        """The range of focal lengths within a relative error `share` of a given one."""
        return cls(focal_px / (1.0 + share), focal_px * (1.0 + share))

    @classmethod
    def of_fields(cls, side_px: int, field_deg: tuple[float, float]) -> "FocalRange":
        """The range of focal lengths at which a picture's side spans a range of fields of view."""
        least, most = (focal_px_of(side_px, deg) for deg in field_deg[::-1])
        return cls(least, most)


def focal_px_of(side_px: int, field_deg: float, projection: Projection = "gnomonic") -> float:
    """The focal length in pixels at which a picture's side spans a field of view."""
    return 0.5 * side_px / distance_of(projection, math.radians(0.5 * field_deg))


def least_log_odds(trials: int) -> float:
    """Least log odds of an accepted attitude that is the best of several trials."""
    return ACCEPT_LOG_ODDS + math.log(trials)


class BlindResult(NamedTuple):
    """The result of a blind search: `found` is None where no evidence sufficed.

    `best_log_odds` is that of the best hypothesis, also of a refused one. `patterns`, `hits` and
    `verified` count the patterns looked up, those that agreed in shape, and those confirmed by
    other stars. `bounded`: the search ended at its limit of work.
    """

    found: Verified | None
    best_log_odds: float
    patterns: int
    hits: int
    verified: int
    bounded: bool


@dataclass
class BlindSolver:
    """A blind solver with the star patterns of a catalog (n, 3), built at their first use."""

    direction: Vector
    stars: Stars = field(init=False)
    _levels: dict[float, QuadLevel] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.stars = Stars(self.direction)

    @property
    def nbytes(self) -> int:
        """Estimated size in bytes of the blind solver once all pattern levels are built."""
        return 10 * self.direction.nbytes + 90_000_000

    def level(self, radius_deg: float) -> QuadLevel:
        """The star patterns of one angular size, built at the first call."""
        if radius_deg not in self._levels:
            self._levels[radius_deg] = build_quad_level(self.direction, radius_deg)
        return self._levels[radius_deg]

    def solve(self, points: Points, focal: FocalRange, trials: int = 1) -> BlindResult:
        """The attitude and lens with the most evidence for a picture's points, if it suffices.

        If it is one of several `trials` to explain one picture, it needs as many times the odds of
        a single trial.
        """
        search = _Search(self, points, focal)
        best: Verified | None = None
        bounded = False
        for attitude, lens in search.hypotheses():
            found = search.verified_at(attitude, lens)
            if found is not None and (best is None or found.log_odds > best.log_odds):
                best = found
            if best is not None and best.log_odds > SURE_LOG_ODDS:
                break
            if search.hits >= MOST_HITS:
                bounded = True
                break
        log_odds = -math.inf if best is None else best.log_odds
        return BlindResult(
            best if log_odds > least_log_odds(trials) else None,
            *(log_odds, search.patterns, search.hits, search.verified, bounded),
        )

    def refined(self, found: Verified, points: Points, focal: FocalRange) -> Verified:
        """A verified solution refitted to more points; the same one if that loses many matches."""
        gate_px = max(5.0 * found.rms_px, 2.0)
        again = refine(points, self.stars, found, focal.log_width, gate_px)
        return again if again is not None and again.matched >= 0.9 * found.matched else found


@dataclass
class _Search:
    """The state of one blind search of a picture, with counts of the work done."""

    solver: BlindSolver
    points: Points
    focal: FocalRange
    patterns: int = 0
    hits: int = 0
    verified: int = 0

    def __post_init__(self) -> None:
        self.few = self.points.first(COARSE_POINTS)
        self.many = self.points.first(VERIFIED_POINTS)

    def hypotheses(self) -> Iterator[tuple[Matrix, Lens]]:
        """Attitudes and lenses at which a pattern of four points matches one of the catalog."""
        done: list[tuple[int, float]] = []
        for most, tolerance in STAGES:
            count = min(most, len(self.points))
            sets = _sets_of_four(count)
            # Skip patterns that an earlier stage looked up with at least this tolerance.
            sets = sets[sets[:, 3] >= max((n for n, t in done if t >= tolerance), default=0)]
            done.append((count, tolerance))
            if len(sets):
                for guess in _guesses(self.points, self.focal):
                    yield from self._hits(sets, *guess, tolerance)

    def _hits(
        self, sets: Sets, lens: Lens, least_px: float, most_px: float, tolerance: float
    ) -> Iterator[tuple[Matrix, Lens]]:
        points, sky = self.points, self.solver.direction
        code, order, chord = quad_codes(lens.directions(points.u_px, points.v_px)[sets])
        quads = np.take_along_axis(sets, order, axis=1)
        for radius_deg in LEVELS_DEG:
            narrow, wide = (share * math.radians(radius_deg) for share in (LEAST_WIDTH, 2.0))
            # The longer the focal length, the smaller the angle of a pattern on the picture.
            fits = (chord * lens.focal_px < wide * most_px) & (
                chord * lens.focal_px > narrow * least_px
            )
            fitting = np.flatnonzero(fits)
            if len(fitting) == 0:
                continue
            level = self.solver.level(radius_deg)
            self.patterns += len(fitting)
            found = level.tree.query_ball_point(code[fitting], tolerance)
            for k in np.flatnonzero([len(rows) > 0 for rows in found]).tolist():
                quad = quads[fitting[k]]
                focal_px = lens.focal_px * chord[fitting[k]] / level.chord[found[k]]
                within = (focal_px > 0.97 * least_px) & (focal_px < 1.03 * most_px)
                for row, length in zip(
                    np.asarray(found[k])[within], focal_px[within].tolist(), strict=True
                ):
                    self.hits += 1
                    at = Lens(lens.width_px, lens.height_px, length)
                    body = at.directions(points.u_px[quad], points.v_px[quad])
                    yield rotation_between(body, sky[level.stars[row]]), at

    def verified_at(self, attitude: Matrix, lens: Lens) -> Verified | None:
        """The verified solution of a pattern hit; None if too few other stars match."""
        few, stars = self.few, self.solver.stars
        gate_px = COARSE_GATE * lens.radius_px
        _, u, v = stars.near(attitude, lens, 2 * len(few))
        if len(u) < 4:
            return None
        _, seen = matched(few, u, v, gate_px)
        share = math.pi * gate_px**2 / (lens.width_px * lens.height_px)
        further = len(seen) - 4
        if further < 1 or _chance_of(further, len(few) * len(u) * share) > LIKELY_CHANCE:
            return None
        self.verified += 1
        return verify(self.many, stars, attitude, lens, self.focal.log_width, gate_px)


def _guesses(points: Points, focal: FocalRange) -> list[tuple[Lens, float, float]]:
    """Trial lenses, each with the least and largest focal length that it represents."""
    radius = 0.5 * math.hypot(points.width_px, points.height_px)
    narrow_px = radius / NARROW_TAN
    guesses = []
    if focal.most_px > narrow_px:
        least = max(focal.least_px, narrow_px)
        guesses.append((min(math.sqrt(2.0) * least, focal.most_px), least, focal.most_px))
    top = min(focal.most_px, narrow_px)
    while top > 1.0001 * focal.least_px:
        low = max(top / WIDE_STEP, focal.least_px)
        guesses.append((math.sqrt(low * top), low, top))
        top = low
    return [(Lens(points.width_px, points.height_px, f), low, high) for f, low, high in guesses]


@cache
def _sets_of_four(count: int) -> Sets:
    """All sets of four out of `count` points, those of the most likely points first."""
    sets = np.array(list(combinations(range(count), 4)), dtype=np.int64).reshape(-1, 4)
    return sets[np.argsort(sets[:, 3], kind="stable")]


def rotation_between(body: Vector, sky: Vector) -> Matrix:
    """The rotation (3, 3) that best turns directions `sky` (n, 3) into `body` (n, 3)."""
    u, _, vt = np.linalg.svd(body.T @ sky)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _chance_of(count: int, mean: float) -> float:
    """The Poisson probability of at least `count` events for a given mean."""
    term, below = math.exp(-mean), 0.0
    for k in range(count):
        below += term
        term *= mean / (k + 1)
    return 1.0 - below
