"""A picture of any camera: its attitude, its lens and its stars."""

from collections.abc import Sequence

from ..base import Model


class PictureAttitude(Model, frozen=True, kw_only=True):
    """The attitude of a picture; the quaternion turns ICRS into the camera's axes."""

    status: str
    quaternion: Sequence[float]
    sigma_arcsec: Sequence[float]
    ra_deg: float
    dec_deg: float
    roll_deg: float
    aberration: str
    log_odds: float


class PictureLens(Model, frozen=True, kw_only=True):
    """The lens that fits a picture; None: the sigma of a parameter that was not fitted."""

    field_deg: Sequence[float]
    focal_px: float
    focal_sigma_px: float | None
    distortion_corner: float
    distortion_sigma: float | None
    center_px: Sequence[float]
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
    psf_sigma_px: float
    noise_counts: float
    attitude: PictureAttitude | None
    orientation: str
    remarks: Sequence[str]
    time: str | None
    exposure_s: float | None
    lens: PictureLens | None
    residual_rms_px: float | None
    sigma_scale: float | None
    shared_error_px: float | None
    zero_point_mag: float | None
    zero_point_sigma_mag: float | None
    stars: Sequence[PictureStar]
    overlay_png: str | None = None
