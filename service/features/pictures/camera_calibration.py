"""Calibration of a camera from pictures of the sky: one lens for all, one attitude for each."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from service.features.pictures.blind.lens import (
    BEND_PRIOR,
    CENTER_PRIOR,
    PARAMETERS,
    Lens,
    lens_of,
    linearised,
)
from service.features.pictures.blind.picture import PictureResult
from service.features.pictures.blind.verify import LEAST_SIGMA_PX
from service.vectors import Matrix, Vector, rotate_about

ROUNDS = 15
OUTLIER_SIGMAS = 4.0
OBSERVABLE = 0.5
"""Ratio of a parameter's sigma to its prior's below which the pictures determine it."""
LEAST_FLOOR_PX = 0.01
LEAST_TOLD_PX = 0.05
"""Least predicted error of a place: bright stars would decide over the whole lens otherwise."""


@dataclass(frozen=True)
class CameraCalibration:
    """The result of a camera calibration: the lens with covariance, and residuals before and after.

    `covariance` (4, 4) is of the logarithm of the focal length, the bend and the centre in units of
    the half diagonal, scaled by the residuals. Places and residuals are (n, 2): before, with only a
    focal length, of all stars, and after, without rejected stars. `centroid_sigma_px` is the
    predicted error of a place, as an rms over the stars of `after_px`; `sigma_floor_px` the
    remaining error.
    """

    lens: Lens
    covariance: Matrix
    before_place_px: Vector
    before_px: Vector
    place_px: Vector
    after_px: Vector
    centroid_sigma_px: float
    sigma_floor_px: float
    psf_sigma_px: float
    noise_counts: float
    zero_point_mag: float
    zero_point_sigma_mag: float
    exposure_s: float | None
    faintest_mag: float
    pictures: int
    remarks: tuple[str, ...]

    @property
    def rms_px(self) -> tuple[float, float]:
        """The rms residuals per axis in pixels, before and after the calibration."""
        before, after = (
            math.sqrt(float(np.mean(each**2))) for each in (self.before_px, self.after_px)
        )
        return before, after

    def sigma(self, number: int) -> float:
        """Standard deviation of a lens parameter: 0 for log focal length, 1 bend, 2, 3 centre."""
        return float(math.sqrt(self.covariance[number, number]))


@dataclass
class _View:
    """The stars of one picture, with its current attitude in the calibration."""

    attitude: Matrix
    u_px: Vector
    v_px: Vector
    predicted_px: Vector
    star: Vector

    @property
    def sigma_px(self) -> Vector:
        """Predicted errors of star places in pixels, at least the errors of the lens model."""
        return np.maximum(self.predicted_px, LEAST_SIGMA_PX)


def calibrate_camera(
    results: Sequence[PictureResult], stars: Sequence[Vector]
) -> CameraCalibration:
    """Fit one lens to pictures with attitudes; `stars` (n, 3) has the star directions of each.

    All pictures must have the same size and an attitude.
    """
    views = [_view(result, star) for result, star in zip(results, stars, strict=True)]
    first = results[0].attitude
    assert first is not None
    size = first.lens.width_px, first.lens.height_px
    focal = [each.attitude.lens.focal_px for each in results if each.attitude is not None]
    start = Lens(*size, float(np.median(focal)))
    plain, _ = _fit(start, views, 1)
    before = np.concatenate([_residuals(plain, view) for view in views])
    before_place = np.concatenate([np.column_stack([v.u_px, v.v_px]) for v in views])
    lens, covariance = _fit(plain, views, len(PARAMETERS))
    residual = [_residuals(lens, view) for view in views]
    # A wrong or blended star is rejected, and the lens is fitted again.
    for view, each in zip(views, residual, strict=True):
        usual = 1.48 * float(np.median(np.abs(np.concatenate(residual))))
        _keep(view, np.abs(each).max(axis=1) < OUTLIER_SIGMAS * max(usual, LEAST_FLOOR_PX))
    lens, covariance = _fit(lens, views, len(PARAMETERS))
    after = np.concatenate([_residuals(lens, view) for view in views])
    sigma = np.concatenate([view.sigma_px for view in views])
    predicted_px = np.concatenate([view.predicted_px for view in views])
    freedom = max(after.size - 3 * len(views) - len(PARAMETERS), 1)
    scale2 = float(((after / sigma[:, None]) ** 2).sum()) / freedom
    covariance = covariance * scale2
    predicted_px2 = float(np.mean(predicted_px**2))
    variance = float((after**2).sum()) / freedom - predicted_px2
    found = [each.attitude for each in results if each.attitude is not None]
    exposures = [each.frame.exposure_s for each in results if each.frame.exposure_s is not None]
    zero = np.array([each.zero_point_mag for each in found])
    magnitudes = [star.magnitude_v_mag for each in found for star in each.stars]
    return CameraCalibration(
        lens=lens,
        covariance=covariance,
        before_place_px=before_place,
        place_px=np.concatenate([np.column_stack([v.u_px, v.v_px]) for v in views]),
        before_px=before,
        after_px=after,
        centroid_sigma_px=math.sqrt(predicted_px2),
        sigma_floor_px=max(math.sqrt(max(variance, 0.0)), LEAST_FLOOR_PX),
        psf_sigma_px=float(np.median([each.points.psf_sigma_px for each in results])),
        noise_counts=float(np.median([each.points.noise_counts for each in results])),
        zero_point_mag=float(np.median(zero)),
        zero_point_sigma_mag=float(np.median([each.zero_point_sigma_mag for each in found])),
        exposure_s=float(np.median(exposures)) if exposures else None,
        faintest_mag=float(np.percentile(magnitudes, 80.0)),
        pictures=len(results),
        remarks=tuple(_remarks(covariance, zero)),
    )


def _view(result: PictureResult, star: Vector) -> _View:
    found = result.attitude
    assert found is not None
    u, v = (np.array([getattr(each, name) for each in found.stars]) for name in ("u_px", "v_px"))
    return _View(found.fit.attitude, u, v, _told_sigma(result), star)


def _told_sigma(result: PictureResult) -> Vector:
    """The predicted position error of every identified star, in pixels."""
    assert result.attitude is not None
    points = result.points
    places = zip(points.u_px.tolist(), points.v_px.tolist(), strict=True)
    sigma = dict(zip(places, points.sigma_px.tolist(), strict=True))
    told = [sigma[each.u_px, each.v_px] for each in result.attitude.stars]
    return np.maximum(told, LEAST_TOLD_PX)


def _keep(view: _View, good: Vector) -> None:
    view.u_px, view.v_px = view.u_px[good], view.v_px[good]
    view.predicted_px, view.star = view.predicted_px[good], view.star[good]


def _residuals(lens: Lens, view: _View) -> Vector:
    """The residuals of a picture's stars, observed minus predicted places (n, 2) in pixels."""
    u, v = lens.places(view.star @ view.attitude.T)
    return np.column_stack([view.u_px - u, view.v_px - v])


def _fit(lens: Lens, views: Sequence[_View], parameters: int) -> tuple[Lens, Matrix]:
    """Fit the lens's first `parameters` parameters, with every picture's attitude eliminated.

    Returns the lens and the covariance of its parameters; the attitudes are updated in place. The
    fit is robust: residuals beyond twice the usual size have less weight.
    """
    names = PARAMETERS[:parameters]
    free = np.array([0.0, *(getattr(lens, name) for name in names[1:])])
    prior = np.array([math.inf, BEND_PRIOR, CENTER_PRIOR, CENTER_PRIOR])[:parameters]
    normal = np.eye(parameters)
    for _ in range(ROUNDS):
        normal, right = np.diag(1.0 / prior**2), -free / prior**2
        parts = []
        for view in views:
            residual, jacobian = linearised(
                lens, names, free, view.attitude, view.u_px, view.v_px, view.star
            )
            off = np.hypot(*residual.reshape(-1, 2).T)
            usual = max(2.0 * float(np.median(off)), 1e-3)
            weight = np.repeat(1.0 / (1.0 + (off / usual) ** 2) / view.sigma_px**2, 2)
            whole = jacobian.T @ (jacobian * weight[:, None])
            pull = jacobian.T @ (residual * weight)
            gain = np.linalg.solve(whole[:3, :3], whole[:3, 3:])
            normal = normal + whole[3:, 3:] - whole[3:, :3] @ gain
            right = right + pull[3:] - gain.T @ pull[:3]
            parts.append((view, whole, pull))
        step = np.linalg.solve(normal, right)
        for view, whole, pull in parts:
            turn = np.linalg.solve(whole[:3, :3], pull[:3] - whole[:3, 3:] @ step)
            view.attitude = rotate_about(turn, view.attitude.T).T
        free = free + step
        if np.abs(step).max() < 1e-10:
            break
    return lens_of(lens, names, free), np.asarray(np.linalg.inv(normal), dtype=np.float64)


def _remarks(covariance: Matrix, zero: Vector) -> list[str]:
    """Remarks on parameters that the pictures do not determine."""
    remarks = []
    if math.sqrt(covariance[1, 1]) > OBSERVABLE * BEND_PRIOR:
        remarks.append(
            "not_observable: the distortion; pictures with stars out to the corners would show it"
        )
    if math.sqrt(max(covariance[2, 2], covariance[3, 3])) > OBSERVABLE * CENTER_PRIOR:
        remarks.append(
            "not_observable: where the optical axis meets the sensor; more stars, or a lens with "
            "more distortion, would show it"
        )
    remarks.append(
        "not_observable: gain and read noise (take pictures of an even light), and how the camera "
        "stands in a spacecraft (its axes are taken as the body's)"
    )
    if len(zero) > 1 and float(np.ptp(zero)) > 0.5:
        remarks.append(
            f"zero_point: differs by {float(np.ptp(zero)):.1f} mag between the pictures: their "
            "exposure or gain was not the same, or there were clouds"
        )
    return remarks


def mission_text(name: str, found: CameraCalibration) -> str:
    """The mission file of a calibrated camera as TOML; omitted settings have default values."""
    lens = found.lens
    term = lens.bend * (lens.focal_px / lens.radius_px) ** 2
    center_u, center_v = lens.center_px
    exposure = "" if found.exposure_s is None else f"exposure_s = {found.exposure_s:.6g}\n"
    stars = len(found.place_px)
    return f"""\
# From {found.pictures} pictures with {stars} stars: residuals of {found.rms_px[1]:.3f} px per axis.
name = "{name}"

[catalog]
magnitude_limit_mag = {min(found.faintest_mag, 9.0):.1f}

[camera]
width_px = {lens.width_px}
height_px = {lens.height_px}
focal_length_px = {lens.focal_px:.3f}    # +- {found.sigma(0) * lens.focal_px:.3f}
center_u_px = {center_u:.3f}    # +- {found.sigma(2) * lens.radius_px:.2f}
center_v_px = {center_v:.3f}    # +- {found.sigma(3) * lens.radius_px:.2f}
u_terms = [[3, 0, {term:.8g}], [1, 2, {term:.8g}]]
v_terms = [[0, 3, {term:.8g}], [2, 1, {term:.8g}]]
psf_sigma_px = {max(found.psf_sigma_px, 0.3):.3f}
sigma_floor_px = {found.sigma_floor_px:.4f}
zero_point_mag = {found.zero_point_mag:.3f}    # scatter {found.zero_point_sigma_mag:.2f}
{exposure}"""
