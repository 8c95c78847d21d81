"""The attitude of a batch of which nothing is known, from one of its trackers.

It stands for the a priori attitude that was not given, or was wrong: zones,
identities and the solution then come of it the way they always do.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from service.attitude.solution import NoAttitude
from service.identify.lost_in_space.solver import FieldOfView, LostInSpace, LostInSpaceResult
from service.missions.mission import Mission, Tracker
from service.observe.correct import CorrectedObservations
from service.sky.run_catalog import RunCatalog
from service.sky.sky_index import SkyIndex
from service.sky.view import Sky
from service.vectors import ARCSEC_PER_RADIAN, Matrix, Vector

SIGMA_FLOOR_ARCSEC = 1.5
"""No star is taken as better known: a run catalog serves a year, and parallax is left out."""
STILL = np.zeros(3)
COLOR_SIGMA_MAG = 0.3
"""What a magnitude is off by beside its noise: colour, and stars that vary."""


@dataclass(frozen=True)
class Found:
    """An attitude (3, 3), inertial to body, or why there is none.

    `bounded`: a search ended at its bound on the work.  `explained` (n,) of every
    tracker marks the stars of the likeliest attitude, also of one that is
    refused.  `corrected` is what the
    stars are to be identified from about the attitude: the observations, without
    their magnitudes where the attitude was found without them; `warnings` then
    says so.
    """

    attitude: Matrix | None
    refusal: NoAttitude | None
    bounded: bool
    explained: tuple[npt.NDArray[np.bool_], ...]
    corrected: Sequence[CorrectedObservations]
    warnings: tuple[str, ...] = ()


class Search(NamedTuple):
    """What a search in the whole sky came to.

    `magnitudes_used` is false where it succeeded only without the magnitudes.
    """

    result: LostInSpaceResult
    magnitudes_used: bool
    bounded: bool


def find_attitude(
    corrected: Sequence[CorrectedObservations],
    velocity_c: Vector,
    run_catalog: RunCatalog,
    mission: Mission,
    sky: Sky,
) -> Found:
    """Look in the whole sky, tracker by tracker, the one with the most stars first.

    The refusal is that of the tracker with the most stars.
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
        )
        bounded |= search.bounded
        explained[place] = search.result.star >= 0
        if search.result.attitude is not None:
            attitude = tracker.body_from_tracker @ search.result.attitude
            if search.magnitudes_used:
                return Found(attitude, None, bounded, tuple(explained), corrected)
            warning = (
                "magnitudes_not_used: the whole sky was searched and the stars identified without "
                "magnitudes"
            )
            off_mag = magnitude_offset(search.result, each.magnitude_mag, index)
            if off_mag is not None:
                warning += f"; those of {tracker.name} have an offset of about {off_mag:.1f} mag"
            unmeasured = _without_magnitudes(corrected)
            return Found(attitude, None, bounded, tuple(explained), unmeasured, (warning,))
        refusals.append(search.result.refusal)
    return Found(None, refusals[0], bounded, tuple(explained), corrected)


def search_sky(
    solver: LostInSpace,
    direction: Vector,
    magnitude_mag: Vector,
    sigma_rad: Vector,
    velocity_c: Vector = STILL,
) -> Search:
    """Search the whole sky, and again without the magnitudes where that finds nothing.

    Magnitudes without a zero point, or with one that is off by a magnitude or
    more, refuse every match.  The refusal is that of the first search.
    """
    first = solver.solve(direction, magnitude_mag, sigma_rad, velocity_c)
    if first.refusal not in (NoAttitude.NO_MATCH, NoAttitude.DOUBTFUL_MATCH) or (
        np.isnan(magnitude_mag).all()
    ):
        return Search(first, True, first.bounded)
    unknown = np.full(len(magnitude_mag), math.nan)
    second = solver.solve(direction, unknown, sigma_rad, velocity_c)
    bounded = first.bounded or second.bounded
    if second.attitude is None:
        return Search(first, True, bounded)
    return Search(second, False, bounded)


def magnitude_offset(
    result: LostInSpaceResult, magnitude_mag: Vector, index: SkyIndex
) -> float | None:
    """The median of observed minus catalog magnitude of the matched stars; None without any."""
    matched = (result.star >= 0) & ~np.isnan(magnitude_mag)
    catalog_mag = index.arrays.stars[result.star[matched], 3]
    return float(np.median(magnitude_mag[matched] - catalog_mag)) if matched.any() else None


def _without_magnitudes(
    corrected: Sequence[CorrectedObservations],
) -> tuple[CorrectedObservations, ...]:
    """Of every tracker: what one of them adds to its magnitudes, others may as well."""
    return tuple(
        replace(each, magnitude_mag=np.full(len(each.magnitude_mag), math.nan))
        for each in corrected
    )


def field_of(tracker: Tracker) -> FieldOfView:
    """The circle that a tracker sees, and its photometry."""
    return FieldOfView(
        tracker.field_of_view_radius_deg,
        magnitude_sigma_mag=float(np.hypot(tracker.magnitude_sigma_mag, COLOR_SIGMA_MAG)),
    )
