"""Zone catalogs: the stars of a cap or a band of the sky, with their pair index.

A zone is the set of stars whose angle to an axis lies between two bounds: a
cap from zero to its radius, a band within its half width of the coelevation.

Cached zones have their axis rounded to a grid and their bounds enlarged by the largest rounding
error. The identifier then uses only the stars within the bounds about the exact axis, so that an
answer depends neither on the grid nor on earlier batches.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from service.compiled.jit import njit, njit_no_refcount
from service.sky.cache import LruCache
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.geometry.directions import separation_rad
from service.sky.geometry.pairs import PairIndex, build_pairs
from service.sky.geometry.star_hashes import (
    Bits,
    StarBuckets,
    build_star_buckets,
    build_star_voxels,
)
from service.vectors import (
    Vector,
    angle_between_deg,
    direction_of,
    read_only,
    separation_deg,
    to_ra_dec,
)

# Margin that keeps a star exactly on a bound within the enlarged zone despite rounding.
_ROUNDING_DEG = 1e-9
# Least difference of cosines from that of a bound that is safe from rounding.
_CLEAR = 1e-12


class SearchRegion(Struct, frozen=True, eq=False, gc=False):
    """A region of the sky to search: an exact inertial axis (3,), and bounds on the angle to it."""

    kind: str
    axis: Vector
    least_deg: float
    most_deg: float

    def reaches_past(self, boresight: Vector, radius_deg: float) -> bool:
        """True if a field of view about an inertial boresight extends beyond the region."""
        angle = separation_deg(self.axis, boresight)
        return min(angle + radius_deg, 180.0) > self.most_deg or (
            self.least_deg > 0.0 and angle - radius_deg < self.least_deg
        )


class ZoneArrays(NamedTuple):
    """A zone of m stars and p pairs in the form that kernels take.

    `direction` (m, 3), `magnitude` (m,), and `vector_mag` (m, 4) with both.
    `grid_start`, `grid_rows` and `grid_direction` are those of `StarBuckets`, `voxels`
    those of `build_star_voxels`.  `pair_separation` (p,), `pair_rows` (2, p),
    `bin_start` and `bins_per_rad` are those of `PairIndex`.  In a band `polar` (m,) are
    the stars' angles to the zone's axis and `polar_difference` (p,) the pairs'
    differences of them; in a cap both are empty.
    """

    direction: Any
    magnitude: Any
    vector_mag: Any
    grid_start: Any
    grid_rows: Any
    grid_direction: Any
    voxels: Any
    pair_separation: Any
    pair_rows: Any
    bin_start: Any
    bins_per_rad: Any
    polar: Any
    polar_difference: Any


@dataclass(frozen=True)
class Zone:
    """The stars of a zone, brightest first, and their pairs.

    `star` holds the rows in the run catalog, ascending; `direction` (n, 3) and `magnitude_mag`
    belong to these, and `vector_mag` (n, 4) has both for joint access. In a band `polar_rad` (n,)
    are the stars' angles to the axis, and `polar_difference_rad` (NTOT,) that of a pair's brighter
    star less that of its dimmer, to a few digits; in a cap both are empty.
    """

    mission: str
    run_catalog: str
    region: SearchRegion
    grid_deg: float
    star: npt.NDArray[np.int32]
    direction: Vector
    magnitude_mag: Vector
    vector_mag: Vector
    pairs: PairIndex
    grid: StarBuckets
    voxels: Bits
    polar_rad: Vector
    polar_difference_rad: npt.NDArray[np.float32]

    @property
    def nbytes(self) -> int:
        """The size of the zone in memory, in bytes."""
        parts = (
            *(self.star, self.direction, self.magnitude_mag, self.vector_mag, self.pairs),
            *(self.grid, self.voxels, self.polar_rad, self.polar_difference_rad),
        )
        return sum(part.nbytes for part in parts)

    @cached_property
    def arrays(self) -> ZoneArrays:
        """The zone in the form that kernels take."""
        grid, pairs = self.grid, self.pairs
        return ZoneArrays(
            direction=self.direction,
            magnitude=self.magnitude_mag,
            vector_mag=self.vector_mag,
            grid_start=grid.start,
            grid_rows=grid.rows,
            grid_direction=grid.direction,
            voxels=self.voxels,
            pair_separation=pairs.separation_rad,
            pair_rows=pairs.rows,
            bin_start=pairs.bin_start,
            bins_per_rad=pairs.bins_per_rad,
            polar=self.polar_rad,
            polar_difference=self.polar_difference_rad,
        )

    def serves_exactly(self, region: SearchRegion) -> bool:
        """True if the zone's stars are exactly those within a region."""
        own = self.region
        return own is region or (
            own.least_deg == region.least_deg
            and own.most_deg == region.most_deg
            and own.axis.tolist() == region.axis.tolist()
        )

    def summary(self) -> dict[str, Any]:
        """A description of the zone for the interface."""
        ra_deg, dec_deg = to_ra_dec(self.region.axis)
        return {
            "kind": self.region.kind,
            "ra_deg": float(ra_deg),
            "dec_deg": float(dec_deg),
            "stars": len(self.star),
            "pairs": self.pairs.count,
        }


class ZoneKey(NamedTuple):
    """The inputs of a zone catalog: its key in the cache."""

    mission: str
    run_catalog: str
    kind: str
    axis: tuple[float, float, float]
    least_deg: float
    most_deg: float
    pair_separation_max_deg: float


def build_zone(
    mission: str,
    run_catalog: RunCatalog,
    region: SearchRegion,
    separation_max_deg: float,
    grid_deg: float = 0.0,
) -> Zone:
    """The zone of the stars within a region, with their pair index."""
    cosine = run_catalog.direction @ region.axis
    low = math.cos(math.radians(min(180.0, region.most_deg + 1e-4)))
    high = math.cos(math.radians(max(0.0, region.least_deg - 1e-4)))
    # The cosine preselects cheaply and generously; the accurate angle decides.
    near = (
        np.flatnonzero((cosine >= low) & (cosine <= high))
        if region.least_deg > 0
        else np.flatnonzero(cosine >= low)
    )
    angle = angle_between_deg(run_catalog.direction[near], region.axis)
    star = near[(angle >= region.least_deg) & (angle <= region.most_deg)].astype(np.int32)
    direction = np.ascontiguousarray(run_catalog.direction[star])
    magnitude = run_catalog.magnitude_mag[star]
    pairs = build_pairs(direction, separation_max_deg)
    polar, difference = np.empty(0), np.empty(0, np.float32)
    if region.kind == "band":
        polar, difference = np.empty(len(star)), np.empty(pairs.count, np.float32)
        _polar_angles(direction, region.axis, pairs.brighter, pairs.dimmer, polar, difference)
    return Zone(
        mission=mission,
        run_catalog=run_catalog.digest,
        region=region,
        grid_deg=grid_deg,
        star=read_only(star),
        direction=read_only(direction),
        magnitude_mag=read_only(magnitude),
        vector_mag=read_only(np.column_stack([direction, magnitude])),
        pairs=pairs,
        grid=build_star_buckets(direction),
        voxels=build_star_voxels(direction),
        polar_rad=read_only(polar),
        polar_difference_rad=read_only(difference),
    )


@njit(nogil=True)
def _polar_angles(direction, axis, brighter, dimmer, polar, difference):  # type: ignore[no-untyped-def]
    for row in range(len(direction)):
        polar[row] = separation_rad(direction[row], axis)
    for k in range(len(brighter)):
        difference[k] = polar[brighter[k]] - polar[dimmer[k]]


def count_within(
    zone: Zone,
    which: npt.NDArray[np.int64],
    axis: Vector,
    least: Vector,
    most: Vector,
    found: npt.NDArray[np.int64],
) -> None:
    """Count a zone's stars and pairs in the regions named by `which`, into rows of `found` (k, 2).

    Regions reach from `least` to `most` (k,) radians from their `axis` (k, 3).
    """
    if zone.grid_deg == 0.0:
        found[which] = len(zone.star), zone.pairs.count
    else:
        _count_within(which, axis, least, most, zone.direction, zone.pairs.rows, found)


@njit
def _count_within(which, axes, leasts, mosts, direction, pair_rows, found):  # type: ignore[no-untyped-def]
    inside = np.empty(len(direction), np.int32)
    for s in which:
        axis, least, most = axes[s], leasts[s], mosts[s]
        inner, outer = math.cos(least) if least > 0.0 else 2.0, math.cos(most)
        if _stars_inside(direction, axis, inner, outer, inside):
            for row in range(len(direction)):
                inside[row] = least <= separation_rad(direction[row], axis) <= most
        found[s, 0] = inside.sum()
        found[s, 1] = _pairs_inside(pair_rows[0], pair_rows[1], inside)


@njit_no_refcount
def _stars_inside(direction, axis, inner, outer, inside):  # type: ignore[no-untyped-def]
    """Mark the stars (n, 3) whose cosine to the axis is in bounds; true if one is near a bound.

    In that case the accurate angles decide. Written without branches, to be vectorised.
    """
    is_near = False
    x, y, z = axis[0], axis[1], axis[2]
    for row in range(len(direction)):
        cosine = direction[row, 0] * x + direction[row, 1] * y + direction[row, 2] * z
        inside[row] = (outer < cosine) & (cosine < inner)
        is_near |= min(abs(cosine - inner), abs(cosine - outer)) <= _CLEAR
    return is_near


@njit_no_refcount
def _pairs_inside(one, other, inside):  # type: ignore[no-untyped-def]
    """The number of pairs, by the rows of their stars (p,), with both stars inside (n,), 0 or 1.

    With 32-bit words and unsigned rows, so that sixteen pairs are processed at a time.
    """
    pairs = np.int32(0)
    for k in range(len(one)):
        pairs += inside[np.uint32(one[k])] & inside[np.uint32(other[k])]
    return pairs


def zone_for(
    cache: LruCache,
    mission: str,
    run_catalog: RunCatalog,
    region: SearchRegion,
    separation_max_deg: float,
    grid_deg: float,
    *,
    wait: bool = True,
) -> tuple[Zone, bool]:
    """The zone that serves a search region, cached or built, and true if it was cached.

    Without `wait` it is not built: raises `NotAtHand`.
    """
    key = zone_key(mission, run_catalog, region, separation_max_deg, grid_deg)

    def build() -> Zone:
        wide = SearchRegion(key.kind, np.array(key.axis), key.least_deg, key.most_deg)
        served = wide if grid_deg > 0.0 else region
        return build_zone(mission, run_catalog, served, separation_max_deg, grid_deg)

    return cache.get(key, build, wait=wait)


def zone_key(
    mission: str,
    run_catalog: RunCatalog,
    region: SearchRegion,
    separation_max_deg: float,
    grid_deg: float,
) -> ZoneKey:
    """The cache key of the zone that serves a search region.

    With a grid the zone's axis is the nearest grid point and its bounds are
    grown by half the diagonal of a grid cell; grid 0 is the exact zone.
    """
    x, y, z = region.axis.tolist()
    least_deg, most_deg = region.least_deg, region.most_deg
    if grid_deg > 0.0:
        x, y, z = snapped(x, y, z, grid_deg)
        grown_by_deg = grid_deg / math.sqrt(2.0) + _ROUNDING_DEG
        least_deg = max(0.0, least_deg - grown_by_deg)
        most_deg = min(180.0, most_deg + grown_by_deg)
    return ZoneKey(
        mission,
        run_catalog.digest,
        region.kind,
        (x, y, z),
        least_deg,
        most_deg,
        separation_max_deg,
    )


def snapped(x: float, y: float, z: float, grid_deg: float) -> tuple[float, float, float]:
    """The grid point nearest to a direction, on rows of declination divided into equal steps.

    A step along a row is at most `grid_deg` of arc, so that no direction lies
    farther than grid_deg / sqrt(2) from its point.
    """
    ra_deg = math.degrees(math.atan2(y, x)) % 360.0
    dec_deg = math.degrees(math.atan2(z, math.hypot(x, y)))
    row_deg = round(dec_deg / grid_deg) * grid_deg
    # The row's widest circle is nearest to the equator, half a step from the row.
    widest = max(0.0, abs(row_deg) - grid_deg / 2.0)
    steps = max(1, math.ceil(360.0 * math.cos(math.radians(widest)) / grid_deg))
    if abs(row_deg) >= 90.0:
        return direction_of(0.0, math.copysign(90.0, row_deg))
    return direction_of(round(ra_deg * steps / 360.0) % steps * 360.0 / steps, row_deg)
