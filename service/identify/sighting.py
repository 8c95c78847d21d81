"""The input of star identification: one tracker's stars, and where to search for them."""

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
"""Kinds of a priori knowledge: a whole attitude, or one direction with unknown roll."""


class SightedArrays(NamedTuple):
    """The stars (n) of one tracker in the form that kernels take.

    `direction` (n, 3), `magnitude` (n,) with NaN if unknown, `sigma_rad` (n,), the `boresight` (3,)
    and the observer's `velocity` (3,) in units of c are those of `Sighting`. `prior_axis` (3,) is
    the known axis for a prior of kind `PRIOR_DIRECTION`.
    """

    direction: Any
    magnitude: Any
    sigma_rad: Any
    boresight: Any
    velocity: Any
    prior_kind: Any
    prior_axis: Any


class RegionBounds(NamedTuple):
    """A search region on the sky in the form that kernels take.

    It has the stars at `least` to `most` radians from `axis` (3,). In a band the cached zone's own
    axis, to which stored polar angles refer, is `off_axis` radians from that axis. `all_inside`:
    the cached zone has exactly the region's stars.
    """

    axis: Any
    least: Any
    most: Any
    off_axis: Any
    all_inside: Any
    is_band: Any


class Sighting(Struct, frozen=True, eq=False, gc=False):
    """The stars of one tracker, with the a priori knowledge and the zone for their identification.

    `direction` (n, 3) is inertial through the presumed attitude; magnitudes may be NaN; sigma is
    one standard deviation per tangent axis. `zone` has at least the stars within `region`. With
    `known_axis` (inertial) only that axis of the presumed attitude is known, else the whole
    rotation. `velocity_c` of the observer is zero if aberration is not corrected. `boresight` is
    the presumed one, inertial. `guide` is set for identifiers that need it, else None. `budget`
    limits the work of all sightings of a batch together.
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
    """The stars of k sightings of one mission as columns, with m stars in all.

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
        """Set a sighting's columns of its search region, apart from those that `set_zone` sets."""
        self.axis[s], self.is_band[s] = region.axis, region.kind == "band"
        self.least[s] = math.radians(region.least_deg)
        self.most[s] = math.radians(region.most_deg)

    def set_zone(self, s: int, region: SearchRegion, zone: Zone) -> None:
        """Set how a sighting's search region lies within the zone that serves it."""
        self.all_inside[s] = zone.serves_exactly(region)
        # Only bands store angles to the axis.
        if self.is_band[s] and not self.all_inside[s]:
            self.off_axis[s] = math.radians(separation_deg(zone.region.axis, region.axis))


def room_for_sightings(
    offsets: Integers, sigma_rad: Vector, magnitude_mag: Vector
) -> SightingColumns:
    """Columns for sightings of given stars, whose other values are still to be filled in."""
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
    """The stars of one sighting, from the columns of many."""
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
    """The search region of one sighting, from the columns of many."""
    return RegionBounds(
        columns.axis[s],
        columns.least[s],
        columns.most[s],
        columns.off_axis[s],
        columns.all_inside[s],
        columns.is_band[s],
    )
