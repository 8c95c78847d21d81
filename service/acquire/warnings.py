"""The warnings of an answer: a code, a colon, and a sentence."""

from collections.abc import Iterable

import numpy as np

from service.acquire.choices import idle_options, impossible_tests
from service.acquire.result import RivalAttitude, TrackerResult
from service.attitude.solution import AttitudeSolution
from service.attitude.solve import taste_bound
from service.identify.identification import MAX_RIVALS
from service.identify.prior_attitude import PriorAttitude
from service.missions.mission import Band, Mission
from service.observations.batch import ObservationBatch
from service.vectors import Matrix, attitude_error_arcsec, separation_deg, unit_of

WORK_BOUND_HIT = "work_bound_hit"
"""The code of the warning that a search ended at its bound on the work."""

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
"""A turn by more about the zone's axis is called one of the roll."""


def warnings_of_batch(batch: ObservationBatch, mission: Mission) -> list[str]:
    """Warnings about the batch itself, whatever was found."""
    off = [
        name for name in impossible_tests(batch, mission) if (batch.options.tests or {}).get(name)
    ]
    warnings = [
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
    return warnings


def warnings_of_attitude(
    solution: AttitudeSolution, mission: Mission, prior: PriorAttitude | None
) -> list[str]:
    """Warnings that an attitude's own residuals, or the a priori knowledge, speak against it."""
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
    """Warnings that nothing was predicted, or that the prediction did not hold."""
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
    """The warning that other stars have an attitude of their own."""
    others = sum(int((star >= 0).sum()) for star in rival.star)
    return (
        f"rival_attitude: {others} stars that this attitude leaves unexplained have one of "
        f"their own, {rival.angle_deg:.3f} deg away, with probability {rival.probability:.3g}"
    )


def warnings_of_trackers(trackers: Iterable[TrackerResult], attitude: Matrix) -> list[str]:
    """Warnings about the identification of each tracker, at the attitude solved for or presumed."""
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
        if each.identification.mirrored:
            warnings.append(
                f"mirrored_field: the stars of {tracker.name} fit better in a mirror: one of its "
                "axes may have the wrong sign, or two are exchanged"
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
