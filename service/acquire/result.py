"""The result of one batch: tracker results, the attitude, a rival, provenance, and warnings."""

import math
from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum
from typing import Literal

import numpy as np
from msgspec import Struct

from service.acquire.choices import Choices, idle_options, impossible_tests
from service.attitude.solution import AttitudeSolution, NoAttitude, taste_bound
from service.identify.identification import (
    MAX_RIVALS,
    Identification,
    Integers,
    Outcome,
    not_known,
    nothing_known,
)
from service.identify.prior_attitude import PriorAttitude
from service.missions.mission import Band, Mission
from service.observations.batch import MeasuredAttitude, ObservationBatch
from service.observations.calibrate import CorrectedObservations
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.ephemeris import LIGHT_KM_PER_S, observer_velocity
from service.sky.zones import SearchRegion
from service.vectors import (
    Matrix,
    Vector,
    attitude_error_arcsec,
    matrix_from_quaternion,
    quaternion_from_matrix,
    read_only,
    separation_deg,
    unit_of,
)

TrackingState = Literal["acquiring", "tracking", "lost"]
"""Tracking states of a batch: found in the whole sky, near a prediction, or lost."""
_COUNTED = [
    (int(each), each.word) for each in (Outcome.UNIQUE, Outcome.AMBIGUOUS, Outcome.UNMATCHED)
]


class Place(Struct, frozen=True, eq=False, gc=False):
    """The region in which a tracker's stars were searched; `cached` if its zone was in the cache.

    `stars` and `pairs` are the numbers within the region, the paper's NCAP and NTOT; the cached
    zone may have more.
    """

    region: SearchRegion
    cached: bool
    stars: int
    pairs: int


class TrackerResult(Struct, frozen=True, eq=False, gc=False):
    """One tracker's part of a result: its search region, identification and residuals.

    `stars`, `pairs` and `zone_cached` are as in `Place`. The region is None if the whole sky gave
    no attitude to search about. `residual_arcsec` is NaN for stars that are not unique and without
    an attitude.
    """

    corrected: CorrectedObservations
    region: SearchRegion | None
    zone_cached: bool
    stars: int
    pairs: int
    identification: Identification
    residual_arcsec: Vector


class Path(StrEnum):
    """The kinds of search that led to a batch's answer."""

    ZONE = "zone"
    LOST_IN_SPACE = "lost_in_space"
    """A search of the whole sky: no a priori attitude was given, or its use was disabled."""
    MEASURED = "measured"
    """No search for stars: a tracker measured the attitude itself."""
    ZONE_THEN_LOST_IN_SPACE = "zone_then_lost_in_space"
    """The a priori attitude gave no good result, and the whole sky was searched."""


class Provenance(Struct, frozen=True, eq=False, gc=False):
    """The catalogs, mission file and program version from which an answer was made."""

    catalog: str
    run_catalog: str
    epoch_year: float
    mission: str
    version: str


class RivalAttitude(Struct, frozen=True, eq=False, gc=False):
    """A second attitude, for a group of stars that the first one leaves unexplained.

    `star` (n,) has, for every tracker, rows of the run catalog, -1 for stars outside of the group.
    `probability` is that of this attitude against the first; `angle_deg` is the rotation between
    the two.
    """

    solution: AttitudeSolution
    star: tuple[Integers, ...]
    probability: float
    angle_deg: float


class Acquisition(Struct, frozen=True, eq=False, gc=False):
    """The result of acquiring one batch.

    `solution` is None if `reason` is set; it is never an older attitude. With a `rival`, the stars
    that the solution leaves unexplained have a different attitude, and the solution is suspect.
    `prior` is the batch's a priori attitude, None without any. `counts` has the numbers of stars
    observed, unique, ambiguous and unmatched.
    """

    batch: ObservationBatch
    mission: Mission
    choices: Choices
    prior: PriorAttitude | None
    path: Path
    run_catalog: RunCatalog
    trackers: tuple[TrackerResult, ...]
    counts: dict[str, int]
    solution: AttitudeSolution | None
    rival: RivalAttitude | None
    reason: NoAttitude | None
    warnings: tuple[str, ...]
    timings_us: Mapping[str, int]
    provenance: Provenance

    @property
    def tracking_state(self) -> TrackingState | None:
        """The tracking state after a batch, None unless the batch asks for the last attitude.

        A batch without an attitude counts as tracking if the prediction identified one of its
        stars.
        """
        if self.batch.tracking is None:
            return None
        if self.solution is None:
            is_tracked = self.path is Path.ZONE and self.counts[Outcome.UNIQUE.word] > 0
            return "tracking" if is_tracked else "lost"
        if self.solution.suspect:
            return "lost"
        return "tracking" if self.path is Path.ZONE else "acquiring"


def tracker_results(
    corrected: Sequence[CorrectedObservations],
    places: Sequence[Place],
    identifications: Sequence[Identification],
    solution: AttitudeSolution | None,
) -> tuple[TrackerResult, ...]:
    """The results of trackers from their zones, identifications and the solution's residuals."""
    results = []
    first = 0
    for each, place, identification in zip(corrected, places, identifications, strict=True):
        n = len(each.magnitude_mag)
        residual = not_known(n) if solution is None else solution.residual_arcsec[first : first + n]
        first += n
        where = place.region, place.cached, place.stars, place.pairs
        results.append(TrackerResult(each, *where, identification, residual))
    return tuple(results)


def unmatched_results(corrected: Sequence[CorrectedObservations]) -> tuple[TrackerResult, ...]:
    """The results of trackers whose stars could not be searched for: all unmatched."""
    counts = [len(each.magnitude_mag) for each in corrected]
    return tuple(
        TrackerResult(each, None, False, 0, 0, nothing_known(n), not_known(n))
        for each, n in zip(corrected, counts, strict=True)
    )


def outcome_counts(trackers: Sequence[TrackerResult]) -> dict[str, int]:
    """The number of observed stars, and of each outcome by its word."""
    found = [outcome for each in trackers for outcome in each.identification.outcome.tolist()]
    counts = {"observed": len(found)}
    for number, word in _COUNTED:
        counts[word] = found.count(number)
    return counts


METHOD = "measured"
_UNKNOWN = np.nan


def measured_solution(measured: MeasuredAttitude, mission: Mission) -> AttitudeSolution:
    """The body's attitude measured by a tracker itself, with its covariance about the body axes.

    With the alignment body = B @ tracker it is B A, and the covariance B P B^T. Residuals and the
    values derived from them are NaN. Raises `BadInput` naming the field for a tracker unknown to
    the mission.
    """
    attitude = matrix_from_quaternion(measured.quaternion)
    covariance = measured.covariance_arcsec2
    if measured.tracker is not None:
        turn = mission.tracker(measured.tracker, "measurement.tracker").body_from_tracker
        attitude, covariance = turn @ attitude, turn @ covariance @ turn.T
        covariance = 0.5 * (covariance + covariance.T)
    return AttitudeSolution(
        quaternion=read_only(quaternion_from_matrix(attitude)),
        matrix=read_only(attitude),
        method=METHOD,
        covariance_arcsec2=read_only(covariance),
        residual_arcsec=np.empty(0),
        residual_rms_arcsec=_UNKNOWN,
        predicted_rms_arcsec=_UNKNOWN,
        taste=_UNKNOWN,
        degrees_of_freedom=0,
        suspect=False,
        triad=np.full(4, _UNKNOWN),
        quest=np.full(4, _UNKNOWN),
        triad_quest_angle_arcsec=_UNKNOWN,
        trackers=(),
    )


# ---- warnings of an answer: a code, a colon, and a sentence -----------------------------------

WORK_BOUND_HIT = "work_bound_hit"
"""The code of the warning that a search ended at its work limit."""

PREDICTION_CONTRADICTED = (
    "prediction_contradicted: the attitude found about the predicted one lies too far from it "
    "and is not used"
)
NO_PREDICTION = {
    "no_good_attitude": "no good attitude was recorded in the time before",
    "too_uncertain": "the attitude may have changed too much since the last good one",
    "flip": "the mission declares a flip since the last good attitude",
}
NEAR_AXIS_COS = 0.9998
FLIP_DEG = 5.0
"""Least rotation in degrees about the zone's axis that is called a roll in warnings."""


def warnings_of_batch(batch: ObservationBatch, mission: Mission) -> list[str]:
    """Warnings about the batch itself: its remarks, and options without effect."""
    warnings, options = list(batch.remarks), batch.options
    if options.tests or options.tolerances:
        off = [name for name in impossible_tests(batch, mission) if options.tests.get(name)]
        warnings += [
            f"test_off: {name} was asked for and cannot be made of this a priori knowledge"
            for name in off
        ]
        warnings += [
            f"option_idle: {name} {reason}"
            for name, reason in idle_options(batch, mission).items()
            if name.removeprefix("tests.") not in off
        ]
    if batch.aberration == "to_correct" and batch.velocity_km_per_s is None:
        warnings.append(
            "velocity_of_earth_alone: no velocity_km_per_s was given; "
            "aberration was corrected for Earth's motion only"
        )
    return warnings + _of_velocity(batch)


EARTH_KM_PER_S, NEAR_EARTHS_KM_PER_S = (17.0, 45.0), 12.0
"""Speeds that include that of the Earth with an orbit about it, and the most of such an orbit."""


def _of_velocity(batch: ObservationBatch) -> list[str]:
    """The warning that a geocentric velocity is one about the Sun, of a spacecraft near the Earth.

    Then it holds the velocity of the Earth, which aberration would count twice.
    """
    velocity = batch.velocity_km_per_s
    if batch.aberration != "to_correct" or velocity is None:
        return []
    speed = math.hypot(*velocity.tolist())
    if not EARTH_KM_PER_S[0] < speed < EARTH_KM_PER_S[1]:
        return []
    off = velocity - observer_velocity(batch.time, None) * LIGHT_KM_PER_S
    off_km_per_s = math.hypot(*off.tolist())
    if off_km_per_s > NEAR_EARTHS_KM_PER_S:
        return []
    warning = (
        f"velocity_about_sun: velocity_km_per_s is {speed:.1f} km/s, and only {off_km_per_s:.1f} "
        "km/s from the Earth's about the Sun; it must be relative to the Earth, whose motion is "
        "counted twice otherwise"
    )
    return [warning]


def warnings_of_attitude(
    solution: AttitudeSolution, mission: Mission, prior: PriorAttitude | None
) -> list[str]:
    """Warnings that an attitude contradicts its own residuals or the a priori knowledge."""
    warnings = []
    if solution.taste > taste_bound(solution.degrees_of_freedom):
        warnings.append(
            f"attitude_suspect: residuals of {solution.residual_rms_arcsec:.1f} arcsec rms "
            f"where {solution.predicted_rms_arcsec:.1f} are expected: a star is misidentified "
            "or noisier than its sigma"
        )
    if prior is None:
        return warnings
    zone = mission.zone
    off_deg = separation_deg(np.dot(prior.axis_body(mission), solution.matrix), prior.axis)
    if off_deg > (zone.half_width_deg if isinstance(zone, Band) else zone.radius_deg):
        warnings.append(
            f"attitude_off_a_priori: its {'pole' if isinstance(zone, Band) else 'boresight'} lies "
            f"{off_deg:.1f} deg from where the a priori knowledge has it"
        )
    return warnings


def warnings_of_tracking(
    batch: ObservationBatch,
    mission: Mission,
    solution: AttitudeSolution | None,
    prior: PriorAttitude | None,
    is_in_zone: bool,
) -> list[str]:
    """Warnings that no attitude was predicted, or that the prediction was wrong."""
    tracking = batch.tracking
    if tracking is not None and tracking.reason is not None:
        return [f"not_tracked: {NO_PREDICTION[tracking.reason]}"]
    if prior is None or prior.predicted is None or is_in_zone:
        return []
    if solution is None or solution.suspect:
        return ["prediction_failed: no good attitude was found about the predicted one"]
    apart = attitude_error_arcsec(solution.matrix, prior.attitude) / 3600.0
    angle_deg = float(np.linalg.norm(apart))
    axis = unit_of(apart) if angle_deg > 0.0 else apart
    is_roll = abs(float(axis @ mission.axis_body)) > NEAR_AXIS_COS and angle_deg > FLIP_DEG
    x, y, z = axis.tolist()
    how = "rolled" if is_roll else "turned"
    warning = (
        f"prediction_failed: the attitude is {how} by {angle_deg:.3f} deg from the predicted one, "
        f"about ({x:.3f}, {y:.3f}, {z:.3f})"
    )
    return [warning]


def warning_of_rival(rival: RivalAttitude) -> str:
    """The warning that other stars have a different attitude."""
    others = sum(int((star >= 0).sum()) for star in rival.star)
    return (
        f"rival_attitude: {others} stars that this attitude leaves unexplained have one of "
        f"their own, {rival.angle_deg:.3f} deg away, with probability {rival.probability:.3g}"
    )


FEWEST_IN_A_MIRROR = 4
"""Least number of stars whose better fit in a mirror is no chance; three fit one at times."""


def is_mirrored(identification: Identification) -> bool:
    """True if the mirror image of a tracker's stars fits the sky better, beyond chance."""
    return identification.mirrored and len(identification.outcome) >= FEWEST_IN_A_MIRROR


def warnings_of_trackers(trackers: Iterable[TrackerResult], attitude: Matrix) -> list[str]:
    """Warnings about each tracker's identification, at the solved or presumed attitude."""
    warnings = []
    for each in trackers:
        tracker, region = each.corrected.tracker, each.region
        if region is not None and region.reaches_past(
            np.dot(tracker.boresight_body, attitude), tracker.field_of_view_radius_deg
        ):
            warnings.append(
                f"field_of_view_past_zone_edge: the field of view of {tracker.name} reaches past "
                "the edge of its zone; stars beyond it cannot be identified"
            )
        if is_mirrored(each.identification):
            warnings.append(
                f"mirrored_field: the stars of {tracker.name} fit better in a mirror; if every "
                "batch says so, one of its axes has the wrong sign, or two are exchanged"
            )
        if each.identification.bounded:
            warnings.append(
                f"{WORK_BOUND_HIT}: the search for the stars of {tracker.name} ended at its bound"
            )
        if each.identification.rivals_cut:
            warnings.append(
                f"rivals_cut: lists of rivals of {tracker.name} end at {MAX_RIVALS}; "
                f"stars with more rivals: {each.identification.rivals_cut}"
            )
        stars = [row for row in each.identification.star.tolist() if row >= 0]
        if len(set(stars)) < len(stars):
            warnings.append(f"same_star_twice: two stars of {tracker.name} have one identity")
    return warnings
