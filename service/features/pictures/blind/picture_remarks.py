"""Remarks for the user on a picture, with or without an attitude."""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from service.features.pictures.blind.lens import Lens
from service.features.pictures.blind.solver import WIDEST_FIELD_DEG
from service.features.pictures.blind.verify import Verified
from service.features.pictures.detection.points import (
    MAX_POINTS,
    PointSources,
    find_points,
    has_dark,
)
from service.features.pictures.frames.frame import Frame
from service.features.pictures.tracker.submit import exposure_stated

if TYPE_CHECKING:
    from service.features.pictures.blind.picture import PictureResult

CLEAR_RATIO, LEAST_CLEAR = 12.0, 25
"""Signal to noise and number of clear points from which a failure suggests an unusual lens."""

CLIPPED_SHARE = 0.5
BLURRED_PX = 3.5
FEW_POINTS = 6
FEW_BESIDE_DARK, LEAST_DARK, DARK_RATIO = 75, 30, 4
"""Most points of light of a negative, its least number of dark points, and their least ratio."""
NOTABLE_HOT = 20
NOTABLE_BEND = 0.003
NOTABLE_FOCAL = 0.005
MOST_OFF_MAG = 1.5
"""Largest change of a camera's zero point that clouds or another aperture explain, in mag."""


def remarks_on(
    lens: Lens, found: Verified, points: PointSources, guess_px: float | None, guess_share: float
) -> Iterator[str]:
    """Remarks for the user on a picture whose attitude was found."""
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


def advice_on(points: PointSources, frame: Frame, guess_px: float | None) -> Iterator[str]:
    """Likely reasons why a picture has no attitude, and options that were not tried."""
    dark = has_dark(frame)
    if points.count < FEW_BESIDE_DARK:
        dark_points = find_points(-frame.counts).count
        if dark_points >= max(LEAST_DARK, DARK_RATIO * points.count):
            yield (
                f"negative: {dark_points} dark points, and {points.count} of light: if the sky is "
                "brighter than the stars, invert the picture"
            )
            return
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
            f"{most_deg:g} degrees: they may be no stars, or the lens may be too wide "
            "(--lens NAME), or the pixels of unequal sides (--pixel-ratio RATIO)"
        )
    yield from remarks_on_light(points, dark)
    if guess_px is None:
        yield "try_next: tell the field of view (--fov DEG), if it is known within a quarter"


def remarks_on_light(points: PointSources, dark: bool) -> Iterator[str]:
    """Remarks on the images of a picture's stars and on its other bright pixels."""
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


def doubt_of_exposure(result: "PictureResult", zero_point_mag: float | None) -> list[str]:
    """A remark if the zero point of a picture is far from that of its camera."""
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
