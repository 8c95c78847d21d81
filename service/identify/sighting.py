"""What an identifier is given: one tracker's stars, and where to search for them."""

import math
from functools import cached_property
from typing import Any, NamedTuple

from msgspec import Struct, field

from service.identify.budget import WorkBudget
from service.missions.mission import Rules
from service.sky.whole_sky.guide import Guide
from service.sky.zones import SearchRegion, Zone
from service.vectors import Vector, separation_deg

PRIOR_ROTATION, PRIOR_DIRECTION = 0, 1
"""Kinds of a priori knowledge: the whole attitude, or one direction with the roll unknown."""


class SightedArrays(NamedTuple):
    """A sighting's stars (n) as kernels take them.

    `direction` (n, 3), `magnitude` (n,) with NaN for none, `sigma_rad` (n,), the
    `boresight` (3,) and the observer's `velocity` (3,) in units of c are those of
    `Sighting`.  `prior_axis` (3,) is the axis that a prior of kind
    `PRIOR_DIRECTION` knows.
    """

    direction: Any
    magnitude: Any
    sigma_rad: Any
    boresight: Any
    velocity: Any
    prior_kind: Any
    prior_axis: Any


class RegionBounds(NamedTuple):
    """A search region as kernels take it.

    A star lies in it whose angle to `axis` (3,) is from `least` to `most` radians.
    In a band the zone's own axis, about which its angles are kept, lies `off_axis`
    radians from it.  `all_inside`: the zone's stars are just those of the region.
    """

    axis: Any
    least: Any
    most: Any
    off_axis: Any
    all_inside: Any
    is_band: Any


class Sighting(Struct, frozen=True, eq=False, dict=True):
    """One tracker's stars and where to search for them.

    `direction` (n, 3) is inertial through the presumed attitude; magnitudes may
    be NaN; sigma is one standard deviation per tangent axis.  `zone` holds at
    least the stars within `region`.  Of the presumed attitude the whole rotation
    is known, or only where it points `known_axis` (inertial).  `velocity_c` of the
    observer is zero where aberration is not to be corrected.  `boresight` is the
    presumed one, inertial.  `guide` is there for identifiers that need it, None
    for the others.  Identifiers spend of the `budget`, which a batch's sightings share.
    """

    direction: Vector
    magnitude_mag: Vector
    sigma_rad: Vector
    known_axis: Vector | None
    velocity_c: Vector
    boresight: Vector
    region: SearchRegion
    zone: Zone
    rules: Rules
    guide: Guide | None = None
    budget: WorkBudget = field(default_factory=WorkBudget)

    @cached_property
    def arrays(self) -> SightedArrays:
        """The stars as kernels take them."""
        axis = self.known_axis
        return SightedArrays(
            self.direction,
            self.magnitude_mag,
            self.sigma_rad,
            self.boresight,
            self.velocity_c,
            PRIOR_ROTATION if axis is None else PRIOR_DIRECTION,
            self.region.axis if axis is None else axis,
        )

    @cached_property
    def bounds(self) -> RegionBounds:
        """The region as kernels take it."""
        region, zone = self.region, self.zone
        all_inside, is_band = zone.serves_exactly(region), region.kind == "band"
        # Angles to the axis are kept in bands alone.
        off_axis_deg = 0.0
        if is_band and not all_inside:
            off_axis_deg = separation_deg(zone.region.axis, region.axis)
        return RegionBounds(
            region.axis,
            math.radians(region.least_deg),
            math.radians(region.most_deg),
            math.radians(off_axis_deg),
            all_inside,
            is_band,
        )
