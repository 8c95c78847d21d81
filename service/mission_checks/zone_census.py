"""Numbers of stars and pairs in a mission's zones over the whole sky, without building zones."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from service.missions.mission import Band, Mission
from service.sky.catalog.run_catalog import RunCatalog
from service.vectors import Vector, from_ra_dec, to_ra_dec, unit

ROWS, COLUMNS = 18, 72
"""Grid of zone axes: steps of 10 deg in declination and 5 deg in right ascension."""

FIRST_STEP_DEG, LAST_STEP_DEG = 2.5, 0.02
STAR_STARTS, PAIR_STARTS = 16, 8
"""Numbers of grid axes from which the extremes of star and pair counts are searched."""
AXES_AT_ONCE = 72


@dataclass(frozen=True)
class Spread:
    """Least, median and largest count over equal areas of the sky."""

    least: int
    median: int
    most: int


@dataclass(frozen=True)
class ZoneCensus:
    """Counts of stars and pairs in zones of one shape, about every axis of the grid.

    `stars` and `pairs` (ROWS, COLUMNS) are NCAP and NTOT; declination falls along the rows, right
    ascension grows along the columns.  `of` names the shape.  `spread` has least, median and most
    of both over the whole sky, and `richest` is the axis with the most pairs.
    """

    of: str
    least_deg: float
    most_deg: float
    stars: Vector
    pairs: Vector
    spread: dict[str, Spread]
    richest: Vector

    def richest_deg(self) -> tuple[float, float]:
        """Right ascension and declination of the zone axis with the most pairs, in degrees."""
        ra_deg, dec_deg = to_ra_dec(self.richest)
        return float(ra_deg), float(dec_deg)


class Extremes:
    """Search for the fewest and the most stars or pairs in a zone about any axis.

    The search starts from the poorest and richest axes of the grid: the best of 24 axes about each
    is taken, at first half a row apart, and the steps are halved if none is better.  Counts jump
    between axes, so an extreme is not proven; none of 100,000 random axes exceeds one.
    """

    def __init__(
        self, direction: Vector, least_deg: float, most_deg: float, limit_deg: float = 0.0
    ) -> None:
        self._direction = direction
        self._bounds_deg = least_deg, most_deg
        self._limit_deg = limit_deg

    def stars(self, counts: Vector, most: bool) -> tuple[int, Vector]:
        """Extreme number of stars (NCAP) and its axis; `counts` (ROWS, COLUMNS) are the grid's."""
        return self._best(counts, STAR_STARTS, most, pairs=False)

    def pairs(self, counts: Vector, most: bool) -> tuple[int, Vector]:
        """Extreme number of pairs (NTOT) and its axis; rough grid `counts` suffice."""
        return self._best(counts, PAIR_STARTS, most, pairs=True)

    def _best(self, counts: Vector, starts: int, most: bool, pairs: bool) -> tuple[int, Vector]:
        sign = 1 if most else -1
        order = np.argsort(-sign * counts.ravel(), kind="stable")[:starts]
        found = [self._climb(axis, sign, pairs) for axis in axes_of_sky()[order]]
        return max(found, key=lambda each: sign * each[0])

    def _climb(self, axis: Vector, sign: int, pairs: bool) -> tuple[int, Vector]:
        step_deg, count = FIRST_STEP_DEG, 0
        while step_deg >= LAST_STEP_DEG:
            axes = np.vstack([axis, _axes_about(axis, step_deg)])
            counts = self._counts(axes, step_deg, pairs)
            best = int(np.argmax(sign * counts))
            count, axis = int(counts[best]), axes[best]
            if best == 0:
                step_deg /= 2.0
        return count, axis

    def _counts(self, axes: Vector, step_deg: float, pairs: bool) -> Vector:
        """Numbers of stars or pairs in zones about axes at most one step from the first."""
        least_deg, most_deg = self._bounds_deg
        wide = _inside(self._direction @ axes[0], least_deg - step_deg, most_deg + step_deg)
        near = self._direction[wide]
        inside = _inside(axes @ near.T, least_deg, most_deg)
        if not pairs:
            return np.asarray(inside.sum(axis=1))
        if len(near) == 0:
            return np.zeros(len(axes), dtype=int)
        tree = _tree_of(near)
        first, second = tree.query_pairs(_chord(self._limit_deg), output_type="ndarray").T.copy()
        return np.array([np.count_nonzero(row[first] & row[second]) for row in inside])


def _axes_about(axis: Vector, step_deg: float) -> Vector:
    """Unit vectors (24, 3) around an axis, alternately at half a step and a full step."""
    first = unit(np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))]))
    second = np.cross(axis, first)
    turn = np.arange(24)[:, None] * math.pi / 12.0
    angle = math.radians(step_deg) * np.where(np.arange(24) % 2, 1.0, 0.5)[:, None]
    return np.asarray(
        np.cos(angle) * axis + np.sin(angle) * (np.cos(turn) * first + np.sin(turn) * second)
    )


def _inside(cosine: Vector, least_deg: float, most_deg: float) -> npt.NDArray[np.bool_]:
    """Mask of cosines whose angles lie between two bounds."""
    near = math.cos(math.radians(least_deg)) if least_deg > 0.0 else 2.0
    far = math.cos(math.radians(most_deg)) if most_deg < 180.0 else -2.0
    return (cosine <= near) & (cosine >= far)


def axes_deg() -> tuple[Vector, Vector]:
    """Right ascensions (COLUMNS,) and declinations (ROWS,) of the axis grid, in degrees."""
    ra_deg = (np.arange(COLUMNS) + 0.5) * 360.0 / COLUMNS
    dec_deg = 90.0 - (np.arange(ROWS) + 0.5) * 180.0 / ROWS
    return ra_deg, dec_deg


def zone_censuses(mission: Mission, run_catalog: RunCatalog) -> list[ZoneCensus]:
    """Census of a mission's zones by shape: one for caps, one per coelevation for bands."""
    zone = mission.zone
    if not isinstance(zone, Band):
        shapes = {f"cap with a radius of {zone.radius_deg:g} deg": (0.0, zone.radius_deg)}
    else:
        shapes = {}
        for tracker in mission.trackers:
            middle_deg = tracker.coelevation_deg or zone.coelevation_deg
            shapes[f"band at {middle_deg:g} deg, +-{zone.half_width_deg:g} deg"] = (
                max(0.0, middle_deg - zone.half_width_deg),
                min(180.0, middle_deg + zone.half_width_deg),
            )
    limit_deg = mission.tolerances.pair_separation_max_deg
    return [_census(of, run_catalog.direction, *bounds, limit_deg) for of, bounds in shapes.items()]


def _census(
    of: str, direction: Vector, least_deg: float, most_deg: float, limit_deg: float
) -> ZoneCensus:
    stars, pairs = _counts(direction, least_deg, most_deg, limit_deg)
    sky = Extremes(direction, least_deg, most_deg, limit_deg)
    most_pairs, richest = sky.pairs(pairs, most=True)
    spread = {
        "stars": star_spread(sky, stars),
        "pairs": Spread(sky.pairs(pairs, most=False)[0], median_of(pairs), most_pairs),
    }
    return ZoneCensus(of, least_deg, most_deg, stars, pairs, spread, richest)


def star_spread(sky: Extremes, counts: Vector) -> Spread:
    """Least, median and most stars of zones or fields of view, from counts over the grid."""
    least, _ = sky.stars(counts, most=False)
    most, _ = sky.stars(counts, most=True)
    return Spread(least, median_of(counts), most)


def star_counts(direction: Vector, least_deg: float, most_deg: float) -> Vector:
    """Numbers of stars (ROWS, COLUMNS) between two angles from each grid axis."""
    axes = axes_of_sky()
    counts = [
        _inside(axes[first : first + AXES_AT_ONCE] @ direction.T, least_deg, most_deg).sum(axis=1)
        for first in range(0, len(axes), AXES_AT_ONCE)
    ]
    return np.concatenate(counts).reshape(ROWS, COLUMNS)


def _tree_of(direction: Vector) -> Any:
    # Imported here, as everywhere in the service: scipy takes a third of a start.
    from scipy.spatial import cKDTree

    return cKDTree(direction)


def zone_counts(
    direction: Vector, axis: Vector, least_deg: float, most_deg: float, limit_deg: float
) -> tuple[int, int]:
    """Number of stars between two angles from an axis, and of their pairs within a separation."""
    inside = direction[_inside(direction @ axis, least_deg, most_deg)]
    if len(inside) == 0:
        return 0, 0
    tree = _tree_of(inside)
    # Both orders of a pair are counted, and each star with itself.
    both = int(tree.count_neighbors(tree, _chord(limit_deg)))
    return len(inside), (both - len(inside)) // 2


def share_below(counts: Vector, least: int) -> float:
    """Share of the sky where a count over the grid is below `least`."""
    return float(_weights()[counts.ravel() < least].sum())


def median_of(counts: Vector) -> int:
    """Median over the sky of counts over the grid, weighted by area."""
    flat = counts.ravel()
    order = np.argsort(flat)
    return int(flat[order][np.searchsorted(np.cumsum(_weights()[order]), 0.5)])


def _counts(
    direction: Vector, least_deg: float, most_deg: float, limit_deg: float
) -> tuple[Vector, Vector]:
    found = [zone_counts(direction, axis, least_deg, most_deg, limit_deg) for axis in axes_of_sky()]
    both = np.array(found).reshape(ROWS, COLUMNS, 2)
    return both[..., 0], both[..., 1]


def axes_of_sky() -> Vector:
    """Unit vectors (ROWS * COLUMNS, 3) of the grid axes, row by row."""
    ra_deg, dec_deg = axes_deg()
    return from_ra_dec(np.tile(ra_deg, ROWS), np.repeat(dec_deg, COLUMNS))


def _weights() -> Vector:
    """Share of the sky that each grid axis represents; rows near a pole cover less."""
    _, dec_deg = axes_deg()
    weight = np.repeat(np.cos(np.radians(dec_deg)), COLUMNS)
    return np.asarray(weight / weight.sum())


def _chord(angle_deg: float) -> float:
    return 2.0 * math.sin(math.radians(min(angle_deg, 180.0)) / 2.0)
