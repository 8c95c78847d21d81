"""Blind solution of a picture from any lens: attitude, lens and stars, without a mission."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from service.errors import BadInput, Fault, shown_value
from service.features.pictures.blind.bright_stars import BrightStars, bright_stars
from service.features.pictures.blind.lens import (
    PROJECTIONS,
    Lens,
    LensFit,
    shared_variance_px2,
    simpler_fit,
)
from service.features.pictures.blind.picture_remarks import (
    CLEAR_RATIO,
    LEAST_CLEAR,
    advice_on,
    remarks_on,
    remarks_on_light,
)
from service.features.pictures.blind.proper_names import PROPER_NAMES
from service.features.pictures.blind.solver import (
    COARSE_GATE,
    WIDEST_FIELD_DEG,
    BlindResult,
    BlindSolver,
    FocalRange,
    focal_px_of,
    least_log_odds,
    rotation_between,
)
from service.features.pictures.blind.square_pixels import averaged, with_square_pixels
from service.features.pictures.blind.verify import LEAST_SIGMA_PX, Points, Verified, verify
from service.features.pictures.detection.points import (
    FIRST_THRESHOLD,
    SECOND_THRESHOLD,
    PointSources,
    find_points,
    has_dark,
)
from service.features.pictures.frames.exif import is_by_rows, mirrored
from service.features.pictures.frames.frame import Frame, require_light
from service.sky.catalog.star_catalog import Catalog
from service.sky.ephemeris import apparent, observer_velocity
from service.times import parse_utc, utc_now
from service.vectors import (
    ARCSEC_PER_RADIAN,
    Matrix,
    Projection,
    Vector,
    attitude_error_arcsec,
    quaternion_from_matrix,
    ra_dec_of,
    rotate_about,
)

GUESS_SHARE = 0.25
"""Largest relative error of a stated focal length or field of view."""
REFINED_POINTS = 200
LEAST_SIDE_PX = 100
MIDDLE_SHARES = (1.0 / 3.0, 0.5, 0.25)
"""Shares of a wide picture's sides that the middle part has which is solved by itself."""
CHANGED_TRIALS = 16
"""Number of changed versions of a picture that may be tried, by which odds are judged."""
LEAST_FAR_SHARE = 0.5
"""Least share of points with a star far from the middle, over that share near the middle."""
MOST_SIGMA_SHARE = 1.0 / 400.0
"""Largest sigma of an accepted attitude, as a share of the picture's longer side.

Nine real pictures have at most .0005, simulated ones with seven or more stars .001. Sigmas are
scaled by residuals: for chance matches, or a lens whose axis was cropped away, they are .004 and
more.
"""
WIDEST_PLAIN_DEG = 120
"""Field of view in degrees that no plain (gnomonic) lens has."""
ENOUGH_FREEDOM = 10
"""Degrees of freedom from which residuals may also reduce the sigmas."""


@dataclass(frozen=True)
class PictureStar:
    """An identified star on a picture: its measured place, and its residual, in pixels."""

    id: str
    name: str | None
    row: int
    """The row of the star in the list of bright stars of the search."""
    magnitude_v_mag: float
    u_px: float
    v_px: float
    residual_u_px: float
    residual_v_px: float


@dataclass(frozen=True)
class PictureAttitude:
    """The attitude and the lens of a solved picture.

    `attitude` (3, 3) turns ICRS into the camera's axes: x to the right of the picture, y down, z to
    the sky through the middle of the picture. `covariance_rad2` (3, 3) is of the small rotation
    about these axes. Sigmas are scaled by `sigma_scale`, which the residuals gave. The covariance
    also holds the possible common error of the stars, `shared_px`, and the rotation of the attitude
    by the lens's last terms: these do not average down.
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
        """The fitted lens, whose optical axis may be off the middle of the picture."""
        return self.fit.lens

    @property
    def lens_attitude(self) -> Matrix:
        """The attitude matrix (3, 3) of axes whose z is the optical axis of the lens."""
        return np.asarray(_of_the_middle(self.lens, np.eye(3)).T @ self.attitude)

    @cached_property
    def quaternion(self) -> Vector:
        """The picture's attitude as a quaternion, scalar last, inertial to camera."""
        return quaternion_from_matrix(self.attitude)

    @property
    def sigma_arcsec(self) -> Vector:
        """One standard deviation (3,) of the attitude about each axis of the camera, in arcsec."""
        return np.asarray(np.sqrt(np.diag(self.covariance_rad2)) * ARCSEC_PER_RADIAN)

    @property
    def sigma_share(self) -> float:
        """The largest sigma of the attitude, as a share of the picture's longer side.

        The sigma about z is converted to the displacement of that side's ends.
        """
        across, about = self.sigma_arcsec[:2].max(), self.sigma_arcsec[2]
        side = max(self.lens.width_px, self.lens.height_px)
        share = max(across * self.lens.focal_px / side, 0.5 * about)
        return float(share) / ARCSEC_PER_RADIAN

    @property
    def boresight_deg(self) -> tuple[float, float]:
        """Right ascension and declination of the middle of the picture, in degrees."""
        return ra_dec_of(self.attitude[2])

    @property
    def roll_deg(self) -> float:
        """Position angle of the picture's upper edge, from north through east, 0 to 360 degrees."""
        toward, up = self.attitude[2], -self.attitude[1]
        east = np.array([-toward[1], toward[0], 0.0])
        north = np.cross(toward, east)
        return math.degrees(math.atan2(float(up @ east), float(up @ north))) % 360.0

    @property
    def field_deg(self) -> tuple[float, float]:
        """The angles in degrees that the picture's width and height span through its middle."""
        lens = self.lens
        u = np.array([-0.5, lens.width_px - 0.5])
        v = np.array([-0.5, lens.height_px - 0.5])
        middle_u, middle_v = _middle(lens)
        across = lens.directions(u, np.full(2, middle_v))
        down = lens.directions(np.full(2, middle_u), v)
        return _angle_deg(*across), _angle_deg(*down)

    def directions(self, u_px: Vector, v_px: Vector) -> Vector:
        """Unit vectors (n, 3) in the camera's axes for places (n,) on the picture."""
        return self.lens.directions(u_px, v_px) @ _of_the_middle(self.lens, np.eye(3)).T

    def sigma_of(self, number: int) -> float:
        """One standard deviation of a fitted parameter by its number; NaN if it was not fitted."""
        if number >= self.fit.parameters:
            return math.nan
        return float(math.sqrt(self.fit.covariance[number, number])) * self.sigma_scale


@dataclass(frozen=True)
class PictureResult:
    """The result for a picture: candidates, the attitude or None, and remarks in words."""

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
    projection: Projection | None = None,
) -> PictureResult:
    """Find the attitude and the lens of a picture; `guess_px` is a rough focal length.

    Where the sides of a pixel are unequal, the picture is first solved with square ones. With a
    `projection` the result is for the whole picture with that lens, or without an attitude;
    see `_of_fisheye`.

    If the stated focal length fails, all others are tried, and if the clear candidates fail,
    fainter ones. If all of that fails, the mirror image is tried; the result then contains the
    mirrored frame. Last, unless `whole_only`, the middle of the picture alone and pixels averaged
    in pairs are tried. From the middle the lens of the whole picture is searched; if none fits, the
    result is that of the middle or of averaged pixels. Raises `BadFile` for a picture without
    light.
    """
    require_light(frame, math.inf)
    if frame.pixel_ratio not in (None, 1.0):
        square, remark, share = with_square_pixels(frame)
        guess = None if guess_px is None else guess_px * share
        found = solve_picture(square, sky, solver, guess, whole_only, projection)
        if found.attitude is not None:
            return replace(found, remarks=(remark, *found.remarks))
        frame = replace(frame, pixel_ratio=None)
    if projection not in (None, "gnomonic"):
        return _of_fisheye(frame, sky, solver, guess_px, projection)
    side = max(frame.width_px, frame.height_px)
    ranges = [FocalRange.of_fields(side, WIDEST_FIELD_DEG)]
    if guess_px is not None:
        ranges.insert(0, FocalRange.about(guess_px, GUESS_SHARE))
    tried: list[PointSources] = []
    for threshold, keep_hot in (
        (FIRST_THRESHOLD, False),
        (SECOND_THRESHOLD, False),
        # For a lens whose star images are much smaller than a pixel.
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
        projections = PROJECTIONS if projection is None else (projection,)
        for whole, points in ((frame, tried[0]), (turned, tried[0].mirrored(is_by_rows(frame)))):
            wide = _from_middle(whole, points, sky, solver, None, projections)
            if wide is not None:
                return wide
        for changed, remark in averaged(frame):
            found = _solved_part(changed, sky, solver, None)
            if found.attitude is not None:
                return replace(found, remarks=(remark, *found.remarks))
    points = tried[min(1, len(tried) - 1)]
    return replace(result, points=points, remarks=tuple(advice_on(points, frame, guess_px)))


def focal_px_of_field(
    side_px: int, field_deg: float, projection: Projection | None, field: str
) -> float:
    """Focal length in pixels at which a picture's longer side spans a field of view.

    Raises `BadInput` naming `field` for a field too wide for a plain lens.
    """
    projection = projection or "gnomonic"
    if projection == "gnomonic" and field_deg >= WIDEST_PLAIN_DEG:
        message = f"must be below {WIDEST_PLAIN_DEG} degrees, unless a lens of a fisheye is named"
        raise BadInput(Fault(field, message, shown_value(field_deg)))
    return focal_px_of(side_px, field_deg, projection)


def _solved_part(
    frame: Frame, sky: BrightStars, solver: BlindSolver, guess_px: float | None
) -> PictureResult:
    """The result for a part of a picture, or for changed pixels; `guess_px` is a focal length."""
    points = find_points(frame.counts)
    focal = FocalRange.of_fields(max(frame.counts.shape), WIDEST_FIELD_DEG)
    if guess_px is not None:
        focal = FocalRange.about(guess_px, GUESS_SHARE)
    return _solved(frame, points, sky, solver, focal, None, CHANGED_TRIALS)


def _of_fisheye(
    frame: Frame,
    sky: BrightStars,
    solver: BlindSolver,
    guess_px: float | None,
    projection: Projection,
) -> PictureResult:
    """The result for a picture, or its mirror image, through a fisheye of a known projection."""
    points = find_points(frame.counts)
    if points.trailed is not None:
        return _refused_trails(frame, points)
    mirror = mirrored(frame), points.mirrored(is_by_rows(frame))
    for guess in (None,) if guess_px is None else (guess_px, None):
        for whole, candidates in ((frame, points), mirror):
            found = _from_middle(whole, candidates, sky, solver, guess, (projection,))
            if found is not None:
                return found
    nothing = BlindResult(None, -math.inf, 0, 0, 0, False)
    remark = (
        f"no_match: neither the picture nor its middle fits the sky behind a lens of {projection} "
        "projection: tell another projection, or none"
    )
    remarks = (remark, *remarks_on_light(points, has_dark(frame)))
    return PictureResult(frame, points, None, nothing, remarks)


def _from_middle(
    frame: Frame,
    points: PointSources,
    sky: BrightStars,
    solver: BlindSolver,
    guess_px: float | None,
    projections: Sequence[Projection],
) -> PictureResult | None:
    """Result for a wide picture, found by solving its middle first; None if that fails.

    The middle has the direction and the roll of the whole picture. From its attitude, which needs
    sufficient evidence, the lens of the whole is searched. If none of several projections fits, the
    result is that of the middle; if a single one does not, there is no result.
    """
    is_told = len(projections) == 1
    for share in (*MIDDLE_SHARES, 1.0) if is_told else MIDDLE_SHARES:
        part = _middle_of(frame, share)
        if min(part.counts.shape) < LEAST_SIDE_PX:
            continue
        found = _solved_part(part, sky, solver, guess_px)
        if found.attitude is None:
            continue
        whole = _widened(frame, points, found.attitude, sky, solver, projections)
        if whole is not None:
            return whole
        if not is_told:
            size = f"{part.width_px} x {part.height_px} px"
            remark = (
                f"wide_lens: the whole picture fits no lens of {WIDEST_FIELD_DEG[1]:g} degrees or "
                f"less, and no wider one without strong distortion; only its middle, {size}, was "
                "solved, and field and lens are those of the middle; tell how the lens projects "
                "the sky (--lens NAME)"
            )
            return replace(found, remarks=(remark, *found.remarks))
    return None


def _fits_far_out(found: Verified, places: Points) -> bool:
    """True if the outer half of the points has about as many identified stars as the inner half."""
    middle_u, middle_v = _middle(found.fit.lens)
    away = np.hypot(places.u_px - middle_u, places.v_px - middle_v)
    far, has_star = away > np.median(away), found.star >= 0
    return float(has_star[far].sum()) >= LEAST_FAR_SHARE * float(has_star[~far].sum())


def _middle_of(frame: Frame, share: float) -> Frame:
    """A frame cut to its middle, with a given share of its sides."""
    height, width = frame.counts.shape
    down, across = (round(0.5 * (1.0 - share) * side) for side in (height, width))
    return replace(frame, counts=frame.counts[down : height - down, across : width - across])


def _widened(
    frame: Frame,
    points: PointSources,
    middle: PictureAttitude,
    sky: BrightStars,
    solver: BlindSolver,
    projections: Sequence[Projection],
) -> PictureResult | None:
    """The result for a whole picture from the attitude of its middle; None if no projection fits.

    Of several projections the one with the most evidence is chosen.
    """
    places = places_of(points).first(REFINED_POINTS)
    attitude = _of_the_middle(middle.lens, middle.fit.attitude)
    focal = FocalRange.about(middle.lens.focal_px, GUESS_SHARE)
    best: Verified | None = None
    for projection in projections:
        lens = Lens(frame.width_px, frame.height_px, middle.lens.focal_px, projection=projection)
        gate_px = COARSE_GATE * lens.radius_px
        found = verify(places, solver.stars, attitude, lens, focal.log_width, gate_px)
        if found is not None and (best is None or found.log_odds > best.log_odds):
            best = found
    least = least_log_odds(CHANGED_TRIALS * len(projections))
    if best is None or best.log_odds < least or not _fits_far_out(best, places):
        return None
    best = solver.refined(best, places, focal)
    whole = _attitude(best, places_of(points), points, frame, sky)
    if whole.sigma_share > MOST_SIGMA_SHARE:
        return None
    width_deg, height_deg = whole.field_deg
    remark = (
        f"wide_lens: a lens of {whole.lens.projection} projection and {width_deg:.0f} x "
        f"{height_deg:.0f} degrees fits the whole picture"
    )
    remarks = (
        remark,
        *remarks_on(whole.lens, best, points, None, GUESS_SHARE),
        *remarks_on_light(points, has_dark(frame)),
    )
    search = BlindResult(best, best.log_odds, 0, 0, 0, False)
    return PictureResult(frame, points, whole, search, remarks)


def _refused_trails(frame: Frame, points: PointSources) -> PictureResult:
    """The result for a picture with star trails that give no attitude."""
    nothing = BlindResult(None, -math.inf, 0, 0, 0, False)
    return PictureResult(frame, points, None, nothing, (trail_refusal(points),))


def trail_refusal(points: PointSources) -> str:
    """A message that a picture with star trails has no attitude, with the reason and remedies."""
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
    trials: int = 1,
) -> PictureResult:
    """The result for one range of focal lengths; without an attitude it has no remarks."""
    places = places_of(points)
    search = solver.solve(places, focal, trials)
    if search.found is None:
        return PictureResult(frame, points, None, search, ())
    found = solver.refined(search.found, places.first(REFINED_POINTS), focal)
    attitude = _attitude(found, places, points, frame, sky)
    if attitude.sigma_share > MOST_SIGMA_SHARE:
        return PictureResult(frame, points, None, search, ())
    remarks = [
        *remarks_on(attitude.lens, found, points, guess_px, GUESS_SHARE),
        *remarks_on_light(points, has_dark(frame)),
    ]
    return PictureResult(frame, points, attitude, search, tuple(remarks))


@lru_cache(maxsize=2)
def blind_sky(catalog: Catalog, year: int | None = None) -> tuple[BrightStars, BlindSolver]:
    """The bright stars of a catalog in a year, by default this one, and a blind solver for them."""
    sky = bright_stars(catalog, round(utc_now().julian_year) if year is None else year)
    return sky, BlindSolver(sky.direction)


def places_of(points: PointSources) -> Points:
    """The candidates of a picture in the form that the blind solver takes."""
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
    # A fit to few stars absorbs the error that they share.
    u_px, v_px, variance_px2 = places.u_px[seen], places.v_px[seen], found.rms_px**2
    shared_px2 = shared_variance_px2(u_px, v_px, found.residual_px, variance_px2)
    flux = points.flux_counts[seen] / (frame.exposure_s or 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        zero = sky.magnitude_mag[row] + 2.5 * np.log10(flux)
    if (seen >= points.clipped_stars).any():
        # The light of clipped stars is unknown.
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
    """The covariance (3, 3) in rad² of attitude errors that more stars do not reduce."""
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
    """The matched stars of a picture, brightest first."""
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
    """Rotate an attitude by the shortest way until its z axis goes through the picture's middle."""
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
    """Rotation (3, p) in radians of the middle's attitude per unit of each lens parameter."""
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
