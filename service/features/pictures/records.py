"""Record of a solved picture from any camera, which is not stored: attitude, lens and stars."""

import math
from typing import TYPE_CHECKING, Annotated, ClassVar

from service.contract.base import Components, Count, Quaternion, Record, doc
from service.observations.frame_record import rounded_counts
from service.vectors import Projection

if TYPE_CHECKING:
    from service.features.pictures.blind.picture import PictureAttitude, PictureResult


class PictureAttitudeFound(Record, frozen=True, kw_only=True):
    """Attitude of a picture, in the form that viewers use."""

    component: ClassVar[str] = "PictureAttitude"
    client_name: ClassVar[str] = "PictureAttitude"
    status: Annotated[str, doc("`suspect`: the lens was fitted on the picture itself.")]
    quaternion: Quaternion
    """Quaternion from ICRS to camera axes, scalar last: x right, y down, z to the sky through
        the middle."""
    sigma_arcsec: Annotated[Components, doc("One standard deviation about x, y and z.")]
    ra_deg: Annotated[float, doc("Right ascension of the middle of the picture.")]
    dec_deg: Annotated[float, doc("Declination of the middle of the picture.")]
    roll_deg: float
    """Position angle of the picture's upper edge, from north through east, 0 to 360."""
    aberration: str
    log_odds: Annotated[float, doc("Logarithm of the odds against chance.")]


class PictureLens(Record, frozen=True, kw_only=True):
    """The lens that fits a picture; a sigma of a parameter that was not fitted is null."""

    field_deg: Annotated[list[float], doc("Angles of the width and of the height.")]
    projection: Annotated[Projection, doc("`gnomonic`: on a plane; others of a fisheye.")] = (
        "gnomonic"
    )
    focal_px: float
    focal_sigma_px: float | None
    distortion_corner: Annotated[float, doc("At the corners, as a share of their distance.")]
    distortion_sigma: float | None
    center_px: Annotated[list[float], doc("The optical axis, in pixels right and down.")]
    center_sigma_px: float | None


class PictureStarFound(Record, frozen=True, kw_only=True):
    """Star found on a picture; its residual is the measured less the expected position."""

    component: ClassVar[str] = "PictureStar"
    client_name: ClassVar[str] = "PictureStar"
    id: str
    name: str | None
    v_mag: float
    u_px: float
    v_px: float
    residual_px: list[float]


class Picture(Record, frozen=True, kw_only=True):
    """Solved picture: attitude, lens and stars; without an attitude, `remarks` suggest remedies."""

    width_px: Count
    height_px: Count
    candidates: Annotated[Count, doc("Points of light.")]
    psf_sigma_px: Annotated[float, doc("Width of the images of stars, one sigma.")]
    noise_counts: float
    attitude: PictureAttitudeFound | None
    orientation: Annotated[str, doc("How the pixels of the file were turned.")]
    remarks: list[str]
    time: Annotated[str | None, doc("UTC of mid exposure, if the file states it.")]
    exposure_s: float | None
    lens: PictureLens | None
    residual_rms_px: float | None
    sigma_scale: Annotated[float | None, doc("By which the residuals scaled the sigmas.")]
    shared_error_px: Annotated[float | None, doc("The error that neighbouring stars share.")]
    zero_point_mag: float | None
    """Zero point: the magnitude of one count, per second if `exposure_s` is known."""
    zero_point_sigma_mag: float | None
    stars: Annotated[list[PictureStarFound], doc("The identified stars, brightest first.")]
    overlay_png: str | None = None
    """PNG in Base64: the picture with stars, names, a grid and a scale; null unless requested."""


def picture_of(result: "PictureResult") -> Picture:
    """Convert the result of a picture to its record; unknown numbers become null."""
    points, frame, found = result.points, result.frame, result.attitude
    return Picture(
        width_px=points.width_px,
        height_px=points.height_px,
        candidates=points.count,
        psf_sigma_px=round(points.psf_sigma_px, 2),
        noise_counts=rounded_counts(points.noise_counts, 3),
        attitude=_attitude(found) if found else None,
        orientation=frame.orientation,
        remarks=[*result.remarks, *frame.remarks],
        time=frame.time,
        exposure_s=frame.exposure_s,
        lens=_lens(found) if found else None,
        residual_rms_px=round(found.rms_px, 3) if found else None,
        sigma_scale=round(found.sigma_scale, 3) if found else None,
        shared_error_px=round(found.shared_px, 3) if found else None,
        zero_point_mag=_known(found.zero_point_mag, 2) if found else None,
        zero_point_sigma_mag=_known(found.zero_point_sigma_mag, 2) if found else None,
        stars=[
            PictureStarFound(
                id=star.id,
                name=star.name,
                v_mag=round(star.magnitude_v_mag, 2),
                u_px=round(star.u_px, 2),
                v_px=round(star.v_px, 2),
                residual_px=[round(star.residual_u_px, 3), round(star.residual_v_px, 3)],
            )
            for star in (found.stars if found else ())
        ],
    )


def _attitude(found: "PictureAttitude") -> PictureAttitudeFound:
    ra_deg, dec_deg = found.boresight_deg
    return PictureAttitudeFound(
        # The lens was fitted on the picture itself: do not call it calibrated.
        status="suspect",
        quaternion=[round(part, 9) for part in found.quaternion.tolist()],
        sigma_arcsec=[round(sigma, 2) for sigma in found.sigma_arcsec.tolist()],
        ra_deg=round(ra_deg, 5),
        dec_deg=round(dec_deg, 5),
        roll_deg=round(found.roll_deg, 4),
        aberration="corrected" if found.aberration_corrected else "ignored: no time is known",
        log_odds=round(found.log_odds, 1),
    )


def _lens(found: "PictureAttitude") -> PictureLens:
    lens = found.lens
    return PictureLens(
        field_deg=[round(angle, 4) for angle in found.field_deg],
        projection=lens.projection,
        focal_px=round(lens.focal_px, 2),
        focal_sigma_px=_known(found.sigma_of(3) * lens.focal_px, 2),
        distortion_corner=round(lens.bend, 6),
        distortion_sigma=_known(found.sigma_of(4), 6),
        center_px=[round(place, 2) for place in lens.center_px],
        center_sigma_px=_known(found.sigma_of(5) * lens.radius_px, 2),
    )


def _known(value: float, digits: int) -> float | None:
    return round(value, digits) if math.isfinite(value) else None
