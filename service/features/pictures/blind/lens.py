"""A least-squares fit of a lens to identified stars: focal length, centre, radial distortion.

A plain lens projects the sky on a plane (gnomonic), a fisheye in one of three other ways.

The error of a star's place averages down with the number of stars. The errors of the lens model, of
the catalog's epoch and of refraction do not: neighbouring stars share them (`shared_variance_px2`).
"""

import math
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from scipy.spatial import cKDTree

from service.vectors import Matrix, Projection, Vector, rotate_about

BEND_PRIOR = 0.04
"""Prior sigma of the radial distortion at the corner, as a share of the radius."""
CENTER_PRIOR = 0.03
"""Prior sigma of the optical axis' distance from the middle, as a share of the half diagonal."""
FREE_SCALE, SCALE_BEND, SCALE_CENTER = 4, 5, 7
"""Numbers of fitted parameters: rotation and focal length; with distortion; with centre too."""
PARAMETERS = ("focal_px", "bend", "off_u", "off_v")
"""Names of a lens's parameters, in the order of fitting."""
_ROUNDS = 12
_CONVERGED = 1e-8
NEIGHBOURS = 3
"""Number of neighbours whose residuals estimate the correlated error of a star."""
LEAST_RESIDUAL_PX = 0.05
WIDEST_RAD = 2.1
"""Largest angle from a lens's optical axis, in radians, at which a picture can show a star."""
PROJECTIONS: tuple[Projection, ...] = get_args(Projection)
_NEAR_AXIS = 1e-3
"""Sine of the angle from the axis below which an equidistant lens is expanded in a series."""


def distance_of(projection: Projection, angle_rad: float) -> float:
    """The distance from the optical axis, in focal lengths, of a point at an angle to the axis."""
    return {
        "gnomonic": math.tan(angle_rad),
        "equidistant": angle_rad,
        "equisolid": 2.0 * math.sin(0.5 * angle_rad),
        "stereographic": 2.0 * math.tan(0.5 * angle_rad),
    }[projection]


def _angle_of(projection: Projection, distance: Vector) -> Vector:
    """The angles from the optical axis of points at distances, in focal lengths, from the axis."""
    if projection == "gnomonic":
        return np.arctan(distance)
    if projection == "equidistant":
        return np.minimum(distance, math.pi)
    if projection == "equisolid":
        return 2.0 * np.arcsin(np.minimum(0.5 * distance, 1.0))
    return 2.0 * np.arctan(0.5 * distance)


def _stretch_of(projection: Projection, body: Vector) -> tuple[Vector, Vector]:
    """The ratio of image distance to the sine of the angle to the axis (n,), and its slope by z.

    It applies to a fisheye; both are infinite opposite to the optical axis.
    """
    z = body[:, 2]
    if projection == "equisolid":
        stretch = np.sqrt(2.0 / (1.0 + z))
        return stretch, -0.5 * stretch / (1.0 + z)
    if projection == "stereographic":
        return 2.0 / (1.0 + z), -2.0 / (1.0 + z) ** 2
    sine = np.hypot(body[:, 0], body[:, 1])
    off = np.maximum(sine, _NEAR_AXIS)
    near = (sine < _NEAR_AXIS) & (z > 0.0)
    stretch = np.where(near, 1.0 + sine**2 / 6.0, np.arctan2(sine, z) / off)
    return stretch, np.where(near, -1.0 / 3.0, (stretch * z - 1.0) / off**2)


@dataclass(frozen=True)
class Lens:
    """A camera lens: focal length, offset of the optical axis, radial distortion, projection.

    `bend` is the radial displacement at the half diagonal `radius_px`, as a share of the radius:
    the true distance from the axis is r (1 + bend (r / radius_px)^2). `off_u` and `off_v` are the
    offsets of the axis from the middle, in units of `radius_px`. Near the axis every projection is
    like a plain lens of that focal length.
    """

    width_px: int
    height_px: int
    focal_px: float
    bend: float = 0.0
    off_u: float = 0.0
    off_v: float = 0.0
    projection: Projection = "gnomonic"

    @property
    def radius_px(self) -> float:
        """Half the diagonal of the lens's picture, in pixels."""
        return 0.5 * math.hypot(self.width_px, self.height_px)

    @property
    def center_px(self) -> tuple[float, float]:
        """The pixel coordinates of the optical axis; the first pixel's centre is (0, 0)."""
        return (
            0.5 * (self.width_px - 1) + self.off_u * self.radius_px,
            0.5 * (self.height_px - 1) + self.off_v * self.radius_px,
        )

    def plane(self, u_px: Vector, v_px: Vector) -> Vector:
        """Undistorted coordinates (n, 2) of pixels in the lens's projection, in focal lengths."""
        center_u, center_v = self.center_px
        x, y = np.asarray(u_px) - center_u, np.asarray(v_px) - center_v
        scale = (1.0 + self.bend * (x * x + y * y) / self.radius_px**2) / self.focal_px
        return np.stack([x * scale, y * scale], axis=-1)

    def directions(self, u_px: Vector, v_px: Vector) -> Vector:
        """Unit vectors (n, 3) of pixels: x to the right of the picture, y down, z the boresight."""
        plane = self.plane(u_px, v_px)
        if self.projection == "gnomonic":
            vectors = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)
            return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
        distance = np.hypot(plane[..., :1], plane[..., 1:])
        angle = _angle_of(self.projection, distance)
        share = np.where(distance > 0.0, np.sin(angle) / np.maximum(distance, 1e-12), 1.0)
        return np.concatenate([plane * share, np.cos(angle)], axis=-1)

    @property
    def reach_rad(self) -> float:
        """The angle in radians of the picture's corners from the optical axis."""
        distance = self.radius_px / self.focal_px * (1.0 + abs(self.bend))
        if self.projection == "gnomonic":
            return math.atan(distance)
        return min(float(_angle_of(self.projection, np.array(distance))), WIDEST_RAD)

    def projected(self, body: Vector) -> Vector:
        """Projected coordinates (n, 2), in focal lengths, of unit vectors (n, 3) in camera axes."""
        if self.projection == "gnomonic":
            return np.asarray(body[:, :2] / body[:, 2:])
        return np.asarray(body[:, :2] * _stretch_of(self.projection, body)[0][:, None])

    def places(self, directions: Vector) -> tuple[Vector, Vector]:
        """Pixel coordinates of directions (n, 3); NaN behind or far outside the picture."""
        least_cosine = 0.0 if self.projection == "gnomonic" else math.cos(WIDEST_RAD)
        with np.errstate(divide="ignore", invalid="ignore"):
            shown = directions[:, 2:] > least_cosine
            x, y = np.where(shown, self.projected(directions), np.nan).T
            true = np.hypot(x, y) * self.focal_px / self.radius_px
            true[~(true < 1.6)] = np.nan
            seen = true.copy()
            for _ in range(8 if self.bend else 0):
                seen -= (seen * (1.0 + self.bend * seen**2) - true) / (
                    1.0 + 3.0 * self.bend * seen**2
                )
            share = np.where(true > 0.0, seen / true, 1.0) * self.focal_px
        center_u, center_v = self.center_px
        return x * share + center_u, y * share + center_v


@dataclass(frozen=True)
class LensFit:
    """A fitted lens and attitude (3, 3), catalog to camera, with their covariance and residuals.

    `covariance` (p, p) is of the small rotation about the camera's axes in radians, of the
    logarithm of the focal length and, if fitted, of the lens's bend, off_u and off_v. Where
    `residual_scale` exceeds 1, the covariance is for sigmas enlarged by that factor. `residual_px`
    (n, 2): observed minus predicted place.
    """

    lens: Lens
    attitude: Matrix
    covariance: Matrix
    residual_px: Vector

    @property
    def parameters(self) -> int:
        """The number of fitted parameters of a lens and its attitude."""
        return len(self.covariance)


def fit_lens(
    lens: Lens,
    attitude: Matrix,
    u_px: Vector,
    v_px: Vector,
    sigma_px: Vector,
    star: Vector,
    parameters: int,
    focal_sigma: float = math.inf,
    weight: Vector | None = None,
) -> LensFit:
    """The lens and attitude that minimise the residuals of identified stars (n, 3).

    Least squares from an approximate start, with priors on distortion and centre; `focal_sigma` is
    the prior sigma of the logarithm of the start's focal length.
    """
    names = PARAMETERS[: parameters - 3]
    start = np.array([0.0, *(getattr(lens, name) for name in names[1:])])
    prior = np.array([focal_sigma, BEND_PRIOR, CENTER_PRIOR, CENTER_PRIOR])[: len(names)]
    weights = np.repeat((1.0 if weight is None else weight) / sigma_px**2, 2)
    free = start.copy()
    for _ in range(_ROUNDS):
        residual, jacobian = linearised(lens, names, free, attitude, u_px, v_px, star)
        normal = jacobian.T @ (jacobian * weights[:, None])
        right = jacobian.T @ (residual * weights)
        normal[3:, 3:] += np.diag(1.0 / prior**2)
        right[3:] -= free / prior**2
        step = np.linalg.solve(normal, right)
        attitude = rotate_about(step[:3], attitude.T).T
        free = free + step[3:]
        free[0] = np.clip(free[0], -0.5, 0.5)
        free[1:] = np.clip(free[1:], -0.15, 0.15)
        if np.abs(step).max() < _CONVERGED:
            break
    fitted = lens_of(lens, names, free)
    residual = _residual(fitted, attitude, u_px, v_px, star)
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return LensFit(fitted, attitude, covariance, residual.reshape(-1, 2))


def lens_of(lens: Lens, names: tuple[str, ...], free: Vector) -> Lens:
    """A lens with new parameters; the first value is added to the logarithm of the focal length."""
    values = dict(zip(names[1:], free[1:].tolist(), strict=True))
    values["focal_px"] = lens.focal_px * math.exp(free[0])
    return replace(lens, **values)


def _residual(lens: Lens, attitude: Matrix, u_px: Vector, v_px: Vector, star: Vector) -> Vector:
    """Observed minus predicted places (2 n,) of stars, in pixels of the undistorted projection."""
    predicted = lens.projected(star @ attitude.T)
    return np.asarray(((lens.plane(u_px, v_px) - predicted) * lens.focal_px).ravel())


def linearised(
    lens: Lens,
    names: tuple[str, ...],
    free: Vector,
    attitude: Matrix,
    u_px: Vector,
    v_px: Vector,
    star: Vector,
) -> tuple[Vector, Matrix]:
    """The residuals (2 n,) of stars in pixels, and their decrease per unit of parameter (2 n, p).

    Parameters are a small rotation about the camera's axes, then those of `lens_of`.
    """
    trial = lens_of(lens, names, free)
    body = star @ attitude.T
    plane = trial.plane(u_px, v_px)
    predicted = trial.projected(body)
    residual = (plane - predicted) * trial.focal_px
    if trial.projection == "gnomonic":
        x, y = predicted.T
        turns = [[-x * y, -1.0 - y * y], [1.0 + x * x, x * y], [-y, x]]
    else:
        x, y, z = body.T
        stretch, slope = _stretch_of(trial.projection, body)
        turns = [
            [slope * x * y, slope * y * y - stretch * z],
            [stretch * z - slope * x * x, -slope * x * y],
            [-stretch * y, stretch * x],
        ]
    columns = [trial.focal_px * np.array(each) for each in turns]
    # In pixels of a fixed focal length: otherwise a longer one would enlarge all residuals.
    columns.append(trial.focal_px * plane.T)
    if len(names) > 1:
        center_u, center_v = trial.center_px
        across, down = (u_px - center_u) / trial.radius_px, (v_px - center_v) / trial.radius_px
        square = across**2 + down**2
        columns.append(-trial.radius_px * square * np.array([across, down]))
    if len(names) > 2:
        both = 2.0 * trial.bend * across * down
        along = 1.0 + trial.bend * square + 2.0 * trial.bend * np.array([across**2, down**2])
        columns.append(trial.radius_px * np.array([along[0], both]))
        columns.append(trial.radius_px * np.array([both, along[1]]))
    return residual.ravel(), np.stack([column.T.ravel() for column in columns], axis=1)


def shared_variance_px2(
    u_px: Vector, v_px: Vector, residual_px: Vector, variance_px2: float
) -> float:
    """The variance per axis, in square pixels, of position errors that neighbouring stars share.

    The mean product of neighbours' residuals (n, 2), plus its sampling error: `variance_px2` of the
    residuals over the root of n.
    """
    places = np.column_stack([u_px, v_px])
    _, near = cKDTree(places).query(places, k=min(NEIGHBOURS + 1, len(u_px)))
    products = (residual_px[:, None, :] * residual_px[near[:, 1:]]).sum(axis=-1)
    return max(0.5 * float(products.mean()), 0.0) + variance_px2 / math.sqrt(len(u_px))


def simpler_fit(
    fit: LensFit, u_px: Vector, v_px: Vector, star: Vector, residual_px: Vector
) -> LensFit | None:
    """Fit to stars (n, 3) without the lens's last parameters; None if only the scale was fitted.

    The difference of its attitude from that of the full fit shows the influence of the lens model;
    terms that neither fit includes may matter as much.
    """
    if fit.parameters == FREE_SCALE:
        return None
    fewer = FREE_SCALE if fit.parameters == SCALE_BEND else SCALE_BEND
    bend = fit.lens.bend if fewer == SCALE_BEND else 0.0
    start = replace(fit.lens, bend=bend, off_u=0.0, off_v=0.0)
    sigma = max(math.sqrt(float(np.mean(residual_px**2))), LEAST_RESIDUAL_PX)
    off = np.hypot(*residual_px.T)
    usual = max(2.0 * float(np.median(off)), LEAST_RESIDUAL_PX)
    return fit_lens(
        *(start, fit.attitude, u_px, v_px, np.full(len(u_px), sigma), star, fewer),
        weight=1.0 / (1.0 + (off / usual) ** 2),
    )
