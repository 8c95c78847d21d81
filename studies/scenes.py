"""Simulated scenes for lost-in-space identification: stars of a camera at a random attitude.

The camera of Zhou & Ye 2015, Table 4: 1,024 pixels over 10 degrees.  A star is detected if its
magnitude with noise is within the limit, so that noise both loses stars and adds fainter ones.
Every scene carries its truth, and scene k of a seed is the same however many are drawn.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from service.missions.mission import RunCatalogSettings
from service.sky.catalog.run_catalog import RunCatalog, build_run_catalog
from service.sky.catalog.star_catalog import load_embedded
from service.vectors import Matrix, Vector, matrix_from_quaternion, read_only, unit

EPOCH_YEAR = 2000.0
MERGE_WITHIN_ARCSEC = 60.0
"""Separation in arcsec below which two stars are drawn as one, less than two camera pixels."""
FAINTEST_SIGMA = 4.5
"""Sigmas of magnitude beyond the limit above which a fainter star is never detected."""
MAX_TRIES = 10_000


@dataclass(frozen=True)
class PinholeCamera:
    """Pinhole camera with a square detector: +Z is the boresight, pixels count from the centre."""

    side_px: int = 1024
    focal_px: float = 5852.0

    @property
    def pixel_rad(self) -> float:
        """Angle of one pixel at the centre, in radians (35.25 arcsec by default)."""
        return 1.0 / self.focal_px

    @property
    def field_deg(self) -> float:
        """Full angle between opposite edges of the detector, in degrees."""
        return 2.0 * math.degrees(math.atan(0.5 * self.side_px / self.focal_px))

    def pixels(self, direction: Vector) -> Vector:
        """Pixel coordinates (n, 2) from the centre for directions (n, 3) in camera axes."""
        return np.asarray(direction[:, :2] / direction[:, 2:] * self.focal_px)

    def directions(self, pixels: Vector) -> Vector:
        """Unit vectors (n, 3) in camera axes from pixel coordinates (n, 2)."""
        return unit(np.column_stack([pixels, np.full(len(pixels), self.focal_px)]))


@dataclass(frozen=True)
class Conditions:
    """Conditions of a simulated scene: noise, limits and numbers of stars."""

    position_px: float = 1.0
    """Standard deviation of star positions per detector axis, in pixels."""
    magnitude_sigma_mag: float = 0.5
    limit_mag: float = 6.0
    radius_deg: float | None = None
    """Radius of a circular field about the boresight; None: the square detector."""
    brightest: int | None = None
    """Greatest number of stars kept, those truly brightest; None: all."""
    fewest: int = 0
    """Least number of detected stars; attitudes are drawn again until reached."""
    spurious: int = 0
    """Number of false points anywhere in the field, as bright as detected stars."""
    camera: PinholeCamera = PinholeCamera()


@dataclass(frozen=True, eq=False)
class Scene:
    """Simulated image: detected points, brightest first, with the truth.

    `direction` (n, 3) are unit vectors in camera axes, +Z the boresight;
    `sigma_rad` (n,) one standard deviation per tangent axis; `star` (n,) rows
    of the sky, -1 for what is no star.  `attitude` (3, 3) takes inertial to
    camera components.  `complete`: no detected star was left out.
    """

    direction: Vector
    magnitude_mag: Vector
    sigma_rad: Vector
    star: npt.NDArray[np.int64]
    attitude: Matrix
    complete: bool = True

    def mirrored(self) -> "Scene":
        """Mirror image of the scene, which no rotation of the sky reproduces."""
        return replace(self, direction=read_only(self.direction * np.array([-1.0, 1.0, 1.0])))

    def with_focal_error(self, share: float) -> "Scene":
        """Scene of a camera whose assumed focal length is too long by the fraction `share`."""
        return replace(
            self, direction=read_only(unit(self.direction * np.array([1.0, 1.0, 1.0 + share])))
        )

    def off_from(self, attitude: Matrix) -> tuple[float, float]:
        """Errors of another attitude in degrees: of its boresight, and of the whole rotation."""
        turn = attitude @ self.attitude.T
        return (
            math.degrees(math.atan2(math.hypot(turn[0, 2], turn[1, 2]), turn[2, 2])),
            math.degrees(
                math.atan2(
                    math.sqrt(
                        (turn[2, 1] - turn[1, 2]) ** 2
                        + (turn[0, 2] - turn[2, 0]) ** 2
                        + (turn[1, 0] - turn[0, 1]) ** 2
                    ),
                    turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0,
                )
            ),
        )


@dataclass(frozen=True)
class SceneSky:
    """Stars that scenes are drawn from, brightest first."""

    run_catalog: RunCatalog

    @classmethod
    def to_magnitude(cls, limit_mag: float) -> "SceneSky":
        """Sky of the stars down to a magnitude limit; a brighter limit gives fewer of its rows."""
        settings = RunCatalogSettings(
            magnitude_limit_mag=limit_mag, merge_within_arcsec=MERGE_WITHIN_ARCSEC
        )
        return cls(build_run_catalog(load_embedded(), settings, EPOCH_YEAR))

    @classmethod
    def for_conditions(cls, conditions: Conditions) -> "SceneSky":
        """Sky of the stars down to the faintest that noise can bring within the limit."""
        return cls.to_magnitude(
            conditions.limit_mag + FAINTEST_SIGMA * conditions.magnitude_sigma_mag
        )

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.run_catalog.direction)

    def about(self, boresight: Vector, radius_rad: float) -> npt.NDArray[np.int64]:
        """Rows of the stars within a radius of an inertial direction, brightest first."""
        found = self._tree.query_ball_point(boresight, 2.0 * math.sin(0.5 * radius_rad))
        return np.sort(np.asarray(found, dtype=np.int64))


def draw_scenes(
    sky: SceneSky, conditions: Conditions, count: int, seed: int, first: int = 0
) -> Iterator[Scene]:
    """Draw scenes `first` to `first + count` of a seed, at uniformly random attitudes.

    Raises `ValueError` if no field of the sky has the requested number of stars.
    """
    for number in range(first, first + count):
        yield draw_scene(sky, conditions, np.random.default_rng([seed, number]))


def draw_scene(sky: SceneSky, conditions: Conditions, rng: np.random.Generator) -> Scene:
    """Draw one scene at a random attitude; see `draw_scenes`."""
    for _ in range(MAX_TRIES):
        attitude = matrix_from_quaternion(unit(rng.normal(size=4)))
        row, direction, magnitude = _detected(sky, conditions, attitude, rng)
        if len(row) >= conditions.fewest:
            break
    else:
        raise ValueError(f"no field of {MAX_TRIES:,} holds {conditions.fewest} stars")
    # Rows of the sky are in order of brightness.
    chosen = np.argsort(row, kind="stable")[: conditions.brightest]
    complete = len(chosen) == len(row)
    row, direction, magnitude = row[chosen], direction[chosen], magnitude[chosen]
    camera = conditions.camera
    pixels = camera.pixels(direction) + rng.normal(size=(len(row), 2)) * conditions.position_px
    if conditions.spurious:
        pixels = np.concatenate([pixels, _anywhere(conditions, conditions.spurious, rng)])
        magnitude = np.concatenate(
            [magnitude, _as_bright(sky, conditions, conditions.spurious, rng)]
        )
        row = np.concatenate([row, np.full(conditions.spurious, -1)])
    return _scene(camera, pixels, magnitude, row, attitude, complete, conditions.position_px)


def draw_random_points(
    sky: SceneSky, conditions: Conditions, points: int, rng: np.random.Generator
) -> Scene:
    """Draw a scene of false points only, as bright as stars."""
    return _scene(
        conditions.camera,
        _anywhere(conditions, points, rng),
        _as_bright(sky, conditions, points, rng),
        np.full(points, -1),
        np.eye(3),
        True,
        conditions.position_px,
    )


def _detected(
    sky: SceneSky, conditions: Conditions, attitude: Matrix, rng: np.random.Generator
) -> tuple[npt.NDArray[np.int64], Vector, Vector]:
    """Rows, directions in camera axes and measured magnitudes of the detected stars."""
    camera = conditions.camera
    half = 0.5 * camera.side_px / camera.focal_px
    radius_deg = conditions.radius_deg
    reach = math.atan(half * math.sqrt(2.0)) if radius_deg is None else math.radians(radius_deg)
    row = sky.about(attitude[2], reach)
    direction = sky.run_catalog.direction[row] @ attitude.T
    noise = rng.normal(size=len(row)) * conditions.magnitude_sigma_mag
    magnitude = sky.run_catalog.magnitude_mag[row] + noise
    seen = magnitude <= conditions.limit_mag
    if radius_deg is None:
        seen &= (np.abs(direction[:, :2]) <= half * direction[:, 2:]).all(axis=1)
    return row[seen], direction[seen], magnitude[seen]


def _anywhere(conditions: Conditions, count: int, rng: np.random.Generator) -> Vector:
    """Random points (count, 2) in pixels, uniform over the field."""
    camera = conditions.camera
    if conditions.radius_deg is None:
        return rng.uniform(-0.5, 0.5, (count, 2)) * camera.side_px
    radius_px = camera.focal_px * math.tan(math.radians(conditions.radius_deg))
    distance, angle = radius_px * np.sqrt(rng.random(count)), rng.random(count) * math.tau
    return np.column_stack([distance * np.cos(angle), distance * np.sin(angle)])


def _as_bright(
    sky: SceneSky, conditions: Conditions, count: int, rng: np.random.Generator
) -> Vector:
    """Random magnitudes from those of the sky's stars within the limit."""
    magnitude = sky.run_catalog.magnitude_mag
    return rng.choice(magnitude[: np.searchsorted(magnitude, conditions.limit_mag)], count)


def _scene(
    camera: PinholeCamera,
    pixels: Vector,
    magnitude: Vector,
    row: npt.NDArray[np.int64],
    attitude: Matrix,
    complete: bool,
    position_px: float,
) -> Scene:
    order = np.argsort(magnitude, kind="stable")
    return Scene(
        direction=read_only(camera.directions(pixels[order])),
        magnitude_mag=read_only(magnitude[order]),
        sigma_rad=read_only(np.full(len(row), position_px * camera.pixel_rad)),
        star=read_only(row[order]),
        attitude=read_only(attitude),
        complete=complete,
    )
