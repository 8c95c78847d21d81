"""The search of the whole sky for the attitude of a batch, using one of its trackers.

The attitude found replaces an a priori attitude that is missing or wrong: zones, identities and the
solution then follow as usual.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from service.attitude.solution import NoAttitude
from service.identify.budget import WorkBudget
from service.identify.lost_in_space.solver import FieldOfView, LostInSpace, LostInSpaceResult
from service.missions.mission import Mission, Tracker
from service.observations.calibrate import CorrectedObservations
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.model import SkyModel
from service.sky.whole_sky.index import SkyIndex
from service.vectors import ARCSEC_PER_RADIAN, Matrix, Vector, read_only

SIGMA_FLOOR_ARCSEC = 1.5
"""Least position sigma of a star in arcsec: an index serves a year and leaves parallax out."""
AT_REST = np.zeros(3)
COLOR_SIGMA_MAG = 0.3
"""Sigma of a magnitude from colours and variable stars, beside the measurement noise."""
FEW_MATCHES, LARGEST_SCATTER_MAG = 4, 1.0
"""Number of matches up to which the scatter of magnitude offsets is limited, and its limit.

Otherwise chance gives three random points an attitude in 1 of 15,000 batches. The limit is twice
the noise of a tracker with poor photometry: half of it would refuse real fields of four stars.
"""


@dataclass(frozen=True)
class FoundAttitude:
    """The attitude (3, 3) found for a batch, inertial to body, or the reason for a refusal.

    `bounded`: a search ended at its work limit. `explained` (n,) marks, for every tracker, the
    stars that the most likely attitude explains, even if refused. `corrected` has the observations
    for identification about the attitude, without magnitudes if the attitude was found without
    them; `warnings` then says so. `star` (n,) has, for every tracker, the run catalog rows used for
    the attitude, -1 for other stars, and `probability` is that of the attitude.
    """

    attitude: Matrix | None
    refusal: NoAttitude | None
    bounded: bool
    explained: tuple[npt.NDArray[np.bool_], ...]
    corrected: Sequence[CorrectedObservations]
    warnings: tuple[str, ...] = ()
    star: tuple[npt.NDArray[np.int64], ...] = ()
    probability: float = math.nan


class SkySearch(NamedTuple):
    """The result of one search of the whole sky.

    `magnitudes_used` is false if the search succeeded only without magnitudes.
    """

    result: LostInSpaceResult
    magnitudes_used: bool
    bounded: bool


def find_attitude(
    corrected: Sequence[CorrectedObservations],
    velocity_c: Vector,
    run_catalog: RunCatalog,
    mission: Mission,
    sky: SkyModel,
    budget: WorkBudget,
) -> FoundAttitude:
    """Search the whole sky with one tracker after another, the one with the most stars first.

    If no search succeeds, the refusal is that of the tracker with the most stars.
    """
    refusals: list[NoAttitude | None] = []
    explained = [np.zeros(len(each.magnitude_mag), np.bool_) for each in corrected]
    bounded = False
    for place in sorted(range(len(corrected)), key=lambda one: -len(corrected[one].magnitude_mag)):
        each = corrected[place]
        tracker = each.tracker
        field = field_of(tracker)
        index = sky.index(mission, run_catalog, field.radius_deg)
        search = search_sky(
            LostInSpace(index, field),
            each.direction_body @ tracker.body_from_tracker,
            each.magnitude_mag,
            np.maximum(each.sigma_arcsec, SIGMA_FLOOR_ARCSEC) / ARCSEC_PER_RADIAN,
            velocity_c,
            budget,
        )
        bounded |= search.bounded
        explained[place] = search.result.star >= 0
        if search.result.attitude is not None:
            attitude = tracker.body_from_tracker @ search.result.attitude
            # The index also has stars fainter than the run catalog's limit, after the others.
            known = search.result.star < len(run_catalog)
            rows = [np.full(len(one.magnitude_mag), -1) for one in corrected]
            rows[place] = np.where(known, search.result.star, -1)
            stars = tuple(rows)
            probability = 1.0 / (1.0 + math.exp(-min(search.result.log_odds, 700.0)))
            if search.magnitudes_used:
                return FoundAttitude(
                    *(attitude, None, bounded, tuple(explained), corrected, ()),
                    *(stars, probability),
                )
            warning = (
                "magnitudes_not_used: the whole sky was searched and the stars identified without "
                "magnitudes"
            )
            off_mag = magnitude_offset(search.result, each.magnitude_mag, index)
            if off_mag is not None:
                warning += f"; those of {tracker.name} have an offset of about {off_mag:.1f} mag"
            unmeasured = _without_magnitudes(corrected)
            return FoundAttitude(
                *(attitude, None, bounded, tuple(explained), unmeasured, (warning,)),
                *(stars, probability),
            )
        refusals.append(search.result.refusal)
    return FoundAttitude(None, refusals[0], bounded, tuple(explained), corrected)


def search_sky(
    solver: LostInSpace,
    direction: Vector,
    magnitude_mag: Vector,
    sigma_rad: Vector,
    velocity_c: Vector = AT_REST,
    budget: WorkBudget | None = None,
) -> SkySearch:
    """Search the whole sky, and repeat without magnitudes if that finds nothing.

    Magnitudes without a zero point, or with one that is off by a magnitude or more, would refuse
    every match. The reported refusal is that of the first search.
    """
    budget = budget or WorkBudget()

    def solve(magnitude_mag: Vector) -> LostInSpaceResult:
        result = solver.solve(direction, magnitude_mag, sigma_rad, velocity_c, budget.left)
        budget.spend(result.work)
        return result

    first = solve(magnitude_mag)
    if first.refusal not in (NoAttitude.NO_MATCH, NoAttitude.DOUBTFUL_MATCH) or (
        np.isnan(magnitude_mag).all()
    ):
        return SkySearch(first, True, first.bounded)
    unknown = np.full(len(magnitude_mag), math.nan)
    second = solve(unknown)
    bounded = first.bounded or second.bounded
    if second.attitude is None:
        return SkySearch(first, True, bounded)
    off_mag = _magnitude_offsets(second, magnitude_mag, solver.index)
    if 2 <= len(off_mag) <= FEW_MATCHES and off_mag.std(ddof=1) > LARGEST_SCATTER_MAG:
        return SkySearch(first, True, bounded)
    return SkySearch(second, False, bounded)


def magnitude_offset(
    result: LostInSpaceResult, magnitude_mag: Vector, index: SkyIndex
) -> float | None:
    """The median of observed minus catalog magnitude over matched stars; None without any."""
    off_mag = _magnitude_offsets(result, magnitude_mag, index)
    return float(np.median(off_mag)) if len(off_mag) else None


def _magnitude_offsets(result: LostInSpaceResult, magnitude_mag: Vector, index: SkyIndex) -> Vector:
    """Observed minus catalog magnitudes of the matched stars that have a magnitude."""
    matched = (result.star >= 0) & ~np.isnan(magnitude_mag)
    return np.asarray(magnitude_mag[matched] - index.arrays.stars[result.star[matched], 3])


def _without_magnitudes(
    corrected: Sequence[CorrectedObservations],
) -> tuple[CorrectedObservations, ...]:
    """Corrected observations of all trackers without their magnitudes."""
    return tuple(
        # Read-only, as a batch's arrays are: for writable ones numba would compile every kernel
        # again.
        replace(each, magnitude_mag=read_only(np.full(len(each.magnitude_mag), math.nan)))
        for each in corrected
    )


def field_of(tracker: Tracker) -> FieldOfView:
    """The circular field of view of a tracker, and its photometric error."""
    return FieldOfView(
        tracker.field_of_view_radius_deg,
        magnitude_sigma_mag=float(np.hypot(tracker.magnitude_sigma_mag, COLOR_SIGMA_MAG)),
    )
