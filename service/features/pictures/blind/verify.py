"""Evidence for an attitude and a lens: catalog stars that match a picture's points."""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from service.features.pictures.blind.lens import (
    BEND_PRIOR,
    CENTER_PRIOR,
    FREE_SCALE,
    SCALE_BEND,
    SCALE_CENTER,
    Lens,
    LensFit,
    fit_lens,
)
from service.vectors import Matrix, Vector

Rows = npt.NDArray[np.int64]

GATE_SIGMAS = 3.5
LEAST_SIGMA_PX = 0.15
"""Least sigma in pixels of a picture's points, before residuals show the actual errors."""
FAINTEST_SHARE = 2.5
"""Number of catalog stars tried per point of a picture, as clutter and gaps shift the limit."""
LEAST_STARS, MOST_STARS = 12, 400
MODELS = (FREE_SCALE, SCALE_BEND, SCALE_CENTER)
FIRST_MODEL = 3
"""Round of verification from which lens models are fitted; earlier ones collect matches."""
LEAST_MATCHES = {FREE_SCALE: 4, SCALE_BEND: 7, SCALE_CENTER: 12}
"""Least number of matches for each lens model; among those allowed the evidence decides."""
HOPELESS_LOG_ODDS = 0.0
"""Log odds after two rounds below which a hypothesis is dropped; chance stays below -5."""
CROWD = 6
"""Number of nearest points that measure the crowding of a place."""
LEAST_REFINED = {FREE_SCALE: 4, SCALE_BEND: 6, SCALE_CENTER: 8}
"""Least number of matches for each lens model in a refinement at a known attitude."""


@dataclass(frozen=True)
class Points:
    """Points of light in a picture (n), likeliest stars first: places and sigmas in pixels."""

    u_px: Vector
    v_px: Vector
    sigma_px: Vector
    width_px: int
    height_px: int

    def __len__(self) -> int:
        return len(self.u_px)

    @cached_property
    def crowding(self) -> Vector:
        """Local density of other points about each point (n), over the mean density; at least 1.

        Clutter gathers in corners and along horizons. If clutter were assumed uniform, a cluster of
        stars that matches such clutter would look significant.
        """
        others = len(self) - 1
        if others < 2:
            return np.ones(len(self))
        places = np.column_stack([self.u_px, self.v_px])
        near = min(CROWD, others)
        # Squares about the points, since their overlap with the picture is exact.
        reach = cKDTree(places).query(places, k=near + 1, p=math.inf)[0][:, -1:]
        size = np.array([self.width_px, self.height_px], dtype=np.float64)
        sides = np.minimum(places + reach, size - 0.5) - np.maximum(places - reach, -0.5)
        share = np.maximum(sides.prod(axis=1), 1.0) / size.prod()
        return np.asarray(np.maximum((near - 1) / others / share, 1.0))

    def first(self, count: int) -> "Points":
        """The first `count` points of a picture, which are the most likely stars."""
        return replace(
            self,
            u_px=self.u_px[:count],
            v_px=self.v_px[:count],
            sigma_px=self.sigma_px[:count],
        )


@dataclass(eq=False)
class Stars:
    """The catalog's directions (n, 3), brightest star first, with search trees."""

    direction: Vector
    _trees: dict[int, cKDTree] = field(default_factory=dict)

    def _brightest(self, toward: Vector, reach: float, most: int) -> Rows:
        """The catalog rows of the brightest `most` stars within an angle of a direction.

        The search uses as many of the sky's brightest stars as have that number there on average,
        and more if that part of the sky is empty.
        """
        count = 2.0 * most / (0.5 * (1.0 - math.cos(reach)))
        while True:
            power = min(math.ceil(math.log2(count)), math.ceil(math.log2(len(self.direction))))
            if power not in self._trees:
                self._trees[power] = cKDTree(self.direction[: 2**power])
            found = self._trees[power].query_ball_point(toward, 2.0 * math.sin(0.5 * reach))
            if len(found) >= most or 2**power >= len(self.direction):
                return np.sort(np.asarray(found, int))[:most]
            count = 2.0 ** (power + 1)

    def near(self, attitude: Matrix, lens: Lens, most: int) -> tuple[Rows, Vector, Vector]:
        """Catalog rows of the brightest `most` stars on a picture, and their pixel coordinates."""
        reach = lens.reach_rad + 0.002
        # Preselection before projection: the picture fills most of the cap about it.
        rows = self._brightest(attitude[2], reach, 3 * most)
        u, v = lens.places(self.direction[rows] @ attitude.T)
        with np.errstate(invalid="ignore"):
            inside = (u > -0.5) & (v > -0.5) & (u < lens.width_px) & (v < lens.height_px)
        first = np.flatnonzero(inside)[:most]
        return rows[first], u[first], v[first]


@dataclass(frozen=True)
class Verified:
    """A verified attitude with its lens, the star of every point (-1: none), and the evidence.

    `log_odds` is the evidence against all points being clutter, integrated over all attitudes and
    expected scales. `residual_px` (m, 2) of the matched points is observed minus predicted;
    `rms_px` per axis accounts for the fitted parameters.
    """

    fit: LensFit
    star: Rows
    log_odds: float
    residual_px: Vector
    rms_px: float

    @property
    def matched(self) -> int:
        """The number of points matched with a star."""
        return int((self.star >= 0).sum())


def verify(
    points: Points,
    stars: Stars,
    attitude: Matrix,
    lens: Lens,
    log_focal_range: float,
    gate_px: float,
) -> Verified | None:
    """Attitude and lens refined by rounds of matching and fitting; None with too few matches."""
    sigma = np.maximum(points.sigma_px, LEAST_SIGMA_PX)
    best = None
    for number, parameters in enumerate((*[0] * FIRST_MODEL, *MODELS)):
        if number == 2 and (best is None or best.log_odds < HOPELESS_LOG_ODDS):
            return best
        if number <= FIRST_MODEL:
            # All models are fitted to the matches of the last search round.
            rows, at, seen = _matches(points, stars, attitude, lens, gate_px)
        if len(seen) < LEAST_MATCHES[parameters or FREE_SCALE]:
            return best
        fit = _refit(points, stars, attitude, lens, rows[at], seen, sigma, parameters)
        scale = _scale(fit, sigma[seen])
        found = _weighed(points, stars, fit, sigma * scale, log_focal_range)
        if found is not None and (best is None or found.log_odds > best.log_odds):
            best = found
        if not parameters:
            # Each search round starts from the fit before it; all models start from the last search
            # round.
            attitude, lens = fit.attitude, fit.lens
            gate_px = min(gate_px, max(GATE_SIGMAS * scale * float(np.median(sigma[seen])), 0.8))
    return best


def refine(
    points: Points, stars: Stars, found: Verified, log_focal_range: float, gate_px: float
) -> Verified | None:
    """A verified solution refitted to more points, with all lens parameters that they allow.

    Parameters that the evidence does not favour are fitted too, so that the sigmas include their
    uncertainty.
    """
    sigma = np.maximum(points.sigma_px, LEAST_SIGMA_PX)
    attitude, lens, refined = found.fit.attitude, found.fit.lens, None
    for _ in range(3):
        rows, at, seen = _matches(points, stars, attitude, lens, gate_px)
        allowed = [each for each in MODELS if len(seen) >= LEAST_REFINED[each]]
        if not allowed:
            break
        fit = _refit(points, stars, attitude, lens, rows[at], seen, sigma, allowed[-1])
        scale = _scale(fit, sigma[seen])
        refined = fit, scale
        attitude, lens = fit.attitude, fit.lens
        gate_px = min(gate_px, max(GATE_SIGMAS * scale * float(np.median(sigma[seen])), 0.8))
    if refined is None:
        return None
    fit, scale = refined
    return _weighed(points, stars, fit, sigma * scale, log_focal_range)


def _refit(
    points: Points,
    stars: Stars,
    attitude: Matrix,
    lens: Lens,
    rows: Rows,
    seen: Rows,
    sigma: Vector,
    parameters: int,
) -> LensFit:
    """Fit a lens to matches; for `parameters` 0, with distortion if there are enough matches."""
    if not parameters:
        parameters = SCALE_BEND if len(seen) >= LEAST_MATCHES[SCALE_BEND] else FREE_SCALE
    start = replace(lens, off_u=0.0, off_v=0.0, bend=lens.bend if parameters > FREE_SCALE else 0.0)
    return fit_lens(
        start,
        attitude,
        points.u_px[seen],
        points.v_px[seen],
        sigma[seen],
        stars.direction[rows],
        parameters,
        weight=_weights(points, stars, attitude, lens, rows, seen, sigma),
    )


def _scale(fit: LensFit, sigma: Vector) -> float:
    """Factor, at least 1, by which sigmas must grow to agree with a lens fit's median residual."""
    pull = np.abs(fit.residual_px) / sigma[:, None]
    # With few stars the fit absorbs a part of the residuals.
    freedom = max(pull.size - fit.parameters, 1) / pull.size
    return max(float(np.median(pull)) / 0.674 / math.sqrt(freedom), 1.0)


def _weights(
    points: Points,
    stars: Stars,
    attitude: Matrix,
    lens: Lens,
    rows: Rows,
    seen: Rows,
    sigma: Vector,
) -> Vector:
    """Weights (n,) of matches by their residuals, so that wrong ones have little influence."""
    u, v = lens.places(stars.direction[rows] @ attitude.T)
    off = np.hypot(points.u_px[seen] - u, points.v_px[seen] - v)
    usual = max(2.0 * float(np.median(off)), float(np.median(sigma[seen])))
    return np.asarray(1.0 / (1.0 + (off / usual) ** 2))


def _matches(
    points: Points, stars: Stars, attitude: Matrix, lens: Lens, gate_px: float
) -> tuple[Rows, Rows, Rows]:
    """Catalog rows on the picture, and for each match the index into the rows and of its point."""
    most = int(np.clip(FAINTEST_SHARE * len(points), LEAST_STARS, MOST_STARS))
    rows, u, v = stars.near(attitude, lens, most)
    if len(rows) == 0:
        nothing = np.empty(0, np.int64)
        return nothing, nothing, nothing
    at, seen = matched(points, u, v, gate_px)
    return rows, at, seen


def matched(points: Points, u_px: Vector, v_px: Vector, gate_px: float) -> tuple[Rows, Rows]:
    """Pairs of stars and points that are mutual nearest neighbours, within a gate."""
    apart = (points.u_px[:, None] - u_px) ** 2 + (points.v_px[:, None] - v_px) ** 2
    star_of, point_of = apart.argmin(axis=1), apart.argmin(axis=0)
    rows = np.arange(len(star_of))
    good = (point_of[star_of] == rows) & (apart[rows, star_of] < gate_px**2)
    return star_of[good], rows[good]


def _weighed(
    points: Points, stars: Stars, fit: LensFit, sigma: Vector, log_focal_range: float
) -> Verified | None:
    """The solution of a fit with its evidence, by Laplace's approximation over the parameters."""
    lens = fit.lens
    gate_px = GATE_SIGMAS * float(np.median(sigma))
    rows, at, seen = _matches(points, stars, fit.attitude, lens, max(gate_px, 0.8))
    if len(seen) < 4:
        return None
    u, v = lens.places(stars.direction[rows[at]] @ fit.attitude.T)
    residual = np.column_stack([points.u_px[seen] - u, points.v_px[seen] - v])
    off2 = (residual**2).sum(axis=1)
    variance = sigma[seen] ** 2
    # The depth is that of the faintest match but for a few; deeper matches cost more evidence.
    depth = float(np.sort(at)[-1 - len(at) // 10]) + 1.0
    expected = np.maximum(at + 1.0, depth)
    share = len(seen) / (len(points) + 1.0)
    area = float(lens.width_px * lens.height_px)
    gain = area / (expected * 2.0 * math.pi * variance) * np.exp(-0.5 * off2 / variance)
    gain /= points.crowding[seen]
    weight = float(np.log(1.0 - share + share * gain).sum())
    weight += (len(points) - len(seen)) * math.log(1.0 - share)
    # The covariance is for the assumed sigmas; the observed scatter enlarges them.
    covariance = (
        fit.covariance * float(np.median(sigma / np.maximum(points.sigma_px, LEAST_SIGMA_PX))) ** 2
    )
    prior = [8.0 * math.pi**2, log_focal_range]
    prior += [math.sqrt(2.0 * math.pi) * s for s in (BEND_PRIOR, CENTER_PRIOR, CENTER_PRIOR)]
    spread = 0.5 * np.linalg.slogdet(2.0 * math.pi * covariance)[1]
    log_odds = weight + float(spread) - sum(math.log(p) for p in prior[: fit.parameters - 2])
    star = np.full(len(points), -1)
    star[seen] = rows[at]
    freedom = max(2 * len(seen) - fit.parameters, 1)
    return Verified(fit, star, log_odds, residual, math.sqrt(float(off2.sum()) / freedom))
