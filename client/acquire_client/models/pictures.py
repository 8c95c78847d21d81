"""Record of a solved picture from any camera, which is not stored: attitude, lens and stars."""
# Written by `make client` from service/features/pictures/records.py.

from collections.abc import Sequence

from ..base import Model


class PictureAttitude(Model, frozen=True, kw_only=True):
    """Attitude of a picture, in the form that viewers use."""

    status: str
    """`suspect`: the lens was fitted on the picture itself."""
    quaternion: Sequence[float]
    """Quaternion from ICRS to camera axes, scalar last: x right, y down, z to the sky through the
    middle."""
    sigma_arcsec: Sequence[float]
    """One standard deviation about x, y and z."""
    ra_deg: float
    """Right ascension of the middle of the picture."""
    dec_deg: float
    """Declination of the middle of the picture."""
    roll_deg: float
    """Position angle of the picture's upper edge, from north through east, 0 to 360."""
    aberration: str
    log_odds: float
    """Logarithm of the odds against chance."""


class PictureLens(Model, frozen=True, kw_only=True):
    """The lens that fits a picture; a sigma of a parameter that was not fitted is None."""

    field_deg: Sequence[float]
    """Angles of the width and of the height."""
    projection: str = "gnomonic"
    """`gnomonic`: on a plane; others of a fisheye."""
    focal_px: float
    focal_sigma_px: float | None
    distortion_corner: float
    """At the corners, as a share of their distance."""
    distortion_sigma: float | None
    center_px: Sequence[float]
    """The optical axis, in pixels right and down."""
    center_sigma_px: float | None


class PictureStar(Model, frozen=True, kw_only=True):
    """Star found on a picture; its residual is the measured less the expected position."""

    id: str
    name: str | None
    v_mag: float
    u_px: float
    v_px: float
    residual_px: Sequence[float]


class Picture(Model, frozen=True, kw_only=True):
    """Solved picture: attitude, lens and stars; without an attitude, `remarks` suggest remedies."""

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
    """Zero point: the magnitude of one count, per second if `exposure_s` is known."""
    zero_point_sigma_mag: float | None
    stars: Sequence[PictureStar]
    """The identified stars, brightest first."""
    overlay_png: str | None = None
    """PNG in Base64: the picture with stars, names, a grid and a scale; None unless requested."""
