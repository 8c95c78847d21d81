"""Instrument drift from one batch: the scale of each tracker, and the angles between trackers.

Neither needs an attitude.  The scatter of stars about their mean direction does not depend on the
orientation of the body, and neither does the angle between the mean directions of two trackers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from service.acquire.choices import aberration_velocity
from service.identify.identification import Integers
from service.missions.mission import Tracker
from service.observations.batch import ObservationBatch
from service.observations.calibrate import CorrectedObservations
from service.sky.ephemeris import apparent
from service.vectors import ARCSEC_PER_RADIAN, Vector

LEAST_SPREAD = 0.25
"""Least rms distance of stars from their mean, as a fraction of the field of view's radius."""


@dataclass(frozen=True, eq=False)
class MeanStars:
    """Unique stars of one tracker: their number, and the sums of their unit vectors (3,).

    `observed` is in body axes, `catalog` inertial and apparent.
    """

    tracker: Tracker
    count: int
    observed: Vector
    catalog: Vector

    @property
    def squares(self) -> tuple[float, float]:
        """Sums of squared distances from the mean direction, of observed and of catalog stars.

        Both are zero where the stars are too close together to give the scale.
        """
        if self.count < 2:
            return 0.0, 0.0
        observed, catalog = (
            # For stars in one place rounding may give a negative value.
            max(self.count - math.hypot(*each.tolist()) ** 2 / self.count, 0.0)
            for each in (self.observed, self.catalog)
        )
        least = LEAST_SPREAD * math.radians(self.tracker.field_of_view_radius_deg)
        return (observed, catalog) if catalog > self.count * least**2 else (0.0, 0.0)


def mean_stars(
    batch: ObservationBatch,
    corrected: Sequence[CorrectedObservations],
    star: Sequence[Integers],
    catalog_direction: Vector,
) -> list[MeanStars]:
    """Sum up the unit vectors of each tracker's unique stars, observed and in the catalog.

    `star` (n,) of every tracker are rows of `catalog_direction` (N, 3), -1 for stars that are not
    unique.
    """
    velocity_c = aberration_velocity(batch)
    found = []
    for seen, rows in zip(corrected, star, strict=True):
        unique = rows >= 0
        catalog = catalog_direction[rows[unique]]
        if len(catalog) and velocity_c.any():
            catalog = apparent(catalog, velocity_c, batch.time)
        sums = seen.direction_body[unique].sum(axis=0), catalog.sum(axis=0)
        found.append(MeanStars(seen.tracker, int(np.count_nonzero(unique)), *sums))
    return found


def scale_offset_ppm(means: Sequence[MeanStars]) -> float | None:
    """Excess of the stars' mutual distances over the catalog's in ppm, over all trackers.

    None where no tracker has stars far enough from each other.
    """
    squares = [each.squares for each in means]
    observed, catalog = (math.fsum(part) for part in zip(*squares, strict=True))
    return 1e6 * (math.sqrt(observed / catalog) - 1.0) if catalog > 0.0 else None


def alignment_offsets_arcsec(means: Sequence[MeanStars]) -> list[float | None]:
    """Mean excess of each tracker's angles to the others over the catalog's angles, in arcsec.

    None for a tracker without a star, or if no other has one.
    """
    seen = [each for each in means if each.count]
    return [
        math.fsum(_wider_arcsec(each, other) for other in seen if other is not each)
        / (len(seen) - 1)
        if each.count and len(seen) > 1
        else None
        for each in means
    ]


def _wider_arcsec(one: MeanStars, other: MeanStars) -> float:
    """Angle between the mean directions of two trackers, observed minus catalog, in arcsec."""
    observed_rad = _angle_rad(one.observed, other.observed)
    return (observed_rad - _angle_rad(one.catalog, other.catalog)) * ARCSEC_PER_RADIAN


def _angle_rad(a: Vector, b: Vector) -> float:
    """Angle in radians between two vectors (3,) of any length, in plain numbers for speed.

    Kahan's formula, which is accurate at every angle.
    """
    first, second = a.tolist(), b.tolist()
    one, other = math.hypot(*first), math.hypot(*second)
    pairs = [(x * other, y * one) for x, y in zip(first, second, strict=True)]
    apart, together = ((x - y for x, y in pairs), (x + y for x, y in pairs))
    return 2.0 * math.atan2(math.hypot(*apart), math.hypot(*together))
