"""Stars and pairs of a mission's zones over the whole sky, counted without building a zone."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from service.missions.mission import Band, Mission
from service.sky.catalog.run_catalog import RunCatalog
from service.vectors import Vector, from_ra_dec

ROWS, COLUMNS = 18, 72
"""The grid of axes: every 10 deg of declination, every 5 deg of right ascension."""


@dataclass(frozen=True)
class Spread:
    """The least, the median and the largest of counts over equal areas of the sky."""

    least: int
    median: int
    most: int


@dataclass(frozen=True)
class ZoneCensus:
    """What zones of one shape hold, for every axis of `axes_deg`.

    `stars` and `pairs` (ROWS, COLUMNS) are NCAP and NTOT; declination falls along the
    rows, right ascension grows along the columns.  `of` says which shape that is.
    """

    of: str
    least_deg: float
    most_deg: float
    stars: Vector
    pairs: Vector

    @property
    def spread(self) -> dict[str, Spread]:
        """The spread of stars and of pairs."""
        return {"stars": spread_of(self.stars), "pairs": spread_of(self.pairs)}

    def richest_deg(self) -> tuple[float, float]:
        """Right ascension and declination of the axis with the most pairs."""
        row, column = np.unravel_index(int(np.argmax(self.pairs)), self.pairs.shape)
        ra_deg, dec_deg = axes_deg()
        return float(ra_deg[column]), float(dec_deg[row])


def axes_deg() -> tuple[Vector, Vector]:
    """Right ascensions (COLUMNS,) and declinations (ROWS,) of the grid, in degrees."""
    ra_deg = (np.arange(COLUMNS) + 0.5) * 360.0 / COLUMNS
    dec_deg = 90.0 - (np.arange(ROWS) + 0.5) * 180.0 / ROWS
    return ra_deg, dec_deg


def zone_censuses(mission: Mission, run_catalog: RunCatalog) -> list[ZoneCensus]:
    """A census for each shape of zone: of a cap one, of a band one for each coelevation."""
    zone = mission.zone
    if not isinstance(zone, Band):
        shapes = {f"cap of {zone.radius_deg:g} deg": (0.0, zone.radius_deg)}
    else:
        shapes = {}
        for tracker in mission.trackers:
            middle_deg = tracker.coelevation_deg or zone.coelevation_deg
            shapes[f"band at {middle_deg:g} deg, +-{zone.half_width_deg:g} deg"] = (
                max(0.0, middle_deg - zone.half_width_deg),
                min(180.0, middle_deg + zone.half_width_deg),
            )
    limit_deg = mission.tolerances.pair_separation_max_deg
    return [
        ZoneCensus(of, *bounds, *_counts(run_catalog.direction, *bounds, limit_deg))
        for of, bounds in shapes.items()
    ]


def stars_in_view(run_catalog: RunCatalog, radius_deg: float) -> Vector:
    """How many stars (ROWS, COLUMNS) of a run catalog a field of view shows."""
    tree: Any = cKDTree(run_catalog.direction)
    counts = tree.query_ball_point(axes_of_sky(), _chord(radius_deg), return_length=True)
    return np.asarray(counts).reshape(ROWS, COLUMNS)


def zone_counts(
    direction: Vector, axis: Vector, least_deg: float, most_deg: float, limit_deg: float
) -> tuple[int, int]:
    """Stars between two angles from an axis, and their pairs not farther apart than a limit."""
    angle_deg = np.degrees(2.0 * np.arcsin(np.linalg.norm(direction - axis, axis=1).clip(0, 2) / 2))
    inside = direction[(least_deg <= angle_deg) & (angle_deg <= most_deg)]
    if len(inside) == 0:
        return 0, 0
    tree: Any = cKDTree(inside)
    # Both orders of a pair are counted, and each star with itself.
    both = int(tree.count_neighbors(tree, _chord(limit_deg)))
    return len(inside), (both - len(inside)) // 2


def share_below(counts: Vector, least: int) -> float:
    """The share of the sky where a count is below `least`."""
    return float(_weights()[counts.ravel() < least].sum())


def spread_of(counts: Vector) -> Spread:
    """The spread of counts over the grid."""
    flat = counts.ravel()
    order = np.argsort(flat)
    middle = int(np.searchsorted(np.cumsum(_weights()[order]), 0.5))
    return Spread(int(flat.min()), int(flat[order][middle]), int(flat.max()))


def _counts(
    direction: Vector, least_deg: float, most_deg: float, limit_deg: float
) -> tuple[Vector, Vector]:
    found = [zone_counts(direction, axis, least_deg, most_deg, limit_deg) for axis in axes_of_sky()]
    both = np.array(found).reshape(ROWS, COLUMNS, 2)
    return both[..., 0], both[..., 1]


def axes_of_sky() -> Vector:
    """The axes of the grid as unit vectors (ROWS * COLUMNS, 3), row by row."""
    ra_deg, dec_deg = axes_deg()
    return from_ra_dec(np.tile(ra_deg, ROWS), np.repeat(dec_deg, COLUMNS))


def _weights() -> Vector:
    """The share of the sky of each axis: rows near a pole cover less."""
    _, dec_deg = axes_deg()
    weight = np.repeat(np.cos(np.radians(dec_deg)), COLUMNS)
    return np.asarray(weight / weight.sum())


def _chord(angle_deg: float) -> float:
    return 2.0 * math.sin(math.radians(min(angle_deg, 180.0)) / 2.0)
