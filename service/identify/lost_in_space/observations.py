"""The input of the search: observed points, field of view, noise."""

from typing import Any, NamedTuple


class Points(NamedTuple):
    """The observed points (n), brightest first, in the tracker's axes, +Z the boresight.

    Magnitudes may be NaN.  Sigmas are one standard deviation per tangent axis,
    radians.  `velocity` of the observer in inertial axes, in units of c, is
    zero where aberration is not to be corrected.
    """

    observed: Any
    magnitude: Any
    sigma: Any
    velocity: Any


class FieldBounds(NamedTuple):
    """The field of view: within a cosine of the boresight, and within two tangents.

    `area` is its solid angle, `limit_mag` the faintest star that the tracker
    shows, NaN where that is not known, `magnitude_sigma` what a magnitude is
    off by at random.
    """

    cos_radius: Any
    tan_x: Any
    tan_y: Any
    area: Any
    limit_mag: Any
    magnitude_sigma: Any
