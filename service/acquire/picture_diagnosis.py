"""What a picture, or its failure, says of camera and sky, in words, and what to try next."""

import math
from collections.abc import Iterator

from service.identify.blind.lens import Lens
from service.identify.blind.verify import Verified
from service.imaging.detection.points import MAX_POINTS, PointSources

CLIPPED_SHARE = 0.5
BLURRED_PX = 3.5
FEW_POINTS = 6
NOTABLE_HOT = 20
NOTABLE_BEND = 0.003
NOTABLE_FOCAL = 0.005


def remarks_on(
    lens: Lens, found: Verified, points: PointSources, guess_px: float | None, guess_share: float
) -> Iterator[str]:
    """What is worth saying of a picture whose attitude was found."""
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
    yield from _light(points)


def advice_without_attitude(points: PointSources) -> Iterator[str]:
    """Why there may be no attitude, and what to try next."""
    if points.count < 4:
        yield (
            f"too_few_points: {points.count} points of light, and four are needed: expose longer, "
            "open the aperture, or focus on the stars"
        )
    elif points.count < FEW_POINTS:
        yield f"few_points: {points.count} points of light hardly tell one field from another"
    elif points.count >= MAX_POINTS:
        yield (
            f"clutter: {MAX_POINTS} candidates and more: crop what is no sky, take off hot pixels "
            "with a dark frame (--dark FILE), or use a shorter exposure with less noise"
        )
    yield from _light(points)
    yield "try_next: tell the field of view (--fov DEG), if it is known within a quarter"


def _light(points: PointSources) -> Iterator[str]:
    if points.hot_pixels > NOTABLE_HOT:
        yield (
            f"hot_pixels: {points.hot_pixels} single bright pixels were taken for no stars; a dark "
            "frame (--dark FILE) takes off all of them"
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
