"""Images of stars by a camera: still, trailed by the body's rates, or with long tails.

Stars with far-reaching images, such as diffraction by an aperture, are found one after another. The
tails of a bright star break into pieces that look like faint stars and hide faint stars. So stars
are subtracted from the frame, the brightest first, each at its best-fitting place, and the residual
is searched again. A piece of a tail has disappeared by the time that its turn comes.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from service.features.pictures.centroids.optics import thermal
from service.features.pictures.centroids.psf import (
    ColouredPsf,
    GaussianPsf,
    Psf,
    SampledPsf,
    airy_psf,
    psfs_in_colours,
    wired_psf,
)
from service.features.pictures.centroids.shape_fit import fit_in_its_colour
from service.features.pictures.centroids.window import Array, Detector, Mask, Window, cutout
from service.features.pictures.detection.cosmic_rays import is_sharp
from service.features.pictures.frames.frame import CountArray
from service.missions.camera import Camera, PsfKind, Wire
from service.missions.mission import Tracker
from service.observations.scans.lines import BREAKDOWN_RATIO
from service.vectors import Matrix, Vector, rotate_about

PsfAt = Callable[[Vector, Vector], list[Psf]]
"""A function from places (n,) on a frame to the image of a star at each place."""

AIRY_OVER_SIGMA = 2.29
"""Ratio of lambda f / D to the sigma of the Gaussian with the same full width at half maximum."""
REACH_OVER_AIRY = 45.0
"""Radius of a computed diffraction image, in lambda f / D: two nulls of a wire a tenth wide."""
LEAST_REACH_PX, MOST_REACH_PX = 48, 160
CORE_SIGMAS = 3.0
COLOURS = 61
"""Number of wavelengths in the sum over a band."""
BLUE_BV_MAG, RED_BV_MAG = -0.2, 1.6
"""Colour indices B-V of the two stars whose images are mixed for stars of any colour."""
SHORT_TRAIL_PX = 0.1


def reach_px(camera: Camera) -> int:
    """The radius in whole pixels to which a star's image is drawn and subtracted."""
    if camera.psf == "gaussian":
        return 8
    reach = math.ceil(REACH_OVER_AIRY * AIRY_OVER_SIGMA * camera.psf_sigma_px)
    return min(max(reach, LEAST_REACH_PX), MOST_REACH_PX)


def still_psf(camera: Camera) -> Psf:
    """The image of a star that does not move; a computed diffraction image is cached."""
    if camera.psf != "gaussian" and camera.band_nm is not None:
        blue, red = psfs_of_colours(camera, (BLUE_BV_MAG, RED_BV_MAG))
        return ColouredPsf(blue, red)
    return _psf(camera.psf, camera.psf_sigma_px, camera.wires, reach_px(camera))


def psfs_of_colours(camera: Camera, bv_mag: tuple[float, ...]) -> Sequence[Psf]:
    """The still images of stars with given colour indices B-V, in the band of a camera.

    Stars shine as black bodies (Ballesteros 2012), the detector counts photons.
    """
    assert camera.band_nm is not None
    return _psfs(
        camera.psf, camera.psf_sigma_px, camera.wires, reach_px(camera), camera.band_nm, bv_mag
    )


@lru_cache(maxsize=8)
def _psfs(
    kind: PsfKind,
    sigma_px: float,
    wires: tuple[Wire, ...],
    reach: int,
    band_nm: tuple[float, float],
    bv_mag: tuple[float, ...],
) -> Sequence[Psf]:
    shortest, longest = band_nm
    weights = []
    for bv in bv_mag:
        heat_k = 4600.0 * (1.0 / (0.92 * bv + 1.7) + 1.0 / (0.92 * bv + 0.62))
        light = thermal(heat_k, shortest * 1e-9, longest * 1e-9, COLOURS)
        photons = light.power * light.wavelength_m
        weights.append(photons / photons.sum())
    sharpest_px = sigma_px * shortest / (0.5 * (shortest + longest))
    sharpest = _psf(kind, sharpest_px, wires, reach)
    assert isinstance(sharpest, SampledPsf)
    return psfs_in_colours(sharpest, light.wavelength_m * 1e9 / shortest, np.array(weights))


@lru_cache(maxsize=8)
def _psf(kind: PsfKind, sigma_px: float, wires: tuple[Wire, ...], reach: int) -> Psf:
    if kind == "gaussian":
        return GaussianPsf(sigma_px)
    if kind == "airy":
        return airy_psf(AIRY_OVER_SIGMA * sigma_px, reach_px=reach)
    return wired_psf(AIRY_OVER_SIGMA * sigma_px, wires, reach_px=reach)


def core_share(camera: Camera) -> float:
    """The share of a star's light in the core of its image; the rest is in tails and rings."""
    if camera.psf == "gaussian":
        return 1.0
    half = math.ceil(CORE_SIGMAS * camera.psf_sigma_px)
    steps = np.arange(-half, half + 1, dtype=np.float64)
    return float(still_psf(camera).pixel(steps[None, :], steps[:, None]).sum())


def psf_of(
    camera: Camera,
    tracker: Tracker | None = None,
    rates_deg_per_s: Vector | None = None,
    exposure_s: float = 0.0,
) -> PsfAt:
    """A function that gives the images of stars, still or trailed by the body's rates."""
    still = still_psf(camera)

    def at(u_px: Vector, v_px: Vector) -> list[Psf]:
        if tracker is None or rates_deg_per_s is None:
            return [still] * len(u_px)
        along = trails_px(
            camera, tracker.body_from_tracker, rates_deg_per_s, u_px, v_px, exposure_s
        )
        return [
            _drawn_out(still, u, v) if math.hypot(u, v) > SHORT_TRAIL_PX else still
            for u, v in zip(*(each.tolist() for each in along), strict=True)
        ]

    return at


STEP_PX = 0.3
"""Step in the sum of still images along a trail: to a thousandth of a smooth trail's peak."""
MOST_STEPS = 400


@dataclass(frozen=True)
class TrailPsf:
    """A star's image smeared evenly along the chord (`trail_u_px`, `trail_v_px`)."""

    psf: Psf
    trail_u_px: float
    trail_v_px: float

    @property
    def fwhm_px(self) -> float:
        """The full widths of the still image and of the trail, added in quadrature, in pixels."""
        # A uniform distribution over the length l has the variance l^2 / 12.
        spread = math.hypot(self.trail_u_px, self.trail_v_px) / math.sqrt(12.0)
        return math.hypot(self.psf.fwhm_px, 2.0 * math.sqrt(2.0 * math.log(2.0)) * spread)

    def pixel(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> Array:
        """The share of the light on pixels at (du, dv) from the star; see `Psf`."""
        du, dv = np.asarray(du_px, dtype=np.float64), np.asarray(dv_px, dtype=np.float64)
        parts = [self.psf.pixel(du - u, dv - v) for u, v in self._steps()]
        return np.asarray(sum(parts[1:], parts[0]) / len(parts))

    def slopes(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> tuple[Array, Array]:
        """The derivatives of a pixel's share of light with respect to du and dv; see `Psf`."""
        du, dv = np.asarray(du_px, dtype=np.float64), np.asarray(dv_px, dtype=np.float64)
        parts = [self.psf.slopes(du - u, dv - v) for u, v in self._steps()]
        along_u, along_v = (np.stack(each).mean(axis=0) for each in zip(*parts, strict=True))
        return along_u, along_v

    def _steps(self) -> list[tuple[float, float]]:
        length = math.hypot(self.trail_u_px, self.trail_v_px)
        count = min(MOST_STEPS, max(1, math.ceil(length / STEP_PX)))
        return [
            (self.trail_u_px * share, self.trail_v_px * share)
            for share in ((k + 0.5) / count - 0.5 for k in range(count))
        ]


def _drawn_out(psf: Psf, u_px: float, v_px: float) -> Psf:
    """A star's image smeared along a trail; a mixture of two colours stays one."""
    if isinstance(psf, ColouredPsf):
        blue, red = TrailPsf(psf.blue, u_px, v_px), TrailPsf(psf.red, u_px, v_px)
        return replace(psf, blue=blue, red=red)
    return TrailPsf(psf, u_px, v_px)


def trails_px(
    camera: Camera,
    body_from_tracker: Matrix,
    rates_deg_per_s: Vector,
    u_px: Vector,
    v_px: Vector,
    exposure_s: float,
) -> tuple[Vector, Vector]:
    """The shift (n,) along u and v of stars during an exposure while the body turns, in pixels.

    Places are those of mid exposure; rates w are of the body relative to inertial, in body axes,
    where an inertially fixed star moves with -w x v.
    """
    turn = np.radians(rates_deg_per_s) @ body_from_tracker * (exposure_s / 2.0)
    middle = camera.directions(u_px, v_px)
    begin_u, begin_v = camera.places(rotate_about(turn, middle))
    end_u, end_v = camera.places(rotate_about(-turn, middle))
    return end_u - begin_u, end_v - begin_v


ROUNDS = 4
FAR_FWHMS = 1.2
"""Distance from a star, in widths of its image, beyond which light belongs to the tails."""
TAIL_NOISES = 0.5
"""Least level of a star's tails at their brightest pixel, in sigmas of noise, for subtraction."""
DOUBT = 0.03
"""Error of a subtracted image from an inexact PSF, as a share of its light."""
SAME_PX = 2.5
LEAST_SHARE = 0.5
"""Least share of a candidate's light that must remain once brighter stars are subtracted; with
less, the candidate may be a piece of a tail.

A star on a brighter tail is found in the next round.
"""
SEEN_SHARE = 0.3
"""Least ratio of a candidate's detected light to the fitted light of its star."""
MOST_IMAGES, MOST_TRIED = 400, 800
"""Largest numbers of stars subtracted, and of candidates tried in one round, to bound the work."""
MARGIN_PX = 2
FAINTEST_DRAWN = 0.01
"""Light of a pixel, in sigmas of noise, below which an image is cut off."""

Extract = Callable[[CountArray, CountArray, "Mask | None", Camera], npt.NDArray[np.void]]
"""A function that detects sources by SEP in light (rows, columns) with a noise map."""


@dataclass(frozen=True)
class StarImage:
    """One subtracted star: its place, its total light, and its image on the frame."""

    u_px: float
    v_px: float
    flux_counts: float
    psf: Psf
    where: tuple[slice, slice]
    counts: Array


@dataclass(frozen=True)
class StarImages:
    """The subtracted stars of a frame, and the sum of their images."""

    stars: list[StarImage]
    light: CountArray

    def places_and_light(self) -> Array:
        """Columns, rows and counts of the subtracted stars (3, n)."""
        rows = [(star.u_px, star.v_px, star.flux_counts) for star in self.stars]
        return np.array(rows, dtype=np.float64).reshape(-1, 3).T

    def behind(self, window: Window, number: int | None) -> Window:
        """A window with the images of all subtracted stars but one as part of its background."""
        rows, columns = window.counts.shape
        v, u = window.corner_v_px, window.corner_u_px
        light = self.light[v : v + rows, u : u + columns].astype(np.float64)
        if number is not None:
            star = self.stars[number]
            own = np.zeros_like(light)
            put_into(own, star.counts, star.where[0].start - v, star.where[1].start - u)
            light -= own
        return replace(window, background_counts=window.background_counts + light)


def put_into(whole: Array, part: Array, row: int, column: int) -> None:
    """Add a smaller array to a larger one at (row, column), clipped to the larger one."""
    rows, columns = whole.shape
    top, left = max(row, 0), max(column, 0)
    bottom, right = min(row + part.shape[0], rows), min(column + part.shape[1], columns)
    if top < bottom and left < right:
        whole[top:bottom, left:right] += part[
            top - row : bottom - row, left - column : right - column
        ]


@dataclass(frozen=True)
class ImageSearch:
    """An iterative search for stars with far-reaching images in one frame.

    `light` is above the background `level`; `noise` is one sigma of a pixel of `light`.
    """

    light: CountArray
    level: CountArray
    noise: float
    mask: Mask | None
    detector: Detector
    camera: Camera
    psf_at: PsfAt
    extract: Extract

    def taken_off(self) -> tuple[StarImages, npt.NDArray[np.void], CountArray]:
        """The subtracted stars, the candidates found behind them by SEP, and the residual light."""
        images = StarImages([], np.zeros_like(self.light))
        limit = TAIL_NOISES * self.noise / max(_tail_share(still_psf(self.camera)), 1e-9)
        for round_ in range(ROUNDS + 1):
            left = self.light - images.light
            found = self.extract(left, self._noise_behind(images), self.mask, self.camera)
            if round_ == ROUNDS or not self._taken(images, found, left, limit):
                break
            for number in range(len(images.stars)):
                self._refit(images, number)
        return images, _without_residue(images, found), left

    def _noise_behind(self, images: StarImages) -> CountArray:
        """One sigma of each pixel after subtraction, with photon noise and shape error of the
        images.
        """
        light = np.maximum(images.light, 0.0)
        gain = self.detector.gain_e_per_count
        variance = self.noise**2 + light / gain + (DOUBT * light) ** 2
        return np.asarray(np.sqrt(variance), dtype=self.light.dtype)

    def _taken(
        self, images: StarImages, found: npt.NDArray[np.void], left: CountArray, limit: float
    ) -> int:
        """Subtract the stars among the candidates, brightest first; returns their number."""
        u, v = found["x"].astype(np.float64), found["y"].astype(np.float64)
        sharp = is_sharp(left, u, v, self.camera.psf_sigma_px)
        psfs = self.psf_at(u, v)
        before = len(images.stars)
        for k in np.argsort(-found["flux"], kind="stable")[:MOST_TRIED].tolist():
            if len(images.stars) == MOST_IMAGES:
                break
            seen, at = float(found["flux"][k]), (float(u[k]), float(v[k]))
            if sharp[k] or seen < SEEN_SHARE * limit or _near(images, *at):
                continue
            if self._core(images, *at) < LEAST_SHARE * _core_of(left, *at):
                continue
            window = images.behind(self._cutout(*at), None)
            star = self._placed(window, at, psfs[k])
            if star is None or star.flux_counts <= max(limit, SEEN_SHARE * seen):
                continue
            if not _near(images, star.u_px, star.v_px):
                self._put(images, star)
        return len(images.stars) - before

    def _refit(self, images: StarImages, number: int) -> None:
        """Fit one subtracted star again behind all others; unchanged if that fails or moves it."""
        star = images.stars[number]
        at = star.u_px, star.v_px
        window = images.behind(self._cutout(*at), number)
        placed = self._placed(window, at, star.psf)
        if placed is None or math.hypot(placed.u_px - at[0], placed.v_px - at[1]) > SAME_PX:
            return
        images.light[star.where] -= star.counts.astype(images.light.dtype)
        images.light[placed.where] += placed.counts.astype(images.light.dtype)
        images.stars[number] = placed

    def _placed(self, window: Window, at: tuple[float, float], psf: Psf) -> StarImage | None:
        """The image of the star fitted in a window; None where its light is too faint to fit."""
        start = at[0] - window.corner_u_px, at[1] - window.corner_v_px
        found, psf = fit_in_its_colour(window, psf, start, self._half)
        if found is None or not found.signal_ratio >= BREAKDOWN_RATIO:
            return None
        u, v = found.u_px + window.corner_u_px, found.v_px + window.corner_v_px
        return self._drawn(u, v, found.flux_counts, psf)

    def _cutout(self, u_px: float, v_px: float) -> Window:
        half = self._half + MARGIN_PX
        good = None if self.mask is None else ~self.mask
        # The background level is added to the counts, so that saturated pixels are recognised.
        window = cutout(self.light, u_px, v_px, half, self.detector, self.level, good=good)
        return replace(window, counts=window.counts + window.background_counts)

    def _core(self, images: StarImages, u: float, v: float) -> float:
        """The residual light of the 3 x 3 pixels about a place, after subtraction."""
        return _core_of(self.light, u, v) - _core_of(images.light, u, v)

    def _put(self, images: StarImages, star: StarImage) -> None:
        images.stars.append(star)
        images.light[star.where] += star.counts.astype(images.light.dtype)

    def _drawn(self, u: float, v: float, flux: float, psf: Psf) -> StarImage:
        rows, columns = self.light.shape
        enough = [half for half, rim in self._rims if flux * rim < FAINTEST_DRAWN * self.noise]
        half = enough[-1] if enough else reach_px(self.camera)
        left, top = max(round(u) - half, 0), max(round(v) - half, 0)
        right, bottom = min(round(u) + half + 1, columns), min(round(v) + half + 1, rows)
        du = np.arange(left, right, dtype=np.float64)[None, :] - u
        dv = np.arange(top, bottom, dtype=np.float64)[:, None] - v
        where = slice(top, bottom), slice(left, right)
        return StarImage(u, v, flux, psf, where, flux * psf.pixel(du, dv))

    @property
    def _half(self) -> int:
        return self.camera.centroid_half_width_px

    @cached_property
    def _rims(self) -> list[tuple[int, float]]:
        """Half widths of squares about a star, each with the largest share of light on its rim."""
        still, halves = still_psf(self.camera), [reach_px(self.camera)]
        while halves[-1] > 4 * self._half:
            halves.append(halves[-1] // 2)
        return [(half, _rim(still, half)) for half in halves]


def _tail_share(psf: Psf) -> float:
    """The share of a star's light in the brightest pixel of its tails."""
    far = FAR_FWHMS * psf.fwhm_px
    steps = np.arange(-32.0, 33.0)
    image = psf.pixel(steps[None, :], steps[:, None])
    return float(np.max(image, where=np.hypot(steps[None, :], steps[:, None]) > far, initial=0.0))


def _rim(psf: Psf, half: int) -> float:
    """The share of a star's light in the brightest pixel on the rim of a square."""
    along = np.arange(-half, half + 1, dtype=np.float64)
    end = np.full_like(along, float(half))
    return float(max(psf.pixel(along, end).max(), psf.pixel(end, along).max()))


def _near(images: StarImages, u: float, v: float) -> bool:
    return any(math.hypot(star.u_px - u, star.v_px - v) < SAME_PX for star in images.stars)


def _core_of(light: CountArray, u: float, v: float) -> float:
    """The light of the 3 x 3 pixels nearest to a place."""
    column, row = max(round(u), 1), max(round(v), 1)
    return float(light[row - 1 : row + 2, column - 1 : column + 2].sum())


def _without_residue(images: StarImages, found: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
    """The candidates that are not residuals of a subtracted star, as rows of SEP."""
    places = zip(found["x"].tolist(), found["y"].tolist(), strict=True)
    return found[np.array([not _near(images, u, v) for u, v in places], dtype=np.bool_)]
