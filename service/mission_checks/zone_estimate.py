"""Stars, pairs and memory of a mission's zones, estimated before a zone is built.

The largest star and pair counts are searched over the whole sky.  Equation 1 of Fink & Shoup (1994)
is NTOT = k_g (NCAP² - NCAP) / 2.  Their equation 2 assumes evenly spread stars, and its k_g is a
bound rather than an estimate.  Here the pairs of a zone follow from the surroundings of each star,
in rings up to HMAX: the number of neighbours, and the side on which most of them lie.  The share of
neighbours inside the zone's shape is counted, which gives the local k_g.  No pair of a zone is
looked at.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from service.mission_checks import zone_census
from service.missions.mission import Band, Mission
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.geometry.pairs import PAIRS_PER_BIN
from service.sky.geometry.star_hashes import BUCKETS_PER_STAR, REACH_RAD
from service.vectors import Vector, to_ra_dec


def geometric_k_g(mission: Mission, size_deg: float) -> float:
    """Factor k_g by equation 2 of Fink & Shoup (1994): thrice the field of view's area over the
    zone's.

    The areas are those of flat circles and strips, as in the paper's tables 13 and 14; a share
    is at most 1.
    """
    view_deg = max(each.field_of_view_radius_deg for each in mission.trackers)
    zone = mission.zone
    if isinstance(zone, Band):
        around = 360.0 * math.sin(math.radians(zone.coelevation_deg))
        return min(1.0, 3.0 * math.pi * view_deg**2 / (around * 2.0 * size_deg))
    return min(1.0, 3.0 * (view_deg / size_deg) ** 2)


RINGS = 4
"""Number of rings of equal area about a star, by which its neighbours are counted."""
ANGLES, STEPS, BEARINGS = 240, 8, 48
"""Numbers of steps across a zone, outward within a ring, and over half a turn about a star."""
NEIGHBOURS_AT_ONCE = 4_000_000
VOXEL_BITS_PER_STAR = 128


@dataclass(frozen=True)
class Neighbours:
    """Numbers of neighbours of each star in a run catalog, in rings up to HMAX.

    `count` is (n, RINGS), `total` (n, RINGS, 3) the sum of the neighbours' unit vectors, in the
    first ring with the star's own.
    """

    direction: Vector
    limit_deg: float
    count: Vector
    total: Vector


@dataclass(frozen=True)
class Shape:
    """Shape of a zone: bounds from its axis, and the share inside of each ring about a star.

    For stars at `cosine` (k,) from the axis, ascending: `share` (k, RINGS) is the share of a ring's
    area inside, and `slope` (k, RINGS) the weight of neighbours concentrated towards the axis.
    """

    least_deg: float
    most_deg: float
    cosine: Vector
    share: Vector
    slope: Vector


@dataclass(frozen=True)
class ZoneEstimate:
    """Estimate for zones of one shape over the sky: `pairs` (NTOT) predicted, `stars` (NCAP)
    counted.

    `pairs_counted` is the most pairs that a zone of the sky holds, `richest_deg` its axis (right
    ascension, declination); `pairs.most` and `k_g`, the share of pairs, are predicted there.
    `k_g_areas` is equation 2's, `pairs_bound` equation 1 with it and the most stars of the sky:
    a bound for stars spread evenly, which those of the sky may exceed.
    `most_bytes` is the memory of the largest zone as the service caches it, grown by its grid.
    """

    of: str
    size_deg: float
    pair_separation_max_deg: float
    magnitude_limit_mag: float
    stars: zone_census.Spread
    pairs: zone_census.Spread
    richest_deg: tuple[float, float]
    k_g: float
    pairs_counted: int
    k_g_areas: float
    pairs_bound: int
    most_bytes: int


def neighbours_of(direction: Vector, limit_deg: float) -> Neighbours:
    """Count the neighbours of unit vectors (n, 3) within an angle, in rings of equal area."""
    from scipy.spatial import cKDTree

    tree: Any = cKDTree(direction)
    chord = 2.0 * math.sin(math.radians(min(limit_deg, 180.0)) / 2.0)
    stars = len(direction)
    count, total = np.zeros((stars, RINGS)), np.zeros((stars, RINGS, 3))
    mean = max(1, int(tree.count_neighbors(tree, chord)) // max(1, stars))
    step = max(1, NEIGHBOURS_AT_ONCE // mean)
    for first in range(0, stars, step):
        chunk: Any = cKDTree(direction[first : first + step])
        found = chunk.sparse_distance_matrix(tree, chord, output_type="ndarray")
        ring = np.minimum((found["v"] / chord) ** 2 * RINGS, RINGS - 1).astype(np.int64)
        place, places = found["i"] * RINGS + ring, chunk.n * RINGS
        part = slice(first, first + chunk.n)
        count[part] = np.bincount(place, minlength=places).reshape(-1, RINGS)
        for k in range(3):
            sums = np.bincount(place, direction[found["j"], k], minlength=places)
            total[part, :, k] = sums.reshape(-1, RINGS)
    count[:, 0] -= 1.0  # Each finds itself, too.
    return Neighbours(direction, limit_deg, count, total)


def shape_of(least_deg: float, most_deg: float, limit_deg: float) -> Shape:
    """Compute the shape of zones between two angles from their axes."""
    inner, outer = np.cos(np.radians((least_deg, most_deg)))
    cosine = np.linspace(outer, inner, ANGLES)
    # Parts of equal area of the disc, ring by ring, and bearings from the axis to the far side.
    parts = RINGS * STEPS
    height = (np.arange(parts) + 0.5) / parts * (1.0 - math.cos(math.radians(limit_deg)))
    bearing = (np.arange(BEARINGS) + 0.5) / BEARINGS * math.pi
    away = np.sqrt(height * (2.0 - height))[:, None]
    towards = away * np.cos(bearing)
    sine = np.sqrt(np.clip(1.0 - cosine**2, 0.0, 1.0))
    point = cosine[:, None, None] * (1.0 - height[:, None]) + sine[:, None, None] * towards
    inside = (point >= outer) & (point <= inner)
    by_ring = ANGLES, RINGS, STEPS * BEARINGS
    share = inside.reshape(by_ring).mean(axis=2)
    slope = (inside * towards).reshape(by_ring).mean(axis=2)
    slope /= np.square(towards).reshape(by_ring[1:]).mean(axis=1)
    return Shape(least_deg, most_deg, cosine, share, slope)


def predicted(neighbours: Neighbours, shape: Shape, axis: Vector) -> tuple[int, float]:
    """Number of stars in a zone about an axis, counted, and of its pairs, predicted."""
    direction = neighbours.direction
    # Rounded, the axis itself may be outside of its zone.
    cosine = np.clip(direction @ axis, -1.0, 1.0)
    inside = np.flatnonzero((cosine >= shape.cosine[0]) & (cosine <= shape.cosine[-1]))
    cosine, total = cosine[inside], neighbours.total[inside]
    sine = np.sqrt(np.clip(1.0 - cosine**2, 1e-18, 1.0))
    along = np.einsum("nrk,nk->nr", total, direction[inside])
    towards_axis = (total @ axis - cosine[:, None] * along) / sine[:, None]
    pairs = 0.0
    for ring in range(RINGS):
        share = np.interp(cosine, shape.cosine, shape.share[:, ring])
        slope = np.interp(cosine, shape.cosine, shape.slope[:, ring])
        # Each pair is found from both of its stars.
        found = neighbours.count[inside, ring] * share + towards_axis[:, ring] * slope
        pairs += 0.5 * float(found.sum())
    return len(inside), max(0.0, pairs)


def zone_bytes(stars: int, pairs: float, is_band: bool) -> int:
    """Memory of a zone in bytes, from the layout of its arrays."""
    # Rows, directions twice, magnitudes twice; the buckets with rows and directions of their own.
    star_bytes = 4 + 24 + 8 + 32 + 4 + 24 + (8 if is_band else 0)
    buckets = 1 << max(4, math.ceil(math.log2(max(1, BUCKETS_PER_STAR * stars))))
    voxels = 1 << max(7, (stars * VOXEL_BITS_PER_STAR // 8 - 1).bit_length())
    # A separation, two rows, a share of a bin; in a band the difference of angles to the pole.
    pair_bytes = 16 + 4 / PAIRS_PER_BIN + (4 if is_band else 0)
    fixed = 4 * buckets + len(REACH_RAD) * voxels
    return round(stars * star_bytes + fixed + pairs * pair_bytes)


def zone_estimates(
    mission: Mission, run_catalog: RunCatalog, neighbours: Neighbours
) -> list[ZoneEstimate]:
    """Estimates of a mission's zones by shape: one for caps, one per coelevation for bands.

    `neighbours` are those of the run catalog up to the mission's HMAX.
    """
    zone, axes = mission.zone, zone_census.axes_of_sky()
    is_band = isinstance(zone, Band)
    size_deg = zone.half_width_deg if isinstance(zone, Band) else zone.radius_deg
    # The cache snaps an axis by half the diagonal of a cell at most; see `sky.zones.zone_for`.
    grown_by_deg = zone.grid_deg / math.sqrt(2.0)
    limit_deg = neighbours.limit_deg
    found = []
    for of, least_deg, most_deg in _bounds(mission):
        shape = shape_of(least_deg, most_deg, limit_deg)
        both = np.array([predicted(neighbours, shape, axis) for axis in axes])
        stars, pairs = both[:, 0], both[:, 1]
        grid = (
            stars.reshape(zone_census.ROWS, zone_census.COLUMNS),
            pairs.reshape(zone_census.ROWS, zone_census.COLUMNS),
        )
        sky = zone_census.Extremes(run_catalog.direction, least_deg, most_deg, limit_deg)
        star_range = zone_census.star_spread(sky, grid[0])
        pairs_counted, richest = sky.pairs(grid[1], most=True)
        _, poorest = sky.pairs(grid[1], most=False)
        in_richest, most_pairs = predicted(neighbours, shape, richest)
        _, least_pairs = predicted(neighbours, shape, poorest)
        grown = max(0.0, least_deg - grown_by_deg), min(180.0, most_deg + grown_by_deg)
        cached = zone_census.Extremes(run_catalog.direction, *grown, limit_deg)
        most_bytes = zone_bytes(
            cached.stars(grid[0], most=True)[0], cached.pairs(grid[1], most=True)[0], is_band
        )
        ra_deg, dec_deg = to_ra_dec(richest)
        k_g_areas = geometric_k_g(mission, size_deg)
        found.append(
            ZoneEstimate(
                of=of,
                size_deg=size_deg,
                pair_separation_max_deg=limit_deg,
                magnitude_limit_mag=mission.catalog.magnitude_limit_mag,
                stars=star_range,
                pairs=zone_census.Spread(
                    round(least_pairs), zone_census.median_of(np.rint(grid[1])), round(most_pairs)
                ),
                richest_deg=(float(ra_deg), float(dec_deg)),
                k_g=float(most_pairs / max(1.0, _all_pairs(in_richest))),
                pairs_counted=pairs_counted,
                k_g_areas=k_g_areas,
                pairs_bound=round(k_g_areas * _all_pairs(star_range.most)),
                most_bytes=most_bytes,
            )
        )
    return found


def _all_pairs(stars: float) -> float:
    return stars * (stars - 1.0) / 2.0


def _bounds(mission: Mission) -> list[tuple[str, float, float]]:
    """Shapes of a mission's zones: description, and the two angles from the axis.

    Trackers at one coelevation share a band.
    """
    zone = mission.zone
    if not isinstance(zone, Band):
        return [(f"cap with a radius of {zone.radius_deg:g} deg", 0.0, zone.radius_deg)]
    half_deg = zone.half_width_deg
    middles = {each.coelevation_deg or zone.coelevation_deg for each in mission.trackers}
    return [
        (
            f"band at {middle:g} deg, +-{half_deg:g} deg",
            max(0.0, middle - half_deg),
            min(180.0, middle + half_deg),
        )
        for middle in sorted(middles)
    ]
