"""A star tracker's camera: the mapping of directions to pixels, and of magnitudes to counts.

The module also completes a mission file of a few lines: the camera's size and field of view
determine the default values of the rest.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from service.missions.strict import Strict, is_missing
from service.vectors import ARCSEC_PER_RADIAN, Vector, unit

CentroidMethod = Literal["window", "scan", "matched", "recursive"]
PsfKind = Literal["gaussian", "airy", "cross"]
Wavelength = Annotated[float, Field(ge=100, le=5000)]
Power = Annotated[int, Field(ge=0, le=12)]
Terms = tuple[tuple[Power, Power, float], ...]
Wire = tuple[
    Annotated[float, Field(ge=-180, le=180)],
    Annotated[float, Field(gt=-0.5, lt=0.5)],
    Annotated[float, Field(gt=0, le=0.5)],
]
"""A wire across the aperture: its direction, deg from u towards v; its distance from the middle of
the aperture; its width. Distance and width are in diameters of the aperture.
"""

TWO_EACH_WAY: tuple[Wire, ...] = (
    (0.0, -0.25, 0.1), (0.0, 0.25, 0.1), (90.0, -0.25, 0.1), (90.0, 0.25, 0.1),
)  # fmt: skip
MOST_COVERED = 0.6
"""Largest share of the aperture that wires may cover; overlaps count twice."""
MOST_SAMPLED_SIGMA_PX = 5.0

WIDEST_BAND = 2.0
"""Largest ratio of the longest to the shortest wavelength of a band."""

MAX_SIDE_PX = 20_000
MOST_STARS = 250

_ROUNDS = 50
_NEAR_ENOUGH = 1e-12
UNKNOWN_FIELD_DEG = 40.0
"""Field of view in degrees assumed for a camera whose mission file states no scale."""
UNKNOWN_LIMIT_MAG = 7.0
ROOM = 1.3
"""Factor by which a roughly stated field of view may be too small."""
WANTED_STARS = 40
STARS_TO_MAG = ((4.0, 516), (5.0, 1610), (6.0, 4999), (7.0, 15495), (8.0, 45598), (9.0, 130172))
"""Magnitudes, each with the number of stars of the whole sky that are brighter."""
SIGMA_PX, ROUGH_SIGMA_PX = 0.3, 1.0
LARGEST_PAIR_DEG = 8.0
REQUIRED_OF_CAMERAS = frozenset(
    (
        "center_u_px",
        "center_v_px",
        "exposure_s",
        "focal_length_px",
        "gain_e_per_count",
        "psf_sigma_px",
        "read_noise_e",
        "saturation_counts",
    )
)
"""The camera keys without which a table `[trackers.camera]` gets defaults."""
_SCALES = ("focal_length_px", "field_of_view_deg", "focal_length_mm", "pixel_um")


class Camera(Strict):
    """The geometry and the photometry of one tracker's frames.

    u counts along columns and v along rows, in pixels; the centre of the first
    pixel is (0, 0).  Tracker X lies along +u, Y along +v and the boresight Z
    points to the sky.  With x = (u - center_u_px) / focal_length_px and y likewise,
    a star stands in the direction of (x + sum of c x^i y^j over `u_terms`,
    y + the same over `v_terms`, 1).
    """

    width_px: int = Field(ge=16, le=MAX_SIDE_PX)
    height_px: int = Field(ge=16, le=MAX_SIDE_PX)
    calibrated: bool = True
    """False if focal length and zero point are rough, so that they are fitted on every frame."""
    focal_length_px: float = Field(ge=10, le=1e7)
    center_u_px: float = Field(ge=-MAX_SIDE_PX, le=MAX_SIDE_PX)
    center_v_px: float = Field(ge=-MAX_SIDE_PX, le=MAX_SIDE_PX)
    """The pixel coordinates of the boresight on the sensor."""
    u_terms: Terms = ()
    v_terms: Terms = ()
    """Distortion terms [i, j, c], which turn the measured plane coordinates into true ones."""
    bias_counts: float = Field(default=0.0, ge=-1e6, le=1e6)
    """The count of a pixel without any light."""
    gain_e_per_count: float = Field(gt=0, le=1e6)
    read_noise_e: float = Field(ge=0, le=1e6)
    dark_e_per_s: float = Field(default=0.0, ge=0, le=1e9)
    saturation_counts: float = Field(gt=0, le=1e9)
    """The count from which a pixel is saturated."""
    exposure_s: float = Field(gt=0, le=3600)
    """The exposure in seconds of a frame that does not state its own."""
    psf_sigma_px: float = Field(ge=0.3, le=20)
    """Sigma of a star's image along each axis in pixels, before integration over the pixel.

    For a diffraction image: the sigma of the Gaussian with the same full width at half maximum as
    the image of the aperture without its wires.
    """
    psf: PsfKind = Field(default="gaussian", exclude_if="gaussian".__eq__)
    """The shape of a star's image: a Gaussian, the Airy disc of a round aperture, or the
    diffraction cross of wires before it. The default is no part of the digest.
    """
    wires: tuple[Wire, ...] = Field(
        default=TWO_EACH_WAY, max_length=32, exclude_if=TWO_EACH_WAY.__eq__
    )
    """The wires across the aperture that cause the diffraction cross."""
    band_nm: tuple[Wavelength, Wavelength] | None = Field(default=None, exclude_if=is_missing)
    """The shortest and longest wavelength that the detector sees; None for light of one colour.

    `psf_sigma_px` then belongs to the middle of the band.
    """
    zero_point_mag: float | None = Field(default=None, ge=-10, le=40)
    """Instrument magnitude of a star of one count per second; None if unknown."""
    sigma_floor_px: float = Field(default=0.0, ge=0, le=10)
    """Calibration error of a star's position in pixels per axis, however bright the star."""
    threshold_sigma: float = Field(default=5.0, ge=3, le=100)
    """Least signal to noise of a detected star, in the image filtered with a star's shape."""
    centroid: CentroidMethod = "matched"
    centroid_half_width_px: int = Field(default=4, ge=2, le=25)
    most_stars: int = Field(default=60, ge=2, le=MOST_STARS)
    """Largest number of stars in a batch; the brightest are chosen."""
    faintest_mag: float | None = Field(default=None, ge=-10, le=30)
    """Faintest measured magnitude of stars in a batch; by default the run catalog's limit."""

    @model_validator(mode="after")
    def _bias_lies_below_saturation(self) -> Self:
        if self.bias_counts >= self.saturation_counts:
            held = f"{self.bias_counts:g} and {self.saturation_counts:g}"
            raise ValueError(f"bias_counts must be below saturation_counts, not {held}")
        return self

    @model_validator(mode="after")
    def _wires_make_a_cross(self) -> Self:
        if self.psf != "gaussian" and self.psf_sigma_px > MOST_SAMPLED_SIGMA_PX:
            message = f"of the psf {self.psf} must be at most {MOST_SAMPLED_SIGMA_PX:g}"
            raise ValueError(f"psf_sigma_px {message}")
        if self.psf != "cross" and "wires" in self.model_fields_set:
            raise ValueError(f'wires belong to the psf "cross", not to "{self.psf}"')
        if self.psf == "cross" and not self.wires:
            raise ValueError('wires: the psf "cross" needs at least one')
        covered = sum(w * math.sqrt(1.0 - 4.0 * at**2) for _, at, w in self.wires) * 4.0 / math.pi
        if covered > MOST_COVERED:
            raise ValueError(
                f"wires cover {covered:.0%} of the aperture; at most {MOST_COVERED:.0%} may be"
            )
        return self

    @model_validator(mode="after")
    def _band_is_of_an_aperture(self) -> Self:
        if self.band_nm is None:
            return self
        if self.psf == "gaussian":
            raise ValueError('band_nm belongs to the psf "airy" or "cross", not to "gaussian"')
        shortest, longest = self.band_nm
        if not shortest < longest <= WIDEST_BAND * shortest:
            raise ValueError(
                f"band_nm must rise, the longest at most {WIDEST_BAND:g} times the shortest"
            )
        return self

    @property
    def shape(self) -> tuple[int, int]:
        """The size of a frame as (rows, columns)."""
        return self.height_px, self.width_px

    @cached_property
    def corner_radius_deg(self) -> float:
        """The angle in degrees from the boresight to the farthest corner of the sensor."""
        u = np.array([-0.5, self.width_px - 0.5, -0.5, self.width_px - 0.5])
        v = np.array([-0.5, -0.5, self.height_px - 0.5, self.height_px - 0.5])
        return float(np.degrees(np.arccos(self.directions(u, v)[:, 2].min())))

    def directions(self, u_px: Vector, v_px: Vector) -> Vector:
        """Unit vectors (n, 3) in tracker axes for places (n,) on the sensor, in pixels."""
        x, y = self._plane(u_px, v_px)
        bent_x, bent_y = self._bent(x, y)
        return unit(np.stack([x + bent_x, y + bent_y, np.ones_like(x)], axis=-1))

    def places(self, directions: Vector) -> tuple[Vector, Vector]:
        """Pixel coordinates (u, v) of directions (n, 3); NaN for those far outside the sensor."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ahead = directions[..., 2] > 0.0
            true_x = np.where(ahead, directions[..., 0] / directions[..., 2], np.nan)
            true_y = np.where(ahead, directions[..., 1] / directions[..., 2], np.nan)
        # A distortion polynomial is meaningless far outside the field in which it was fitted.
        far = np.hypot(true_x, true_y) > 2.0 * math.tan(math.radians(self.corner_radius_deg))
        true_x, true_y = np.where(far, np.nan, true_x), np.where(far, np.nan, true_y)
        x, y = true_x, true_y
        # Distortion is small, so the fixed-point iteration converges in a few rounds.
        for _ in range(_ROUNDS):
            bent_x, bent_y = self._bent(x, y)
            moved = np.nanmax(np.abs([true_x - bent_x - x, true_y - bent_y - y]), initial=0.0)
            x, y = true_x - bent_x, true_y - bent_y
            if moved < _NEAR_ENOUGH:
                break
        return (
            x * self.focal_length_px + self.center_u_px,
            y * self.focal_length_px + self.center_v_px,
        )

    def tangent_sigmas_arcsec(
        self, u_px: Vector, v_px: Vector, sigma_u_px: Vector, sigma_v_px: Vector
    ) -> Vector:
        """One standard deviation (n,) per tangent axis in arcsec, from pixel errors along u and v.

        It is the root of the mean of the variances along two tangent axes (half the trace).
        """
        direction = self.directions(u_px, v_px)
        along_u = self.directions(u_px + 1.0, v_px) - direction
        along_v = self.directions(u_px, v_px + 1.0) - direction
        variance = np.sum(along_u**2, axis=1) * sigma_u_px**2
        variance += np.sum(along_v**2, axis=1) * sigma_v_px**2
        return np.asarray(np.sqrt(variance / 2.0) * ARCSEC_PER_RADIAN)

    def magnitude(self, flux_counts: Vector, exposure_s: float) -> Vector:
        """Instrument magnitudes of stars from their counts over an exposure; NaN where undefined.

        All are NaN if the zero point is unknown.
        """
        if self.zero_point_mag is None:
            return np.full(np.shape(flux_counts), np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            light = np.where(flux_counts > 0.0, flux_counts, np.nan) / exposure_s
        return np.asarray(self.zero_point_mag - 2.5 * np.log10(light))

    def flux_counts(self, magnitude_mag: Vector, exposure_s: float) -> Vector:
        """The counts over an exposure of stars with given instrument magnitudes.

        All are NaN if the zero point is unknown.
        """
        if self.zero_point_mag is None:
            return np.full(np.shape(magnitude_mag), np.nan)
        return np.asarray(exposure_s * 10.0 ** (0.4 * (self.zero_point_mag - magnitude_mag)))

    def _plane(self, u_px: Vector, v_px: Vector) -> tuple[Vector, Vector]:
        return (
            (np.asarray(u_px) - self.center_u_px) / self.focal_length_px,
            (np.asarray(v_px) - self.center_v_px) / self.focal_length_px,
        )

    def _bent(self, x: Vector, y: Vector) -> tuple[Vector, Vector]:
        zero = np.zeros_like(x)
        return (
            sum((c * x**i * y**j for i, j, c in self.u_terms), zero),
            sum((c * x**i * y**j for i, j, c in self.v_terms), zero),
        )


def with_camera_defaults(table: dict[str, Any]) -> dict[str, Any]:
    """The tables of a mission file; those left out beside a table `camera` get default values.

    The camera needs `width_px` and `height_px`. Its scale may be given by `focal_length_px`, for a
    calibrated camera, roughly by `field_of_view_deg` along the longer side or `focal_length_mm`
    with `pixel_um`, or not at all; the lens is then fitted on every frame. Wrong values are left
    for the mission's check.
    """
    camera = table.get("camera")
    if not isinstance(camera, dict) or "trackers" in table:
        return table
    camera = dict(camera)
    try:
        focal_px, scale_key = _focal_px(camera)
        width, height = float(camera["width_px"]), float(camera["height_px"])
        if not (min(width, height) >= 16 and 10 <= focal_px < 1e8):
            raise ValueError
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        # The check of the mission will report the fault.
        return {**table, "trackers": [{"name": "CAMERA", "camera": camera}]} | {"camera": camera}
    exact = scale_key == "focal_length_px"
    room = 1.0 if exact else ROOM
    radius_deg = math.degrees(math.atan(0.5 * math.hypot(width, height) / focal_px * 1.05)) * room
    short_deg = 2.0 * math.degrees(math.atan(0.5 * min(width, height) / focal_px))
    long_deg = 2.0 * math.degrees(math.atan(0.5 * max(width, height) / focal_px))
    pixel_deg = math.degrees(1.0 / focal_px)
    limit_mag = _limit_mag(short_deg * long_deg) if scale_key else UNKNOWN_LIMIT_MAG
    rest = {key: value for key, value in table.items() if key != "camera"}
    return {
        "zone": {
            "kind": "cap",
            "axis_body": [0.0, 0.0, 1.0],
            "radius_deg": round(min(1.3 * radius_deg + 1.0, 90.0), 2),
        },
        "tolerances": {
            "pair_separation_max_deg": round(min(LARGEST_PAIR_DEG, long_deg), 2),
            "separation_deg": round(3.0 * pixel_deg, 5),
            "magnitude_mag": 1.0,
            "magnitude_order_mag": 1.0,
            "cross_product_deg": 90.0,
        },
        "catalog": {"magnitude_limit_mag": limit_mag},
        **rest,
        "trackers": [
            {
                "name": "CAMERA",
                "x_axis_body": [1.0, 0.0, 0.0],
                "y_axis_body": [0.0, 1.0, 0.0],
                "z_axis_body": [0.0, 0.0, 1.0],
                "field_of_view_radius_deg": round(min(radius_deg, 60.0), 3),
                "sigma_arcsec": round(
                    (SIGMA_PX if exact else ROUGH_SIGMA_PX) * 3600.0 * pixel_deg, 2
                ),
                "magnitude_sigma_mag": 0.3,
                "camera": camera_defaults(camera),
            }
        ],
    }


def camera_defaults(
    camera: dict[str, Any], field_of_view_deg: Sequence[float] | None = None
) -> dict[str, Any]:
    """A mission file's camera table completed with default values.

    A missing focal length is computed from `field_of_view_deg` and the width. Raises `KeyError`,
    `TypeError` or `ValueError` for a size or scale that is missing or wrong.
    """
    if field_of_view_deg is not None and not any(each in camera for each in _SCALES):
        tangent = math.tan(math.radians(0.5 * field_of_view_deg[0]))
        camera = {**camera, "focal_length_px": round(0.5 * camera["width_px"] / tangent, 3)}
    focal_px, scale_key = _focal_px(camera)
    return {
        "center_u_px": 0.5 * (float(camera["width_px"]) - 1.0),
        "center_v_px": 0.5 * (float(camera["height_px"]) - 1.0),
        "gain_e_per_count": 1.0,
        "read_noise_e": 0.0,
        "saturation_counts": 1e9,
        "exposure_s": 1.0,
        "psf_sigma_px": 1.2,
        "sigma_floor_px": 0.1,
        "calibrated": scale_key == "focal_length_px",
        **{key: value for key, value in camera.items() if key not in _SCALES},
        "focal_length_px": focal_px,
    }


def field_of_camera_deg(camera: Mapping[str, Any]) -> tuple[float, float]:
    """Width and height of a camera's field of view in degrees, symmetric about its boresight."""
    return tuple(  # type: ignore[return-value]
        round(2.0 * math.degrees(math.atan(_half_px(camera, axis) / camera["focal_length_px"])), 3)
        for axis in (("width_px", "center_u_px"), ("height_px", "center_v_px"))
    )


def _half_px(camera: Mapping[str, Any], axis: tuple[str, str]) -> float:
    """The distance in pixels from the boresight to the farther edge of the sensor."""
    size_px, center_px = (float(camera[key]) for key in axis)
    return max(center_px + 0.5, size_px - 0.5 - center_px)


def _focal_px(camera: dict[str, Any]) -> tuple[float, str | None]:
    """The focal length of a camera in pixels, and the key of the file that gives it, or None."""
    if "focal_length_px" in camera:
        return float(camera["focal_length_px"]), "focal_length_px"
    if "focal_length_mm" in camera or "pixel_um" in camera:
        return 1000.0 * float(camera["focal_length_mm"]) / float(camera["pixel_um"]), "focal_mm"
    scale_key = "field_of_view_deg" if "field_of_view_deg" in camera else None
    field_deg = float(camera.get("field_of_view_deg", UNKNOWN_FIELD_DEG))
    if not 0.0 < field_deg < 150.0:
        raise ValueError
    side = max(float(camera["width_px"]), float(camera["height_px"]))
    return 0.5 * side / math.tan(math.radians(0.5 * field_deg)), scale_key


def _limit_mag(field_deg2: float) -> float:
    """The magnitude down to which a field of view holds `WANTED_STARS` stars on average."""
    wanted = math.log(WANTED_STARS * 41253.0 / field_deg2)
    magnitudes, counts = zip(*STARS_TO_MAG, strict=True)
    return round(float(np.interp(wanted, np.log(counts), magnitudes)), 1)
