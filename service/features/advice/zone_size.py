"""Size of a mission's zones: cost in stars and pairs, and size for the a priori errors.

A zone must contain the field of view about any attitude within the a priori error, so its radius
(for a band: half width) is the sum of field of view and error.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from service.mission_checks.zone_census import Extremes, star_counts
from service.mission_checks.zone_estimate import geometric_k_g
from service.missions.mission import Band, Mission
from service.vectors import Vector

Verdict = Literal["too_few", "fits", "too_small", "larger_than_needed"]

LEAST_BATCHES = 50
"""Least number of recorded a priori errors: fewer show too little of the rare large ones."""
GROSS = 3.0
"""Multiple of the 90 % point above which an a priori error is a failure of its source."""
RESERVE = 1.2
"""Factor on the largest usual error observed, since a later one may be larger."""
TOO_LARGE = 1.5
"""Ratio of present to needed zone size above which the zone is called too large."""
CERTAIN_SIGMAS = 4.0
"""Sigmas of the found attitude by which an a priori error must exceed the zone to count."""
LARGEST_DEG = {"cap": 180.0, "band": 90.0}


@dataclass(frozen=True)
class ZoneCost:
    """Largest star and pair counts of zones of one size, over the whole sky.

    `stars` is the most NCAP, `pairs` the most NTOT as counted, of a zone about another axis;
    `k_g` is the paper's approximation (equation 2) and `pairs_by_k_g` what it makes of NCAP
    (equation 1).
    """

    size_deg: float
    stars: int
    pairs: int
    k_g: float

    @property
    def pairs_by_k_g(self) -> int:
        """Number of pairs NTOT by equation 1 of Fink & Shoup (1994)."""
        return round(self.k_g * self.stars * (self.stars - 1) / 2.0)


@dataclass(frozen=True)
class AprioriErrors:
    """Statistics of the angles between a priori and found attitudes.

    `gross` counts unusually large errors; `usual_deg` is the largest of the others.  `beyond` of
    these exceed the margin of the zone by more than the found attitude's own error.
    """

    batches: int
    median_deg: float
    usual_deg: float
    beyond: int
    gross: int
    largest_deg: float


@dataclass(frozen=True)
class ZoneSize:
    """Present size of a zone compared with recorded a priori errors.

    `setting` is its key in the mission file; `margin_deg` is the largest error that the zone
    covers.  `covering_deg` is the size for the usual errors with a reserve, None with too few of
    them.
    """

    setting: str
    size_deg: float
    view_radius_deg: float
    margin_deg: float
    errors: AprioriErrors | None
    verdict: Verdict
    covering_deg: float | None

    @property
    def sizes_deg(self) -> list[float]:
        """Present zone size and the size that covers the errors, ascending, without repeats."""
        return sorted({self.size_deg, self.covering_deg or self.size_deg})


def zone_size(
    mission: Mission, angles_deg: Sequence[float], sigmas_deg: Sequence[float]
) -> ZoneSize:
    """Judge the size of a mission's zone from recorded a priori errors.

    `angles_deg` are the recorded angles from a priori to found attitudes, `sigmas_deg` the standard
    deviations of the found ones.
    """
    is_band = isinstance(mission.zone, Band)
    setting = "zone.half_width_deg" if is_band else "zone.radius_deg"
    now_deg = _size_deg(mission)
    view_deg = max(each.field_of_view_radius_deg for each in mission.trackers)
    margin_deg = max(0.0, now_deg - view_deg)
    errors = _errors(angles_deg, sigmas_deg, margin_deg)
    covering_deg = None
    verdict: Verdict = "too_few"
    if errors is not None and errors.batches >= LEAST_BATCHES:
        wanted_deg = math.ceil(10.0 * (view_deg + RESERVE * errors.usual_deg)) / 10.0
        covering_deg = min(wanted_deg, LARGEST_DEG[mission.zone.kind])
        if errors.beyond:
            verdict = "too_small"
        elif now_deg > TOO_LARGE * covering_deg:
            verdict = "larger_than_needed"
        else:
            verdict = "fits"
    return ZoneSize(
        setting=setting,
        size_deg=now_deg,
        view_radius_deg=view_deg,
        margin_deg=margin_deg,
        errors=errors,
        verdict=verdict,
        covering_deg=covering_deg,
    )


def zone_cost(mission: Mission, direction: Vector, size_deg: float) -> ZoneCost:
    """Largest star and pair counts over the sky for zones of a given size.

    `direction` (n, 3) is the run catalog's.
    """
    bounds_deg = _bounds_deg(mission, size_deg)
    counts = star_counts(direction, *bounds_deg)
    sky = Extremes(direction, *bounds_deg, mission.tolerances.pair_separation_max_deg)
    stars, _ = sky.stars(counts, most=True)
    # Where stars are dense pairs are many: the grid's pairs need not be counted for the starts.
    pairs, _ = sky.pairs(counts, most=True)
    return ZoneCost(size_deg, stars, pairs, geometric_k_g(mission, size_deg))


def _size_deg(mission: Mission) -> float:
    zone = mission.zone
    return zone.half_width_deg if isinstance(zone, Band) else zone.radius_deg


def _bounds_deg(mission: Mission, size_deg: float) -> tuple[float, float]:
    """Angles from the zone's axis between which its stars lie, in degrees."""
    zone = mission.zone
    if not isinstance(zone, Band):
        return 0.0, size_deg
    return max(0.0, zone.coelevation_deg - size_deg), min(180.0, zone.coelevation_deg + size_deg)


def _errors(
    angles_deg: Sequence[float], sigmas_deg: Sequence[float], margin_deg: float
) -> AprioriErrors | None:
    if not angles_deg:
        return None
    angles = np.asarray(angles_deg)
    median_deg, most_deg = np.percentile(angles, (50.0, 90.0)).tolist()
    is_usual = angles <= GROSS * most_deg
    usual = angles[is_usual]
    certain = angles - CERTAIN_SIGMAS * np.asarray(sigmas_deg)
    return AprioriErrors(
        batches=len(angles),
        median_deg=median_deg,
        usual_deg=float(usual.max()),
        beyond=int(np.count_nonzero(is_usual & (certain > margin_deg))),
        gross=len(angles) - len(usual),
        largest_deg=float(angles.max()),
    )
