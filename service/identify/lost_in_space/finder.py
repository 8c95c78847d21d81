"""The attitude of a batch of which nothing is known, from one of its trackers.

It stands for the a priori attitude that was not given, or was wrong: zones,
identities and the solution then come of it the way they always do.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.attitude.solution import NoAttitude
from service.identify.lost_in_space.solver import FieldOfView, LostInSpace
from service.missions.mission import Mission, Tracker
from service.observe.correct import CorrectedObservations
from service.sky.run_catalog import RunCatalog
from service.sky.view import Sky
from service.vectors import ARCSEC_PER_RADIAN, Matrix, Vector

SIGMA_FLOOR_ARCSEC = 1.5
"""No star is taken as better known: a run catalog serves a year, and parallax is left out."""
COLOR_SIGMA_MAG = 0.3
"""What a magnitude is off by beside its noise: colour, and stars that vary."""


@dataclass(frozen=True)
class Found:
    """An attitude (3, 3), inertial to body, or why there is none.

    `bounded`: a search ended at its bound on the work.  `explained` (n,) of every
    tracker marks the stars of the likeliest attitude, also of one that is refused.
    """

    attitude: Matrix | None
    refusal: NoAttitude | None
    bounded: bool
    explained: tuple[npt.NDArray[np.bool_], ...]


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
        result = LostInSpace(index, field).solve(
            each.direction_body @ tracker.body_from_tracker,
            each.magnitude_mag,
            np.maximum(each.sigma_arcsec, SIGMA_FLOOR_ARCSEC) / ARCSEC_PER_RADIAN,
            velocity_c,
        )
        bounded |= result.bounded
        explained[place] = result.star >= 0
        if result.attitude is not None:
            attitude = tracker.body_from_tracker @ result.attitude
            return Found(attitude, None, bounded, tuple(explained))
        refusals.append(result.refusal)
    return Found(None, refusals[0], bounded, tuple(explained))


def field_of(tracker: Tracker) -> FieldOfView:
    """The circle that a tracker sees, and its photometry."""
    return FieldOfView(
        tracker.field_of_view_radius_deg,
        magnitude_sigma_mag=float(np.hypot(tracker.magnitude_sigma_mag, COLOR_SIGMA_MAG)),
    )
