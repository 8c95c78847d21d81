"""A picture of any camera, solved without a record: its attitude, its lens and its stars."""
# Written by `make client` from service/contract/pictures.py.

from collections.abc import Sequence

from ..base import Model


class PictureAttitude(Model, frozen=True, kw_only=True):
    """The attitude of a picture as a viewer shows it."""

    status: str
    """`suspect`: the lens was fitted on the picture itself."""
    quaternion: Sequence[float]
    """ICRS to camera, scalar last: x right, y down, z to the sky through the middle."""
    sigma_arcsec: Sequence[float]
    """One standard deviation about x, y and z."""
    ra_deg: float
    """Right ascension of the middle of the picture."""
    dec_deg: float
    """Declination of the middle of the picture."""
    roll_deg: float
    """Position angle of the upper edge, from north through east, 0 to 360."""
    aberration: str
    log_odds: float
    """Logarithm of the odds against chance."""


class PictureLens(Model, frozen=True, kw_only=True):
    """The lens that fits a picture; a sigma of a parameter that was not fitted is None."""

    field_deg: Sequence[float]
    """Angles of the width and of the height."""
    focal_px: float
    focal_sigma_px: float | None
    distortion_corner: float
    """At the corners, as a share of their distance."""
    distortion_sigma: float | None
    center_px: Sequence[float]
    """The optical axis, in pixels right and down."""
    center_sigma_px: float | None


class PictureStar(Model, frozen=True, kw_only=True):
    """A star on a picture; the residual is its place less the expected one."""

    id: str
    name: str | None
    v_mag: float
    u_px: float
    v_px: float
    residual_px: Sequence[float]


class Picture(Model, frozen=True, kw_only=True):
    """The attitude, lens and stars of a picture; without an attitude, `remarks` say what to try."""

    width_px: int
    height_px: int
    candidates: int
    """Points of light."""
    psf_sigma_px: float
    """Width of the images of stars, one sigma."""
    noise_counts: float
    attitude: PictureAttitude | None
    orientation: str
    """How the pixels of the file were turned."""
    remarks: Sequence[str]
    time: str | None
    """UTC of mid exposure, if the file states it."""
    exposure_s: float | None
    lens: PictureLens | None
    residual_rms_px: float | None
    sigma_scale: float | None
    """By which the residuals scaled the sigmas."""
    shared_error_px: float | None
    """The error that neighbouring stars share."""
    zero_point_mag: float | None
    """Magnitude of one count, per second if `exposure_s` is known."""
    zero_point_sigma_mag: float | None
    stars: Sequence[PictureStar]
    """The identified stars, brightest first."""
    overlay_png: str | None = None
    """Base64: the picture with stars, names, a grid and a scale, if asked for."""
