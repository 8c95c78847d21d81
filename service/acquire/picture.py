"""A picture from anybody's lens: its attitude, its lens and its stars, with no mission at all."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from service.identify.blind.lens import Lens, LensFit, shared_variance_px2, simpler_fit
from service.identify.blind.solver import (
    WIDEST_FIELD_DEG,
    BlindResult,
    BlindSolver,
    FocalRange,
    rotation_between,
)
from service.identify.blind.verify import LEAST_SIGMA_PX, Points, Verified
from service.imaging.detection.points import (
    FIRST_THRESHOLD,
    MAX_POINTS,
    SECOND_THRESHOLD,
    PointSources,
    find_points,
    has_dark,
)
from service.imaging.frames.exif import is_by_rows, mirrored
from service.imaging.frames.frame import Frame, require_light
from service.imaging.sky_overlay import DrawnStar, SkyView, draw_sky
from service.imaging.submit import exposure_stated
from service.sky.catalog.proper_names import PROPER_NAMES
from service.sky.catalog.star_catalog import Catalog
from service.sky.ephemeris import apparent, observer_velocity
from service.sky.whole_sky.bright_stars import BrightStars, bright_stars
from service.times import parse_utc, utc_now
from service.vectors import (
    ARCSEC_PER_RADIAN,
    Matrix,
    Vector,
    attitude_error_arcsec,
    quaternion_from_matrix,
    ra_dec_of,
    rotate_about,
)

GUESS_SHARE = 0.25
"""How far off a focal length or field of view that is told may be."""
REFINED_POINTS = 200
CLEAR_RATIO, LEAST_CLEAR = 12.0, 25
"""Signal to noise of clear points, and how many of them without an attitude speak for a lens or
pixels of another kind."""
LEAST_SIDE_PX = 100
MIDDLE_SHARES = (1.0 / 3.0, 0.5, 0.25)
"""Parts of the sides of a wide picture that are solved alone."""
MOST_SIGMA_SHARE = 1.0 / 400.0
"""The share of the longer side above which an attitude's sigma is too large for an answer.

Those of nine real pictures are .0005 of the side at most, of drawn ones with seven stars or more
.001.  Residuals scale the sigmas: where stars lie anywhere within gates of pixels, by chance or
because the lens's axis was cropped away, they are .004 and more.
"""
ENOUGH_FREEDOM = 10
"""Residuals less their parameters from which the sigmas are scaled down as well as up."""


@dataclass(frozen=True)
class PictureStar:
    """A star on a picture, in pixels: where it is seen, and that minus where it should be."""

    id: str
    name: str | None
    row: int
    """The rows of the bright stars that the picture was compared with."""
    magnitude_v_mag: float
    u_px: float
    v_px: float
    residual_u_px: float
    residual_v_px: float


@dataclass(frozen=True)
class PictureAttitude:
    """The attitude and the lens of a picture.

    `attitude` (3, 3) turns ICRS into the camera's axes: x to the right of the picture, y
    down, z to the sky through the middle of the picture.  `covariance_rad2` (3, 3) is of the
    small rotation about these axes.  Sigmas are scaled by `sigma_scale`, which the residuals
    gave.  The covariance also holds what the stars' errors may have in common, `shared_px`,
    and how far the lens's last terms turn the attitude: these do not average down.
    """

    attitude: Matrix
    covariance_rad2: Matrix
    fit: LensFit
    sigma_scale: float
    shared_px: float
    log_odds: float
    rms_px: float
    stars: tuple[PictureStar, ...]
    zero_point_mag: float
    zero_point_sigma_mag: float
    aberration_corrected: bool

    @property
    def lens(self) -> Lens:
        """The lens that was fitted; its own axis need not be in the middle of the picture."""
        return self.fit.lens

    @cached_property
    def quaternion(self) -> Vector:
        """Scalar last, inertial to camera."""
        return quaternion_from_matrix(self.attitude)

    @property
    def sigma_arcsec(self) -> Vector:
        """One standard deviation (3,) about each axis of the camera."""
        return np.asarray(np.sqrt(np.diag(self.covariance_rad2)) * ARCSEC_PER_RADIAN)

    @property
    def sigma_share(self) -> float:
        """The largest sigma as a share of the picture's longer side.

        That about z is taken where it moves the ends of that side.
        """
        across, about = self.sigma_arcsec[:2].max(), self.sigma_arcsec[2]
        side = max(self.lens.width_px, self.lens.height_px)
        share = max(across * self.lens.focal_px / side, 0.5 * about)
        return float(share) / ARCSEC_PER_RADIAN

    @property
    def boresight_deg(self) -> tuple[float, float]:
        """Right ascension and declination of the middle of the picture."""
        return ra_dec_of(self.attitude[2])

    @property
    def roll_deg(self) -> float:
        """The position angle of the picture's upper edge: from north through east, 0 to 360."""
        toward, up = self.attitude[2], -self.attitude[1]
        east = np.array([-toward[1], toward[0], 0.0])
        north = np.cross(toward, east)
        return math.degrees(math.atan2(float(up @ east), float(up @ north))) % 360.0

    @property
    def field_deg(self) -> tuple[float, float]:
        """The angles that the picture's width and height span through its middle."""
        lens = self.lens
        u = np.array([-0.5, lens.width_px - 0.5])
        v = np.array([-0.5, lens.height_px - 0.5])
        middle_u, middle_v = _middle(lens)
        across = lens.directions(u, np.full(2, middle_v))
        down = lens.directions(np.full(2, middle_u), v)
        return _angle_deg(*across), _angle_deg(*down)

    def directions(self, u_px: Vector, v_px: Vector) -> Vector:
        """Unit vectors (n, 3) in the camera's axes of places (n,) on the picture."""
        return self.lens.directions(u_px, v_px) @ _of_the_middle(self.lens, np.eye(3)).T

    def sigma_of(self, number: int) -> float:
        """One standard deviation of a parameter of the fit by its number; NaN if not fitted."""
        if number >= self.fit.parameters:
            return math.nan
        return float(math.sqrt(self.fit.covariance[number, number])) * self.sigma_scale


@dataclass(frozen=True)
class PictureResult:
    """The result of a picture: candidates, attitude or None, and remarks in words."""

    frame: Frame
    points: PointSources
    attitude: PictureAttitude | None
    search: BlindResult
    remarks: tuple[str, ...]


def solve_picture(
    frame: Frame,
    sky: BrightStars,
    solver: BlindSolver,
    guess_px: float | None = None,
    whole_only: bool = False,
) -> PictureResult:
    """Find the attitude and the lens of a picture; `guess_px` is a rough focal length.

    Where what is told leads to nothing all other focal lengths are tried, and where the
    clear candidates do, so are fainter ones.  Where all of that leads to nothing, the mirror
    image is tried: a result then is of the mirrored frame, which it holds.  Last, unless
    `whole_only`, its middle alone and pixels averaged in pairs are tried, and a result is of
    such a frame.  Raises `BadFile` for a picture without light.
    """
    require_light(frame, math.inf)
    side = max(frame.width_px, frame.height_px)
    ranges = [FocalRange.of_fields(side, WIDEST_FIELD_DEG)]
    if guess_px is not None:
        ranges.insert(0, FocalRange.about(guess_px, GUESS_SHARE))
    tried: list[PointSources] = []
    for threshold, keep_hot in (
        (FIRST_THRESHOLD, False),
        (SECOND_THRESHOLD, False),
        # Of a lens whose images of stars are much smaller than a pixel.
        (FIRST_THRESHOLD, True),
    ):
        if keep_hot and not tried[0].hot_pixels:
            break
        tried.append(find_points(frame.counts, threshold, keep_hot))
        if tried[-1].trailed is not None:
            return _refused_trails(frame, tried[-1])
        for focal in ranges:
            result = _solved(frame, tried[-1], sky, solver, focal, guess_px)
            if result.attitude is not None:
                return result
    turned = mirrored(frame)
    for points in tried[:2]:
        flipped = points.mirrored(is_by_rows(frame))
        for focal in ranges:
            found = _solved(turned, flipped, sky, solver, focal, guess_px)
            if found.attitude is not None:
                return found
    clear = np.count_nonzero(tried[0].signal_ratio > CLEAR_RATIO)
    if clear >= LEAST_CLEAR and not whole_only:
        for changed, remark in other_shapes(frame):
            if min(changed.counts.shape) < LEAST_SIDE_PX:
                continue
            points = find_points(changed.counts)
            focal = FocalRange.of_fields(max(changed.counts.shape), WIDEST_FIELD_DEG)
            found = _solved(changed, points, sky, solver, focal, None)
            if found.attitude is not None:
                return replace(found, remarks=(remark, *found.remarks))
    points = tried[min(1, len(tried) - 1)]
    return replace(result, points=points, remarks=tuple(_advice(points, frame, guess_px)))


def other_shapes(frame: Frame) -> Iterator[tuple[Frame, str]]:
    """Changed pictures that a simple lens may fit, each with a remark that says what was changed.

    The middle of a picture has the same direction and roll as the whole.  Behind a fisheye, or
    where a plane spans more than the solver looks for, the middle is like any other lens's.
    """
    height, width = frame.counts.shape
    for share in MIDDLE_SHARES:
        down, across = (round(0.5 * (1.0 - share) * side) for side in (height, width))
        counts = frame.counts[down : height - down, across : width - across]
        size = f"{counts.shape[1]} x {counts.shape[0]} px"
        remark = (
            f"wide_lens: the whole picture fits no lens of {WIDEST_FIELD_DEG[1]:g} degrees or less "
            f"without strong distortion; only its middle, {size}, was solved, and field and lens "
            "are those of the middle"
        )
        yield replace(frame, counts=counts), remark
    for name, counts in (
        ("columns", frame.counts[:, : width // 2 * 2].reshape(height, -1, 2).mean(axis=2)),
        ("rows", frame.counts[: height // 2 * 2].reshape(-1, 2, width).mean(axis=1)),
    ):
        remark = (
            f"unequal_pixels: the pixels fit the sky once pairs of {name} are averaged, as after "
            "binning 1 x 2; places and focal length are in pixels of the averaged picture"
        )
        yield replace(frame, counts=counts), remark


def _refused_trails(frame: Frame, points: PointSources) -> PictureResult:
    """The result of a picture whose stars moved in a way that tells no attitude."""
    nothing = BlindResult(None, -math.inf, 0, 0, 0, False)
    return PictureResult(frame, points, None, nothing, (trail_refusal(points),))


def trail_refusal(points: PointSources) -> str:
    """Message that a picture with trailed stars has no attitude, with the reason and remedies."""
    return (
        f"trailed: stars moved by about {points.trail_px:.0f} px during the exposure, "
        f"{points.trailed}: where they were at mid exposure cannot be told; use a shorter "
        "exposure, or hold the camera still"
    )


def _solved(
    frame: Frame,
    points: PointSources,
    sky: BrightStars,
    solver: BlindSolver,
    focal: FocalRange,
    guess_px: float | None,
) -> PictureResult:
    """The result of one range of focal lengths; without an attitude it has no remarks."""
    places = places_of(points)
    search = solver.solve(places, focal)
    if search.found is None:
        return PictureResult(frame, points, None, search, ())
    found = solver.refined(search.found, places.first(REFINED_POINTS), focal)
    attitude = _attitude(found, places, points, frame, sky)
    if attitude.sigma_share > MOST_SIGMA_SHARE:
        return PictureResult(frame, points, None, search, ())
    remarks = [
        *remarks_on(attitude.lens, found, points, guess_px, GUESS_SHARE),
        *_light(points, has_dark(frame)),
    ]
    return PictureResult(frame, points, attitude, search, tuple(remarks))


@lru_cache(maxsize=2)
def blind_sky(catalog: Catalog, year: int | None = None) -> tuple[BrightStars, BlindSolver]:
    """The bright stars of a catalog in a year, by default this one, and the solver over them."""
    sky = bright_stars(catalog, round(utc_now().julian_year) if year is None else year)
    return sky, BlindSolver(sky.direction)


def overlay_of(result: PictureResult, title: str) -> bytes:
    """The picture as PNG with its stars, their names, a grid and a scale."""
    points, found = result.points, result.attitude
    candidates = list(zip(points.u_px.tolist(), points.v_px.tolist(), strict=True))
    view, stars = None, []
    if found is not None:
        ra_deg, dec_deg = found.boresight_deg
        width_deg, height_deg = found.field_deg
        title += (
            f"   RA {ra_deg:.3f}° Dec {dec_deg:+.3f}° roll {found.roll_deg:.2f}°   "
            f"{width_deg:.2f}° x {height_deg:.2f}°"
        )
        optical_axis = _of_the_middle(found.lens, np.eye(3)).T @ found.attitude
        view = SkyView(found.lens.places, optical_axis, found.boresight_deg, found.field_deg)
        stars = [DrawnStar(star.u_px, star.v_px, star.name or star.id) for star in found.stars]
    return draw_sky(
        points.light, points.noise_counts, points.binning, candidates, stars, view, title
    )


def places_of(points: PointSources) -> Points:
    """The candidates as the solver takes them."""
    return Points(points.u_px, points.v_px, points.sigma_px, points.width_px, points.height_px)


def _attitude(
    found: Verified, places: Points, points: PointSources, frame: Frame, sky: BrightStars
) -> PictureAttitude:
    fit, seen = found.fit, np.flatnonzero(found.star >= 0)
    row = found.star[seen]
    pull = found.residual_px / np.maximum(places.sigma_px[seen], LEAST_SIGMA_PX)[:, None]
    freedom = pull.size - fit.parameters
    scale = math.sqrt(float((pull**2).sum()) / max(freedom, 1))
    if freedom < ENOUGH_FREEDOM:
        scale = max(scale, 1.0)
    about = fit.attitude
    if frame.time is not None:
        time = parse_utc(frame.time)
        velocity_c = observer_velocity(time, None)
        moved = apparent(sky.direction[row], velocity_c, time)
        about = fit.attitude @ rotation_between(sky.direction[row], moved)
    jacobian = _turns_of_the_middle(fit)
    # Of the residuals a few stars leave little: what they had in common is not seen at all.
    u_px, v_px, variance_px2 = places.u_px[seen], places.v_px[seen], found.rms_px**2
    shared_px2 = shared_variance_px2(u_px, v_px, found.residual_px, variance_px2)
    flux = points.flux_counts[seen] / (frame.exposure_s or 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        zero = sky.magnitude_mag[row] + 2.5 * np.log10(flux)
    if (seen >= points.clipped_stars).any():
        # The light of stars that are cut off is not known.
        zero = zero[seen >= points.clipped_stars]
    zero = zero[np.isfinite(zero)]
    middle = float(np.median(zero)) if len(zero) else math.nan
    spread = 1.48 * float(np.median(np.abs(zero - middle))) if len(zero) > 1 else math.nan
    return PictureAttitude(
        attitude=_of_the_middle(fit.lens, about),
        covariance_rad2=scale**2 * jacobian @ fit.covariance @ jacobian.T
        + _systematic(found, u_px, v_px, sky.direction[row], shared_px2),
        fit=fit,
        sigma_scale=scale,
        shared_px=math.sqrt(shared_px2),
        log_odds=found.log_odds,
        rms_px=found.rms_px,
        stars=tuple(_stars(found, seen, points, sky)),
        zero_point_mag=middle,
        zero_point_sigma_mag=spread,
        aberration_corrected=frame.time is not None,
    )


def _systematic(
    found: Verified, u_px: Vector, v_px: Vector, star: Vector, shared_px2: float
) -> Matrix:
    """The covariance (3, 3) of what does not average down, in square radians."""
    lens = found.fit.lens
    middle_u, middle_v = _middle(lens)
    arm_px2 = float(np.mean((u_px - middle_u) ** 2 + (v_px - middle_v) ** 2))
    covariance = shared_px2 * np.diag([lens.focal_px**-2.0, lens.focal_px**-2.0, 1.0 / arm_px2])
    simple = simpler_fit(found.fit, u_px, v_px, star, found.residual_px)
    if simple is None:
        return covariance
    whole = _of_the_middle(lens, found.fit.attitude)
    turn = attitude_error_arcsec(_of_the_middle(simple.lens, simple.attitude), whole)
    return np.asarray(covariance + np.outer(turn, turn) / ARCSEC_PER_RADIAN**2)


def _stars(found: Verified, seen: Any, points: PointSources, sky: BrightStars) -> Any:
    """The matched stars, brightest first."""
    order = np.argsort(sky.magnitude_mag[found.star[seen]], kind="stable")
    for k in order.tolist():
        point, row = int(seen[k]), int(found.star[seen[k]])
        place = int(sky.row[row])
        yield PictureStar(
            sky.catalog.star_id(place),
            PROPER_NAMES.get(int(sky.catalog.hip[place])),
            row,
            float(sky.magnitude_mag[row]),
            float(points.u_px[point]),
            float(points.v_px[point]),
            *found.residual_px[k].tolist(),
        )


def _middle(lens: Lens) -> tuple[float, float]:
    return 0.5 * (lens.width_px - 1), 0.5 * (lens.height_px - 1)


def _of_the_middle(lens: Lens, attitude: Matrix) -> Matrix:
    """The attitude whose z goes through the middle of the picture, turned on the shortest way."""
    u, v = _middle(lens)
    x, y, z = lens.directions(np.array([u]), np.array([v]))[0].tolist()
    turn = np.array(
        [
            [1.0 - x * x / (1.0 + z), -x * y / (1.0 + z), -x],
            [-x * y / (1.0 + z), 1.0 - y * y / (1.0 + z), -y],
            [x, y, z],
        ]
    )
    return np.asarray(turn @ attitude)


def _turns_of_the_middle(fit: LensFit) -> Matrix:
    """How the attitude of the middle (3, p) turns, in radians, with every parameter of the fit."""
    turns = np.zeros((3, fit.parameters))
    unmoved = _of_the_middle(fit.lens, fit.attitude)
    step = 1e-6
    for column in range(fit.parameters):
        lens, attitude = fit.lens, fit.attitude
        if column < 3:
            attitude = rotate_about(step * np.eye(3)[column], attitude.T).T
        elif column > 3:
            name = ("bend", "off_u", "off_v")[column - 4]
            lens = replace(lens, **{name: getattr(lens, name) + step})
        moved = _of_the_middle(lens, attitude)
        turns[:, column] = attitude_error_arcsec(moved, unmoved) / ARCSEC_PER_RADIAN / step
    return turns


def _angle_deg(one: Vector, other: Vector) -> float:
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(one, other))), float(one @ other)))


def doubt_of_exposure(result: PictureResult, zero_point_mag: float | None) -> list[str]:
    """A remark where the zero point of a picture is far from that of its camera."""
    found = result.attitude
    if found is None or zero_point_mag is None or not math.isfinite(found.zero_point_mag):
        return []
    off_mag = found.zero_point_mag - zero_point_mag
    if abs(off_mag) <= MOST_OFF_MAG:
        return []
    remark = (
        f"exposure_doubtful: with {exposure_stated(result.frame)}, the zero point is "
        f"{found.zero_point_mag:.2f} mag, and that of the camera {zero_point_mag:.2f} mag: a "
        f"factor of {10.0 ** (0.4 * abs(off_mag)):.3g}"
    )
    return [remark]


MOST_OFF_MAG = 1.5
"""The change of a camera's zero point that clouds and another aperture explain."""
CLIPPED_SHARE = 0.5
BLURRED_PX = 3.5
FEW_POINTS = 6
NOTABLE_HOT = 20
NOTABLE_BEND = 0.003
NOTABLE_FOCAL = 0.005


def remarks_on(
    lens: Lens, found: Verified, points: PointSources, guess_px: float | None, guess_share: float
) -> Iterator[str]:
    """Remarks that a user should read about a picture whose attitude was found."""
    fitted_px = lens.focal_px
    if guess_px is not None:
        off = fitted_px / guess_px - 1.0
        if abs(math.log(fitted_px / guess_px)) > math.log1p(guess_share):
            yield (
                f"focal_length: {fitted_px:.0f} px fits, far from the {guess_px:.0f} px that were "
                "told; the whole range was searched"
            )
        elif abs(off) > NOTABLE_FOCAL:
            yield (
                f"focal_length: residuals are radial: {fitted_px:.0f} px instead of "
                f"{guess_px:.0f} fits"
            )
    if abs(lens.bend) > NOTABLE_BEND:
        kind = "pincushion" if lens.bend < 0.0 else "barrel"
        yield (
            f"distortion: a {kind} of {abs(lens.bend) * lens.radius_px:.1f} px at the corners "
            "was fitted"
        )
    unmatched = len(found.star) - found.matched
    if unmatched > found.matched:
        yield f"clutter: {unmatched} of {len(found.star)} candidates are no star of the catalog"


def _advice(points: PointSources, frame: Frame, guess_px: float | None) -> Iterator[str]:
    """Likely reasons why a picture has no attitude, and options that were not tried."""
    dark = has_dark(frame)
    if points.count < 4:
        yield (
            f"too_few_points: {points.count} points of light, and four are needed: expose longer, "
            "open the aperture, or focus on the stars"
        )
    elif points.count < FEW_POINTS:
        yield f"few_points: {points.count} points of light hardly tell one field from another"
    elif points.count >= MAX_POINTS:
        steps = ["crop what is no sky"]
        if not points.clipped_stars:
            steps += [] if dark else ["take off hot pixels with a dark frame (--dark FILE)"]
            steps.append("use a shorter exposure with less noise")
        yield f"clutter: {MAX_POINTS} candidates and more: {', or '.join(steps)}"
    clear = np.count_nonzero(points.signal_ratio > CLEAR_RATIO)
    if clear >= LEAST_CLEAR:
        least_deg, most_deg = WIDEST_FIELD_DEG
        yield (
            f"no_match: {clear} clear points fit no sky behind a lens of {least_deg:g} to "
            f"{most_deg:g} degrees: they may be no stars, or the lens may be too wide, or the "
            "pixels of unequal sides"
        )
    yield from _light(points, dark)
    if guess_px is None:
        yield "try_next: tell the field of view (--fov DEG), if it is known within a quarter"


def _light(points: PointSources, dark: bool) -> Iterator[str]:
    if points.clipped_stars:
        yield (
            f"clipped_stars: {points.clipped_stars} stars are cut off at the largest count: their "
            "places are from their flanks and less sure, their magnitudes unknown; a picture that "
            "is not stretched shows more"
        )
    if points.trail_px is not None:
        yield (
            f"trailed: stars moved by about {points.trail_px:.0f} px during the exposure; the "
            "middles of their trails were taken, where they were at mid exposure"
        )
    if points.hot_pixels > NOTABLE_HOT:
        more = "" if dark else "; a dark frame (--dark FILE) takes off all of them"
        yield (
            f"hot_pixels: {points.hot_pixels} single bright pixels were taken for no stars{more}"
        )
    if points.clipped_share > CLIPPED_SHARE:
        yield (
            f"clipped: {points.clipped_share:.0%} of the pixels are clipped to black: faint stars "
            "are lost; raise the offset (black level) or expose longer"
        )
    if points.psf_sigma_px > BLURRED_PX:
        yield (
            f"blurred: images of stars are {2.35 * points.psf_sigma_px:.0f} px wide: out of focus, "
            "or moved during the exposure"
        )
