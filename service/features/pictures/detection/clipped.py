"""Stars that are cut off at the largest count, as on stretched pictures of 8 bits.

Such a star is a flat disc: it has no peak, and the point filter ranks it by its edge. Its place is
the centroid of the light below the clipping level, to which only its flanks contribute unevenly,
and the size of the disc ranks it among the other stars.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from service.features.pictures.frames.frame import CountArray
from service.vectors import Vector

LEVEL_SHARE = 0.94
"""Threshold of a clipped disc, as a share of the largest count; compression rounds tops."""
LEAST_PIXELS, LEAST_DISCS = 6, 8
"""Least pixels of a clipped disc, and least discs in a stretched picture: a few bright stars
saturate in any.
"""
MOST_DISCS = 300
MOST_SHARE = 0.2
"""Largest share of a picture's pixels that clipped stars may fill; more is a bright sky."""
MOST_RADIUS_SHARE = 0.03
"""Largest radius of a clipped star's disc, as a share of the picture's shorter side."""
MOST_STRETCH = 2.5
"""Largest elongation of a clipped star's disc: its longer side over the width of a round one."""
FLANK_PX = 3.0
LEAST_SIGMA_PX, SIGMA_SHARE, STRETCH_SHARE = 0.05, 0.015, 0.25
"""Least sigma of a disc's place: in pixels, and as shares of its radius and elongation."""
_ROUNDS = 4


class ClippedStars(NamedTuple):
    """Clipped stars (n,), the largest first: places, sigmas, light below clipping, radii."""

    u_px: Vector
    v_px: Vector
    sigma_px: Vector
    light: Vector
    radius_px: Vector

    def are_outside(
        self, u: npt.NDArray[np.int64], v: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.bool_]:
        """True for peaks (n,) that lie outside of all clipped discs and their flanks."""
        outside = np.ones(len(u), dtype=bool)
        reach = self.radius_px + FLANK_PX
        for u_px, v_px, away in zip(self.u_px, self.v_px, reach, strict=True):
            outside &= np.hypot(u - u_px, v - v_px) > away
        return outside


def clipped_stars(light: CountArray) -> ClippedStars | None:
    """Clipped stars on background-subtracted light; None for too few or too many clipped pixels."""
    level = LEVEL_SHARE * float(light.max(initial=0.0))
    full = light >= level
    pixels = int(np.count_nonzero(full))
    if level <= 0.0 or not LEAST_DISCS * LEAST_PIXELS <= pixels <= MOST_SHARE * light.size:
        return None
    labels, _ = ndimage.label(full)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    chosen = np.flatnonzero(sizes >= LEAST_PIXELS)
    if len(chosen) < LEAST_DISCS:
        return None
    chosen = chosen[np.argsort(-sizes[chosen], kind="stable")]
    boxes = ndimage.find_objects(labels)
    most_px = MOST_RADIUS_SHARE * min(light.shape)
    found = []
    for number in chosen.tolist():
        radius_px = math.sqrt(sizes[number] / math.pi)
        rows, columns = boxes[number - 1]
        longest = max(rows.stop - rows.start, columns.stop - columns.start)
        if radius_px <= max(most_px, FLANK_PX) and longest <= MOST_STRETCH * 2.0 * radius_px + 1.0:
            middle = 0.5 * (columns.start + columns.stop - 1), 0.5 * (rows.start + rows.stop - 1)
            found.append(_placed(light, labels, level, number, middle, radius_px))
        if len(found) == MOST_DISCS:
            break
    if len(found) < LEAST_DISCS:
        return None
    table = np.array(found)
    return ClippedStars(*table[np.argsort(-table[:, 3], kind="stable")].T)


def _placed(
    light: CountArray,
    labels: npt.NDArray[np.int32],
    level: float,
    number: int,
    middle: tuple[float, float],
    radius_px: float,
) -> tuple[float, float, float, float, float]:
    """Centroid, sigma, light and radius of one clipped star, from its label and bounding box."""
    reach = radius_px + FLANK_PX
    half = math.ceil(reach) + 2
    first_u, first_v = max(round(middle[0]) - half, 0), max(round(middle[1]) - half, 0)
    window = slice(first_v, first_v + 2 * half + 1), slice(first_u, first_u + 2 * half + 1)
    others = (labels[window] != number) & (labels[window] != 0)
    weight = np.where(others, 0.0, np.clip(light[window].astype(np.float64), 0.0, level))
    rows, columns = np.indices(weight.shape)
    u, v = middle[0] - first_u, middle[1] - first_v
    for _ in range(_ROUNDS):
        # A soft edge, so that pixels do not enter and leave abruptly between rounds.
        inside = np.clip(reach + 0.5 - np.hypot(columns - u, rows - v), 0.0, 1.0) * weight
        total = float(inside.sum())
        u, v = float((inside * columns).sum()) / total, float((inside * rows).sum()) / total
    across, down = columns - u, rows - v
    uu, vv = float((inside * across**2).sum()) / total, float((inside * down**2).sum()) / total
    uv = float((inside * across * down).sum()) / total
    mean, apart = 0.5 * (uu + vv), math.hypot(0.5 * (uu - vv), uv)
    stretch_px = 2.0 * (math.sqrt(mean + apart) - math.sqrt(max(mean - apart, 0.0)))
    sigma = math.hypot(LEAST_SIGMA_PX, SIGMA_SHARE * radius_px, STRETCH_SHARE * stretch_px)
    return u + first_u, v + first_v, sigma, total, radius_px
