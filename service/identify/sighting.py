"""What an identifier is given: one tracker's stars, and where to search for them."""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import Struct, field

from service.compiled.jit import njit
from service.identify.budget import WorkBudget
from service.missions.mission import Rules
from service.sky.whole_sky.guide import Guide
from service.sky.zones import SearchRegion, Zone
from service.vectors import Vector, separation_deg

Integers = npt.NDArray[np.int64]

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


class Sighting(Struct, frozen=True, eq=False, gc=False):
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


class SightingColumns(NamedTuple):
    """Many sightings of one mission, one after another: k with m stars in all.

    | column | shape | |
    |---|---|---|
    | `offsets` | (k + 1,) | the stars of sighting s: from `offsets[s]` to before `offsets[s + 1]` |
    | `direction` | (m, 3) | as in `SightedArrays`, and so the following |
    | `magnitude`, `sigma_rad` | (m,) | |
    | `boresight`, `velocity`, `prior_axis` | (k, 3) | |
    | `prior_kind` | (k,) | |
    | `axis` | (k, 3) | as in `RegionBounds`, and so the following |
    | `least`, `most`, `off_axis`, `all_inside`, `is_band` | (k,) | |
    | `left` | (k,) | units of work that are left; kernels subtract what they spend |
    """

    offsets: Any
    direction: Any
    magnitude: Any
    sigma_rad: Any
    boresight: Any
    velocity: Any
    prior_kind: Any
    prior_axis: Any
    axis: Any
    least: Any
    most: Any
    off_axis: Any
    all_inside: Any
    is_band: Any
    left: Any

    def set_region(self, s: int, region: SearchRegion) -> None:
        """Fill in the region of a sighting; how it lies in its zone is filled in by `set_zone`."""
        self.axis[s], self.is_band[s] = region.axis, region.kind == "band"
        self.least[s] = math.radians(region.least_deg)
        self.most[s] = math.radians(region.most_deg)

    def set_zone(self, s: int, region: SearchRegion, zone: Zone) -> None:
        """Fill in how the region of a sighting lies in the zone that serves it."""
        self.all_inside[s] = zone.serves_exactly(region)
        # Angles to the axis are kept in bands alone.
        if self.is_band[s] and not self.all_inside[s]:
            self.off_axis[s] = math.radians(separation_deg(zone.region.axis, region.axis))


def room_for_sightings(
    offsets: Integers, sigma_rad: Vector, magnitude_mag: Vector
) -> SightingColumns:
    """Columns for the sightings of these stars; what is not given is to be filled in."""
    k, m = len(offsets) - 1, len(sigma_rad)
    boresight, velocity, prior_axis, axis = np.zeros((4, k, 3))
    least, most, off_axis = np.zeros((3, k))
    all_inside, is_band = np.zeros((2, k), np.bool_)
    prior_kind, left = np.zeros((2, k), np.int64)
    return SightingColumns(
        *(offsets, np.empty((m, 3)), magnitude_mag, sigma_rad),
        *(boresight, velocity, prior_kind, prior_axis),
        *(axis, least, most, off_axis, all_inside, is_band, left),
    )


@njit(nogil=True)
def sighted_at(columns, s):  # type: ignore[no-untyped-def]
    """The stars of one of many sightings."""
    first, last = columns.offsets[s], columns.offsets[s + 1]
    return SightedArrays(
        columns.direction[first:last],
        columns.magnitude[first:last],
        columns.sigma_rad[first:last],
        columns.boresight[s],
        columns.velocity[s],
        columns.prior_kind[s],
        columns.prior_axis[s],
    )


@njit(nogil=True)
def bounds_at(columns, s):  # type: ignore[no-untyped-def]
    """The region of one of many sightings."""
    return RegionBounds(
        columns.axis[s],
        columns.least[s],
        columns.most[s],
        columns.off_axis[s],
        columns.all_inside[s],
        columns.is_band[s],
    )
