"""The size of a mission's zone: what it costs in pairs, and what a priori errors need.

A zone must hold the field of view about any attitude that the a priori one may stand for, so
its radius (of a band: its half width) is that of the field of view and the error together.
The most stars and pairs of such a zone are sought over the whole sky.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from service.advice.zone_census import Extremes, star_counts
from service.missions.mission import Band, Mission
from service.vectors import Vector

Verdict = Literal["too_few", "fits", "too_small", "larger_than_needed"]

LEAST_BATCHES = 50
"""Fewer errors say too little of the rare large ones."""
USUAL_PERCENT = 90.0
GROSS = 3.0
"""Times that percentile: an error beyond it is a failure of its source, which no zone mends."""
RESERVE = 1.2
"""Times the largest usual error that was seen: the next one may be larger."""
TOO_LARGE = 1.5
"""Times the size with that reserve."""
LARGEST_DEG = {"cap": 180.0, "band": 90.0}


@dataclass(frozen=True)
class ZoneCost:
    """The largest zones of one size that the sky has.

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
        """NTOT by equation 1 of Fink & Shoup (1994)."""
        return round(self.k_g * self.stars * (self.stars - 1) / 2.0)


@dataclass(frozen=True)
class AprioriErrors:
    """How far a priori attitudes were from those found.

    `gross` of them are errors beyond what is usual; `usual_deg` is the largest of the others,
    of which the zone leaves no room for `beyond`.
    """

    batches: int
    median_deg: float
    usual_deg: float
    beyond: int
    gross: int
    largest_deg: float


@dataclass(frozen=True)
class ZoneSize:
    """The size of a zone beside what was recorded.

    `setting` is its key in the mission file; `margin_deg` is the error that it leaves room
    for.  `covering_deg` is the size for the usual errors with a reserve, None without enough
    of them.
    """

    setting: str
    size_deg: float
    field_of_view_deg: float
    margin_deg: float
    errors: AprioriErrors | None
    verdict: Verdict
    covering_deg: float | None

    @property
    def sizes_deg(self) -> list[float]:
        """The present size and the one that covers the errors, ascending."""
        return sorted({self.size_deg, self.covering_deg or self.size_deg})


def zone_size(mission: Mission, angles_deg: Sequence[float]) -> ZoneSize:
    """Advice on the size of a mission's zone.

    `angles_deg` are the recorded angles from a priori to found attitudes.
    """
    is_band = isinstance(mission.zone, Band)
    setting = "zone.half_width_deg" if is_band else "zone.radius_deg"
    now_deg = _size_deg(mission)
    view_deg = max(each.field_of_view_radius_deg for each in mission.trackers)
    margin_deg = max(0.0, now_deg - view_deg)
    errors = _errors(angles_deg, margin_deg)
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
        field_of_view_deg=view_deg,
        margin_deg=margin_deg,
        errors=errors,
        verdict=verdict,
        covering_deg=covering_deg,
    )


def zone_cost(mission: Mission, direction: Vector, size_deg: float) -> ZoneCost:
    """The most stars and the most pairs of a zone of this size.

    `direction` (n, 3) is the run catalog's.
    """
    bounds_deg = _bounds_deg(mission, size_deg)
    counts = star_counts(direction, *bounds_deg)
    sky = Extremes(direction, *bounds_deg, mission.tolerances.pair_separation_max_deg)
    stars, _ = sky.stars(counts, most=True)
    # Where stars are dense pairs are many: the grid's pairs need not be counted for the starts.
    pairs, _ = sky.pairs(counts, most=True)
    return ZoneCost(size_deg, stars, pairs, geometric_k_g(mission, size_deg))


def geometric_k_g(mission: Mission, size_deg: float) -> float:
    """Equation 2 of Fink & Shoup (1994): thrice the field of view's area over the zone's.

    The areas are those of flat circles and strips, as in the paper's tables 13 and 14; a share
    is at most 1.
    """
    view_deg = max(each.field_of_view_radius_deg for each in mission.trackers)
    zone = mission.zone
    if isinstance(zone, Band):
        around = 360.0 * math.sin(math.radians(zone.coelevation_deg))
        return min(1.0, 3.0 * math.pi * view_deg**2 / (around * 2.0 * size_deg))
    return min(1.0, 3.0 * (view_deg / size_deg) ** 2)


def _size_deg(mission: Mission) -> float:
    zone = mission.zone
    return zone.half_width_deg if isinstance(zone, Band) else zone.radius_deg


def _bounds_deg(mission: Mission, size_deg: float) -> tuple[float, float]:
    """The angles from the zone's axis between which its stars lie."""
    zone = mission.zone
    if not isinstance(zone, Band):
        return 0.0, size_deg
    return max(0.0, zone.coelevation_deg - size_deg), min(180.0, zone.coelevation_deg + size_deg)


def _errors(angles_deg: Sequence[float], margin_deg: float) -> AprioriErrors | None:
    if not angles_deg:
        return None
    angles = np.asarray(angles_deg)
    median_deg, most_deg = np.percentile(angles, (50.0, USUAL_PERCENT)).tolist()
    usual = angles[angles <= GROSS * most_deg]
    return AprioriErrors(
        batches=len(angles),
        median_deg=median_deg,
        usual_deg=float(usual.max()),
        beyond=int(np.count_nonzero(usual > margin_deg)),
        gross=len(angles) - len(usual),
        largest_deg=float(angles.max()),
    )
